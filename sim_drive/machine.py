"""The emulated machine: every drive of it and the plant they move, as one node on the bus.

It owns the servo rate. Servo tick n is due exactly n * 1953125 // 2 ns after the start (1024 Hz), in integers, so that
the ticks never drift against the bus, and stand at the same nanoseconds in every run.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, NamedTuple

from drivers.frame import Frame
from drivers.node import Event
from sim_drive.machine_axis import MachineAxis, Motor
from sim_drive.machine_seam import DriveTap, FrameHandler, MachineDrive
from sim_drive.physics.plant import Plant
from sim_drive.physics.servo import SERVO_RATE_HZ, ServoLoop

TWO_SERVO_PERIODS_NS: Final = 2_000_000_000 // SERVO_RATE_HZ
"""A servo period is not a whole number of nanoseconds, but two are: 1953125 ns."""
MAX_CATCH_UP_NS: Final = 1_000_000_000
"""A host that comes later than this has lost the time in between: see `TimeSkipped`."""

_NEVER: Final = 1 << 63
_MAX_WAKES_PER_INSTANT: Final = 16
_MAX_CROSS_ROUNDS: Final = 8


@dataclass(frozen=True, slots=True)
class LinkageTorn(Event):
    """The linkage has come too near a singular position and is torn; every drive of the machine has been tripped."""

    plant_time_s: float
    angles_rad: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class TimeSkipped(Event):
    """The host came so late that servo ticks have been left out; the plant stood still meanwhile."""

    skipped_ticks: int


class TickRecord(NamedTuple):
    """One servo tick for diagnosis; every tuple has one value an axis."""

    at_ns: int
    angles_rad: tuple[float, ...]
    counts: tuple[int, ...]
    demands_counts: tuple[float, ...]
    torque_commands_Nm: tuple[float, ...]
    torques_Nm: tuple[float, ...]
    drawn_J: tuple[float, ...]
    """Energy that the axis has drawn from its supply, see `AxisEnergy`."""


class _Station:
    """One drive on the bus, and the motors that it has."""

    __slots__ = (
        "drive",
        "due_ns",
        "events",
        "motors",
        "next_wake_ns",
        "outbox",
        "receive",
        "tap",
        "wake_ns",
    )

    def __init__(self, drive: MachineDrive, motors: Sequence[Motor]) -> None:
        self.drive = drive
        self.motors = tuple(motors)
        self.tap: DriveTap | None = None
        self.wake_ns: int | None = None
        """When the drive wanted to be woken when it was asked last."""
        self.due_ns = _NEVER
        """When it will be woken."""
        # Looked up once: they are asked for at every frame and tick.
        self.receive = drive.receive
        self.next_wake_ns = drive.next_wake_ns
        self.outbox = drive.outbox
        self.events = drive.events

    def receive_through_tap(self, frame: Frame, now_ns: int) -> None:
        if self.tap is not None:
            for heard in self.tap.hear(frame, now_ns):
                self.drive.receive(heard, now_ns)


_Route = tuple[tuple[_Station, FrameHandler | None], ...]
"""The drives that listen to a COB-ID, each with what may be called in place of its ``receive``."""


class EmulatedMachine:
    """Drives and plant as one core (`drivers.node.Node`); the drives' axes move those of the plant in their order.

    At a servo tick the plant is first advanced to it under the torques commanded at the tick before. Then each axis of
    each drive in turn is shown its resolver and asked for its demand, from which its servo loop makes the torque for
    the coming period (`sim_drive.machine_axis.Motor`).

    Frames are dispatched by COB-ID. What one drive sends, the other drives of the machine hear too, as on a wire, but
    at once rather than after its time on the wire: after all drives have taken the frame or tick that caused it, so
    that a TPDO sent at a SYNC reaches the others after their own SYNC, as it would on a wire.

    A late ``wake`` runs all that is due, in the order of its own instants, each with its own exact time; more than
    `MAX_CATCH_UP_NS` late, the servo ticks in between are left out and `TimeSkipped` says so. At one instant the servo
    tick comes first, then the drives' own wakes in their order. The same ``seed`` gives the same resolver noise.
    """

    __slots__ = (
        "_brakes",
        "_drives_due_ns",
        "_due_ns",
        "_events",
        "_frames",
        "_has_tripped",
        "_motors",
        "_next_tick_ns",
        "_routes",
        "_start_ns",
        "_stations",
        "_tick",
        "_tick_ns",
        "_torques",
        "axes",
        "drive_axes",
        "drives",
        "plant",
        "records",
    )

    def __init__(
        self,
        drives: Sequence[MachineDrive],
        plant: Plant,
        axes: Sequence[MachineAxis],
        start_ns: int = 0,
        seed: int = 0,
        record_ticks: int = 0,
    ) -> None:
        """Take over the drives and the plant at ``start_ns``.

        ``record_ticks``: how many of the last servo ticks `records` keeps; 0 keeps none and costs nothing.

        Raises ValueError where the numbers of the drives' axes, ``axes`` and the plant's axes differ.
        """
        count = sum(len(drive.axes) for drive in drives)
        if not count == len(axes) == plant.axis_count:
            raise ValueError(
                f"drives of {count} axes and {len(axes)} scalings of axes for a plant of {plant.axis_count} axes"
            )
        self.drives: Final = tuple(drives)
        self.plant: Final = plant
        self.axes: Final = tuple(axes)
        self.records: Final = deque[TickRecord](maxlen=record_ticks)
        self.drive_axes: Final = tuple(axis for drive in self.drives for axis in drive.axes)
        noise_source = Random(seed)  # noqa: S311 - reproducible on purpose
        self._motors: Final = tuple(
            Motor(index, drive_axis, axis, plant, noise_source, start_ns)
            for index, (drive_axis, axis) in enumerate(zip(self.drive_axes, axes, strict=True))
        )
        motors = iter(self._motors)
        self._stations: Final = tuple(_Station(drive, [next(motors) for _ in drive.axes]) for drive in self.drives)
        self._torques = [0.0] * count
        self._brakes = [True] * count
        self._has_tripped = False
        self._start_ns = start_ns
        self._tick = 0
        self._tick_ns = start_ns
        self._next_tick_ns = start_ns + TWO_SERVO_PERIODS_NS // 2
        self._due_ns = self._next_tick_ns
        """The next servo tick or the earliest wake of a drive."""
        self._drives_due_ns = _NEVER
        """The earliest wake of a drive."""
        self._frames: list[Frame] = []
        self._events: list[Event] = []
        self._routes: dict[int, _Route] = {}
        for station in self._stations:
            self._ask_wake(station)
        self._read_subscriptions()

    @property
    def servo_ticks(self) -> int:
        """Number of the last servo tick, counted from 1 at one servo period after the start."""
        return self._tick

    def servo_loop(self, axis: int) -> ServoLoop:
        """The servo loop of an axis, for diagnosis."""
        return self._motors[axis].servo

    def put_tap(self, place: int, tap: DriveTap) -> None:
        """Put ``tap`` between the drive at ``place`` and all that it hears, sends and measures, for good."""
        station = self._stations[place]
        station.tap = tap
        station.receive = station.receive_through_tap
        for motor, axis_tap in zip(station.motors, tap.axes, strict=True):
            motor.put_tap(axis_tap)
        self._read_subscriptions()

    def deliver(self, place: int, frame: Frame, now_ns: int) -> None:
        """Let a drive hear a frame that its tap has held back."""
        station = self._stations[place]
        station.drive.receive(frame, now_ns)
        self._ask_wake(station)
        self._exchange(now_ns)

    def transmit(self, place: int, frame: Frame, now_ns: int) -> None:
        """Put a frame of a drive on the bus that its tap has held back."""
        self._frames.append(frame)
        if frame.cob_id in self._routes:
            self._tell_others(self._stations[place], frame, now_ns)
        self._exchange(now_ns)

    def refresh(self, now_ns: int) -> None:
        """Ask every drive for its frames, events and next wake, after something outside has changed one."""
        for station in self._stations:
            self._ask_wake(station)
        self._exchange(now_ns)

    def receive(self, frame: Frame, now_ns: int) -> bool:
        """Hand a frame of the bus to the drives that listen to it; False as in ``drivers.node.Node``."""
        has_news = self._due_ns < now_ns
        if has_news:
            self.wake(now_ns)
        cob_id, data, is_remote = frame
        listeners = self._routes.get(cob_id)
        if listeners is None:
            return has_news
        is_quiet = True
        for station, handler in listeners:
            if handler is None or is_remote:
                station.receive(frame, now_ns)
            else:
                handler(data, now_ns)
            drive = station.drive
            if drive.is_wake_stale:
                self._ask_wake(station)
                has_news = True
            if station.outbox or station.events or drive.subscriptions_changed:
                is_quiet = False
        if is_quiet:
            return has_news
        self._exchange(now_ns)
        return True

    def next_wake_ns(self) -> int | None:
        """The next servo tick or the next wake of a drive; never None, for the servo ticks never end."""
        return self._due_ns

    def wake(self, now_ns: int) -> bool:
        """Run every servo tick and every drive's wake that is due, each at its own instant.

        False as in ``drivers.node.Node``.
        """
        if now_ns - self._next_tick_ns > MAX_CATCH_UP_NS:
            self._skip_to(now_ns)
        while self._due_ns <= now_ns:
            if self._due_ns == self._next_tick_ns:
                self._run_tick(self._due_ns)
            else:
                due = next(station for station in self._stations if station.due_ns == self._due_ns)
                self._wake_drive(due, self._due_ns)
        return bool(self._frames or self._events)

    def take_frames(self) -> list[Frame]:
        """Frames of all drives in the order they were sent."""
        frames = self._frames
        if frames:
            self._frames = []
        return frames

    def take_events(self) -> list[Event]:
        """Events of all drives and of the machine."""
        events = self._events
        if events:
            self._events = []
        return events

    def _ask_wake(self, station: _Station) -> None:
        wake_ns = station.next_wake_ns()
        if wake_ns != station.wake_ns:
            self._set_wake(station, wake_ns)

    def _set_wake(self, station: _Station, wake_ns: int | None) -> None:
        station.wake_ns = wake_ns
        station.due_ns = _NEVER if wake_ns is None else wake_ns
        self._find_due()

    def _find_due(self) -> None:
        self._drives_due_ns = min(station.due_ns for station in self._stations)
        self._due_ns = min(self._next_tick_ns, self._drives_due_ns)

    def _wake_drive(self, station: _Station, due_ns: int) -> None:
        # A wake asked for in the past (a servo tick may do that) is due now: no drive sees time run backwards.
        at_ns = due_ns if due_ns > self._tick_ns else self._tick_ns
        for _ in range(_MAX_WAKES_PER_INSTANT):
            station.drive.wake(at_ns)
            self._set_wake(station, station.next_wake_ns())
            if station.due_ns > at_ns:
                break
        else:
            # A drive that always wants more at one instant must not stop the others: it goes on at the next tick.
            self._set_wake(station, self._next_tick_ns)
        self._exchange(at_ns)

    def _run_tick(self, now_ns: int) -> None:
        plant = self.plant
        plant.advance(self._torques, self._brakes)
        self._tick += 1
        self._tick_ns = now_ns
        self._next_tick_ns = next_ns = self._start_ns + (self._tick + 1) * TWO_SERVO_PERIODS_NS // 2
        self._due_ns = next_ns if next_ns < self._drives_due_ns else self._drives_due_ns
        if plant.torn_at_s is not None and not self._has_tripped:
            self._trip_all(plant.torn_at_s, now_ns)
        is_quiet = True
        angles = plant.angles
        for station in self._stations:
            for motor in station.motors:
                index = motor.index
                self._torques[index] = motor.run(now_ns, angles[index])
                self._brakes[index] = motor.is_braked
            drive = station.drive
            if drive.watches_events:
                drive.after_servo_tick(now_ns)
            if drive.is_wake_stale:
                self._ask_wake(station)
            if station.outbox or station.events or drive.subscriptions_changed:
                is_quiet = False
        if self.records.maxlen:
            self._record(now_ns)
        if not is_quiet:
            self._exchange(now_ns)

    def _exchange(self, now_ns: int) -> None:
        """Collect what the drives have sent and noticed, and let them hear each other."""
        for _ in range(_MAX_CROSS_ROUNDS):
            is_quiet = True
            for station in self._stations:
                if station.drive.subscriptions_changed:
                    self._read_subscriptions()
                if station.events:
                    self._events += station.events
                    station.events.clear()
                if station.outbox:
                    frames = station.outbox.copy()
                    station.outbox.clear()
                    if station.tap is not None:
                        frames = [told for frame in frames for told in station.tap.tell(frame, now_ns)]
                    self._frames += frames
                    for frame in frames:
                        cob_id, _, _ = frame
                        if cob_id in self._routes:
                            is_quiet = False
                            self._tell_others(station, frame, now_ns)
            # Drives that answer each other without end go on at the next tick: on a wire it would cost them time too.
            if is_quiet:
                return

    def _tell_others(self, sender: _Station, frame: Frame, now_ns: int) -> None:
        for station, _ in self._routes[frame.cob_id]:
            if station is not sender:
                station.receive(frame, now_ns)
                self._ask_wake(station)

    def _read_subscriptions(self) -> None:
        routes: dict[int, _Route] = {}
        for station in self._stations:
            station.drive.subscriptions_changed = False
            for cob_id in sorted(station.drive.cob_ids()):
                handler = None if station.tap is not None else station.drive.handler_of(cob_id)
                routes[cob_id] = (*routes.get(cob_id, ()), (station, handler))
        self._routes = routes

    def _trip_all(self, torn_at_s: float, now_ns: int) -> None:
        self._has_tripped = True
        angles = tuple(self.plant.angle(motor.index) for motor in self._motors)
        self._events.append(LinkageTorn(now_ns, torn_at_s, angles))
        for motor in self._motors:
            motor.trip(now_ns)

    def _skip_to(self, now_ns: int) -> None:
        """Let the last servo tick not after ``now_ns`` be the next one."""
        tick = (now_ns - self._start_ns) * 2 // TWO_SERVO_PERIODS_NS
        if self._start_ns + (tick + 1) * TWO_SERVO_PERIODS_NS // 2 <= now_ns:
            tick += 1
        self._events.append(TimeSkipped(now_ns, tick - self._tick - 1))
        self._tick = tick - 1
        self._tick_ns = self._start_ns + self._tick * TWO_SERVO_PERIODS_NS // 2
        self._next_tick_ns = self._start_ns + tick * TWO_SERVO_PERIODS_NS // 2
        # Wakes missed meanwhile are due once, now, not once for every period they have missed.
        for station in self._stations:
            station.due_ns = max(station.due_ns, self._next_tick_ns)
        self._find_due()

    def _record(self, now_ns: int) -> None:
        axes = range(len(self._motors))
        self.records.append(
            TickRecord(
                now_ns,
                tuple(self.plant.angle(axis) for axis in axes),
                tuple(motor.counts for motor in self._motors),
                tuple(motor.drive_axis.position_demand_counts for motor in self._motors),
                tuple(self._torques),
                tuple(self.plant.torque(axis) for axis in axes),
                tuple(self.plant.axis_energy(axis).drawn for axis in axes),
            )
        )
