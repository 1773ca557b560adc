"""Both axes of the emulated machine under their position controllers, without bus, frames or objects.

For optimisers and studies that need thousands of machine cycles: one numba kernel advances the coupled plant, runs
eq (5) and (6) of both drives at 1024 Hz, and, at every SYNC, latches the resolvers and lets a target of cyclic
synchronous position and a torque offset act, exactly as the emulated machine does. The
same set-points at the same instants give the same counts, bit for bit; a test holds the two against each other.

What is left out: software position limits, brakes, faults and everything that a drive does when it is not enabled.

Kernels may call `advance_to_sync`, `apply_set_points` and `simulate`; Python uses `ClosedLoop`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from config.schema import GatewayConfig
from mechanism.errors import ParameterError
from mechanism.jit import kernel
from sim_drive.assembly import build_machine
from sim_drive.machine import TWO_SERVO_PERIODS_NS
from sim_drive.machine_axis import MachineAxis
from sim_drive.physics.driveline import SERVO_PERIOD_S
from sim_drive.physics.five_bar_motion import advance_five_bar
from sim_drive.physics.plant import CoupledPlant
from sim_drive.physics.servo import GAIN_SCALE, OUTPUT_MAXIMUM, OUTPUT_MINIMUM, VOLT_PER_UNIT, DemandResolution

Float = NDArray[np.float64]
Int = NDArray[np.int64]

# Layout of the flat arrays; kernels see these as compile-time constants.
# Settings of an axis.
_COUNTS_PER_RAD: Final = 0
_NM_PER_UNIT: Final = 1
_LIMIT_HIGH: Final = 2
_LIMIT_LOW: Final = 3
_ROUNDS_ERROR: Final = 4
_ROUNDS_DIFFERENCE: Final = 5
_OUTPUT_DELAY: Final = 6
_NM_PER_PERMILLE: Final = 7
_VOLT_NM: Final = 8
_ECCENTRICITY: Final = 9
_ECCENTRICITY_RAD: Final = 10
# Memory of an axis: its controller, its resolver, the commands under way, and the line that its demand follows.
_ERROR_SUM: Final = 0
_ERROR_BEFORE: Final = 1
_POSITION_BEFORE: Final = 2
_DEMAND_BEFORE: Final = 3
_NOISE: Final = 4
_COMMAND: Final = 5
_DELAYED: Final = 6
_TORQUE_OFFSET: Final = 7
_LINE_POSITION: Final = 8
_LINE_VELOCITY: Final = 9
_LINE_DURATION: Final = 10
_MEMORY_COUNT: Final = 11
# Clock of the machine, in ns: instant of the last servo tick, its number, and where the lines of both axes begin.
_TICK_NS: Final = 0
_TICK: Final = 1
_LINE_START_NS: Final = 2
_CLOCK_COUNT: Final = 4
_TICK_COLUMNS: Final = 5
"""Of a recorded servo tick, each axis: counts, demand in counts; torque command, torque and torque offset in N m."""

_AXES: Final = 2
_NS_PER_S: Final = 1_000_000_000


class PlantArguments(NamedTuple):
    """What `sim_drive.physics.five_bar_motion.advance_five_bar` wants of a plant, apart from its state."""

    dynamics: Float
    settings: Float
    closure: int
    singular_sine: float
    step_s: float
    substeps: int


@kernel
def _resolver(settings: Float, memory: Float, axis: int, angle: float) -> float:
    """Whole counts that the resolver shows at an angle (rad)."""
    reading = angle * settings[axis, _COUNTS_PER_RAD] + memory[axis, _NOISE] + 0.5
    eccentricity: float = settings[axis, _ECCENTRICITY]
    if eccentricity != 0.0:
        reading += eccentricity * sin(angle - settings[axis, _ECCENTRICITY_RAD])
    return floor(reading)


@kernel
def _demand_at(memory: Float, clock: Int, axis: int, now_ns: int) -> float:
    """The line that an axis' demand follows, in counts; before its start and after its end it rests."""
    t = (now_ns - clock[_LINE_START_NS + axis]) * 1e-9
    if t >= memory[axis, _LINE_DURATION]:
        t = memory[axis, _LINE_DURATION]
    elif t < 0.0:
        t = 0.0
    return memory[axis, _LINE_POSITION] + memory[axis, _LINE_VELOCITY] * t


@kernel
def _control(settings: Float, gains: Float, memory: Float, axis: int, demand_counts: float, actual: float) -> float:
    """Torque command (N m) of eq (5) and (6) with the memory that they have: `servo.ServoLoop.update`."""
    demand = floor(demand_counts + 0.5) if settings[axis, _ROUNDS_ERROR] > 0.0 else demand_counts
    demand_fed = demand if settings[axis, _ROUNDS_DIFFERENCE] > 0.0 else demand_counts
    error = demand - actual
    error_sum = memory[axis, _ERROR_SUM] + error
    wanted = (
        gains[axis, 0] * error
        + gains[axis, 1] * error_sum
        + gains[axis, 2] * (error - memory[axis, _ERROR_BEFORE])
        - gains[axis, 3] * (actual - memory[axis, _POSITION_BEFORE])
        + gains[axis, 4] * (demand_fed - memory[axis, _DEMAND_BEFORE])
    ) / GAIN_SCALE + memory[axis, _TORQUE_OFFSET] / settings[axis, _NM_PER_UNIT]
    if wanted >= settings[axis, _LIMIT_HIGH]:
        output = settings[axis, _LIMIT_HIGH]
        if error < 0.0:
            memory[axis, _ERROR_SUM] = error_sum
    elif wanted <= settings[axis, _LIMIT_LOW]:
        output = settings[axis, _LIMIT_LOW]
        if error > 0.0:
            memory[axis, _ERROR_SUM] = error_sum
    else:
        output = floor(wanted + 0.5)
        memory[axis, _ERROR_SUM] = error_sum
    memory[axis, _ERROR_BEFORE] = error
    memory[axis, _POSITION_BEFORE] = actual
    memory[axis, _DEMAND_BEFORE] = demand_fed
    return output * VOLT_PER_UNIT * settings[axis, _VOLT_NM]


@kernel
def advance_to_sync(
    plant_state: Float,
    dynamics: Float,
    plant_settings: Float,
    closure: int,
    singular_sine: float,
    step_s: float,
    substeps: int,
    settings: Float,
    gains: Float,
    memory: Float,
    clock: Int,
    sync_ns: int,
    noise: Float,
    ticks: Float,
    first_tick: int,
) -> bool:
    """Run every servo tick that is due before ``sync_ns``; False if the linkage tore.

    ``noise`` (n, 2): the resolvers' noise in counts at tick ``first_tick`` + 1 and after, empty for none. ``ticks``
    (n, 2, 5) takes those ticks, empty for nothing. Of what `ClosedLoop` holds, state, memory and clock are changed.
    """
    while True:
        number = clock[_TICK] + 1
        now_ns = number * TWO_SERVO_PERIODS_NS // 2
        if now_ns >= sync_ns:
            return True
        torn = advance_five_bar(
            plant_state,
            dynamics,
            plant_settings,
            closure,
            singular_sine,
            step_s,
            substeps,
            memory[0, _COMMAND],
            memory[1, _COMMAND],
            False,
            False,
        )[8]
        if torn:
            return False
        clock[_TICK] = number
        clock[_TICK_NS] = now_ns
        row = number - first_tick - 1
        for axis in range(_AXES):
            if row < noise.shape[0]:
                memory[axis, _NOISE] = noise[row, axis]
            counts = _resolver(settings, memory, axis, plant_state[axis])
            demand = _demand_at(memory, clock, axis, now_ns)
            command = _control(settings, gains, memory, axis, demand, counts)
            if settings[axis, _OUTPUT_DELAY] > 0.0:
                memory[axis, _COMMAND] = memory[axis, _DELAYED]
                memory[axis, _DELAYED] = command
            else:
                memory[axis, _COMMAND] = command
            if row < ticks.shape[0]:
                ticks[row, axis, 0] = counts
                ticks[row, axis, 1] = demand
                ticks[row, axis, 2] = command
                ticks[row, axis, 3] = plant_state[6 + axis]
                ticks[row, axis, 4] = memory[axis, _TORQUE_OFFSET]


@kernel
def latch(plant_state: Float, settings: Float, memory: Float, clock: Int, axis: int, now_ns: int) -> float:
    """Whole counts that an axis' resolver shows at ``now_ns``, not more than a servo period after the last tick."""
    offset_s = (now_ns - clock[_TICK_NS]) * 1e-9
    if offset_s < 0.0:
        offset_s = 0.0
    elif offset_s > SERVO_PERIOD_S:
        offset_s = SERVO_PERIOD_S
    angle = plant_state[axis] + offset_s * (plant_state[axis + 2] + 0.5 * offset_s * plant_state[axis + 4])
    return _resolver(settings, memory, axis, angle)


@kernel
def apply_set_points(
    settings: Float,
    memory: Float,
    clock: Int,
    sync_ns: int,
    period_s: float,
    target2: float,
    target5: float,
    torque_offset2: float,
    torque_offset5: float,
) -> None:
    """What a SYNC does with targets (whole counts) and torque offsets (per mille of rated torque) that came before it.

    The demand goes from where it is to the target in a straight line that takes ``period_s``, and for as long again
    goes on beyond it if no other target comes.
    """
    for axis in range(_AXES):
        target = target2 if axis == 0 else target5
        start = _demand_at(memory, clock, axis, sync_ns)
        clock[_LINE_START_NS + axis] = sync_ns
        memory[axis, _LINE_POSITION] = start
        memory[axis, _LINE_VELOCITY] = (target - start) / period_s
        memory[axis, _LINE_DURATION] = period_s + period_s
        offset = torque_offset2 if axis == 0 else torque_offset5
        memory[axis, _TORQUE_OFFSET] = offset * 0.001 * settings[axis, _NM_PER_PERMILLE]


@kernel
def simulate(
    plant_state: Float,
    dynamics: Float,
    plant_settings: Float,
    closure: int,
    singular_sine: float,
    step_s: float,
    substeps: int,
    settings: Float,
    gains: Float,
    memory: Float,
    clock: Int,
    period_s: float,
    sync_ns: Int,
    targets: Int,
    torque_offsets: Float,
    noise: Float,
    actual: Int,
    torque: Float,
    ticks: Float,
) -> int:
    """n SYNCs at the instants ``sync_ns`` (n,); returns how many came before the linkage tore, n if it is whole.

    ``targets`` (n, 2) in counts and ``torque_offsets`` (n, 2) in per mille, or empty: what acts at each SYNC.
    ``actual`` (n, 2) in counts and ``torque`` (n, 2) in N m take what is latched at each SYNC before that. ``noise``
    and ``ticks`` as for `advance_to_sync`.
    """
    first_tick = clock[_TICK]
    offset2 = 0.0
    offset5 = 0.0
    for k in range(sync_ns.shape[0]):
        now_ns = sync_ns[k]
        if not advance_to_sync(
            plant_state,
            dynamics,
            plant_settings,
            closure,
            singular_sine,
            step_s,
            substeps,
            settings,
            gains,
            memory,
            clock,
            now_ns,
            noise,
            ticks,
            first_tick,
        ):
            return k
        for axis in range(_AXES):
            actual[k, axis] = int(latch(plant_state, settings, memory, clock, axis, now_ns))
            torque[k, axis] = plant_state[6 + axis]
        if k < torque_offsets.shape[0]:
            offset2 = torque_offsets[k, 0]
            offset5 = torque_offsets[k, 1]
        apply_set_points(
            settings, memory, clock, now_ns, period_s, float(targets[k, 0]), float(targets[k, 1]), offset2, offset5
        )
    return sync_ns.shape[0]


@dataclass(frozen=True, slots=True)
class ClosedLoopRun:
    """What n SYNCs have latched, (n, 2), columns CV axis and servo axis.

    ``error_counts[k]``: the target that acted at SYNC k-1 minus the actual position at SYNC k, as the gateway has it.
    Where the linkage tore there are fewer than were asked for, and ``is_torn`` says so.
    """

    actual_counts: Int
    torque_Nm: Float
    error_counts: Int
    is_torn: bool
    ticks: Float
    """(m, 2, 5): counts, demand (counts), torque command, torque and torque offset (N m) at every servo tick.

    The command has the offset in it. Empty unless asked for.
    """


class ClosedLoop:
    """The machine that a configuration describes, enabled, in cyclic synchronous position; see the module.

    State lasts from one ``run`` to the next, so that set-points may depend on what came of those before. The SYNC comes
    every cycle; the first one ``SYNC_PHASE_NS`` after the start.
    """

    SYNC_PHASE_NS: Final = 300_000

    __slots__ = (
        "_clock",
        "_last_targets",
        "_memory",
        "_noise_counts",
        "_random",
        "_settings",
        "_state",
        "_sync",
        "cycle_s",
        "gains",
        "home_rad",
        "plant",
    )

    def __init__(
        self,
        plant: PlantArguments,
        axes: Sequence[MachineAxis],
        gains: Sequence[Sequence[int]],
        torque_limits_Nm: Sequence[tuple[float, float]],
        home_rad: Sequence[float],
        cycle_s: float,
        seed: int = 0,
    ) -> None:
        """``torque_limits_Nm``: of each axis what the drive allows forwards and backwards, both positive.

        ``home_rad``: angles at which the axes stand at first; ``seed``: of the resolvers' noise.
        """
        self.plant: Final = plant
        self.home_rad = (home_rad[0], home_rad[1])
        self.cycle_s: Final = cycle_s
        self.gains: Float = np.array(gains, dtype=np.float64)
        """(2, 5): K_P, K_I, K_D, K_V, K_F of both axes, integers over 256; may be replaced between two runs."""
        self._settings = np.array(
            [_axis_settings(axis, limits) for axis, limits in zip(axes, torque_limits_Nm, strict=True)]
        )
        self._noise_counts = np.array([axis.resolver_noise_counts for axis in axes])
        self._state = np.zeros(8)
        self._memory = np.zeros((_AXES, _MEMORY_COUNT))
        self._clock = np.zeros(_CLOCK_COUNT, dtype=np.int64)
        self._last_targets: Int = np.zeros(_AXES, dtype=np.int64)
        self._sync = 0
        self._random = np.random.default_rng(seed)
        self.reset(seed)

    def reset(
        self,
        seed: int = 0,
        theta_rad: tuple[float, float] | None = None,
        omega_rad_per_s: tuple[float, float] = (0.0, 0.0),
        torque_Nm: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Enable the drives at these angles and velocities, the amplifiers giving these torques; at home by default.

        The demand is where the axes are, and moves with them until the first SYNC.
        """
        theta = self.home_rad if theta_rad is None else theta_rad
        self._state[:] = (*theta, *omega_rad_per_s, 0.0, 0.0, *torque_Nm)
        self._memory[:] = 0.0
        self._clock[:] = 0
        self._sync = 0
        self._random = np.random.default_rng(seed)
        for axis in range(_AXES):
            scale = self._settings[axis, _COUNTS_PER_RAD]
            counts = floor(theta[axis] * scale + 0.5)
            line = theta[axis] * scale if omega_rad_per_s[axis] else float(counts)
            memory = self._memory[axis]
            memory[_POSITION_BEFORE] = counts
            memory[_DEMAND_BEFORE] = memory[_LINE_POSITION] = line
            memory[_LINE_VELOCITY] = omega_rad_per_s[axis] * scale
            memory[_LINE_DURATION] = 2.0 * self.cycle_s
            memory[_COMMAND] = memory[_DELAYED] = torque_Nm[axis]
            before = line + memory[_LINE_VELOCITY] * (self.SYNC_PHASE_NS * 1e-9)
            self._last_targets[axis] = floor(before + 0.5)

    def run(
        self,
        targets: Int,
        torque_offsets: Float | None = None,
        *,
        sync_ns: Int | None = None,
        record_ticks: bool = False,
    ) -> ClosedLoopRun:
        """Go on for n SYNCs with these ``targets`` (n, 2) in counts, and torque offsets (n, 2) in per mille.

        Counts are the resolvers', which are 0 where the links' angles are. ``sync_ns`` (n,): other instants of SYNCs
        than the regular ones, growing. Raises ValueError where the shapes do not fit.
        """
        count = len(targets)
        offsets = np.zeros((0, _AXES)) if torque_offsets is None else np.asarray(torque_offsets, dtype=np.float64)
        if targets.shape != (count, _AXES) or (torque_offsets is not None and offsets.shape != targets.shape):
            raise ValueError(f"targets of shape {targets.shape} with torque offsets of shape {offsets.shape}")
        if sync_ns is None:
            cycle_ns = round(self.cycle_s * _NS_PER_S)
            sync_ns = self.SYNC_PHASE_NS + cycle_ns * np.arange(self._sync, self._sync + count, dtype=np.int64)
        elif sync_ns.shape != (count,):
            raise ValueError(f"{len(sync_ns)} SYNCs for {count} targets")
        last_ns = int(sync_ns[-1]) if count else 0
        tick_count = max(0, last_ns * 2 // TWO_SERVO_PERIODS_NS - int(self._clock[_TICK]) + 1)
        noise = np.zeros((0, _AXES))
        if self._noise_counts.any():
            noise = self._random.normal(size=(tick_count, _AXES)) * self._noise_counts
        ticks = np.zeros((tick_count if record_ticks else 0, _AXES, _TICK_COLUMNS))
        first_tick = int(self._clock[_TICK])
        actual = np.zeros((count, _AXES), dtype=np.int64)
        torque = np.zeros((count, _AXES))
        wanted = np.ascontiguousarray(targets, dtype=np.int64)
        done = simulate(
            self._state,
            *self.plant,
            self._settings,
            self.gains,
            self._memory,
            self._clock,
            self.cycle_s,
            sync_ns,
            wanted,
            offsets,
            noise,
            actual,
            torque,
            ticks,
        )
        in_force = np.vstack([self._last_targets[None, :], wanted[:-1]]) if count else wanted
        if count:
            self._last_targets = wanted[-1].copy()
        self._sync += count
        used = int(self._clock[_TICK]) - first_tick
        return ClosedLoopRun(
            actual[:done],
            torque[:done],
            (in_force - actual)[:done],
            done < count,
            ticks[:used] if record_ticks else ticks,
        )


def _axis_settings(axis: MachineAxis, torque_limits_Nm: tuple[float, float]) -> list[float]:
    unit = axis.torque_per_volt * VOLT_PER_UNIT
    high, low = (limit / unit for limit in torque_limits_Nm)
    resolution = axis.demand_resolution
    return [
        axis.counts_per_revolution / (2.0 * np.pi),
        unit,
        float(floor(high)) if high < -OUTPUT_MINIMUM else OUTPUT_MAXIMUM,
        -float(floor(low)) if low < -OUTPUT_MINIMUM else OUTPUT_MINIMUM,
        float(resolution is not DemandResolution.UNROUNDED),
        float(resolution is DemandResolution.COUNTS),
        float(axis.output_delay_periods),
        axis.rated_torque_Nm,
        axis.torque_per_volt,
        axis.resolver_eccentricity_counts,
        axis.resolver_eccentricity_rad,
    ]


def closed_loop_of(config: GatewayConfig, seed: int = 0) -> ClosedLoop:
    """The closed loop of the machine that `sim_drive.assembly.build_machine` builds from ``config``.

    Raises drivers.errors.EdsError or mechanism.errors.MechanismError; a ParameterError for a machine with flexible
    couplings, which this kernel does not have.
    """
    machine = build_machine(config)
    plant = machine.plant
    if not isinstance(plant, CoupledPlant):
        raise ParameterError(
            "axes.*.emulation.coupling", "given", "null where the machine is simulated without its bus"
        )
    return ClosedLoop(
        plant=PlantArguments(*plant.kernel_arguments),
        axes=machine.axes,
        gains=[axis.gains for axis in machine.drive_axes],
        torque_limits_Nm=[(axis.torque_limit_Nm, axis.negative_torque_limit_Nm) for axis in machine.drive_axes],
        home_rad=(plant.angle(0), plant.angle(1)),
        cycle_s=config.cycle_s,
        seed=seed,
    )
