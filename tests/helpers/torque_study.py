"""Runs with torque offsets, for tests and benches: on the fast closed loop, and the whole chain in virtual time."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from config.loading import load_config, parse_config
from config.schema import GatewayConfig
from drivers.virtual_time import VirtualBus
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.torque_offsets import build_torque_offsets
from gateway.learning.law import LearnedTorque, build_learning
from gateway.record.sample import Phase, SampleLayout
from gateway.running.assembly import build_core
from gateway.running.drive_settings import axis_units
from gateway.running.preparation import compile_config, prepare
from mechanism.cam_profile import CamProfile
from mechanism.motion import MasterPlan, plan_run
from sim_drive.assembly import build_machine
from sim_drive.closed_loop import ClosedLoop, closed_loop_of

PAPER = load_config("paper")
SECOND = 1_000_000_000
CHUNK = 50
"""Cycles for which demands are made before the loop is run: far less than a revolution, after which they are felt."""
MIXES = {
    "all 20 % too large": (1.2, 1.2, 1.2),
    "all 20 % too small": (0.8, 0.8, 0.8),
    "masses +, inertia -, friction +": (1.2, 0.8, 1.2),
    "masses -, inertia +, friction -": (0.8, 1.2, 0.8),
    "masses +, inertia +, friction -": (1.2, 1.2, 0.8),
    "masses -, inertia -, friction +": (0.8, 0.8, 1.2),
}
"""Models that are wrong: factors of masses, inertias and friction."""


def configured(
    feed_forward: str = "{enabled: true}", learning: str = "{}", noise: float = 0.0, base: GatewayConfig = PAPER
) -> GatewayConfig:
    """``base`` with these sections in place of its own; ``noise`` of the resolvers in counts RMS."""
    lines = [line for line in base.text.splitlines() if not line.startswith(("feed_forward:", "learning:"))]
    text = "\n".join(lines)
    if noise:
        text = re.sub(r"\n( +)(torque_per_volt_Nm)", rf"\n\1resolver_noise_counts: {noise:g}\n\1\2", text)
    return parse_config(f"{text}\nfeed_forward: {feed_forward}\nlearning: {learning}\n", base.path)


def wrong_model(masses: float, inertia: float, friction: float, base: GatewayConfig = PAPER) -> str:
    """A feed-forward section whose model has these factors on what the machine really has."""
    machine = base.machine
    links = ", ".join(
        f"{name}: {{mass_kg: {link.mass_kg * masses!r}, inertia_com_kgm2: {link.inertia_com_kgm2 * inertia!r}}}"
        for name, link in ((name, getattr(machine.links, name)) for name in "pqrs")
    )
    axes = ", ".join(
        f"{name}: {{inertia_kgm2: {own.inertia_kgm2 * inertia!r}, viscous_Nms: {own.viscous_Nms * friction!r},"
        f" coulomb_Nm: {own.coulomb_Nm * friction!r}}}"
        for name, own in ((name, axis.emulation) for name, axis in base.axes.items())
    )
    tip = machine.end_effector_mass_kg * masses
    return f"{{enabled: true, end_effector_mass_kg: {tip!r}, links: {{{links}}}, axes: {{{axes}}}}}"


@dataclass
class Cycles:
    """Following errors, counts: peak and RMS in each machine cycle, (cycles, 2), columns CV and servo axis."""

    peak: np.ndarray
    rms: np.ndarray

    def worst(self, start: int = 0, end: int | None = None) -> tuple[int, float, int]:
        """Servo peak, servo RMS and CV peak, the worst of these machine cycles."""
        return (
            int(self.peak[start:end, 1].max()),
            float(self.rms[start:end, 1].max()),
            int(self.peak[start:end, 0].max()),
        )


def by_cycle(theta2: np.ndarray, errors: np.ndarray, start: float, count: int) -> Cycles:
    """``errors`` (n, 2) in machine cycles from theta2 = ``start`` on."""
    number = np.floor((theta2 - start) / math.tau + 1e-9).astype(int)
    cycles = [errors[number == cycle] for cycle in range(count)]
    return Cycles(
        np.array([np.abs(one).max(axis=0) for one in cycles]),
        np.array([np.sqrt(np.mean(one.astype(float) ** 2, axis=0)) for one in cycles]),
    )


class FastRun:
    """The gateway's own demand on the fast closed loop: many machine cycles a second."""

    def __init__(
        self,
        config: GatewayConfig,
        *,
        learning: bool = True,
        learned: LearnedTorque | None = None,
        seed: int = 0,
        profile: CamProfile | None = None,
        on_chunk: Callable[[ClosedLoop, int], None] | None = None,
    ) -> None:
        self.config = config
        self.profile = compile_config(config).profile if profile is None else profile
        self.units = tuple(axis_units(axis) for axis in config.ordered_axes)
        self.learning = build_learning(config, self.profile, learned) if learning else None
        torques = build_torque_offsets(config, self.profile, self.units, self.learning)
        self.demand = CamDemand(self.profile, self.units, config.cycle_s, 6.0, 30.0, torques)
        self.loop = closed_loop_of(config, seed)
        self.on_chunk = on_chunk
        self.cycle = 0
        self._targets = (0, 0)
        self._last = (0.0, 0.0)

    def follow(self, plan: MasterPlan) -> tuple[np.ndarray, np.ndarray]:
        """Follow a plan from where the last one ended; theta2 (n,) and errors (n, 2) of its cycles."""
        self.demand.begin(plan, self._targets)
        count = round(plan.duration_s / self.config.cycle_s)
        theta2, errors = np.zeros(count), np.zeros((count, 2))
        for first in range(0, count, CHUNK):
            size = min(CHUNK, count - first)
            targets, offsets = np.zeros((size, 2), dtype=np.int64), np.zeros((size, 2))
            masters = [self._last]
            for k in range(size):
                self.demand.step()
                targets[k], offsets[k] = self.demand.targets, self.demand.torque_offsets
                masters.append((self.demand.master_position, self.demand.master_velocity))
            if self.on_chunk is not None:
                self.on_chunk(self.loop, self.cycle)
            run = self.loop.run(targets, offsets)
            assert not run.is_torn
            # The error at a SYNC is that of the target which acted at the one before.
            for k in range(size):
                position, speed = masters[k]
                theta2[first + k], errors[first + k] = position, run.error_counts[k]
                if self.demand.observer is not None:
                    self.demand.observer.observe(position, speed, run.error_counts[k].tolist(), True)
            self._last = masters[-1]
            self.cycle += size
        self._targets = self.demand.targets
        return theta2, errors

    def cycles(self, count: int, speed_rpm: float = 60.0) -> Cycles:
        """Ramp up, so many machine cycles at this speed, and ramp down; what the errors were at the speed."""
        start = self._last[0]
        plan = plan_run(start, speed_rpm * math.tau / 60.0, count, 6.0, 30.0)
        theta2, errors = self.follow(plan)
        cruise = plan.at(plan.cruise_start_s)[0]
        return by_cycle(theta2, errors, cruise, count)


class Sink:
    """Keeps the samples of a session as one structured array."""

    def __init__(self) -> None:
        self.layout = SampleLayout(PAPER.axis_names)
        self.packed = bytearray()

    def append(self, *values: float) -> None:
        self.packed += self.layout.pack(*values)

    @property
    def samples(self) -> Any:
        return np.frombuffer(bytes(self.packed), self.layout.dtype)

    def phases(self, *phases: Phase) -> tuple[np.ndarray, np.ndarray]:
        """theta2 (n,) and errors in counts (n, 2) of these phases."""
        samples = self.samples
        kept = samples[np.isin(samples["phase"], phases)]
        return kept["master_position"], kept["position_demand"] - kept["position_actual"]


class WholeRun:
    """Gateway and emulated machine on a virtual bus, from boot-up to disabled drives."""

    def __init__(
        self,
        config: GatewayConfig,
        cycles: int,
        seed: int = 0,
        stop_at_s: float | None = None,
        record_ticks: int = 0,
        faults: Any = None,
    ) -> None:
        self.prepared = prepare(config, cycles)
        self.sink = Sink()
        self.machine = build_machine(config, seed, record_ticks=record_ticks)
        self.core = build_core(config, self.prepared.cam.profile, self.prepared.plan, self.sink)
        bus = VirtualBus([self.core, self.machine], config.bus.bit_rate, seed, faults=faults)
        if stop_at_s is not None:
            bus.run_until(round(stop_at_s * SECOND))
            self.core.request_stop()
        limit_s = self.prepared.plan.duration_s + 30.0
        bus.run_while(lambda: not self.core.is_done, round(limit_s * SECOND))
        assert self.core.is_done
        assert self.core.failure is None

    def errors(self, *phases: Phase) -> Cycles:
        """Peak and RMS over these phases, as one cycle."""
        _, errors = self.sink.phases(*phases)
        return Cycles(np.abs(errors).max(axis=0)[np.newaxis], np.sqrt(np.mean(errors**2.0, axis=0))[np.newaxis])

    def cycles(self, count: int) -> Cycles:
        """The machine cycles at speed."""
        theta2, errors = self.sink.phases(Phase.CAM)
        return by_cycle(theta2, errors, theta2[0], count)


def scaled_cam(share: float, config: GatewayConfig = PAPER) -> CamProfile:
    """Another profile: the configuration's with its stroke times ``share``."""
    profile = compile_config(config).profile
    return CamProfile(profile.coefficients * share, profile.net_turns)


def friction_drifting(share: float, period_cycles: int) -> Callable[[ClosedLoop, int], None]:
    """Lets viscous and dry friction of both axes swing by ``share`` with a period of so many cycles."""
    nominal: list[np.ndarray] = []

    def drift(loop: ClosedLoop, cycle: int) -> None:
        if not nominal:
            nominal.append(loop.plant.settings[:, :2].copy())
        loop.plant.settings[:, :2] = nominal[0] * (1.0 + share * math.sin(math.tau * cycle / period_cycles))

    return drift
