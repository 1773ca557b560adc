"""A gateway and an emulated machine that fails on command, in virtual time, and what the linkage went through."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from config.conversion import closure_at_home, dynamics_parameters
from config.loading import load_config, parse_config
from config.schema import GatewayConfig
from drivers.frame import Frame
from drivers.node import Event, Node
from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import GuardTripped, StopReason
from gateway.record.sample import Phase
from gateway.running.assembly import build_core
from gateway.running.core import GatewayCore
from gateway.running.machine_session import StepReached
from gateway.running.preparation import PreparedRun, prepare
from mechanism.dynamics import inverse_dynamics_along
from sim_drive.assembly import build_machine
from sim_drive.injection.faults import Fault, FaultKind
from sim_drive.injection.injector import Injector

SECOND = 1_000_000_000
CV, SERVO = 1, 2
PAPER = load_config("paper")
CRUISE_FROM_S = 1.75
"""The paper's machine is at its speed from here on; link p then stands at 320 deg."""


TWO_COUNTS_RAD = 2.0 * math.tau / 4096


def at_theta2(degrees: float) -> float:
    """When (s) the CV axis of the paper's machine is at this angle in its first revolution at full speed."""
    return CRUISE_FROM_S + ((degrees - 320.0) % 360.0) / 360.0


def changed(*replacements: tuple[str, str]) -> GatewayConfig:
    """The paper's configuration with parts of its text replaced."""
    text = PAPER.text
    for old, new in replacements:
        assert old in text, old
        text = text.replace(old, new)
    return parse_config(text, PAPER.path)


@lru_cache(maxsize=8)
def prepared_run(text: str, path: Path, cycles: int) -> PreparedRun:
    return prepare(parse_config(text, path), cycles)


@dataclass(frozen=True, slots=True)
class Strain:
    """What the linkage went through from an instant on."""

    least_sine: float
    """Of the angle between q and r: the distance to the singular position, 0 in it."""
    cam_distance_rad: float
    """Greatest distance of link s from the cam of link p's actual angle."""
    shaft_torques_Nm: tuple[float, float]
    """Peak of what motor, brake and friction together put on each shaft."""
    rest_s: float
    """From the instant until both axes are, for good, within two counts of where they are at the end."""


class Guarded:
    """A session and its machine; the machine's true angles are kept for every servo tick."""

    def __init__(
        self,
        *faults: Fault,
        config: GatewayConfig = PAPER,
        cycles: int = 1,
        seed: int = 0,
        is_brakeless: bool = False,
        bus_faults: object = None,
        trace: Callable[[int, Frame], None] | None = None,
        host: Callable[[GatewayCore], Node] | None = None,
    ) -> None:
        """``host``: what drives the gateway's core on the bus in its place."""
        self.config = config
        self.prepared = prepared_run(config.text, config.path, cycles)
        self.machine = build_machine(config, record_ticks=200_000)
        brakes = (Fault(FaultKind.BROKEN_BRAKE, node, 1.0) for node in (CV, SERVO) if is_brakeless)
        self.injector = Injector(self.machine, (*faults, *brakes), seed)
        self.samples: list[tuple[float, ...]] = []
        self.core = build_core(config, self.prepared.cam.profile, self.prepared.plan, self)
        self.events: list[Event] = []
        self.bus = VirtualBus(
            [self.core if host is None else host(self.core), self.injector],
            config.bus.bit_rate,
            seed,
            trace,
            bus_faults,
            on_event=lambda node, event: self.events.append(event),
        )

    def append(self, *values: float) -> None:
        self.samples.append(values)

    def until(self, at_s: float) -> "Guarded":
        self.bus.run_until(round(at_s * SECOND))
        return self

    def inject(self, fault: Fault) -> "Guarded":
        self.injector.inject(fault, self.bus.now_ns)
        self.bus.refresh()
        return self

    def to_end(self, limit_s: float = 30.0, after_s: float = 0.3) -> "Guarded":
        self.bus.run_while(lambda: not self.core.is_done, round(limit_s * SECOND))
        self.bus.run_until(self.bus.now_ns + round(after_s * SECOND))
        return self

    @property
    def stopped_by(self) -> StopReason:
        return self.core.stopped_by

    @property
    def trips(self) -> list[GuardTripped]:
        return [event for event in self.events if isinstance(event, GuardTripped)]

    @property
    def is_torn(self) -> bool:
        return self.machine.plant.torn_at_s is not None

    @property
    def phases(self) -> set[Phase]:
        return {Phase(int(sample[12])) for sample in self.samples}

    @property
    def place(self) -> tuple[str, Phase]:
        """Where the session is now: its step, and what the cycle demands."""
        steps = [event.step for event in self.events if isinstance(event, StepReached)]
        return steps[-1] if steps else "", self.core.loop.steering.phase

    @property
    def is_without_torque(self) -> bool:
        return not any(drive.is_powered for drive in self.machine.drives)

    def master_peaks(self, phase: Phase) -> tuple[float, float]:
        """Peaks of the master's demanded acceleration (rad/s^2) and jerk (rad/s^3) in a phase, either way."""
        cycle_s = self.config.bus.cycle_us * 1e-6
        velocities = np.array([sample[3] for sample in self.samples])
        is_in = np.array([int(sample[12]) == phase for sample in self.samples])
        acceleration = np.diff(velocities) / cycle_s
        jerk = np.diff(acceleration) / cycle_s
        # From the phase before this one, and into the one after it, as well.
        around = is_in[1:] | is_in[:-1]
        return float(np.abs(acceleration[around]).max()), float(np.abs(jerk[around[1:] | around[:-1]]).max())

    def strain(self, from_s: float, to_s: float = math.inf) -> Strain:
        """What the linkage went through between two instants."""
        records = [r for r in self.machine.records if from_s * SECOND <= r.at_ns <= to_s * SECOND]
        angles = np.array([record.angles_rad for record in records])
        tick_s = 1.0 / 1024.0
        five_bar = self.machine.plant.parameters.dynamics.five_bar
        closure = self.machine.plant.parameters.closure
        sines = np.abs(five_bar.transmission_sines(angles[:, 0], angles[:, 1], closure)[:, 0])
        cam = self.prepared.cam.profile.at_many(angles[:, 0])[:, 0]
        away = np.abs(angles - angles[-1]).max(axis=1) > TWO_COUNTS_RAD
        rest = float((np.flatnonzero(away)[-1] + 1) * tick_s) if away.any() else 0.0
        return Strain(
            float("nan") if not np.isfinite(sines).all() else float(sines.min()),
            float(np.abs(angles[:, 1] - cam).max()),
            shaft_torques(angles, tick_s, self.config),
            rest,
        )


class Silenced:
    """The gateway is heard no more from an instant on, as when its process has been killed."""

    def __init__(self, from_s: float) -> None:
        self.from_ns = round(from_s * SECOND)

    def delays_ns(self, sender: int, frame: Frame, now_ns: int, source: object) -> tuple[int, ...]:
        return () if sender == 0 and now_ns >= self.from_ns else (0,)


class Host:
    """Drives the core as a host that is away once, for a span, or late with everything it sends for another one."""

    def __init__(
        self, core: GatewayCore, away: tuple[float, float] = (0.0, 0.0), late: tuple[float, float] = (0.0, 0.0)
    ):
        self.core = core
        self.away = tuple(round(at_s * SECOND) for at_s in away)
        self.late = tuple(round(at_s * SECOND) for at_s in late)
        self.take_frames = core.take_frames
        self.take_events = core.take_events

    def receive(self, frame: Frame, now_ns: int) -> None:
        if not self.away[0] <= now_ns < self.away[1]:
            self.core.receive(frame, now_ns)
            self._be_late(now_ns)

    def next_wake_ns(self) -> int | None:
        due_ns = self.core.next_wake_ns()
        return self.away[1] if due_ns is not None and self.away[0] <= due_ns < self.away[1] else due_ns

    def wake(self, now_ns: int) -> None:
        self.core.wake(now_ns)
        self._be_late(now_ns)

    def _be_late(self, now_ns: int) -> None:
        if self.late[0] <= now_ns < self.late[1]:
            self.core.loop.sent(now_ns + self.core.loop.period_ns)


class OverTorque:
    """Has a drive's TPDOs tell of more torque than there is, for a span; the host hears it, the drive does nothing."""

    def __init__(self, core: GatewayCore, node: int, at_s: float, for_s: float, permille: int = 3000) -> None:
        self.core = core
        self.cob_id = 0x180 + node
        self.from_ns, self.until_ns = round(at_s * SECOND), round((at_s + for_s) * SECOND)
        self.torque = permille.to_bytes(2, "little", signed=True)
        self.next_wake_ns = core.next_wake_ns
        self.wake = core.wake
        self.take_frames = core.take_frames
        self.take_events = core.take_events

    def receive(self, frame: Frame, now_ns: int) -> None:
        if frame.cob_id == self.cob_id and self.from_ns <= now_ns < self.until_ns:
            frame = Frame(frame.cob_id, frame.data[:6] + self.torque)
        self.core.receive(frame, now_ns)


@dataclass(frozen=True, slots=True)
class Moment:
    """An instant of a run, and where the session then is: see ``Guarded.place``."""

    at_s: float
    step: str
    phase: Phase


@lru_cache(maxsize=1)
def moments() -> Mapping[str, Moment]:
    """Instants all over a run of the paper's machine, from one that nothing disturbs."""
    run = Guarded().to_end()
    steps = {event.step: event.at_ns / SECOND for event in run.events if isinstance(event, StepReached)}
    at_s = np.array([sample[1] for sample in run.samples]) / SECOND
    phases = np.array([sample[12] for sample in run.samples])
    theta2 = np.degrees([sample[2] for sample in run.samples]) % 360.0

    def begin(phase: Phase, which: int = 0) -> float:
        return float(at_s[np.flatnonzero(np.diff(phases, prepend=-1.0) * (phases == phase))[which]])

    def at_angle(degrees: float) -> float:
        return float(at_s[np.flatnonzero((phases == Phase.CAM) & (np.abs(theta2 - degrees) < 0.5))[0]])

    homing, enabling = steps["homing axis servo"], steps["enabling the axes"]
    standstill, end = begin(Phase.STANDSTILL), begin(Phase.STANDSTILL, 1)
    ramp_up, cam, ramp_down = begin(Phase.RAMP_UP), begin(Phase.CAM), begin(Phase.RAMP_DOWN)
    return {
        "commissioning": Moment(0.5 * steps["starting the cycle"], "commissioning", Phase.COMMISSIONING),
        "homing": Moment(0.5 * (homing + enabling), "homing axis servo", Phase.COMMISSIONING),
        "enabling": Moment(0.5 * (enabling + standstill), "enabling the axes", Phase.COMMISSIONING),
        "standstill": Moment(0.5 * (standstill + ramp_up), "enabling the axes", Phase.STANDSTILL),
        "slow ramp up": Moment(ramp_up + 0.15, "moving", Phase.RAMP_UP),
        "fast ramp up": Moment(cam - 0.1, "moving", Phase.RAMP_UP),
        "cam": Moment(at_angle(100.0), "moving", Phase.CAM),
        "cam, farther": Moment(at_angle(230.0), "moving", Phase.CAM),
        "return stroke": Moment(at_angle(325.0), "moving", Phase.CAM),
        "fast ramp down": Moment(ramp_down + 0.25, "moving", Phase.RAMP_DOWN),
        "slow ramp down": Moment(end - 0.15, "moving", Phase.RAMP_DOWN),
        "end": Moment(end + 0.05, "moving", Phase.STANDSTILL),
    }


BEFORE_MOTION = ("commissioning", "homing", "enabling", "standstill")
IN_MOTION = (
    "slow ramp up",
    "fast ramp up",
    "cam",
    "cam, farther",
    "return stroke",
    "fast ramp down",
    "slow ramp down",
)
MOMENTS = (*BEFORE_MOTION, *IN_MOTION, "end")
"""Names of ``moments``."""


def shaft_torques(angles: np.ndarray, tick_s: float, config: GatewayConfig) -> tuple[float, float]:
    """Peaks of the torques at both shafts, by inverse dynamics of the motion (angles at servo ticks)."""
    omega = np.gradient(angles, tick_s, axis=0)
    alpha = np.gradient(omega, tick_s, axis=0)
    torques = np.empty_like(angles)
    closure = closure_at_home(config)
    params = dynamics_parameters(config).to_array()
    inverse_dynamics_along(params, angles, omega, alpha, int(closure), 0.0, torques)
    peaks = np.abs(torques).max(axis=0)
    return float(peaks[0]), float(peaks[1])


def first_of(events: Sequence[Event], kind: type[Event]) -> Event | None:
    return next((event for event in events if isinstance(event, kind)), None)
