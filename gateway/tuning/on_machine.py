"""Tuning on the machine itself: from the gains that it has to those that are wanted, in small steps, each one tried.

Between two runs of a few machine cycles no gain changes by more than a bounded factor, and the runs are guarded at
reduced following errors, beyond which the master ramps down on the cam. A run that does not come to its end leaves the
gains in force that were there before the first step; else those that did best stay.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, log
from typing import Any, Final, Protocol

import numpy as np
import yaml

from config.guard_section import Reaction
from config.loading import parse_config
from config.schema import GatewayConfig
from drivers.errors import DriveError
from drivers.master import Master, Procedure
from drivers.node import Node
from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import StopReason
from gateway.errors import GatewayError
from gateway.record.sample import Phase, SampleArray, SampleLayout
from gateway.reporting.run_data import FOLLOWING_PHASES
from gateway.running.assembly import build_core
from gateway.running.drive_settings import build_master, node_settings
from gateway.running.preparation import PreparedRun
from gateway.running.procedure_core import ProcedureCore
from gateway.tuning.controller import GainPair, Gains
from gateway.tuning.gain_download import read_gains, write_gains

LARGEST_STEP: Final = 1.25
"""Factor by which a gain changes at most from one run to the next."""
ERROR_LIMIT_SHARE: Final = 0.3
"""Of the configured following error: the reduced limit, unless one is given."""
NS_PER_S: Final = 1_000_000_000
_MAX_EXTRA_S: Final = 60.0
_PAUSE_NS: Final = 100_000_000
_TRANSFER_NS: Final = 20 * NS_PER_S


@dataclass(frozen=True, slots=True)
class TrialRun:
    """What a run with some gains came to; pairs are (master, slave), of the steady phase if it came to its end."""

    gains: GainPair
    stopped_by: str
    peak_counts: tuple[float, float]
    rms_counts: tuple[float, float]

    @property
    def is_complete(self) -> bool:
        """Whether nothing stopped it."""
        return self.stopped_by == StopReason.COMPLETED.value

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """Plain values, by the axes' names."""
        return {
            "gains": {name: gains.to_json() for name, gains in zip(names, self.gains, strict=True)},
            "stopped_by": self.stopped_by,
            "peak_counts": dict(zip(names, self.peak_counts, strict=True)),
            "rms_counts": {name: round(value, 4) for name, value in zip(names, self.rms_counts, strict=True)},
        }


class TrialMachine(Protocol):
    """A machine that can be run with other gains: on a bus, or in virtual time."""

    def read_gains(self) -> GainPair:
        """The gains that the drives have now."""
        ...

    def write_gains(self, gains: GainPair) -> None:
        """Write gains to both drives, verified."""
        ...

    def run(self, gains: GainPair) -> TrialRun:
        """A guarded run with the gains that the drives have, which are ``gains``."""
        ...


@dataclass(frozen=True, slots=True)
class MachineTuning:
    """``trials`` in their order, the first one with the gains that were there; ``in_force``: what the drives have."""

    trials: tuple[TrialRun, ...]
    in_force: GainPair
    is_aborted: bool
    """A run was stopped, and the drives have the gains that they had at first."""


def gain_path(present: GainPair, wanted: GainPair, largest_step: float = LARGEST_STEP) -> list[GainPair]:
    """The gains from ``present``, exclusive, to ``wanted``, with no factor above ``largest_step`` from one to the next.

    A gain that is 0 at either end has no factor: it goes in even steps. Raises GatewayError for a factor that is no
    step up.
    """
    if not largest_step > 1.0:
        raise GatewayError(f"the largest step of a gain is a factor of {largest_step:g}, but must be above 1")
    first = np.array([gains.values for gains in present], dtype=float)
    last = np.array([gains.values for gains in wanted], dtype=float)
    both = (first > 0.0) & (last > 0.0)
    ratios = np.divide(last, first, out=np.ones_like(last), where=both)
    widest = float(np.abs(np.log(ratios)).max())
    steps = max(1, ceil(widest / log(largest_step) - 1e-9))
    path: list[GainPair] = []
    for step in range(1, steps + 1):
        share = step / steps
        values = np.where(both, first * ratios**share, first + (last - first) * share)
        path.append((Gains.of(values[0].tolist()), Gains.of(values[1].tolist())))
    return path


def tune_on_machine(
    machine: TrialMachine,
    wanted: GainPair,
    goals: tuple[float, float],
    *,
    largest_step: float = LARGEST_STEP,
    on_trial: Callable[[TrialRun, int, int], None] | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> MachineTuning:
    """Go from the gains of the drives to ``wanted`` step by step; see the module.

    ``goals``: counts of (master, slave) against which peak errors are weighed; ``on_trial(trial, number, of)`` is told
    each run. Raises GatewayError if the machine does not even run with the gains that it has, and what the machine
    raises, with the old gains written again.
    """
    before = machine.read_gains()
    path = gain_path(before, wanted, largest_step)
    trials: list[TrialRun] = []

    def tried(gains: GainPair) -> TrialRun:
        trial = machine.run(gains)
        trials.append(trial)
        if on_trial is not None:
            on_trial(trial, len(trials), len(path) + 1)
        return trial

    if not tried(before).is_complete:
        why = trials[0].stopped_by
        raise GatewayError(f"the machine does not run with the gains that it has, which stay: stopped by {why}")
    in_force = before
    try:
        for gains in path:
            if is_stopped():
                break
            machine.write_gains(gains)
            in_force = gains
            if not tried(gains).is_complete:
                machine.write_gains(before)
                return MachineTuning(tuple(trials), before, is_aborted=True)
        best = min(trials, key=lambda trial: max(p / g for p, g in zip(trial.peak_counts, goals, strict=True))).gains
        if best != in_force:
            machine.write_gains(best)
    except BaseException:
        machine.write_gains(before)
        raise
    return MachineTuning(tuple(trials), best, is_aborted=False)


def trial_config(config: GatewayConfig, error_limits: tuple[int, int] | None = None) -> GatewayConfig:
    """The configuration for the runs: reduced following errors, upon which the machine stops on the cam.

    Torque offsets are left out: they would hide what the gains are worth.

    ``error_limits``: counts of (master, slave); None: a share of the configured ones.
    """
    document = config.unaided.model_dump(mode="json")
    for number, name in enumerate(config.axis_names):
        limits = document["axes"][name]["limits"]
        own = max(1, round(ERROR_LIMIT_SHARE * limits["following_error_counts"]))
        limits["guarded_error_counts"] = own if error_limits is None else error_limits[number]
    document["guard"]["following_error"].update(reaction=Reaction.CONTROLLED_STOP.value)
    return parse_config(yaml.safe_dump(document, sort_keys=False), config.path)


def judge_trial(gains: GainPair, samples: SampleArray, stopped_by: str) -> TrialRun:
    """Figures of a run's samples; those whose TPDO was missed are left out."""
    phase = samples["phase"]
    usable = (phase == Phase.CAM) if stopped_by == StopReason.COMPLETED.value else np.isin(phase, FOLLOWING_PHASES)
    usable &= samples["flags"] == 0
    error = (samples["position_demand"] - samples["position_actual"])[usable].astype(float)
    if not len(error):
        error = np.zeros((1, 2))
    peak, rms = np.abs(error).max(axis=0), np.sqrt(np.square(error).mean(axis=0))
    return TrialRun(gains, stopped_by, (float(peak[0]), float(peak[1])), (float(rms[0]), float(rms[1])))


class _Samples:
    """Keeps the samples of a session in memory."""

    def __init__(self, axis_names: Sequence[str]) -> None:
        self._layout = SampleLayout(axis_names)
        self._packed = bytearray()

    def append(self, *values: float) -> None:
        """See ``gateway.cyclic.cycle.SampleSink``."""
        self._packed += self._layout.pack(*values)

    def array(self) -> SampleArray:
        """What has been kept."""
        return np.frombuffer(bytes(self._packed), self._layout.dtype)


class VirtualTimeMachine:
    """An emulated machine that is run again and again in virtual time, and keeps what was written into its drives."""

    def __init__(self, prepared: PreparedRun, machine: Node, seed: int = 0) -> None:
        """``prepared`` with a configuration of `trial_config`."""
        self._prepared = prepared
        self._machine = machine
        self._seed = seed
        self._now_ns = 0

    def read_gains(self) -> GainPair:
        """See `TrialMachine`."""
        return self._carry_out(lambda master: read_gains(master, node_settings(self._prepared.config)))

    def write_gains(self, gains: GainPair) -> None:
        """See `TrialMachine`."""
        self._carry_out(lambda master: write_gains(master, node_settings(self._prepared.config), gains))

    def _carry_out(self, make: Callable[[Master], Procedure[GainPair]]) -> GainPair:
        core = ProcedureCore(build_master(self._prepared.config), make)
        bus = self._bus(core)
        bus.run_while(lambda: not core.is_done, self._now_ns + _TRANSFER_NS)
        self._now_ns = bus.now_ns + _PAUSE_NS
        if core.failure is not None:
            raise core.failure
        if core.result is None:
            raise GatewayError("the drives did not answer in time")
        return core.result

    def _bus(self, core: Node) -> VirtualBus:
        bit_rate = self._prepared.config.wire_bit_rate
        return VirtualBus([core, self._machine], bit_rate, self._seed, start_ns=self._now_ns)

    def run(self, gains: GainPair) -> TrialRun:
        """See `TrialMachine`."""
        prepared = self._prepared
        samples = _Samples(prepared.config.axis_names)
        # The last run may have ended anywhere on the cam: a stop leaves the axes where they are, on the cam still.
        core = build_core(prepared.config, prepared.cam.profile, prepared.plan, samples)
        bus = self._bus(core)
        limit_ns = self._now_ns + round((prepared.plan.duration_s + _MAX_EXTRA_S) * NS_PER_S)
        bus.run_while(lambda: not core.is_done, limit_ns)
        self._now_ns = bus.now_ns + _PAUSE_NS
        if core.failure is not None and not isinstance(core.failure, (GatewayError, DriveError)):
            raise core.failure
        stopped_by = core.stopped_by.value if core.is_done else "time"
        return judge_trial(gains, samples.array(), stopped_by)
