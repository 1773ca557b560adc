"""Whether an axis carries its load: its torque at rest against the model's, by hand."""

import pytest

from config.conversion import closure_at_home
from config.loading import load_config
from gateway.cyclic.axis_channel import AxisChannel
from gateway.running.drive_settings import axis_units
from gateway.running.load_check import MEAN_CYCLES, LoadCheck, build_load_check

PAPER = load_config("paper")
CLOSURE = closure_at_home(PAPER)
FRICTION_NM = (0.04, 0.05)


def channels():
    return [AxisChannel(name, 1, axis_units(axis), 100) for name, axis in PAPER.axes.items()]


def looked(check, axes, torques):
    """Shows the torques of both axes, cycle by cycle; returns after how many all loads are carried, None for never."""
    check.begin(axes)
    for cycle, pair in enumerate(torques, start=1):
        for axis, torque in zip(axes, pair, strict=True):
            axis.torque = torque
        if check.look():
            return cycle
        if check.is_over:
            return None
    raise AssertionError("neither carried nor over")


@pytest.mark.parametrize(
    ("loads_Nm", "torques", "carried_after"),
    [
        # 0.6 N m of 1.5 are 400 per mille, friction 27: from (400 - 27) / 3 = 124.3 per mille on it is carried.
        ((0.6, 0.0), (125, 0), MEAN_CYCLES),
        ((0.6, 0.0), (124, 0), None),
        ((-0.6, 0.0), (-125, 0), MEAN_CYCLES),
        ((-0.6, 0.0), (125, 0), None),
        # Three times 33 per mille of friction are 99: 0.148 N m are no more than that, 0.15 are 100; from
        # (100 - 33) / 3 = 22.3 per mille on it is carried.
        ((0.0, 0.148), (0, 0), 1),
        ((0.0, 0.15), (0, 0), None),
        ((0.0, 0.15), (0, 23), MEAN_CYCLES),
        ((0.6, 0.3), (400, 0), None),
        ((0.6, 0.3), (400, 200), MEAN_CYCLES),
        ((float("nan"), float("nan")), (0, 0), 1),
    ],
)
def test_a_load_is_carried_from_a_third_of_it_on(loads_Nm, torques, carried_after):
    check = LoadCheck(lambda theta2, theta5: loads_Nm, FRICTION_NM, 40)
    assert looked(check, channels(), [torques] * 40) == carried_after
    assert bool(check.problems) == (carried_after is None)


def test_one_blow_of_a_controller_is_no_load_carried():
    check = LoadCheck(lambda theta2, theta5: (0.6, 0.0), FRICTION_NM, 40)
    # 900 in one of eight cycles are 112 on average, which is told.
    blows = [(900 if cycle % MEAN_CYCLES == 3 else 0, 0) for cycle in range(40)]
    assert looked(check, channels(), blows) is None
    problem = "axis cv: holds with 112 per mille of its rated torque what takes 400 by the model; look at its resolver"
    assert check.problems == [f"{problem} and its brake"]


def test_the_model_is_the_feed_forwards_and_none_without_it():
    without = PAPER.model_copy(update={"feed_forward": PAPER.feed_forward.model_copy(update={"enabled": False})})
    assert build_load_check(without, CLOSURE) is None
    check, axes = build_load_check(PAPER, CLOSURE), channels()
    assert looked(check, axes, [(0, 0)] * 50) is None
    # At home link p lies level: 0.596 kg at 90.7 mm, and its share of q, r and the end effector, carry to the left.
    assert "what takes 413 by the model" in check.problems[0]
    assert len(check.problems) == 1


@pytest.mark.parametrize(("load_Nm", "is_one"), [(0.075, False), (0.077, True), (0.0, False), (-0.077, True)])
def test_friction_that_no_model_has_holds_a_small_load(load_Nm, is_one):
    """50 per mille of 1.5 N m are 0.075."""
    check = LoadCheck(lambda theta2, theta5: (load_Nm, 0.0), (0.0, 0.0), 40)
    assert (looked(check, channels(), [(0, 0)] * 40) is None) == is_one


@pytest.mark.parametrize(("cycle_us", "cycles"), [(1000, 50), (4000, 3 * MEAN_CYCLES), (20_000, 3 * MEAN_CYCLES)])
def test_however_long_a_cycle_is_several_means_are_looked_at(cycle_us, cycles):
    bus = PAPER.bus.model_copy(update={"cycle_us": cycle_us})
    check = build_load_check(PAPER.model_copy(update={"bus": bus}), CLOSURE)
    check.begin(channels())
    looks = 0
    while not check.is_over:
        check.look()
        looks += 1
    assert looks == cycles


def test_it_can_be_left_out():
    section = PAPER.feed_forward.model_copy(update={"load_check_ms": 0.0})
    assert build_load_check(PAPER.model_copy(update={"feed_forward": section}), CLOSURE) is None
