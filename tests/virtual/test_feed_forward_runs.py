"""Whole sessions with feed-forward in virtual time: what is left of the following errors."""

from dataclasses import dataclass

import numpy as np
import pytest

from config.loading import load_config, parse_config
from drivers.virtual_time import VirtualBus
from gateway.preparation import build_core, prepare
from gateway.sample import Phase, SampleLayout
from sim_drive.assembly import build_machine

PAPER = load_config("paper")
SECOND = 1_000_000_000


def with_feed_forward(section):
    kept = "\n".join(line for line in PAPER.text.splitlines() if not line.startswith("feed_forward:"))
    return parse_config(f"{kept}\nfeed_forward: {section}\n", PAPER.path)


@dataclass
class Errors:
    """Following errors in counts of (CV, servo) in one phase."""

    peak: np.ndarray
    rms: np.ndarray


class Sink:
    def __init__(self):
        self.layout = SampleLayout(PAPER.axis_names)
        self.packed = bytearray()

    def append(self, *values):
        self.packed += self.layout.pack(*values)

    def errors(self, *phases):
        samples = np.frombuffer(bytes(self.packed), self.layout.dtype)
        of_phase = samples[np.isin(samples["phase"], phases)]
        error = of_phase["position_demand"] - of_phase["position_actual"]
        return Errors(np.abs(error).max(axis=0), np.sqrt(np.mean(error.astype(float) ** 2, axis=0)))


def run(section, cycles=1, stop_at_s=None):
    config = with_feed_forward(section)
    prepared = prepare(config, cycles)
    sink = Sink()
    core = build_core(config, prepared.cam.profile, prepared.plan, sink)
    machine = build_machine(config)
    bus = VirtualBus([core, machine], config.bus.bit_rate)
    if stop_at_s is not None:
        bus.run_until(round(stop_at_s * SECOND))
        core.request_stop()
    bus.run_while(lambda: not core.is_done, 30 * SECOND)
    assert core.is_done
    assert core.failure is None
    return sink


@pytest.fixture(scope="module")
def exact():
    return run("{enabled: true}")


def test_with_the_exact_model_a_count_is_left_on_the_cam_and_on_the_way_down(exact):
    for phase in (Phase.CAM, Phase.RAMP_DOWN):
        assert exact.errors(phase).peak.tolist() <= [1, 1]
        assert exact.errors(phase).rms[1] < 0.5
    # The way up begins with gravity on the position controllers alone.
    assert np.all(exact.errors(Phase.RAMP_UP).peak <= [12, 2])


def test_no_other_instant_of_the_torque_is_better(exact):
    best = exact.errors(Phase.CAM).rms[1]
    for delay_us in (500, 4500):
        other = run(f"{{enabled: true, torque_delay_us: {delay_us}}}").errors(Phase.CAM).rms[1]
        assert other > best + 0.05


def test_a_controlled_stop_keeps_what_the_model_knows():
    stopping = run("{enabled: true}", stop_at_s=2.9)
    errors = stopping.errors(Phase.CONTROLLED_STOP)
    assert np.all(errors.peak <= [1, 2])
