"""What a configuration file may say. Every key's name carries its unit; unknown keys are refused."""

import math
from enum import Enum
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from config.bus_budget import MAX_BUS_LOAD, BusBudget, bus_budget, deadline_without_wire_us
from config.emulation_section import EmulatedDriveSection
from config.guard_section import GuardSection
from config.model import AxisName, Model, Point, Positive
from config.torque_sections import FeedForwardSection, LearningSection, PositionLoopSection
from config.watchdog_section import SyncWatchdogSection
from drivers.nmt import MAX_NODE_ID

SERVO_RATE_HZ: Final = 1024
"""Rate of the emulated drives' position controllers, the paper's."""
SINGULAR_SHARE: Final = 0.5
"""The emulated linkage tears at this share of the transmission sine that the configuration keeps as its distance."""
VIRTUAL_BIT_RATE: Final = 1_000_000_000
"""What a channel without a bit rate has in virtual time."""

Millimetres = Annotated[float, Field(ge=1.0, le=10_000.0)]


class FiveBarSection(Model):
    """Link lengths and pivots of the five-bar, in the paper's letters."""

    p_mm: Millimetres
    q_mm: Millimetres
    r_mm: Millimetres
    s_mm: Millimetres
    cv_pivot_mm: Point = (0.0, 0.0)
    servo_pivot_mm: Point

    def linkage_sine(self, theta2_deg: float, theta5_deg: float) -> float:
        """Sine of the angle between links q and r, 0 where they are in line or do not reach each other."""
        a = self._crank_end(self.cv_pivot_mm, self.p_mm, theta2_deg)
        d = self._crank_end(self.servo_pivot_mm, self.s_mm, theta5_deg)
        cosine = (self.q_mm**2 + self.r_mm**2 - math.dist(a, d) ** 2) / (2.0 * self.q_mm * self.r_mm)
        return math.sqrt(max(1.0 - cosine * cosine, 0.0))

    def _crank_end(self, pivot_mm: tuple[float, float], length_mm: float, angle_deg: float) -> tuple[float, float]:
        angle = math.radians(angle_deg)
        return pivot_mm[0] + length_mm * math.cos(angle), pivot_mm[1] + length_mm * math.sin(angle)


class LinkSection(Model):
    """A link as a rigid body; ``com_m`` is measured along the link from its first joint (see mechanism.dynamics)."""

    mass_kg: Annotated[float, Field(ge=0.0, le=1000.0)]
    com_m: Annotated[float, Field(ge=-10.0, le=10.0)]
    com_perp_m: Annotated[float, Field(ge=-10.0, le=10.0)] = 0.0
    inertia_com_kgm2: Annotated[float, Field(ge=0.0, le=1000.0)]

    @property
    def inertia_about_joint_kgm2(self) -> float:
        """Moment of inertia about the first joint."""
        return self.inertia_com_kgm2 + self.mass_kg * (self.com_m**2 + self.com_perp_m**2)


class LinksSection(Model):
    """The four moving links."""

    p: LinkSection
    q: LinkSection
    r: LinkSection
    s: LinkSection


class MachineSection(Model):
    """The linkage, its masses, and the plane that it stands in."""

    five_bar: FiveBarSection
    links: LinksSection
    end_effector_mass_kg: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    gravity_m_s2: Point = (0.0, -9.80665)
    minimum_transmission_sine: Annotated[float, Field(ge=0.01, le=0.9)] = 0.1
    """Least sine of the angles between q and r and between r and s: the distance kept to singular positions."""


class MotionSection(Model):
    """What the machine is to do."""

    curve: str
    """CSV file of the desired curve, relative to the configuration file."""
    speed_rpm: Annotated[float, Field(gt=0.0, le=6000.0)]
    machine_cycles: Annotated[int, Field(ge=1, le=1_000_000)] = 10
    ramp_acceleration_rad_per_s2: Positive
    ramp_jerk_rad_per_s3: Positive
    approach_speed_rad_per_s: Positive = 0.5
    """Of the faster axis on the slow way onto the cam, from wherever the linkage stands."""
    engagement_window_deg: Annotated[float, Field(ge=1.0, le=360.0)] | None = None
    """Of the master, within which the slave leaves its cam or is back on it; null: whichever fits best there."""
    cam_points: Annotated[int, Field(ge=64, le=65536)] = 1024
    structural_error_limit_mm: Annotated[float, Field(gt=0.0, le=1000.0)] = 0.5

    @model_validator(mode="after")
    def _points_are_a_power_of_two(self) -> Self:
        if self.cam_points & (self.cam_points - 1):
            raise ValueError(f"cam_points: {self.cam_points} is not a power of two")
        return self


class IdentitySection(Model):
    """Identity object 1018h as it must be; a part that is left out is not checked."""

    vendor_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    product_code: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    revision_number: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    serial_number: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None


class LimitsSection(Model):
    """What the axis may do at most; cam and ramps are checked against it before anything moves."""

    position_deg: tuple[float, float] | None = None
    velocity_rad_per_s: Positive
    acceleration_rad_per_s2: Positive
    jerk_rad_per_s3: Positive | None = None
    following_error_counts: Annotated[int, Field(ge=1, le=0x7FFFFFFF)]
    """The drive's window (6065h), beyond which it faults, and what the gateway guards."""
    guarded_error_counts: Annotated[int, Field(ge=1, le=0x7FFFFFFF)] | None = None
    """What the gateway guards if that is to be less, so that it reacts before the drive does."""
    quick_stop_deceleration_rad_per_s2: Positive | None = None
    """Of the drive's own ramp (6085h) in a quick stop and after a fault; null leaves what the drive has."""

    @property
    def gateway_error_counts(self) -> int:
        """Following error that the gateway guards."""
        return self.following_error_counts if self.guarded_error_counts is None else self.guarded_error_counts

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.position_deg is not None and self.position_deg[0] >= self.position_deg[1]:
            raise ValueError(f"position_deg: {self.position_deg[0]:g} is not below {self.position_deg[1]:g}")
        if self.gateway_error_counts > self.following_error_counts:
            raise ValueError(
                f"guarded_error_counts: {self.guarded_error_counts} can never be met, the drive faults at"
                f" following_error_counts {self.following_error_counts}"
            )
        return self


class Role(Enum):
    """Which link an axis drives."""

    MASTER = "master"
    SLAVE = "slave"


class AxisSection(Model):
    """One drive on the bus, and the axis that it moves."""

    role: Role
    node_id: Annotated[int, Field(ge=1, le=MAX_NODE_ID)]
    identity: IdentitySection = IdentitySection()
    counts_per_revolution: Annotated[int, Field(ge=16, le=1 << 24)] = 4096
    home_angle_deg: Annotated[float, Field(ge=-3600.0, le=3600.0)] = 0.0
    """Angle of the link where the axis is homed, so where its position actual value is 0."""
    homing_method: Literal[35, 37] | None = 37
    """CiA 402 homing on the current position; null leaves the drive's zero as it is."""
    rated_torque_Nm: Positive
    limits: LimitsSection
    position_loop: PositionLoopSection | None = None
    """Null: the drive closes the loop (csp); else the gateway does (cst)."""
    sync_watchdog: SyncWatchdogSection | None = None
    """Null: the drive's watch over SYNC, if it has one, is left as it is."""
    emulation: EmulatedDriveSection


class SyncSource(Enum):
    """Who sends SYNC."""

    AUTO = "auto"
    """The kernel on SocketCAN, the loop elsewhere."""
    KERNEL = "kernel"
    """The broadcast manager of SocketCAN, from the kernel's own timer."""
    LOOP = "loop"
    """The cyclic loop, on absolute deadlines."""


class Timestamps(Enum):
    """By whose clock the arrival of a frame is told."""

    AUTO = "auto"
    """The controller's where the interface offers it, else the kernel's."""
    KERNEL = "kernel"
    """The kernel's: when it has taken the frame from the driver."""
    HARDWARE = "hardware"
    """The controller's: when the frame has been on the bus."""


class BusSection(Model):
    """Where the drives are, and how often they are spoken to."""

    interface: Annotated[str, Field(pattern=r"^[a-z0-9_]{1,32}$")] = "auto"
    """auto: socketcan on ``channel`` where that interface is up, else socketcand at ``host``:``port``."""
    channel: Annotated[str, Field(min_length=1, max_length=64)] = "vcan0"
    host: Annotated[str, Field(min_length=1, max_length=253)] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 29536
    bit_rate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    is_virtual: bool = False
    """The channel has no bit rate (vcan, loopback): the budget is told, and a run on a real bus alone is held to it."""
    cycle_us: Annotated[int, Field(ge=200, le=1_000_000)] = 1000
    sdo_frames_a_cycle: Annotated[int, Field(ge=1, le=100)] = 2
    """Reserve for SDO while the cycle runs, requests and responses together; no more is sent."""
    sync_source: SyncSource = SyncSource.AUTO
    timestamps: Timestamps = Timestamps.AUTO
    trace_lateness: bool = False
    """Tell, in the run's events, of every late wake: processor taken away, stolen by the host, page faults.

    Why deadlines were missed is in every report without it."""
    processor: Annotated[int, Field(ge=0, le=4095)] | None = None
    """Processor that the cyclic loop is bound to; null: an isolated one if there is one, else none."""
    gateway_node_id: Annotated[int, Field(ge=1, le=MAX_NODE_ID)] = 127
    """Node id under which the gateway sends its own heartbeat."""
    heartbeat_ms: Annotated[int, Field(ge=1, le=30_000)] = 50
    """Period of all heartbeats, the gateway's and the drives'."""
    heartbeat_timeout_ms: Annotated[int, Field(ge=2, le=60_000)] = 200
    boot_up_timeout_s: Annotated[float, Field(gt=0.0, le=60.0)] = 2.0

    def interpolation_time(self) -> tuple[int, int] | None:
        """The cycle as 60C2h says it: value 1..255 and power of ten in seconds, None if it cannot be said."""
        value, exponent = self.cycle_us, -6
        while value % 10 == 0:
            value, exponent = value // 10, exponent + 1
        return (value, exponent) if value <= 255 else None


class RecoverySection(Model):
    """What is done after a stop that the guard called for; no motion is ever restarted."""

    timeout_s: Annotated[float, Field(ge=0.0, le=60.0)] = 2.0
    """How long a drive that has gone may take to come back, to be commissioned anew; 0 leaves all as they are."""
    bus_off_timeout_s: Annotated[float, Field(ge=0.05, le=60.0)] = 5.0
    """How long the gateway's own controller may be bus-off before the bus is given up."""
    restart_delay_ms: Annotated[int, Field(ge=1, le=10_000)] = 100
    """After so long the gateway restarts its controller, where the interface's own restart-ms is 0."""
    max_restarts: Annotated[int, Field(ge=0, le=100)] = 3
    """In a run; 0 leaves the restart to the interface."""


class EmulatorSection(Model):
    """The emulated machine as a whole."""

    eds: str = "eds/sim_drive.eds"
    sub_steps: Annotated[int, Field(ge=1, le=100)] = 4
    missing_sync_limit: Annotated[int, Field(ge=0, le=1000)] = 0
    """Set-point watchdog 3050h of a drive as it is switched on; 0: off, as ``axes.*.sync_watchdog`` finds it."""


class GatewayConfig(Model):
    """A whole configuration file."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    description: Annotated[str, Field(max_length=2000)] = ""
    machine: MachineSection
    motion: MotionSection
    axes: Annotated[dict[AxisName, AxisSection], Field(min_length=2, max_length=2)]
    bus: BusSection = BusSection()
    guard: GuardSection = GuardSection()
    recovery: RecoverySection = RecoverySection()
    feed_forward: FeedForwardSection = FeedForwardSection()
    learning: LearningSection = LearningSection()
    emulator: EmulatorSection = EmulatorSection()
    _path: Path = Path()
    _text: str = ""

    @property
    def path(self) -> Path:
        """File that the configuration was read from."""
        return self._path

    @property
    def text(self) -> str:
        """The file's text as it was read, for the recording."""
        return self._text

    @property
    def axis_names(self) -> tuple[str, ...]:
        """The axes, master first: the order in which samples and frames have them."""
        return tuple(sorted(self.axes, key=lambda name: self.axes[name].role is not Role.MASTER))

    @property
    def ordered_axes(self) -> tuple[AxisSection, ...]:
        """The axes in the order of ``axis_names``."""
        return tuple(self.axes[name] for name in self.axis_names)

    @property
    def cycle_s(self) -> float:
        """The cycle in seconds."""
        return self.bus.cycle_us * 1e-6

    @property
    def budget(self) -> BusBudget:
        """What the configuration puts on the bus."""
        bus = self.bus
        return bus_budget(len(self.axes), bus.cycle_us, bus.bit_rate, bus.heartbeat_ms, bus.sdo_frames_a_cycle)

    @property
    def tpdo_deadline_us(self) -> float:
        """How long after SYNC the TPDOs are waited for."""
        return deadline_without_wire_us(self.bus.cycle_us) if self.bus.is_virtual else self.budget.tpdo_deadline_us

    @property
    def wire_bit_rate(self) -> int:
        """Bit rate of the bus in virtual time."""
        return VIRTUAL_BIT_RATE if self.bus.is_virtual else self.bus.bit_rate

    @property
    def speed_rad_per_s(self) -> float:
        """Speed of the CV axis."""
        return self.motion.speed_rpm * 2.0 * math.pi / 60.0

    @property
    def unaided(self) -> Self:
        """The same machine without feed-forward and learning: the drives' controllers alone."""
        return self.model_copy(update={"feed_forward": FeedForwardSection(), "learning": LearningSection()})

    def relative(self, name: str) -> Path:
        """A file that the configuration names: beside it, or the shipped one of that name."""
        beside = self._path.parent / name
        return beside if beside.exists() else Path(__file__).parent / name

    @model_validator(mode="after")
    def _cross_check(self) -> Self:
        roles = [axis.role for axis in self.axes.values()]
        if roles.count(Role.MASTER) != 1 or roles.count(Role.SLAVE) != 1:
            raise ValueError("axes: there must be one axis with role master and one with role slave")
        users: dict[int, str] = {self.bus.gateway_node_id: "bus.gateway_node_id"}
        for name, axis in self.axes.items():
            if axis.node_id in users:
                taken = f"{axis.node_id} is taken by {users[axis.node_id]}"
                raise ValueError(f"axes.{name}.node_id: {taken}, every node id must be unique")
            users[axis.node_id] = f"axes.{name}"
        if self.bus.interpolation_time() is None:
            raise ValueError(
                f"bus.cycle_us: {self.bus.cycle_us} cannot be said in 60C2h, which takes 1 to 255 times a power of ten"
            )
        if self.bus.heartbeat_ms * 1000 <= self.bus.cycle_us:
            raise ValueError(
                f"bus.heartbeat_ms: {self.bus.heartbeat_ms} ms is not longer than the cycle of {self.bus.cycle_us} us"
            )
        if self.bus.heartbeat_timeout_ms < 2 * self.bus.heartbeat_ms:
            raise ValueError(
                f"bus.heartbeat_timeout_ms: {self.bus.heartbeat_timeout_ms} is below twice heartbeat_ms "
                f"({self.bus.heartbeat_ms}), a single late heartbeat would stop the machine"
            )
        for section, names in (("feed_forward", self.feed_forward.axes), ("learning", self.learning.axes)):
            for name in names:
                if name not in self.axes:
                    known = " and ".join(self.axes)
                    raise ValueError(f"{section}.axes.{name}: there is no such axis, they are {known}")
        budget = self.budget
        if not (budget.is_within_bound or self.bus.is_virtual):
            raise ValueError(
                f"bus.cycle_us: {self.bus.cycle_us} us is too short for {len(self.axes)} axes at "
                f"{self.bus.bit_rate} bit/s, SYNC, PDOs, heartbeats and the SDO reserve would take {budget.load:.0%} "
                f"of it (bound {MAX_BUS_LOAD:.0%}), {budget.shortest_cycle_us} us would fit; on a channel without a "
                "bit rate say is_virtual: true"
            )
        return self

    @model_validator(mode="after")
    def _machine_can_be_emulated(self) -> Self:
        links = self.machine.links
        step_s = 1.0 / (SERVO_RATE_HZ * self.emulator.sub_steps)
        for name, link in zip(self.axis_names, (links.p, links.s), strict=True):
            self.axes[name].emulation.check_steps(f"axes.{name}.emulation", link.inertia_about_joint_kgm2, step_s)
        home = [axis.home_angle_deg for axis in self.ordered_axes]
        sine = self.machine.five_bar.linkage_sine(home[0], home[1])
        bound = SINGULAR_SHARE * self.machine.minimum_transmission_sine
        if sine < bound:
            raise ValueError(
                f"axes: at home_angle_deg {home[0]:g} and {home[1]:g} the linkage cannot stand, the sine of the angle "
                f"between links q and r is {sine:.3g} (bound {bound:g}, half of machine.minimum_transmission_sine)"
            )
        return self

    @model_validator(mode="after")
    def _guard_can_trip(self) -> Self:
        self.guard.check_cycle(self.bus.cycle_us, self.bus.heartbeat_timeout_ms)
        for name, axis in self.axes.items():
            if axis.sync_watchdog is not None:
                axis.sync_watchdog.check(name, self.bus.cycle_us, self.guard.sync_lost.limit_cycles)
            limits = axis.limits
            self.guard.check_axis(
                name, axis.counts_per_revolution, limits.following_error_counts, limits.gateway_error_counts
            )
            links = self.machine.five_bar
            self.guard.check_end_effector(links.p_mm + links.q_mm, axis.counts_per_revolution)
        return self

    @model_validator(mode="after")
    def _master_is_within_its_limits(self) -> Self:
        name = self.axis_names[0]
        limits, motion = self.axes[name].limits, self.motion
        if self.speed_rad_per_s > limits.velocity_rad_per_s:
            raise ValueError(
                f"motion.speed_rpm: {motion.speed_rpm:g} is {self.speed_rad_per_s:.3f} rad/s, above "
                f"axes.{name}.limits.velocity_rad_per_s {limits.velocity_rad_per_s:g}"
            )
        if motion.ramp_acceleration_rad_per_s2 > limits.acceleration_rad_per_s2:
            raise ValueError(
                f"motion.ramp_acceleration_rad_per_s2: {motion.ramp_acceleration_rad_per_s2:g} is above "
                f"axes.{name}.limits.acceleration_rad_per_s2 {limits.acceleration_rad_per_s2:g}"
            )
        if limits.jerk_rad_per_s3 is not None and motion.ramp_jerk_rad_per_s3 > limits.jerk_rad_per_s3:
            raise ValueError(
                f"motion.ramp_jerk_rad_per_s3: {motion.ramp_jerk_rad_per_s3:g} is above "
                f"axes.{name}.limits.jerk_rad_per_s3 {limits.jerk_rad_per_s3:g}"
            )
        for other, axis in self.axes.items():
            if motion.approach_speed_rad_per_s > axis.limits.velocity_rad_per_s:
                raise ValueError(
                    f"motion.approach_speed_rad_per_s: {motion.approach_speed_rad_per_s:g} is above "
                    f"axes.{other}.limits.velocity_rad_per_s {axis.limits.velocity_rad_per_s:g}"
                )
        if limits.position_deg is not None:
            raise ValueError(
                f"axes.{name}.limits.position_deg: the master turns without end and can have no such limit"
            )
        return self
