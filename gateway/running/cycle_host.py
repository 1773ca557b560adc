"""The real-time host of the gateway's core: sockets, sleeps and the clock around ``gateway.cyclic.cycle``.

It wakes once a cycle, when all TPDOs are expected to be there (the loop's *phase*, learned from their arrival), takes
everything that waits in one go, and sends the demand; so the demand is on the bus long before the next SYNC, and the
cycle costs one sleep. Until the phase is known, and when TPDOs are late, it waits for frames.

Unlike the emulator's host, which gives every wake the instant it was due, this one tells the core the time that it
really is: the gateway's account is about how late things are.
"""

import select
import time
from collections.abc import Callable
from typing import Final, Protocol

from drivers.controller import Controller
from drivers.frame import Frame
from drivers.nmt import SYNC_COB_ID
from drivers.pdo import RPDO_BASE
from drivers.period_trim import PeriodTrim
from drivers.ports import Port
from drivers.sdo import SDO_RESPONSE_BASE
from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.listeners import LateListener
from gateway.record.sample import SampleFlag
from gateway.running.controller_watch import ControllerWatch
from gateway.running.core import GatewayCore

MAX_WAIT_NS: Final = 50_000_000
MAX_FRAMES_A_PASS: Final = 64
"""Frames taken from a bus at most before the clock is looked at again."""
RETRY_NS: Final = 200_000
"""When to offer a full bus its frames again: a frame of 8 bytes takes 135 us at 1 Mbit/s."""
SHORTEST_SLEEP_NS: Final = 15_000
PHASE_MARGIN_NS: Final = 15_000
PHASE_RISE: Final = 2
PHASE_FALL: Final = 6
"""The phase follows a later arrival by 1/4 of the difference, an earlier one by 1/64."""


class SyncTimer(Protocol):
    """Who sends SYNC in place of the loop."""

    def start(self) -> None:
        """Send it from now on."""
        ...

    def stop(self) -> None:
        """Send it no more."""
        ...

    def retime(self, period_us: int) -> None:
        """Leave so much time between two of them."""
        ...


class LateWatch(LateListener, Protocol):
    """Who wants to know what the loop does with its time, and why something was late."""

    def follow(self, loop: CyclicLoop, phase_ns: Callable[[], int]) -> None:
        """This loop will be driven from now on; ``phase_ns`` tells when after SYNC it wakes."""
        ...

    def rests(self, now_ns: int, until_ns: int) -> None:
        """The loop, which read its clock at ``now_ns``, sleeps until then."""
        ...

    def waits(self, now_ns: int, until_ns: int) -> None:
        """The loop waits for frames, until then at the latest."""
        ...

    def woke(self, cycle: int, woke_ns: int) -> None:
        """It has slept, and woke at this time for the cycle after number ``cycle``."""
        ...

    def roused(self, woke_ns: int) -> None:
        """It has waited for frames, and goes on at this time."""
        ...

    def sync_is_stale(self) -> None:
        """The SYNC that the loop is given next was on the bus before the instant that it is told."""
        ...

    def was_refused(self, span_ns: int) -> None:
        """It has waited so long for a bus that was full."""
        ...

    def tell(self) -> None:
        """A demand has just been sent, and nothing is urgent for some time."""
        ...


class CycleHost:
    """Drives one core until its session is over."""

    def __init__(
        self,
        core: GatewayCore,
        cyclic: Port,
        poll: Callable[[], None],
        *,
        service: Port | None = None,
        sync: SyncTimer | None = None,
        late: LateWatch | None = None,
        controller: ControllerWatch | None = None,
        echo_cob_id: int | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """``cyclic`` carries SYNC and PDOs, ``service`` all the rest; None where ``cyclic`` carries that too.

        ``sync`` sends SYNC, and ``cyclic`` then hears it; None leaves it to the loop. ``poll`` is called at least once
        a cycle. ``echo_cob_id``: the last frame of each demand, which ``cyclic`` hears when it has been on the bus;
        None: what has been sent is taken to be on the bus. ``controller`` looks after the CAN controller of ``cyclic``;
        None: nobody does.
        """
        self._echo_cob_id = echo_cob_id
        self._demands = frozenset(axis.rpdo_cob_id for axis in core.loop.steering.axes)
        self._core = core
        self._cyclic = cyclic
        self._service = service
        self._sync = sync
        self._is_sync_on = False
        self._late = late
        self._poll = poll
        self._clock = clock
        self._sleep = sleep
        self._latest_ns = clock()
        self._lateness_ns = 0
        self._backlog: list[Frame] = []
        self._controller = controller
        self._errors = Controller() if controller is None else controller.controller
        self._error_count = 0
        self._polled_cycle: int = -1
        self.phase_ns = 0
        """When after SYNC the loop wakes; 0 while it is not known."""
        self._trim = PeriodTrim(core.loop.period_ns // 1000)
        core.loop.is_paced = sync is not None
        if late is not None:
            core.loop.late_listener = late
            late.follow(core.loop, lambda: self.phase_ns)

    def run(self) -> None:
        """Drive the core until it is done. Raises BusError when the bus has gone."""
        core, clock = self._core, self._clock
        try:
            while not core.is_done:
                self._drain(self._cyclic)
                if self._service is not None:
                    self._drain(self._service)
                now_ns = clock()
                if self._errors.is_restless and self._controller is not None:
                    self._look_after_controller(self._controller, now_ns)
                due_ns = core.next_wake_ns()
                if due_ns is not None and due_ns > now_ns:
                    self._rest(now_ns, due_ns)
                    continue
                self._latest_ns = max(self._latest_ns, now_ns)
                core.wake(self._latest_ns)
                frames = core.take_frames()
                if frames:
                    self._send(frames)
        finally:
            if self._sync is not None and self._is_sync_on:
                self._sync.stop()

    def _drain(self, port: Port) -> None:
        """Hand over what waits. What the loop was too late for is still handed over first: it came in time."""
        core = self._core
        for _ in range(MAX_FRAMES_A_PASS):
            received = port.receive()
            if received is None:
                return
            frame, arrival_ns = received
            if arrival_ns > self._latest_ns:
                self._latest_ns = arrival_ns
            elif self._late is not None and frame.cob_id == SYNC_COB_ID and arrival_ns < self._latest_ns:
                self._late.sync_is_stale()
            if frame.cob_id == self._echo_cob_id:
                core.loop.sent(self._latest_ns)
                continue
            core.receive(frame, self._latest_ns)
            if frame.cob_id == SYNC_COB_ID:
                core.loop.woke(self._lateness_ns)
                if self._sync is not None and self._is_sync_on and self._trim.observe(core.loop.sync_period_ns):
                    self._sync.retime(self._trim.interval_us)
            frames = core.take_frames()
            if frames:
                self._send(frames)

    def _send(self, frames: list[Frame]) -> None:
        loop = self._core.loop
        # A heartbeat that goes by itself says nothing of when the demand went; in a batch the demand comes first.
        has_demand = frames[0].cob_id in self._demands if frames else False
        if self._backlog:
            loop.note(SampleFlag.SEND_BUFFER_FULL)
            frames = _without_superseded(self._backlog, frames) + frames
            has_demand = self._has_demand(frames)
            self._backlog = []
        send = self._cyclic.send
        for number, frame in enumerate(frames):
            if not send(frame):
                loop.note(SampleFlag.SEND_BUFFER_FULL)
                self._backlog = frames[number:]
                if self._has_demand(self._backlog):
                    # Not on the bus yet: as it stands now, it comes too late.
                    loop.sent(loop.sync_due_ns + loop.period_ns)
                return
        if not has_demand:
            pass
        elif self._echo_cob_id is None or not loop.is_paced:
            loop.sent(self._clock())
        elif loop.is_closed and any(frame.cob_id == self._echo_cob_id for frame in frames):
            # Not before the bus says so.
            loop.sent(loop.sync_due_ns + loop.period_ns)
        self._switch_sync()
        self._follow_cycle()
        # A loop that is always late never waits, and must hear of a stop all the same.
        self._polled_cycle = loop.cycle
        self._poll()
        if self._late is not None and loop.is_closed:
            self._late.tell()

    def _has_demand(self, frames: list[Frame]) -> bool:
        return any(frame.cob_id in self._demands for frame in frames)

    def _look_after_controller(self, controller: ControllerWatch, now_ns: int) -> None:
        loop = self._core.loop
        self._latest_ns = max(self._latest_ns, now_ns)
        controller.look(self._latest_ns)
        if loop.is_off_bus:
            # What could not go before is as stale as all else; and the kernel is not to send SYNC after the return.
            self._backlog = []
            self._switch_sync()

    def _switch_sync(self) -> None:
        loop = self._core.loop
        if self._sync is not None and self._is_sync_on is not (loop.is_running and loop.is_paced):
            self._is_sync_on = not self._is_sync_on
            (self._sync.start if self._is_sync_on else self._sync.stop)()

    def _follow_cycle(self) -> None:
        """Learn the phase from what has arrived, and note what the controller has reported."""
        loop = self._core.loop
        arrival_ns = loop.arrival_offset_ns
        if loop.is_closed and arrival_ns > 0:
            wanted_ns = arrival_ns + PHASE_MARGIN_NS
            away_ns = wanted_ns - self.phase_ns
            self.phase_ns += away_ns >> PHASE_RISE if away_ns > 0 else -(-away_ns >> PHASE_FALL)
            self.phase_ns = min(self.phase_ns, loop.period_ns // 2)
        if self._errors.frame_count != self._error_count:
            self._error_count = self._errors.frame_count
            loop.note(SampleFlag.BUS_ERROR)

    def _rest(self, now_ns: int, due_ns: int) -> None:
        """Sleep until the core is due, the loop's phase has come, or a frame is there."""
        self._switch_sync()
        loop = self._core.loop
        if not loop.is_running or loop.cycle != self._polled_cycle:
            self._polled_cycle = loop.cycle
            self._poll()
        late = self._late
        if self._backlog:
            self._wait(min(due_ns - now_ns, RETRY_NS))
            if late is not None:
                late.was_refused(self._clock() - now_ns)
            self._send([])
            return
        if loop.is_running:
            sync_ns = loop.sync_due_ns
            if not loop.is_closed:
                target_ns = sync_ns - loop.period_ns + self.phase_ns
            else:
                target_ns = sync_ns + self.phase_ns if loop.is_paced else sync_ns
            target_ns = min(target_ns, due_ns)
            # A SYNC that is overdue may come at any moment.
            if target_ns - now_ns > SHORTEST_SLEEP_NS and not loop.missing_syncs:
                if late is not None:
                    late.rests(now_ns, target_ns)
                self._sleep((target_ns - now_ns) * 1e-9)
                woke_ns = self._clock()
                self._lateness_ns = max(0, woke_ns - target_ns)
                if late is not None:
                    late.woke(loop.cycle, woke_ns)
                return
        until_ns = min(due_ns, now_ns + MAX_WAIT_NS)
        if late is None or not loop.is_running:
            self._wait(until_ns - now_ns)
            return
        late.waits(now_ns, until_ns)
        self._wait(until_ns - now_ns)
        late.roused(self._clock())

    def _wait(self, span_ns: int) -> None:
        timeout_s = span_ns * 1e-9
        if self._service is None or self._core.loop.is_running:
            self._cyclic.wait(timeout_s)
        else:
            select.select((self._cyclic.fileno(), self._service.fileno()), (), (), timeout_s)


def _without_superseded(backlog: list[Frame], frames: list[Frame]) -> list[Frame]:
    """What is still worth sending of a backlog: a newer demand takes the place of an older one."""
    demands = range(RPDO_BASE[0], SDO_RESPONSE_BASE)
    newer = {frame.cob_id for frame in frames if frame.cob_id == SYNC_COB_ID or frame.cob_id in demands}
    return [frame for frame in backlog if frame.cob_id not in newer]


def run_core(core: GatewayCore, port: Port, clock: Callable[[], int], poll: Callable[[], None]) -> None:
    """Drive ``core`` on one port until it is done, the loop sending SYNC; see ``CycleHost``. Raises BusError."""
    CycleHost(core, port, poll, clock=clock).run()
