"""Figures of the fast closed loop, and of what a search for gains costs; prints, asserts no time."""

import time

import numpy as np
import pytest

from config.loading import load_config
from gateway.running.preparation import compile_config
from gateway.tuning.controller import Gains
from gateway.tuning.margins import gain_array, loop_model, robustness
from gateway.tuning.search import GainSearch, TuningGoals
from gateway.tuning.steady_cycle import SteadyCycle
from sim_drive.closed_loop import closed_loop_of

PAPER = load_config("paper")
PRESENT = gain_array(tuple(Gains.from_section(axis.emulation.gains) for axis in PAPER.ordered_axes))

pytestmark = pytest.mark.bench


def cpu_s(work, times):
    work()
    started = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - started) / times


def test_fast_closed_loop(capsys):
    cam = compile_config(PAPER)
    loop = closed_loop_of(PAPER)
    cycle = SteadyCycle(loop, PAPER, cam.profile, cycles=9)

    def ten_cycles():
        loop.reset()
        loop.run(cycle.targets)

    each = cpu_s(ten_cycles, 5)
    coarse = loop_model(PAPER, cam.profile, cam.closure, 18, 120)
    search = GainSearch(SteadyCycle(loop, PAPER, cam.profile), coarse, (1.5, 1.5), TuningGoals())
    cost = cpu_s(lambda: search.cost(PRESENT), 20)
    full = loop_model(PAPER, cam.profile, cam.closure)
    stated = cpu_s(lambda: robustness(full, PRESENT), 3)
    ticks = np.ceil(len(cycle.targets) * PAPER.cycle_s * 1024)
    with capsys.disabled():
        print(f"\nfast closed loop: {len(cycle.targets) * PAPER.cycle_s / each:.0f} times real time,", end=" ")
        print(f"{each / ticks * 1e6:.2f} us a servo tick of both axes")
        print(f"one evaluation of the search {cost * 1e3:.1f} ms, margins over 72 positions {stated * 1e3:.0f} ms")
