"""The drive's RPDOs (CiA 301, 7.2.2.5): their data act at once, or wait for the SYNC."""

from collections.abc import Callable, Sequence
from typing import Any

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import Entry, LiveDictionary, WriteHook
from sim_drive.communication.emcy import EmergencyCode, EmergencyProducer, ErrorRegister
from sim_drive.device.axis import Axis, SetPointSource
from sim_drive.device.pdo_mapping import Codec
from sim_drive.device.pdo_slave import LAST_SYNCHRONOUS_TYPE, NS_PER_MS, PdoSub, SlavePdo


class ReceivePdo(SlavePdo):
    """An RPDO: its data act at once, or wait for the SYNC. With an event timer it is missed if it does not come."""

    __slots__ = (
        "_axes",
        "_emergency",
        "_event_entry",
        "_steps",
        "_unpack",
        "deadline_ns",
        "event_ns",
        "is_late",
        "is_synchronous",
        "pending",
    )

    def __init__(
        self,
        number: int,
        dictionary: LiveDictionary,
        axes: Sequence[Axis],
        emergency: EmergencyProducer,
        on_change: Callable[[int], None],
    ) -> None:
        """``number``, from 1, is the PDO's; it may map objects of any of ``axes``."""
        communication = objects.RPDO_COMMUNICATION + number - 1
        super().__init__(dictionary, communication, objects.RPDO_MAPPING + number - 1, on_change)
        self._axes = axes
        self._emergency = emergency
        self._event_entry = dictionary.entry(communication, PdoSub.EVENT_TIMER)
        self._event_entry.on_write = self._on_event_timer
        self.event_ns = 0
        """How long it may fail to come, from the first time on that it has; 0: for ever."""
        self.deadline_ns: int | None = None
        self.is_late = False
        self._unpack: Callable[[bytes], tuple[Any, ...]] = _unpack_nothing
        self._steps: tuple[tuple[Entry, WriteHook | None, bool], ...] = ()
        self.is_synchronous = False
        self.pending: bytes | None = None
        """Data that wait for the next SYNC."""

    def _take_codec(self, codec: Codec) -> None:
        self._unpack = codec.unpack_from
        self._steps = tuple((entry, entry.on_write, entry.is_unlimited) for entry in self.entries)

    def _start(self, now_ns: int) -> None:
        self.is_synchronous = self.transmission_type <= LAST_SYNCHRONOUS_TYPE
        self.event_ns = self._event_entry.value * NS_PER_MS
        self.is_late = False
        self.forget()

    def forget(self) -> None:
        """The node has changed its state: nothing waits for a SYNC, and nothing is missed before it has come again."""
        self.pending = None
        self.deadline_ns = None

    def note_arrival(self, data: bytes, now_ns: int) -> None:
        """Start the event timer anew; what is too short to be used is no arrival."""
        if len(data) >= self.length:
            self.is_late = False
            self.deadline_ns = now_ns + self.event_ns

    def _on_event_timer(self, value: int, now_ns: int) -> AbortCode | None:
        self.event_ns = value * NS_PER_MS
        self.deadline_ns = None
        self.is_late = False
        self._on_change(now_ns)
        return None

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take the PDO's data; too short is refused, too long is used as far as mapped (CiA 301, 7.2.2.5.1)."""
        if len(data) != self.length:
            self._take_wrong_length(data, now_ns)
            if len(data) < self.length:
                return
        elif self._emergency.has_errors:
            self._emergency.end_cause(EmergencyCode.PDO_TOO_SHORT, now_ns)
            self._emergency.end_cause(EmergencyCode.PDO_TOO_LONG, now_ns)
        if self.is_synchronous:
            self.pending = data
        else:
            for axis in self._axes:
                axis.source = SetPointSource.EVENT_PDO
            self.apply(data, now_ns)
            for axis in self._axes:
                axis.source = SetPointSource.SDO

    def _take_wrong_length(self, data: bytes, now_ns: int) -> None:
        code = EmergencyCode.PDO_TOO_SHORT if len(data) < self.length else EmergencyCode.PDO_TOO_LONG
        self._emergency.raise_error(code, ErrorRegister.COMMUNICATION, now_ns, is_fault=False, persists=False)

    def apply(self, data: bytes, now_ns: int) -> None:
        """Write the mapped objects, in the order of the mapping; what its object refuses is left as it was."""
        unpack = self._unpack
        for (entry, on_write, is_unlimited), value in zip(self._steps, unpack(data)):  # noqa: B905 - as mapped
            if not is_unlimited:
                entry.store(value, now_ns)
            elif on_write is None or on_write(value, now_ns) is None:
                entry.value = value


def _unpack_nothing(data: bytes) -> tuple[Any, ...]:
    return ()
