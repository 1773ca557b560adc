"""SDO server (CiA 301, 7.2.4.3): expedited, segmented and block transfers in both directions, without I/O."""

import struct
from typing import Final

from drivers.frame import Frame
from drivers.sdo import SDO_RESPONSE_BASE, AbortCode, ClientCommand, ServerCommand
from drivers.sdo_block import (
    ABORT_COMMAND,
    BLOCK_SIZE_INDICATED,
    CRC_SUPPORTED,
    MAX_BLOCK_SIZE,
    BlockSubcommand,
    is_block_size,
)
from sim_drive.communication.dictionary import Entry, LiveDictionary, check_size, read_bytes, write_bytes
from sim_drive.communication.sdo_block import BlockDownload, BlockUpload, is_initiate

SDO_LENGTH: Final = 8
"""Every SDO frame has 8 data bytes; one with fewer is not an SDO frame and stays unanswered."""

_MULTIPLEXED: Final = struct.Struct("<BHBI")
_EXPEDITED: Final = 0x02
_SIZE_INDICATED: Final = 0x01
_TOGGLE: Final = 0x10
_LAST_SEGMENT: Final = 0x01
_SEGMENT_BYTES: Final = 7
_EXPEDITED_BYTES: Final = 4
_BLOCK_DOWNLOAD_ENDED: Final = bytes((ServerCommand.BLOCK_DOWNLOAD << 5 | BlockSubcommand.END, 0, 0, 0, 0, 0, 0, 0))


class SdoServer:
    """Answers one client at a time; a new initiate replaces whatever was going on.

    Within the sub-blocks of a block download every frame but an abort is a segment, so that nothing else can replace
    it. If a client falls silent in the midst of a sub-block for half of the time-out, its end has been lost: the server
    then acknowledges what it has, and the client goes on from there.
    """

    __slots__ = (
        "_block_download",
        "_block_size",
        "_block_upload",
        "_buffer",
        "_cob_id",
        "_deadline_ns",
        "_dictionary",
        "_download",
        "_expected_size",
        "_index",
        "_outbox",
        "_position",
        "_resume_ns",
        "_subindex",
        "_timeout_ns",
        "_toggle",
        "_upload",
    )

    def __init__(
        self,
        node_id: int,
        dictionary: LiveDictionary,
        outbox: list[Frame],
        timeout_ns: int,
        block_size: int = MAX_BLOCK_SIZE,
    ) -> None:
        """Make a server that is free.

        ``timeout_ns``: how long a client may pause within a transfer before it is aborted; ``block_size``: how many
        segments a sub-block of a download has. Raises ValueError if ``block_size`` is not 1 to 127.
        """
        if not is_block_size(block_size):
            raise ValueError(f"block_size must be 1 to {MAX_BLOCK_SIZE}, not {block_size}")
        self._cob_id = SDO_RESPONSE_BASE + node_id
        self._dictionary = dictionary
        self._outbox = outbox
        self._timeout_ns = timeout_ns
        self._block_size = block_size
        self._deadline_ns: int | None = None
        self._resume_ns: int | None = None
        """When a client that is silent within a sub-block is helped on."""
        self._block_download: BlockDownload | None = None
        self._block_upload: BlockUpload | None = None
        self._download: Entry | None = None
        self._upload: bytes | None = None
        self._buffer = bytearray()
        self._expected_size: int | None = None
        self._position = 0
        self._toggle = 0
        self._index = 0
        self._subindex = 0

    def set_node_id(self, node_id: int) -> None:
        """Serve under another node id; a transfer under way is forgotten."""
        self._cob_id = SDO_RESPONSE_BASE + node_id
        self.reset()

    @property
    def is_busy(self) -> bool:
        """Whether a transfer is under way that takes more than one request."""
        return self._deadline_ns is not None

    def reset(self) -> None:
        """Forget the transfer under way without a word."""
        self._download = None
        self._upload = None
        self._block_download = None
        self._block_upload = None
        self._buffer = bytearray()
        self._deadline_ns = None
        self._resume_ns = None

    def next_wake_ns(self) -> int | None:
        """When the transfer under way times out, or is to be helped on."""
        return self._deadline_ns if self._resume_ns is None else self._resume_ns

    def wake(self, now_ns: int) -> None:
        """Abort a transfer whose client has been silent for too long."""
        if self._deadline_ns is not None and now_ns >= self._deadline_ns:
            self._abort(AbortCode.PROTOCOL_TIMED_OUT)
        elif self._resume_ns is not None and now_ns >= self._resume_ns:
            self._resume_ns = None
            response = self._block_download.resume() if self._block_download else None
            if response is not None:
                self._send(response)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take a request's data bytes."""
        if len(data) != SDO_LENGTH:
            return
        if self._block_download is not None and self._goes_to_block(self._block_download, data, now_ns):
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
        elif specifier == ClientCommand.BLOCK_DOWNLOAD:
            self._take_block_download(data, now_ns)
        elif specifier == ClientCommand.BLOCK_UPLOAD:
            self._take_block_upload(data, now_ns)
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
        self._give(value, now_ns)

    def _give(self, value: bytes, now_ns: int) -> None:
        """Answer the initiate of an ordinary upload."""
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

    def _goes_to_block(self, transfer: BlockDownload, data: bytes, now_ns: int) -> bool:
        """Give the frame to the block download under way, if it is one of its segments; whether it is."""
        if transfer.is_ending:
            # A last segment that comes twice looks like an abort to whoever does not know it.
            return transfer.is_repetition(data)
        if data[0] == ABORT_COMMAND:
            return False
        outcome = transfer.take_segment(data)
        if isinstance(outcome, AbortCode):
            self._abort(outcome)
            return True
        self._deadline_ns = now_ns + self._timeout_ns
        self._resume_ns = now_ns + self._timeout_ns // 2
        if outcome is not None:
            self._resume_ns = None
            self._send(outcome)
        return True

    def _take_block_download(self, data: bytes, now_ns: int) -> None:
        if is_initiate(data[0]):
            self._initiate_block_download(data, now_ns)
            return
        transfer = self._block_download
        outcome = AbortCode.COMMAND_SPECIFIER_UNKNOWN if transfer is None else transfer.finish(data)
        if transfer is not None and not isinstance(outcome, AbortCode):
            refusal = write_bytes(transfer.entry, outcome, now_ns)
            if refusal is None:
                self.reset()
                self._send(_BLOCK_DOWNLOAD_ENDED)
                return
            outcome = refusal
        if isinstance(outcome, AbortCode):
            self._abort(outcome)

    def _initiate_block_download(self, data: bytes, now_ns: int) -> None:
        self._begin(data)
        size = int.from_bytes(data[4:8], "little") if data[0] & BLOCK_SIZE_INDICATED else None
        entry = self._dictionary.find_writable(self._index, self._subindex, size)
        if not isinstance(entry, Entry):
            self._abort(entry)
            return
        self._block_download = BlockDownload(entry, size, bool(data[0] & CRC_SUPPORTED), self._block_size)
        self._deadline_ns = now_ns + self._timeout_ns
        self._respond(ServerCommand.BLOCK_DOWNLOAD << 5 | data[0] & CRC_SUPPORTED, self._block_size)

    def _take_block_upload(self, data: bytes, now_ns: int) -> None:
        if is_initiate(data[0]):
            self._initiate_block_upload(data, now_ns)
            return
        transfer = self._block_upload
        outcome = AbortCode.COMMAND_SPECIFIER_UNKNOWN if transfer is None else transfer.take(data)
        if isinstance(outcome, AbortCode):
            self._abort(outcome)
            return
        for payload in outcome:
            self._send(payload)
        if outcome:
            self._deadline_ns = now_ns + self._timeout_ns
        else:
            self.reset()

    def _initiate_block_upload(self, data: bytes, now_ns: int) -> None:
        self._begin(data)
        block_size, protocol_switch_threshold = data[4], data[5]
        entry = self._dictionary.find_readable(self._index, self._subindex)
        value = read_bytes(entry, now_ns) if isinstance(entry, Entry) else entry
        if not isinstance(value, AbortCode) and not is_block_size(block_size):
            value = AbortCode.INVALID_BLOCK_SIZE
        if isinstance(value, AbortCode):
            self._abort(value)
        elif len(value) <= protocol_switch_threshold:
            self._give(value, now_ns)
        else:
            self._block_upload = BlockUpload(value, bool(data[0] & CRC_SUPPORTED), block_size)
            self._deadline_ns = now_ns + self._timeout_ns
            # CRC is told to be there only if it will be: some clients check it although they have not asked for it.
            command = ServerCommand.BLOCK_UPLOAD << 5 | data[0] & CRC_SUPPORTED | BLOCK_SIZE_INDICATED
            self._respond(command, len(value))

    # -- responses -----------------------------------------------------------------------------------------------

    def _abort(self, code: AbortCode) -> None:
        """Send an abort for the transfer under way (or the last one), and be free for the next."""
        self.reset()
        self._respond(ServerCommand.ABORT << 5, code)

    def _respond(self, command: int, word: int) -> None:
        self._send(_MULTIPLEXED.pack(command, self._index, self._subindex, word))

    def _send(self, payload: bytes) -> None:
        self._outbox.append(Frame(self._cob_id, payload))
