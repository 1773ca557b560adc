"""The emulated machine: every drive of it and the plant they move, as one node on the bus.

It owns the servo rate. Servo tick n is due exactly n * 1953125 // 2 ns after the start (1024 Hz), in integers, so that
the ticks never drift against the bus, and stand at the same nanoseconds in every run.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, isfinite, pi, sin
from random import Random
from typing import Final, NamedTuple

from drivers.frame import Frame
from drivers.node import Event
from sim_drive.machine_seam import AxisTap, DriveAxis, DriveTap, FrameHandler, Latch, MachineDrive
from sim_drive.physics.driveline import SERVO_PERIOD_S
from sim_drive.physics.plant import Plant
from sim_drive.physics.servo import SERVO_RATE_HZ, DemandResolution, ServoLoop

TWO_SERVO_PERIODS_NS: Final = 2_000_000_000 // SERVO_RATE_HZ
"""A servo period is not a whole number of nanoseconds, but two are: 1953125 ns."""
MAX_CATCH_UP_NS: Final = 1_000_000_000
"""A host that comes later than this has lost the time in between: see `TimeSkipped`."""
LINKAGE_TORN_ERROR_CODE: Final = 0xFF10
"""EMCY error code of a drive whose linkage has torn: of the device-specific range FF00h to FFFFh (CiA 301, 7.2.7.1)."""
LINKAGE_TORN_REGISTER_BITS: Final = 0x81
"""Generic and manufacturer-specific error (CiA 301, object error register)."""

_NEVER: Final = 1 << 63
_MAX_WAKES_PER_INSTANT: Final = 16
_MAX_CROSS_ROUNDS: Final = 8


@dataclass(frozen=True, slots=True)
class MachineAxis:
    """Resolver and scaling of one axis.

    ``torque_per_volt`` in N m / V is the amplifier's; ``rated_torque_Nm`` is what 1000 per mille are;
    ``resolver_noise_counts`` the standard deviation of the resolver's noise before it is quantised, 0 for none;
    ``output_delay_periods``: 1 where the controller's output acts one servo period after the position it was made from,
    as in a drive that computes in between, 0 where it acts at once; ``resolver_eccentricity_counts``: amplitude of an
    error once a revolution, of a rotor that does not run true, which passes zero rising at
    ``resolver_eccentricity_rad``.

    Raises ValueError where a value is out of its bounds.
    """

    counts_per_revolution: int = 4096
    torque_per_volt: float = 0.45
    rated_torque_Nm: float = 1.0
    resolver_noise_counts: float = 0.0
    demand_resolution: DemandResolution = DemandResolution.UNROUNDED_DIFFERENCE
    output_delay_periods: int = 0
    resolver_eccentricity_counts: float = 0.0
    resolver_eccentricity_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.counts_per_revolution < 1:
            raise ValueError(f"counts_per_revolution = {self.counts_per_revolution!r}, must be 1 or more")
        for name, value in (("torque_per_volt", self.torque_per_volt), ("rated_torque_Nm", self.rated_torque_Nm)):
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and positive")
        for name, value in (
            ("resolver_noise_counts", self.resolver_noise_counts),
            ("resolver_eccentricity_counts", self.resolver_eccentricity_counts),
        ):
            if not (isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} = {value!r}, must be finite and zero or more")
        if self.output_delay_periods not in (0, 1):
            raise ValueError(f"output_delay_periods = {self.output_delay_periods!r}, must be 0 or 1")


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


class _Motor:
    """One axis of the machine: of a drive and of the plant, with scaling and servo loop, and the resolver's last."""

    __slots__ = (
        "axis",
        "counts",
        "counts_per_rad",
        "delayed_torque",
        "drive_axis",
        "eccentricity",
        "index",
        "is_plain",
        "is_powered",
        "noise",
        "permille_per_Nm",
        "servo",
        "tap",
        "velocity",
    )

    def __init__(self, index: int, drive_axis: DriveAxis, axis: MachineAxis) -> None:
        self.index = index
        self.drive_axis = drive_axis
        self.axis = axis
        self.servo = ServoLoop(axis.demand_resolution)
        self.counts_per_rad = axis.counts_per_revolution / (2.0 * pi)
        self.permille_per_Nm = 1000.0 / axis.rated_torque_Nm
        self.noise = 0.0
        self.eccentricity = axis.resolver_eccentricity_counts
        self.counts = 0
        self.velocity = 0.0
        """Counts/s, over the last servo period."""
        self.is_powered = False
        self.delayed_torque = 0.0
        """Torque command of the last servo tick, with an output delay."""
        self.tap: AxisTap | None = None
        self.is_plain = not self.eccentricity
        """Whether the resolver shows no more than the angle and its noise."""

    def quantise(self, angle_rad: float) -> int:
        """What the resolver shows at this angle."""
        reading = angle_rad * self.counts_per_rad + self.noise + 0.5
        if self.eccentricity:
            reading += self.eccentricity * sin(angle_rad - self.axis.resolver_eccentricity_rad)
        counts = floor(reading)
        return counts if self.tap is None else self.tap.show(counts)


class _Station:
    """One drive on the bus, and the motors that it has."""

    __slots__ = (
        "after_servo_tick",
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

    def __init__(self, drive: MachineDrive, motors: Sequence[_Motor]) -> None:
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
        self.after_servo_tick = drive.after_servo_tick
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
    the coming period. An axis that is not powered gets no torque, and its servo loop starts anew, without a jump, when
    it is.

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
        "_noise_source",
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
        self._motors: Final = tuple(
            _Motor(index, *pair) for index, pair in enumerate(zip(self.drive_axes, axes, strict=True))
        )
        motors = iter(self._motors)
        self._stations: Final = tuple(_Station(drive, [next(motors) for _ in drive.axes]) for drive in self.drives)
        self._noise_source = Random(seed)  # noqa: S311 - reproducible on purpose
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
        for motor in self._motors:
            motor.counts = motor.quantise(plant.angle(motor.index))
            motor.drive_axis.measure_by(self._latch_of(motor))
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
            motor.tap = axis_tap
            motor.is_plain = False
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
        for station in self._stations:
            for motor in station.motors:
                self._run_servo(motor, now_ns)
            station.after_servo_tick(now_ns)
            drive = station.drive
            if drive.is_wake_stale:
                self._ask_wake(station)
            if station.outbox or station.events or drive.subscriptions_changed:
                is_quiet = False
        if self.records.maxlen:
            self._record(now_ns)
        if not is_quiet:
            self._exchange(now_ns)

    def _run_servo(self, motor: _Motor, now_ns: int) -> None:
        """Show an axis its resolver, and let its controller make the torque for the coming servo period."""
        index = motor.index
        drive_axis = motor.drive_axis
        axis = motor.axis
        if axis.resolver_noise_counts > 0.0:
            motor.noise = self._noise_source.gauss(0.0, axis.resolver_noise_counts)
        angle = self.plant.angle(index)
        tap = motor.tap
        plain = angle * motor.counts_per_rad + motor.noise + 0.5
        counts = floor(plain) if motor.is_plain else motor.quantise(angle)
        motor.velocity = float((counts - motor.counts) * SERVO_RATE_HZ)
        motor.counts = counts
        drive_axis.on_tick(now_ns, counts)
        self._brakes[index] = not drive_axis.is_brake_released and (tap is None or not tap.is_brake_broken)
        if not drive_axis.is_powered:
            motor.is_powered = False
            self._torques[index] = motor.delayed_torque = 0.0
            return
        demand = drive_axis.position_demand_counts
        if not motor.is_powered:
            self._power_on(motor, demand, now_ns)
        torque = None if drive_axis.torque_demand is None else drive_axis.torque_demand_Nm
        if torque is None:
            torque = motor.servo.update(
                demand,
                counts,
                drive_axis.gains,
                drive_axis.torque_offset_Nm,
                axis.torque_per_volt,
                drive_axis.torque_limit_Nm,
                drive_axis.negative_torque_limit_Nm,
                drive_axis.velocity_offset,
            )
        else:
            # The controller is to start without a bump when it gets the axis back.
            motor.servo.reset(demand, counts)
        if axis.output_delay_periods:
            torque, motor.delayed_torque = motor.delayed_torque, torque
        self._torques[index] = torque

    def _power_on(self, motor: _Motor, demand_counts: float, now_ns: int) -> None:
        """The drive has switched its amplifier on since the tick before."""
        motor.is_powered = True
        motor.servo.reset(demand_counts, motor.counts)
        if self._has_tripped:
            # Neither a fault reset nor switching the drive off and on mends a torn linkage.
            motor.drive_axis.trip(LINKAGE_TORN_ERROR_CODE, LINKAGE_TORN_REGISTER_BITS, now_ns, persists=True)

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
                        if frame.cob_id in self._routes:
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

    def _latch_of(self, motor: _Motor) -> Latch:
        index = motor.index
        angle = self.plant.angle
        torque = self.plant.torque

        def latch(now_ns: int) -> tuple[int, float, int]:
            offset_s = (now_ns - self._tick_ns) * 1e-9
            if offset_s < 0.0:
                offset_s = 0.0
            elif offset_s > SERVO_PERIOD_S:
                offset_s = SERVO_PERIOD_S
            radians = angle(index, offset_s)
            return (
                floor(radians * motor.counts_per_rad + motor.noise + 0.5)
                if motor.is_plain
                else motor.quantise(radians),
                motor.velocity,
                floor(torque(index) * motor.permille_per_Nm + 0.5),
            )

        return latch

    def _trip_all(self, torn_at_s: float, now_ns: int) -> None:
        self._has_tripped = True
        angles = tuple(self.plant.angle(motor.index) for motor in self._motors)
        self._events.append(LinkageTorn(now_ns, torn_at_s, angles))
        for motor in self._motors:
            motor.drive_axis.trip(LINKAGE_TORN_ERROR_CODE, LINKAGE_TORN_REGISTER_BITS, now_ns, persists=True)

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
