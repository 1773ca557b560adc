"""EMCY producer (CiA 301, 7.2.7) with the error register 1001h and the pre-defined error field 1003h.

A node has one of each; the error code 603Fh is each logical axis' own.
"""

import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag, unique
from typing import Final

from drivers.frame import Frame
from drivers.node import Event
from drivers.objects import COB_ID_EMCY, ERROR_REGISTER, INHIBIT_TIME_EMCY, PREDEFINED_ERROR_FIELD
from drivers.pdo import PDO_COB_ID_INVALID
from drivers.sdo import AbortCode
from sim_drive.communication.cob_ids import COB_ID_MASK, is_refused
from sim_drive.communication.dictionary import Entry, LiveDictionary

ERROR_HISTORY_LENGTH: Final = 8
"""Errors that 1003h remembers."""

_EMCY: Final = struct.Struct("<HB5s")
_INHIBIT_UNIT_NS: Final = 100_000
_MAX_HELD_BACK: Final = 16
"""EMCY frames that wait for the inhibit time to pass; the oldest give way to more."""
NODE: Final = 0
"""In place of an axis: the error is the node's, and so every axis'."""


@unique
class EmergencyCode(IntEnum):
    """Emergency error codes that the drive raises by itself (CiA 301, table 26; CiA 402-1; FF00h: our own)."""

    NO_ERROR = 0x0000
    PARAMETERS_LOST = 0x6310
    """What was stored by 1010h cannot be used, and the drive has its default values."""
    COMMUNICATION = 0x8100
    """The NMT master has stopped the node, or reset its communication, while the axis was enabled."""
    HEARTBEAT = 0x8130
    PDO_TOO_SHORT = 0x8210
    PDO_TOO_LONG = 0x8220
    SYNC_LENGTH = 0x8240
    RPDO_TIMEOUT = 0x8250
    FOLLOWING_ERROR = 0x8611
    SYNC_CONTROLLER = 0x8700
    """Set-points have failed to come for too many SYNC periods."""
    CAM_NOT_VALID = 0xFF20
    """Camming was asked for without a valid table in the selected slot."""
    CAM_JUMP = 0xFF21
    """Engaging the cam would make the axis jump."""
    INTERPOLATION_UNDERFLOW = 0xFF22
    """The buffer of the interpolated position mode has run empty in motion."""


class ErrorRegister(IntFlag):
    """Bits of 1001h (CiA 301, table 39)."""

    NONE = 0
    GENERIC = 0x01
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    DEVICE_PROFILE = 0x20
    MANUFACTURER = 0x80


@dataclass(frozen=True, slots=True)
class EmergencyRaised(Event):
    """The drive has noticed an error, or (code 0) lost the last one."""

    node_id: int
    code: int
    register: int
    axis: int = NODE
    """In a node of several axes: the number of the one that has the error."""


@dataclass(slots=True)
class _ActiveError:
    register: int
    is_fault: bool
    persists: bool


class EmergencyProducer:
    """Knows which errors are active, and tells of every change.

    In a node of several axes an error is the node's, or that of one axis, whose number is then the first of the EMCY's
    vendor-specific bytes. ``of_axis`` is an axis' share in it.
    """

    __slots__ = (
        "_active",
        "_cob_id",
        "_codes",
        "_events",
        "_free_at_ns",
        "_held_back",
        "_history",
        "_inhibit_time",
        "_is_silent",
        "_node_id",
        "_outbox",
        "_register",
        "has_errors",
        "on_held_back",
    )

    def __init__(
        self,
        node_id: int,
        dictionary: LiveDictionary,
        outbox: list[Frame],
        events: list[Event],
        codes: Sequence[Entry],
    ) -> None:
        """``codes``: the error code 603Fh of each axis."""
        self._node_id = node_id
        self._outbox = outbox
        self._events = events
        self._active: dict[tuple[int, int], _ActiveError] = {}
        """By code and axis, oldest first."""
        self._register = dictionary.entry(ERROR_REGISTER)
        self._codes = tuple(codes)
        self._cob_id = dictionary.entry(COB_ID_EMCY)
        self._cob_id.on_write = self._on_cob_id
        self._history = [dictionary.entry(PREDEFINED_ERROR_FIELD, n) for n in range(ERROR_HISTORY_LENGTH + 1)]
        self._history[0].on_write = self._on_history_cleared
        for number, entry in enumerate(self._history[1:], start=1):
            entry.on_read = self._history_reader(number, entry)
        self._inhibit_time = dictionary.entry(INHIBIT_TIME_EMCY)
        self._held_back: deque[Frame] = deque(maxlen=_MAX_HELD_BACK)
        self._free_at_ns = 0
        self._is_silent = True
        self.has_errors = False
        """Whether any error is active."""
        self.on_held_back: Callable[[], None] = _no_matter
        """Called when ``next_wake_ns`` may have become earlier."""

    @property
    def is_silent(self) -> bool:
        """No EMCY is sent, as before the boot-up and in NMT state stopped; errors are still remembered."""
        return self._is_silent

    @is_silent.setter
    def is_silent(self, is_silent: bool) -> None:
        self._is_silent = is_silent
        if is_silent:
            self._held_back.clear()

    def next_wake_ns(self) -> int | None:
        """When the inhibit time lets the next EMCY go."""
        return self._free_at_ns if self._held_back else None

    def wake(self, now_ns: int) -> None:
        """Send what the inhibit time has let go."""
        if self._held_back and now_ns >= self._free_at_ns:
            self._outbox.append(self._held_back.popleft())
            self._free_at_ns = now_ns + self._inhibit_time.value * _INHIBIT_UNIT_NS

    def set_node_id(self, node_id: int) -> None:
        """Events tell another node id from now on; the COB-ID is 1014h's."""
        self._node_id = node_id

    def of_axis(self, number: int) -> "AxisErrors":
        """The errors of axis ``number`` (from 1)."""
        return AxisErrors(self, NODE if len(self._codes) == 1 else number)

    def has_persisting_fault(self, axis: int) -> bool:
        """Whether the cause of an error of an axis or of the node is still there: a fault reset has to be refused."""
        return any(error.persists for (_, other), error in self._active.items() if other in (NODE, axis))

    def is_active(self, code: int) -> bool:
        """Whether this error has been raised and not cleared."""
        return any(code == active for active, _ in self._active)

    def restore(self) -> None:
        """Bring 1001h and 603Fh up to date after the dictionary's defaults were restored."""
        self._free_at_ns = 0
        self._register.value = self._combined_register()
        for axis, entry in self._code_entries(NODE):
            own = (code for code, other in reversed(self._active) if axis == NODE or other in (NODE, axis))
            entry.value = next(own, int(EmergencyCode.NO_ERROR))

    def forget(self) -> None:
        """Lose all errors without a word, save those whose cause persists."""
        self._active = {key: error for key, error in self._active.items() if error.persists}
        self.restore()

    def _code_entries(self, axis: int) -> list[tuple[int, Entry]]:
        """The error codes 603Fh that an error of ``axis`` shows in, each with its axis as errors name it."""
        if len(self._codes) == 1:
            return [(NODE, self._codes[0])]
        return [(number, entry) for number, entry in enumerate(self._codes, start=1) if axis in (NODE, number)]

    def raise_error(
        self, code: int, register: int, now_ns: int, *, is_fault: bool, persists: bool, axis: int = NODE
    ) -> None:
        """Note an error and tell of it, unless it is active already.

        ``is_fault``: it stays active until a fault reset. ``persists``: its cause stays until ``end_cause``.
        """
        known = self._active.get((code, axis))
        if known is not None:
            known.is_fault = known.is_fault or is_fault
            known.persists = persists
            return
        # Plain integers from here on: enums have names for some values, and a log is to show the same for all.
        code = int(code)
        self._active[code, axis] = _ActiveError(int(register | ErrorRegister.GENERIC), is_fault, persists)
        for _, entry in self._code_entries(axis):
            entry.value = code
        history = self._history
        for place in range(ERROR_HISTORY_LENGTH, 1, -1):
            history[place].value = history[place - 1].value
        history[1].value = code
        history[0].value = min(history[0].value + 1, ERROR_HISTORY_LENGTH)
        self._tell(code, now_ns, axis)

    def end_cause(self, code: int, now_ns: int, axis: int | None = None) -> None:
        """The cause of an error has gone: the error is over, unless it has led to a fault that is still to be reset.

        ``axis``: whose error it is; None: everybody's.
        """
        for key in [key for key in self._active if key[0] == code and (axis is None or key[1] == axis)]:
            error = self._active[key]
            error.persists = False
            if not error.is_fault:
                del self._active[key]
                self._tell_recovery(now_ns)

    def reset_fault(self, axis: int, now_ns: int) -> None:
        """Clear every error of an axis and of the node (there must be none that persists), as a fault reset does."""
        cleared = [key for key in self._active if key[1] in (NODE, axis)]
        for key in cleared:
            del self._active[key]
        if cleared:
            self._tell_recovery(now_ns)
        for _, entry in self._code_entries(axis):
            entry.value = int(EmergencyCode.NO_ERROR)

    def _combined_register(self) -> int:
        self.has_errors = bool(self._active)
        register = 0
        for error in self._active.values():
            register |= error.register
        return register

    def _tell_recovery(self, now_ns: int) -> None:
        if self._active:
            self._register.value = self._combined_register()
        else:
            self._tell(int(EmergencyCode.NO_ERROR), now_ns, NODE)

    def _tell(self, code: int, now_ns: int, axis: int) -> None:
        register = self._combined_register()
        self._register.value = register
        self._events.append(EmergencyRaised(now_ns, self._node_id, code, register, axis))
        cob_id = self._cob_id.value
        if self._is_silent or cob_id & PDO_COB_ID_INVALID:
            return
        frame = Frame(cob_id & COB_ID_MASK, _EMCY.pack(code, register, bytes((axis,))))
        if now_ns < self._free_at_ns or self._held_back:
            self._held_back.append(frame)
            self.on_held_back()
        else:
            self._outbox.append(frame)
            self._free_at_ns = now_ns + self._inhibit_time.value * _INHIBIT_UNIT_NS

    def _on_cob_id(self, value: int, now_ns: int) -> AbortCode | None:
        # Bit 31 says that the object does not exist; turned round, that it does.
        exists = value ^ PDO_COB_ID_INVALID
        if is_refused(exists, self._cob_id.value ^ PDO_COB_ID_INVALID, PDO_COB_ID_INVALID):
            return AbortCode.VALUE_RANGE_EXCEEDED
        return None

    def _on_history_cleared(self, value: int, now_ns: int) -> AbortCode | None:
        if value:
            return AbortCode.VALUE_RANGE_EXCEEDED
        for entry in self._history[1:]:
            entry.value = 0
        return None

    def _history_reader(self, number: int, entry: Entry):
        def read(now_ns: int) -> int:
            return entry.value if number <= self._history[0].value else AbortCode.NO_DATA_AVAILABLE

        return read


class AxisErrors:
    """The errors of one axis; its only one in most nodes, whose errors are then the node's."""

    __slots__ = ("_number", "_producer")

    def __init__(self, producer: EmergencyProducer, number: int) -> None:
        self._producer = producer
        self._number = number

    @property
    def has_persisting_fault(self) -> bool:
        """Whether the cause of an error is still there, so that a fault reset has to be refused."""
        return self._producer.has_persisting_fault(self._number)

    def raise_error(self, code: int, register: int, now_ns: int, *, is_fault: bool, persists: bool) -> None:
        """See EmergencyProducer."""
        self._producer.raise_error(code, register, now_ns, is_fault=is_fault, persists=persists, axis=self._number)

    def end_cause(self, code: int, now_ns: int) -> None:
        """See EmergencyProducer."""
        self._producer.end_cause(code, now_ns, self._number)

    def reset_fault(self, now_ns: int) -> None:
        """See EmergencyProducer."""
        self._producer.reset_fault(self._number, now_ns)


def _no_matter() -> None:
    pass
