"""The cycle: SYNC, actual values, guard, demand, RPDOs, in one fixed order; a core without I/O.

    SYNC(k) -> drives latch actual values, apply the demand received before SYNC(k), send TPDOs(k)
            -> the loop has all TPDOs(k), or their deadline passes -> guard -> demand -> RPDOs -> SYNC(k+1)

Here is when what is on the bus, and the account of it; guard and demand are `gateway.cyclic.steering`'s.
"""

from collections.abc import Callable
from operator import attrgetter
from typing import Final

from drivers.frame import Frame
from drivers.nmt import SYNC_COB_ID
from drivers.object_dictionary import DataType
from drivers.pdo import PdoLayout
from gateway.cyclic.guard import Condition
from gateway.cyclic.lateness import Late
from gateway.cyclic.listeners import LateListener, SampleSink
from gateway.cyclic.steering import Steering
from gateway.record.lateness import LateKind
from gateway.record.sample import INT32_MAX, MISSED_TPDO_MASK, Phase, SampleFlag, saturate_int32

RPDO_LAYOUT: Final = PdoLayout((DataType.UNSIGNED16, DataType.INTEGER32, DataType.INTEGER16))
"""Controlword, target position, torque offset."""
TPDO_LAYOUT: Final = PdoLayout((DataType.UNSIGNED16, DataType.INTEGER32, DataType.INTEGER16))
"""Statusword, position actual value, torque actual value."""

SYNC_FRAME: Final = Frame(SYNC_COB_ID)
TPDO_DEADLINE: Final = 0.8
"""Share of the cycle after which a TPDO counts as missed and the demand is sent without it."""
SYNC_PATIENCE: Final = 2
"""A SYNC that is late by this part of the period counts as missing."""
SYNC_TAKE_OVER: Final = 3
"""After so many missing SYNCs in a row the loop sends them itself."""
_UNSENT_NS: Final = 1
"""A demand that is made only after its SYNC counts as this late; how late it really is nobody knows yet."""
GRID_FILTER: Final = 2
"""The expected grid follows a late SYNC by this part of the lateness: the kernel sets its timer anew after each SYNC,
and its grid slips by what each of them is late."""


# Looked up once: the cycle needs them a thousand times a second and more.
_actual_of: Final = attrgetter("actual")
_statusword_of: Final = attrgetter("statusword")
_torque_of: Final = attrgetter("torque")
_unpack_tpdo: Final = TPDO_LAYOUT.unpack_from
_pack_rpdo: Final = RPDO_LAYOUT.pack
_TPDO_LENGTH: Final = TPDO_LAYOUT.length
_COMMISSIONING: Final = Phase.COMMISSIONING


class CyclicLoop:
    """The cyclic exchange with all axes. The host calls ``sent`` after it has handed a batch of frames to the bus."""

    __slots__ = (
        "_all_axes",
        "_arrival_ns",
        "_awaited",
        "_axes",
        "_cpu_clock",
        "_cpu_ns",
        "_deadline_share_ns",
        "_doubtful",
        "_flags",
        "_guard",
        "_is_closed",
        "_is_lost",
        "_is_taken",
        "_provisional",
        "_sent_ns",
        "_sink",
        "_sync_deviation_ns",
        "_sync_due_ns",
        "_sync_ns",
        "_wake_lateness_ns",
        "actuals_are_valid",
        "cycle",
        "is_off_bus",
        "is_paced",
        "is_running",
        "late_listener",
        "missing_syncs",
        "outbox",
        "period_ns",
        "processor_read_ns",
        "steering",
        "sync_gap_limit",
        "sync_period_ns",
        "tpdo_slots",
    )

    def __init__(
        self,
        steering: Steering,
        period_ns: int,
        sink: SampleSink,
        cpu_clock: Callable[[], int] | None = None,
        tpdo_deadline_ns: int | None = None,
    ) -> None:
        """``cpu_clock`` gives the loop's processor time in ns, for the account; None leaves that figure at 0.

        ``tpdo_deadline_ns``: how long after SYNC the TPDOs are waited for; None is ``TPDO_DEADLINE`` of the period.
        """
        self.steering = steering
        self._axes = axes = steering.axes
        self._guard = steering.guard
        self.period_ns = period_ns
        self.outbox: list[Frame] = []
        self.cycle = -1
        self.is_running = False
        self.is_paced = False
        """SYNC is sent by somebody else, the kernel, and seen by ``receive_sync``; set before ``start``."""
        self.is_off_bus = False
        """The own controller is bus-off: the cycle goes on, but what it hands out is lost."""
        self.missing_syncs = 0
        """SYNCs in a row that were due and not seen."""
        self.actuals_are_valid = False
        """Every axis has sent a TPDO for the cycle that was closed last."""
        self.late_listener: LateListener | None = None
        self.sync_gap_limit = INT32_MAX
        """So many SYNCs in a row that were not sent are a condition of the guard's; so is a timer that sends none."""
        self.tpdo_slots = {axis.tpdo_cob_id: number for number, axis in enumerate(axes)}
        self._sink = sink
        self._cpu_clock = cpu_clock
        self._cpu_ns = 0
        self.processor_read_ns = 0
        """What the clock of the loop's processor time showed when it was read last."""
        self._all_axes = (1 << len(axes)) - 1
        deadline_ns = round(period_ns * TPDO_DEADLINE) if tpdo_deadline_ns is None else tpdo_deadline_ns
        self._deadline_share_ns = period_ns - deadline_ns
        self._sync_due_ns = 0
        self._sync_ns = 0
        self._sync_deviation_ns = 0
        self.sync_period_ns = 0
        """From the SYNC before to the last one."""
        self._wake_lateness_ns = 0
        self._awaited = 0
        self._doubtful = 0
        """Axes whose TPDO was missed in the cycle before: the next one may be that one, come late."""
        self._provisional = 0
        """Doubtful axes of which one TPDO has come in this cycle."""
        self._is_closed = True
        self._is_taken = True
        """The demand sent last was on the bus before the SYNC that came last, so that the drives apply it."""
        self._is_lost = False
        """The demand that was made last has not gone onto the bus, and will not."""
        self._arrival_ns = 0
        self._sent_ns = 0
        self._flags = 0

    # -- commands ------------------------------------------------------------------------------------------------

    def start(self, now_ns: int) -> None:
        """Begin the cycle: the first SYNC goes out one period from now."""
        self.is_running = True
        self._sync_due_ns = now_ns + self.period_ns
        self._sync_ns = now_ns
        self._is_closed = True
        self._is_taken = True
        self.missing_syncs = 0

    def stop(self) -> None:
        """No further SYNC."""
        self.is_running = False

    def leave_bus(self) -> None:
        """The own controller has gone bus-off: no drive sees a SYNC, or takes a demand, until ``rejoin_bus``.

        The demand stands still meanwhile, so that it goes on from where the drives have been left. SYNC is the loop's
        own business from now on: a timer's, sent at once after the return, would take over what is then still stale.
        """
        self.is_off_bus = True
        self.is_paced = False

    def rejoin_bus(self) -> None:
        """The own controller is back; the next SYNC is seen again, the next demand taken."""
        self.is_off_bus = False
        self.steering.let_settle()

    # -- the cycle -----------------------------------------------------------------------------------------------

    def next_wake_ns(self) -> int:
        """The TPDOs' deadline while they are awaited, else the next SYNC, or when it counts as missing."""
        if not self._is_closed:
            return self._sync_due_ns - self._deadline_share_ns
        return self._sync_due_ns + self.period_ns // SYNC_PATIENCE if self.is_paced else self._sync_due_ns

    @property
    def sync_due_ns(self) -> int:
        """When the next SYNC is due."""
        return self._sync_due_ns

    @property
    def is_closed(self) -> bool:
        """Whether the demand of this cycle has been sent, and only the next SYNC is waited for."""
        return self._is_closed

    @property
    def arrival_offset_ns(self) -> int:
        """How long after its SYNC the last TPDO of this cycle came; 0 as long as none is there."""
        return self._arrival_ns - self._sync_ns

    def wake(self, now_ns: int) -> bool:
        """Do what is due; returns whether a cycle was closed."""
        closed = False
        if not self._is_closed and now_ns >= self._sync_due_ns - self._deadline_share_ns:
            self._close(now_ns)
            closed = True
        if self.is_paced:
            if now_ns >= self._sync_due_ns + self.period_ns // SYNC_PATIENCE:
                self._miss_sync(now_ns)
        elif now_ns >= self._sync_due_ns:
            self._send_sync(now_ns)
        return closed

    def receive_sync(self, at_ns: int) -> bool:
        """The SYNC that paces this loop was on the bus at ``at_ns``; returns whether a cycle was closed."""
        if not self.is_paced:
            return False
        was_open = not self._is_closed
        if was_open:
            # The loop has slept through its deadline: what it sends now comes too late for this SYNC.
            self._close(at_ns)
            self._sent_ns = at_ns + _UNSENT_NS
        if self.cycle >= 0:
            self._account(at_ns)
            self._is_taken = self._sent_ns <= at_ns
        deviation_ns = at_ns - self._sync_due_ns
        lost = (deviation_ns + self.period_ns // 2) // self.period_ns
        if lost > 0:
            self._tell_late(LateKind.OVERRUN, self._sync_due_ns, self._sync_due_ns + self.period_ns // 2, at_ns)
            self._sync_due_ns += lost * self.period_ns
            self._flags = int(SampleFlag.OVERRUN)
            self._lose_syncs(lost, at_ns)
        else:
            self._flags = 0
        if self.missing_syncs:
            self._flags |= SampleFlag.SYNC_LOST
            self.missing_syncs = 0
        # A timer is late, never early.
        late_ns = at_ns - self._sync_due_ns
        self._sync_due_ns += late_ns if late_ns < 0 else late_ns // GRID_FILTER
        self._begin(at_ns, deviation_ns)
        return was_open

    def receive_tpdo(self, number: int, data: bytes, now_ns: int) -> bool:
        """Take the TPDO of axis ``number``; returns whether it closed the cycle.

        After a cycle without its TPDO the next one of an axis may be that one, come late: it then counts only when a
        second one comes in the same cycle, or at the deadline.
        """
        if len(data) != _TPDO_LENGTH:
            return False
        axis = self._axes[number]
        axis.statusword, axis.actual, axis.torque = _unpack_tpdo(data)
        bit = 1 << number
        if self._doubtful & bit and not self._is_own(bit, now_ns):
            return False
        self._awaited &= ~bit
        if self._awaited or self._is_closed:
            return False
        self._arrival_ns = now_ns
        self._close(now_ns)
        return True

    def sent(self, now_ns: int) -> None:
        """The host has handed all frames to the bus at this time."""
        if self._is_closed:
            self._sent_ns = now_ns
        elif self.late_listener is not None:
            self.late_listener.demand_is_out(now_ns)

    def lost(self) -> None:
        """What was in the outbox has been thrown away: it could not be put on the bus."""
        self._is_lost = True
        self._is_taken = False
        self._flags |= SampleFlag.SEND_BUFFER_FULL | SampleFlag.BUS_ERROR
        if self._is_closed:
            self._sent_ns = self._sync_due_ns + self.period_ns

    def note(self, flag: int) -> None:
        """Something that the host has noticed in this cycle: a ``SampleFlag``."""
        self._flags |= flag

    def woke(self, lateness_ns: int) -> None:
        """How late the host woke for this cycle, where that is not how late SYNC is."""
        self._wake_lateness_ns = lateness_ns

    def _is_own(self, bit: int, now_ns: int) -> bool:
        """Whether the TPDO of a doubtful axis that has just come is certainly this cycle's."""
        if not self._is_closed and not self._provisional & bit:
            self._provisional |= bit
            self._arrival_ns = now_ns
            return False
        self._doubtful &= ~bit
        self._provisional &= ~bit
        self._flags |= SampleFlag.LATE_TPDO
        return True

    def _miss_sync(self, now_ns: int) -> None:
        self.missing_syncs += 1
        self._flags |= SampleFlag.SYNC_LOST
        # A host that was away has its timers late too: they are given another period from now on.
        self._sync_due_ns = max(self._sync_due_ns, now_ns - self.period_ns // SYNC_PATIENCE) + self.period_ns
        if self.missing_syncs >= SYNC_TAKE_OVER:
            # Without SYNC no drive takes a demand, not even that of a stop.
            self.is_paced = False
            self._lose_syncs(max(self.missing_syncs, self.sync_gap_limit), now_ns)
            self._sync_due_ns = now_ns
            self._send_sync(now_ns)

    def _lose_syncs(self, count: int, now_ns: int) -> None:
        if count >= self.sync_gap_limit and self.steering.phase is not _COMMISSIONING:
            self._guard.hold(Condition.SYNC_LOST, 0, count, self.sync_gap_limit, now_ns)

    def _send_sync(self, now_ns: int) -> None:
        lateness_ns = now_ns - self._sync_due_ns
        if self.cycle >= 0:
            # An overrun moves the grid on; the demand's deadline is the SYNC that was due next.
            self._account(self._sync_due_ns)
        self.outbox.append(SYNC_FRAME)
        self._flags = 0
        self._is_taken = not self._is_lost
        if self.missing_syncs:
            self._flags = int(SampleFlag.SYNC_LOST)
            self.missing_syncs = 0
        if lateness_ns >= self.period_ns:
            # Lost cycles are not made up for: two SYNCs at once would be worse for the drives than a gap.
            self._flags |= int(SampleFlag.OVERRUN)
            lost = lateness_ns // self.period_ns
            due_ns = self._sync_due_ns
            self._tell_late(LateKind.OVERRUN, due_ns, due_ns + self.period_ns, now_ns)
            self._sync_due_ns += lost * self.period_ns
            self._lose_syncs(lost, now_ns)
        self._begin(now_ns, lateness_ns)
        self._wake_lateness_ns = lateness_ns

    def _begin(self, sync_ns: int, deviation_ns: int) -> None:
        """SYNC of the next cycle is on the bus."""
        self._sync_due_ns += self.period_ns
        self._sync_deviation_ns = deviation_ns
        self.sync_period_ns = span_ns = sync_ns - self._sync_ns
        if span_ns > self.period_ns + self.period_ns // SYNC_PATIENCE:
            self.steering.skip(span_ns // self.period_ns)
        self._sync_ns = sync_ns
        self._arrival_ns = sync_ns
        self._sent_ns = 0
        self.cycle += 1
        self._awaited = self._all_axes
        self._is_closed = False

    def _close(self, now_ns: int) -> None:
        """All TPDOs of this cycle are here, or overdue: guard, demand, RPDOs."""
        self._is_closed = True
        self._sent_ns = now_ns
        self._awaited &= ~self._provisional
        self._provisional = 0
        self._doubtful = self._awaited
        self._flags |= self._awaited
        self.actuals_are_valid = not self._awaited
        self.steering.step(self._awaited, self._is_taken, self.is_off_bus or self._is_lost, now_ns)
        self._is_lost = False
        outbox = self.outbox
        for axis in self._axes:
            payload = _pack_rpdo(axis.controlword, axis.target, axis.torque_offset)
            outbox.append(Frame(axis.rpdo_cob_id, payload))

    def _tell_late(self, kind: LateKind, sync_ns: int, deadline_ns: int, sent_ns: int | None) -> None:
        if self.late_listener is not None:
            tpdo_ns = None if self._flags & MISSED_TPDO_MASK else self._arrival_ns
            deviation_ns = self._sync_deviation_ns
            late = Late(
                kind,
                self.cycle,
                sync_ns,
                deadline_ns,
                sent_ns,
                self.is_paced,
                deviation_ns,
                tpdo_ns,
                is_lost=self._is_lost,
                own_ns=self._cpu_ns,
            )
            self.late_listener.missed(late)

    def _account(self, deadline_ns: int) -> None:
        """Hand on the sample of the cycle that ends with SYNC; ``deadline_ns`` is that of its demand."""
        if self._cpu_clock is not None:
            cpu_ns = self._cpu_clock()
            self._cpu_ns = cpu_ns - self.processor_read_ns if self.processor_read_ns else 0
            self.processor_read_ns = cpu_ns
        lead_ns = deadline_ns - self._sent_ns
        if lead_ns < 0:
            self._flags |= SampleFlag.MISSED_RPDO_DEADLINE
            sent_ns = None if lead_ns == -_UNSENT_NS else self._sent_ns
            self._tell_late(LateKind.RPDO_DEADLINE, self._sync_ns, deadline_ns, sent_ns)
            self._guard.hold_cycles(Condition.MISSED_DEADLINE, 0, self._sync_ns)
        elif not self._guard.is_quiet:
            self._guard.clear(Condition.MISSED_DEADLINE, 0)
        arrival_ns = self._arrival_ns - self._sync_ns
        deviation_ns, period_ns, cpu_ns = self._sync_deviation_ns, self.sync_period_ns, self._cpu_ns
        spans_ns = (deviation_ns, period_ns, self._wake_lateness_ns, arrival_ns, lead_ns, cpu_ns)
        if max(spans_ns) > INT32_MAX or min(spans_ns) < -INT32_MAX:
            spans_ns = map(saturate_int32, spans_ns)
        master_position, master_velocity, velocities, targets, torque_offsets, phase = self.steering.in_force
        axes = self._axes
        self._sink.append(
            self.cycle,
            self._sync_ns,
            master_position,
            master_velocity,
            *velocities,
            *spans_ns,
            phase,
            self._flags,
            *targets,
            *map(_actual_of, axes),
            *map(_statusword_of, axes),
            *map(_torque_of, axes),
            *torque_offsets,
        )
