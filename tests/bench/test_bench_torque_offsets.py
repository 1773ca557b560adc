"""What feed-forward and learning cost a cycle, and what they leave of the following errors: printed, never asserted.

The figures are those of the configuration ``paper``: its gains, resolvers, friction and delays. Run with -m bench -s.
"""

import gc
import time

import pytest
from torque_study import MIXES, PAPER, FastRun, configured, friction_drifting, scaled_cam, wrong_model

from gateway.cyclic.demand import CamDemand
from gateway.cyclic.torque_offsets import build_torque_offsets
from gateway.learning.law import build_learning
from gateway.running.drive_settings import axis_units
from gateway.running.preparation import compile_config
from mechanism.motion import plan_run

pytestmark = pytest.mark.bench

ROUNDS = 5
"""The best of so many is printed: what else the computer does only ever adds."""
CYCLES = 5000
LEARNING = "{enabled: true}"
HEAVY = wrong_model(1.2, 1.2, 1.2)


@pytest.fixture(scope="module")
def cam():
    return compile_config(PAPER).profile


def microseconds(call, count=CYCLES):
    best = float("inf")
    gc.disable()
    for _ in range(ROUNDS):
        start = time.process_time_ns()
        for _ in range(count):
            call()
        best = min(best, time.process_time_ns() - start)
    gc.enable()
    return best / count / 1e3


def test_what_a_cycle_costs(cam):
    units = tuple(axis_units(axis) for axis in PAPER.ordered_axes)
    learning = build_learning(PAPER, cam)
    for title, torques in (
        ("demand alone", None),
        ("with feed-forward", build_torque_offsets(configured(), cam, units)),
        ("with both", build_torque_offsets(configured(), cam, units, learning)),
    ):
        demand = CamDemand(cam, units, PAPER.cycle_s, 6.0, 30.0, torques)
        demand.begin(plan_run(0.0, PAPER.speed_rad_per_s, 1000, 6.0, 30.0), (0, 0))
        print(f"\n{title:24} {microseconds(demand.step):6.2f} us a step", end="")
    position = 0.0

    def observe():
        nonlocal position
        position += PAPER.speed_rad_per_s * PAPER.cycle_s
        demand.observe(position, PAPER.speed_rad_per_s, (1, -1), True)

    print(f"\n{'learning from a cycle':24} {microseconds(observe):6.2f} us", end="")
    spans = []
    for _ in range(CYCLES):
        start = time.perf_counter_ns()
        observe()
        spans.append(time.perf_counter_ns() - start)
    spans.sort()
    print(f", median {spans[len(spans) // 2] / 1e3:.2f} us, 99.9 % below {spans[-len(spans) // 1000] / 1e3:.2f} us")


def line(title, cycles, start=0, end=None):
    servo_peak, servo_rms, cv_peak = cycles.worst(start, end)
    print(f"{title:52} {servo_peak:4d} {servo_rms:6.2f} {cv_peak:4d}")


def test_what_is_left_of_the_errors(cam):
    print(f"\n{'counts, worst machine cycle':52} {'servo':>4} {'RMS':>6} {'CV':>4}")
    line("gains alone", FastRun(configured("{}"), learning=False, profile=cam).cycles(4), 1)
    line("exact model", FastRun(configured(), learning=False, profile=cam).cycles(4), 1)
    for name, factors in MIXES.items():
        line(f"model: {name}", FastRun(configured(wrong_model(*factors)), learning=False, profile=cam).cycles(4), 1)
    for name, factors in MIXES.items():
        run = FastRun(configured(wrong_model(*factors), LEARNING), profile=cam)
        line(f"learning, cycles 10 to 40: {name}", run.cycles(40), 9)
    run = FastRun(configured(HEAVY, LEARNING), profile=cam, on_chunk=friction_drifting(0.1, 20_000))
    line("learning, friction drifting by 10 %, cycles 10 to 100", run.cycles(100), 9)
    run = FastRun(configured(HEAVY, LEARNING), profile=cam)
    for speed_rpm in (60.0, 90.0, 120.0):
        cycles = run.cycles(14, speed_rpm)
        line(f"{speed_rpm:g} rpm, the first cycle", cycles, 0, 1)
        line(f"{speed_rpm:g} rpm, from the tenth on", cycles, 9)
    cycles = FastRun(configured(HEAVY, LEARNING), profile=scaled_cam(0.8)).cycles(14)
    line("another profile, the first cycle", cycles, 0, 1)
    line("another profile, from the tenth on", cycles, 9)


def test_at_which_instant_the_torque_is_best(cam):
    from config.conversion import torque_delay_s

    delay_us = torque_delay_s(PAPER) * 1e6
    print(f"\ntorque delay, us, {delay_us:.0f} by calculation; servo errors at 120 rpm with the exact model")
    for off_us in (-1000, -500, -250, 0, 250, 500, 1000):
        config = configured(f"{{enabled: true, torque_delay_us: {delay_us + off_us}}}")
        servo_peak, servo_rms, _ = FastRun(config, learning=False, profile=cam).cycles(3, 120.0).worst(1)
        print(f"{delay_us + off_us:8.0f} {servo_peak:4d} {servo_rms:6.2f}")
