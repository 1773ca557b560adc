"""SDO server (CiA 301, 7.2.4.3): expedited and segmented transfers in both directions, without I/O."""

import struct
from typing import Final

from drivers.frame import Frame
from drivers.sdo import SDO_RESPONSE_BASE, AbortCode, ClientCommand, ServerCommand
from sim_drive.dictionary import Entry, LiveDictionary, check_size, read_bytes, write_bytes

SDO_LENGTH: Final = 8
"""Every SDO frame has 8 data bytes; one with fewer is not an SDO frame and stays unanswered."""

_MULTIPLEXED: Final = struct.Struct("<BHBI")
_EXPEDITED: Final = 0x02
_SIZE_INDICATED: Final = 0x01
_TOGGLE: Final = 0x10
_LAST_SEGMENT: Final = 0x01
_SEGMENT_BYTES: Final = 7
_EXPEDITED_BYTES: Final = 4


class SdoServer:
    """Answers one client at a time; a new initiate replaces whatever was going on."""

    __slots__ = (
        "_buffer",
        "_cob_id",
        "_deadline_ns",
        "_dictionary",
        "_download",
        "_expected_size",
        "_index",
        "_outbox",
        "_position",
        "_subindex",
        "_timeout_ns",
        "_toggle",
        "_upload",
    )

    def __init__(self, node_id: int, dictionary: LiveDictionary, outbox: list[Frame], timeout_ns: int) -> None:
        """``timeout_ns``: how long a client may pause within a segmented transfer before it is aborted."""
        self._cob_id = SDO_RESPONSE_BASE + node_id
        self._dictionary = dictionary
        self._outbox = outbox
        self._timeout_ns = timeout_ns
        self._deadline_ns: int | None = None
        self._download: Entry | None = None
        self._upload: bytes | None = None
        self._buffer = bytearray()
        self._expected_size: int | None = None
        self._position = 0
        self._toggle = 0
        self._index = 0
        self._subindex = 0

    @property
    def is_busy(self) -> bool:
        """Whether a segmented transfer is under way."""
        return self._deadline_ns is not None

    def reset(self) -> None:
        """Forget the transfer under way without a word."""
        self._download = None
        self._upload = None
        self._buffer = bytearray()
        self._deadline_ns = None

    def next_wake_ns(self) -> int | None:
        """When the transfer under way times out."""
        return self._deadline_ns

    def wake(self, now_ns: int) -> None:
        """Abort a transfer whose client has been silent for too long."""
        if self._deadline_ns is not None and now_ns >= self._deadline_ns:
            self._abort(AbortCode.PROTOCOL_TIMED_OUT)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take a request's data bytes."""
        if len(data) != SDO_LENGTH:
            return
        specifier = data[0] >> 5
        if specifier == ClientCommand.ABORT:
            self.reset()
        elif specifier == ClientCommand.INITIATE_DOWNLOAD:
            self._initiate_download(data, now_ns)
        elif specifier == ClientCommand.INITIATE_UPLOAD:
            self._initiate_upload(data, now_ns)
        elif specifier == ClientCommand.DOWNLOAD_SEGMENT:
            self._take_segment(data, now_ns)
        elif specifier == ClientCommand.UPLOAD_SEGMENT:
            self._give_segment(data, now_ns)
        elif specifier in {ClientCommand.BLOCK_UPLOAD, ClientCommand.BLOCK_DOWNLOAD}:
            self._refuse_block_transfer(data)
        else:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN)

    # -- download ------------------------------------------------------------------------------------------------

    def _begin(self, data: bytes) -> None:
        self.reset()
        self._index = data[1] | data[2] << 8
        self._subindex = data[3]

    def _initiate_download(self, data: bytes, now_ns: int) -> None:
        self._begin(data)
        command = data[0]
        is_expedited = bool(command & _EXPEDITED)
        size: int | None = None
        if command & _SIZE_INDICATED:
            size = _EXPEDITED_BYTES - (command >> 2 & 3) if is_expedited else int.from_bytes(data[4:8], "little")
        entry = self._dictionary.find_writable(self._index, self._subindex, size)
        if not isinstance(entry, Entry):
            self._abort(entry)
            return
        if not is_expedited:
            self._download = entry
            self._expected_size = size
            self._toggle = 0
            self._deadline_ns = now_ns + self._timeout_ns
        else:
            # Without a size the object's own length counts (e = 1, s = 0).
            used = size if size is not None else entry.size if entry.size is not None else _EXPEDITED_BYTES
            if used > _EXPEDITED_BYTES:
                self._abort(AbortCode.LENGTH_TOO_LOW)
                return
            refusal = write_bytes(entry, data[4 : 4 + used], now_ns)
            if refusal is not None:
                self._abort(refusal)
                return
        self._respond(ServerCommand.INITIATE_DOWNLOAD << 5, 0)

    def _take_segment(self, data: bytes, now_ns: int) -> None:
        entry = self._download
        if entry is None:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN)
            return
        command = data[0]
        if command & _TOGGLE != self._toggle:
            self._abort(AbortCode.TOGGLE_BIT_NOT_ALTERNATED)
            return
        self._buffer += data[1 : 8 - (command >> 1 & 7)]
        refusal = self._check_progress(entry, is_last=bool(command & _LAST_SEGMENT))
        if refusal is None and command & _LAST_SEGMENT:
            refusal = write_bytes(entry, bytes(self._buffer), now_ns)
        if refusal is not None:
            self._abort(refusal)
            return
        self._send(bytes((ServerCommand.DOWNLOAD_SEGMENT << 5 | self._toggle, 0, 0, 0, 0, 0, 0, 0)))
        self._toggle ^= _TOGGLE
        if command & _LAST_SEGMENT:
            self.reset()
        else:
            self._deadline_ns = now_ns + self._timeout_ns

    def _check_progress(self, entry: Entry, is_last: bool) -> AbortCode | None:
        received = len(self._buffer)
        if self._expected_size is not None:
            if received > self._expected_size:
                return AbortCode.LENGTH_TOO_HIGH
            if is_last and received < self._expected_size:
                return AbortCode.LENGTH_TOO_LOW
        if received > entry.capacity:
            return check_size(entry, received)
        return None

    # -- upload --------------------------------------------------------------------------------------------------

    def _initiate_upload(self, data: bytes, now_ns: int) -> None:
        self._begin(data)
        entry = self._dictionary.find_readable(self._index, self._subindex)
        value = read_bytes(entry, now_ns) if isinstance(entry, Entry) else entry
        if isinstance(value, AbortCode):
            self._abort(value)
            return
        size = len(value)
        if size <= _EXPEDITED_BYTES:
            command = ServerCommand.INITIATE_UPLOAD << 5 | (_EXPEDITED_BYTES - size) << 2 | _EXPEDITED | _SIZE_INDICATED
            self._respond(command, int.from_bytes(value, "little"))
            return
        self._upload = value
        self._position = 0
        self._toggle = 0
        self._deadline_ns = now_ns + self._timeout_ns
        self._respond(ServerCommand.INITIATE_UPLOAD << 5 | _SIZE_INDICATED, size)

    def _give_segment(self, data: bytes, now_ns: int) -> None:
        value = self._upload
        if value is None:
            self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN)
            return
        if data[0] & _TOGGLE != self._toggle:
            self._abort(AbortCode.TOGGLE_BIT_NOT_ALTERNATED)
            return
        segment = value[self._position : self._position + _SEGMENT_BYTES]
        self._position += len(segment)
        is_last = self._position >= len(value)
        command = ServerCommand.UPLOAD_SEGMENT << 5 | self._toggle | (_SEGMENT_BYTES - len(segment)) << 1 | is_last
        self._send(bytes((command,)) + segment.ljust(_SEGMENT_BYTES, b"\0"))
        self._toggle ^= _TOGGLE
        if is_last:
            self.reset()
        else:
            self._deadline_ns = now_ns + self._timeout_ns

    # -- block transfer ------------------------------------------------------------------------------------------

    def _refuse_block_transfer(self, data: bytes) -> None:
        """The one place where block transfer is answered; a client falls back on segments (CiA 301, 7.2.4.3.9)."""
        self._begin(data)
        self._abort(AbortCode.COMMAND_SPECIFIER_UNKNOWN)

    # -- responses -----------------------------------------------------------------------------------------------

    def _abort(self, code: AbortCode) -> None:
        """Send an abort for the transfer under way (or the last one), and be free for the next."""
        self.reset()
        self._respond(ServerCommand.ABORT << 5, code)

    def _respond(self, command: int, word: int) -> None:
        self._send(_MULTIPLEXED.pack(command, self._index, self._subindex, word))

    def _send(self, payload: bytes) -> None:
        self._outbox.append(Frame(self._cob_id, payload))
