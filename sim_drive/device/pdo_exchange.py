"""The exchange of PDOs: which of the drive's PDOs a SYNC, an event or a remote request concerns, and SYNC itself."""

from collections.abc import Callable, Iterator, Sequence
from typing import Final

from drivers import objects
from drivers.frame import Frame
from drivers.sdo import AbortCode
from sim_drive.communication.cob_ids import COB_ID_MASK, EXTENDED_FRAME, is_restricted
from sim_drive.communication.dictionary import LiveDictionary
from sim_drive.communication.emcy import EmergencyCode, EmergencyProducer, ErrorRegister
from sim_drive.device.axis import Axis, SetPointSource
from sim_drive.device.receive_pdo import ReceivePdo
from sim_drive.device.transmit_pdo import TransmitPdo
from sim_drive.logical_axes import PDO_STEP, in_first_axis, of_axis

PDO_COUNT: Final = 4
"""RPDOs and TPDOs that an axis has, each."""

FrameHandler = Callable[[bytes, int], None]
"""Takes a frame's data and the time."""
RequestHandler = Callable[[int], None]
"""Takes the time at which a remote frame has come."""

_NS_PER_US: Final = 1_000
_RESERVED_COUNTER_OVERFLOW: Final = 1
_SYNC_GENERATE: Final = 1 << 30

_POSITION_AND_TORQUE: Final = frozenset({objects.POSITION_ACTUAL_VALUE, objects.TORQUE_ACTUAL_VALUE})

# Members of an enumeration by a name of the module's own: looking them up in their class costs a call's time.
_SDO: Final = SetPointSource.SDO
_SYNC: Final = SetPointSource.SYNC


class PdoExchange:
    """The drive's PDOs together. They are exchanged while ``is_operational``, which the drive sets by ``enter``."""

    __slots__ = (
        "_acts_on_receipt",
        "_axes",
        "_counter_overflow",
        "_emergency",
        "_monitored_rpdos",
        "_on_change",
        "_on_timer",
        "_rpdos",
        "_samplers",
        "_sync_at_ns",
        "_sync_cob_id",
        "_sync_period",
        "_sync_rpdos",
        "_sync_senders",
        "_sync_window",
        "_tpdos",
        "_waiting_tpdos",
        "event_tpdos",
        "is_operational",
        "watches_events",
    )

    def __init__(
        self,
        dictionary: LiveDictionary,
        axes: Sequence[Axis],
        outbox: list[Frame],
        emergency: EmergencyProducer,
        on_change: Callable[[], None],
        on_timer: Callable[[], None],
        acts_on_receipt: bool,
    ) -> None:
        """Make PDOs that are not exchanged yet.

        ``on_change()``: the handlers have changed; ``on_timer()``: ``next_wake_ns`` may have become earlier.
        ``acts_on_receipt``: synchronous RPDOs do not wait for the SYNC, as on some real drives.
        """
        self._axes = tuple(axes)
        self._emergency = emergency
        self._on_change = on_change
        self._on_timer = on_timer
        self._acts_on_receipt = acts_on_receipt
        numbers = [PDO_STEP * (axis.number - 1) + n for axis in self._axes for n in range(1, PDO_COUNT + 1)]
        self._rpdos = [ReceivePdo(number, dictionary, self._axes, emergency, self.rearrange) for number in numbers]
        self._tpdos = [TransmitPdo(number, dictionary, self._axes, outbox, self.rearrange) for number in numbers]
        self._sync_rpdos: tuple[ReceivePdo, ...] = ()
        self._sync_senders: tuple[Callable[[int], None], ...] = ()
        """What a SYNC has each synchronous TPDO do."""
        self._samplers: tuple[Callable[[int], None], ...] = ()
        """What a SYNC has sampled, for its TPDOs to send."""
        self.event_tpdos: tuple[TransmitPdo, ...] = ()
        """Those that ``poll`` has something to do with."""
        self._waiting_tpdos: tuple[TransmitPdo, ...] = ()
        """Synchronous TPDOs whose SYNC start value has not come yet."""
        self._monitored_rpdos: tuple[ReceivePdo, ...] = ()
        self._sync_cob_id = dictionary.entry(objects.COB_ID_SYNC)
        self._sync_cob_id.on_write = self._on_sync_cob_id
        self._sync_period = dictionary.entry(objects.COMMUNICATION_CYCLE_PERIOD)
        self._counter_overflow = dictionary.entry(objects.SYNCHRONOUS_COUNTER_OVERFLOW)
        self._counter_overflow.on_write = self._on_counter_overflow
        self._sync_window = dictionary.entry(objects.SYNCHRONOUS_WINDOW_LENGTH)
        self._sync_window.on_write = self._on_sync_window
        self._sync_at_ns: int | None = None
        """The last SYNC, noted while there is a synchronous window; None before the first."""
        self.is_operational = False
        self.watches_events = False
        """Whether ``poll`` has anything to do."""

    def restore(self, now_ns: int) -> None:
        """Begin anew with what the dictionary holds; ``rearrange`` has to follow."""
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.restore(now_ns)

    def enter(self, is_operational: bool, now_ns: int) -> None:
        """The node has entered a state: nothing of the one before goes on."""
        self.is_operational = is_operational
        self._sync_at_ns = None
        for rpdo in self._rpdos:
            rpdo.forget()
        if is_operational:
            for tpdo in self._tpdos:
                if tpdo.is_valid:
                    tpdo.begin(now_ns)
            self._sort_synchronous_tpdos()
        self.watches_events = is_operational and bool(self.event_tpdos)

    def rearrange(self, now_ns: int) -> None:
        """A PDO has been configured: see anew what concerns which."""
        self._sort_synchronous_tpdos()
        self.event_tpdos = tuple(tpdo for tpdo in self._tpdos if _is_used(tpdo) and tpdo.is_event_driven)
        self.watches_events = self.is_operational and bool(self.event_tpdos)
        self._monitored_rpdos = tuple(rpdo for rpdo in self._rpdos if _is_used(rpdo) and rpdo.event_ns)
        if not any(rpdo.is_late for rpdo in self._rpdos):
            self._emergency.end_cause(EmergencyCode.RPDO_TIMEOUT, now_ns)
        self._sync_rpdos = tuple(rpdo for rpdo in self._rpdos if _is_used(rpdo) and rpdo.is_synchronous)
        self._on_change()

    def _sort_synchronous_tpdos(self) -> None:
        """Part the synchronous TPDOs in those that a SYNC concerns, and those that wait for their first one."""
        synchronous = [tpdo for tpdo in self._tpdos if _is_used(tpdo) and tpdo.is_synchronous]
        has_counter = bool(self._counter_overflow.value)
        waiting = [tpdo for tpdo in synchronous if has_counter and tpdo.sync_start_value and not tpdo.has_started]
        self._waiting_tpdos = tuple(waiting)
        self._sync_senders = tuple(tpdo.sync_sender for tpdo in synchronous if tpdo not in waiting)
        measured = {entry.variable.index for tpdo in synchronous for entry in tpdo.entries if entry.on_read is not None}
        samplers: list[Callable[[int], None]] = []
        for axis in self._axes:
            own = {first for first in map(in_first_axis, measured) if of_axis(first, axis.number) in measured}
            if own:
                samplers.append(axis.sample_actual_position if own <= _POSITION_AND_TORQUE else axis.sample)
        self._samplers = tuple(samplers)

    # -- timers --------------------------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        """When an event or inhibit timer runs out."""
        if not self.is_operational:
            return None
        dues = [tpdo.due_ns for tpdo in self.event_tpdos] + [rpdo.deadline_ns for rpdo in self._monitored_rpdos]
        return min((due for due in dues if due is not None), default=None)

    def wake(self, now_ns: int) -> None:
        """Do what the timers have come to."""
        if not self.is_operational:
            return
        for tpdo in self.event_tpdos:
            tpdo.wake(now_ns)
        for rpdo in self._monitored_rpdos:
            if rpdo.deadline_ns is not None and now_ns >= rpdo.deadline_ns:
                self._miss(rpdo, now_ns)

    def poll(self, now_ns: int) -> None:
        """Send the event-driven TPDOs of which something has changed, or have them wait for their inhibit time."""
        for tpdo in self.event_tpdos:
            if tpdo.poll(now_ns):
                self._on_timer()

    # -- subscriptions -------------------------------------------------------------------------------------------

    def handlers(self) -> Iterator[tuple[int, FrameHandler]]:
        """COB-IDs of data frames, and what takes them."""
        for rpdo in self._rpdos:
            if _is_used(rpdo):
                yield rpdo.cob_id, self._rpdo_handler(rpdo)
        is_plain = not self._counter_overflow.value and not self._sync_window.value
        yield self._sync_cob_id.value & COB_ID_MASK, self._on_sync if is_plain else self._on_noted_sync

    def request_handlers(self) -> dict[int, RequestHandler]:
        """COB-IDs of remote frames, and what takes them."""
        asked_for = (tpdo for tpdo in self._tpdos if _is_used(tpdo) and tpdo.is_sent_on_request)
        return {tpdo.cob_id: self._request_handler(tpdo) for tpdo in asked_for}

    def _rpdo_handler(self, rpdo: ReceivePdo) -> FrameHandler:
        receive = rpdo.receive
        window_ns = self._sync_window.value * _NS_PER_US if rpdo.is_synchronous else 0
        if window_ns or rpdo.event_ns:
            return self._guarded_rpdo_handler(rpdo, window_ns)
        if rpdo.is_synchronous and self._acts_on_receipt:
            return self._hasty_rpdo_handler(rpdo)

        is_synchronous = rpdo.is_synchronous
        length = rpdo.length
        emergency = self._emergency

        def handle(data: bytes, now_ns: int) -> None:
            if not self.is_operational:
                return
            if is_synchronous and len(data) == length and not emergency.has_errors:
                # As ``receive`` would: nothing but this is done for most frames there are.
                rpdo.pending = data
            else:
                receive(data, now_ns)

        return handle

    def _hasty_rpdo_handler(self, rpdo: ReceivePdo) -> FrameHandler:
        """A synchronous RPDO acts without waiting for the SYNC, as if one had come with it."""

        def handle(data: bytes, now_ns: int) -> None:
            if not self.is_operational:
                return
            rpdo.receive(data, now_ns)
            pending = rpdo.pending
            if pending is not None:
                rpdo.pending = None
                for axis in self._axes:
                    axis.source = _SYNC
                rpdo.apply(pending, now_ns)
                for axis in self._axes:
                    axis.on_sync(now_ns)
                    axis.source = _SDO

        return handle

    def _guarded_rpdo_handler(self, rpdo: ReceivePdo, window_ns: int) -> FrameHandler:
        """With synchronous window (0: none) or event timer.

        What comes later after a SYNC than the window is long is not used (CiA 301, 7.5.2.8). No EMCY tells of it: the
        standard leaves that open, and has no code for it.
        """

        def handle(data: bytes, now_ns: int) -> None:
            if not self.is_operational:
                return
            if rpdo.event_ns:
                rpdo.note_arrival(data, now_ns)
                self._on_timer()
                if not any(other.is_late for other in self._rpdos):
                    self._emergency.end_cause(EmergencyCode.RPDO_TIMEOUT, now_ns)
            if not window_ns or self._sync_at_ns is None or now_ns - self._sync_at_ns <= window_ns:
                rpdo.receive(data, now_ns)

        return handle

    def _miss(self, rpdo: ReceivePdo, now_ns: int) -> None:
        """An RPDO has not come within its event time."""
        rpdo.deadline_ns = None
        rpdo.is_late = True
        self._emergency.raise_error(
            EmergencyCode.RPDO_TIMEOUT, ErrorRegister.COMMUNICATION, now_ns, is_fault=False, persists=False
        )

    def _request_handler(self, tpdo: TransmitPdo) -> RequestHandler:
        def handle(now_ns: int) -> None:
            if self.is_operational:
                tpdo.on_request(now_ns)

        return handle

    # -- SYNC ----------------------------------------------------------------------------------------------------

    def _on_sync(self, data: bytes, now_ns: int) -> None:
        """Sample and send first, then let the demands act that came before this SYNC."""
        if not self.is_operational:
            return
        if data:
            self._refuse_sync(now_ns)
            return
        if self._emergency.has_errors:
            self._emergency.end_cause(EmergencyCode.SYNC_LENGTH, now_ns)
        for sample in self._samplers:
            sample(now_ns)
        for send in self._sync_senders:
            send(now_ns)
        for axis in self._axes:
            axis.source = _SYNC
        for rpdo in self._sync_rpdos:
            pending = rpdo.pending
            if pending is not None:
                rpdo.pending = None
                rpdo.apply(pending, now_ns)
        for axis in self._axes:
            on_sync = axis.on_sync
            on_sync(now_ns)
            axis.source = _SDO

    def _on_noted_sync(self, data: bytes, now_ns: int) -> None:
        """A SYNC with counter, or with a synchronous window after it."""
        if not self.is_operational:
            return
        if len(data) != (1 if self._counter_overflow.value else 0):
            self._refuse_sync(now_ns)
            return
        self._sync_at_ns = now_ns
        if data and self._waiting_tpdos:
            for tpdo in self._waiting_tpdos:
                tpdo.has_started = data[0] == tpdo.sync_start_value
            self._sort_synchronous_tpdos()
        self._on_sync(b"", now_ns)

    def _refuse_sync(self, now_ns: int) -> None:
        self._emergency.raise_error(
            EmergencyCode.SYNC_LENGTH, ErrorRegister.COMMUNICATION, now_ns, is_fault=False, persists=False
        )

    def _on_counter_overflow(self, value: int, now_ns: int) -> AbortCode | None:
        if value == _RESERVED_COUNTER_OVERFLOW:
            return AbortCode.VALUE_RANGE_EXCEEDED
        if self._sync_period.value:
            return AbortCode.CANNOT_STORE_DEVICE_STATE
        self._counter_overflow.value = value
        self.rearrange(now_ns)
        return None

    def _on_sync_window(self, value: int, now_ns: int) -> AbortCode | None:
        self._sync_window.value = value
        self._sync_at_ns = None
        self._on_change()
        return None

    def _on_sync_cob_id(self, value: int, now_ns: int) -> AbortCode | None:
        if value & (_SYNC_GENERATE | EXTENDED_FRAME) or is_restricted(value & COB_ID_MASK):
            return AbortCode.VALUE_RANGE_EXCEEDED
        self._sync_cob_id.value = value
        self._on_change()
        return None


def _is_used(pdo: ReceivePdo | TransmitPdo) -> bool:
    """Whether a PDO is valid and carries something."""
    return pdo.is_valid and bool(pdo.length)
