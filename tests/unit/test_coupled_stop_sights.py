"""What a coupled stop sees of its axes: a lost master only now and then, resolvers that leap."""

import math

import pytest

from config.loading import load_config
from config.schema import PositionLoopSection
from drivers.cia402 import COMMAND_ENABLE_OPERATION, COMMAND_QUICK_STOP
from gateway.cyclic.axis_channel import RARE_CYCLES, AxisChannel
from gateway.cyclic.guard import Guard
from gateway.cyclic.reactions import CoupledStop
from gateway.running.drive_settings import axis_units, position_loop
from gateway.running.preparation import compile_config
from mechanism.slave_law import SlaveLaw

CONFIG = load_config("paper")
LAW = SlaveLaw(compile_config(CONFIG).profile)


def make_stop(leap_limit=math.inf):
    """Of the paper's machine, whose master does not brake while it is not seen; and its channels."""
    channels = [AxisChannel(name, 1, axis_units(axis), 100) for name, axis in CONFIG.axes.items()]
    for channel in channels:
        channel.leap_limit = leap_limit
    return CoupledStop(LAW, channels, Guard(CONFIG.guard, CONFIG.axis_names), CONFIG.cycle_s, 0.0), channels


@pytest.mark.parametrize("apart", [1, 2, 6, 20, 50])
def test_rare_sights_of_the_master_do_not_make_its_velocity_swing_up(apart):
    """It coasts at 1 rev/s, seen every so many cycles: what the observer takes for its speed stays near that."""
    stop, channels = make_stop()
    master = channels[0]
    stop.begin(0.0, math.tau, [0, 0])
    for cycle in range(1, 2001):
        is_seen = cycle % apart == 0
        master.silent_cycles = 0 if is_seen else 1
        if is_seen:
            master.actual = round(4096 * cycle * CONFIG.cycle_s)
        stop.step()
        # A count is 1.53 mrad: within one cycle of sight that is 1.5 rad/s, of which the observer takes 0.4.
        assert abs(stop.master_velocity - math.tau) < 2.5
        assert abs(stop.master_position - math.tau * cycle * CONFIG.cycle_s) < 0.1


def leaping_stop(leaps, speed=math.tau):
    """A stop of a master that coasts, with ``leaps[cycle]`` counts more to each axis' actual value from then on.

    Returns the slave's target and the master's position by cycle, and what the resolvers are taken to show too much.
    """
    stop, channels = make_stop(20.0)
    units = [channel.units for channel in channels]
    shown, told = [0, 0], []
    begin = [units[0].counts(0.0), units[1].counts(LAW.at(speed * 2 * CONFIG.cycle_s)[0])]
    for cycle in range(300):
        position = speed * cycle * CONFIG.cycle_s
        shown = [value + more for value, more in zip(shown, leaps.get(cycle, (0, 0)), strict=True)]
        for channel, angle, leapt in zip(channels, (position, LAW.at(position)[0]), shown, strict=True):
            channel.actual = channel.units.counts(angle) + leapt
        if cycle == 0:
            for channel, leapt in zip(channels, shown, strict=True):
                channel.leapt = leapt
            stop.begin(0.0, speed, begin)
        else:
            stop.step()
        told.append((stop.targets[1], stop.master_position))
    return told, [channel.leapt for channel in channels]


@pytest.mark.parametrize(
    "leaps",
    [
        {50: (-250, 0)},
        {50: (30, 0), 90: (-30, 0)},
        {50: (0, 300), 60: (0, -300)},
        {50: (100, -100), 51: (-100, 100)},
        # What has leapt before the stop goes back in it.
        {0: (-250, 120), 88: (250, -120)},
    ],
)
def test_a_leap_of_a_resolver_is_no_motion_of_the_master_and_moves_the_slaves_target_along(leaps):
    expected, none = leaping_stop({})
    told, leapt = leaping_stop(leaps)
    assert none == [0, 0]
    sums = [sum(more[axis] for more in leaps.values()) for axis in (0, 1)]
    assert leapt == pytest.approx(sums, abs=2)
    shown = 0
    for cycle, ((target, position), (wanted, truly)) in enumerate(zip(told, expected, strict=True)):
        shown += leaps.get(cycle, (0, 0))[1]
        assert position == pytest.approx(truly, abs=math.radians(0.3))
        # The cam's slope is at most 3.4, and a leap is known to within a count.
        assert cycle == 0 or abs(target - shown - wanted) < 12


@pytest.mark.parametrize("is_told", [True, False])
def test_a_way_gone_while_no_sync_was_sent_is_no_leap(is_told):
    stop, channels = make_stop(20.0)
    stop.begin(0.0, math.tau, [0, 0])
    for cycle in [*range(10), *range(30, 60)]:
        for channel in channels:
            channel.actual = round(4.096 * cycle)
        if cycle == 30 and is_told:
            stop.skip(20)
        stop.step()
        assert not is_told or abs(stop.master_velocity - math.tau) < 2.0
    assert [channel.leapt > 50 for channel in channels] == [not is_told] * 2
    assert (abs(stop.master_position - math.tau * 0.059) < 0.02) == is_told


def test_a_way_gone_in_silence_is_no_leap():
    stop, channels = make_stop(20.0)
    stop.begin(0.0, 0.0, [0, 0])
    for cycle in range(1, 60):
        for channel in channels:
            channel.silent_cycles = cycle if 10 <= cycle < 40 else 0
            channel.actual = 200 if cycle >= 40 else 0
        stop.step()
    assert [channel.leapt for channel in channels] == [0, 0]
    assert stop.master_position == pytest.approx(200 * math.tau / 4096, abs=0.01)


@pytest.mark.parametrize(("back", "left"), [(250, 0), (0, -250)])
def test_a_leap_that_goes_back_while_no_sync_was_sent_has_gone_back(back, left):
    stop, channels = make_stop(20.0)
    stop.begin(0.0, math.tau, [0, 0])
    for cycle in [*range(10), *range(18, 60)]:
        for channel in channels:
            channel.actual = round(4.096 * cycle) - (250 if cycle >= 5 else 0) + (back if cycle >= 18 else 0)
        if cycle == 18:
            stop.skip(8)
        stop.step()
    assert channels[0].leapt == pytest.approx(left, abs=2)
    assert stop.master_position == pytest.approx(math.tau * 0.059, abs=0.01)


@pytest.mark.parametrize("leapt", [0, -250])
@pytest.mark.parametrize(
    ("is_in_torque", "away_deg", "is_stopped"), [(True, 11, True), (True, 9, False), (False, 11, False)]
)
def test_a_slave_that_the_gateways_loop_does_not_get_near_its_cam_is_left_to_its_drive(
    is_in_torque, away_deg, is_stopped, leapt
):
    stop, channels = make_stop(40.0)
    slave = channels[1]
    slave.statusword = 0x1237
    slave.controlword = COMMAND_ENABLE_OPERATION
    if is_in_torque:
        section = PositionLoopSection(
            proportional_Nm_per_rad=15, integrating_Nm_per_rad_s=0, derivative_Nms_per_rad=0, torque_limit_Nm=4.5
        )
        axis = CONFIG.ordered_axes[1].model_copy(update={"position_loop": section})
        slave.position_loop = position_loop(axis, CONFIG.cycle_s)
    target = slave.units.counts(LAW.at(0.0)[0])
    slave.actual = target + round(away_deg / 360.0 * 4096)
    stop.begin(0.0, 0.0, [0, target])
    slave.actual += leapt
    for _ in range(10):
        stop.step()
    assert (slave.controlword == COMMAND_QUICK_STOP) == is_stopped


def test_no_drive_is_told_to_stop_while_its_target_jumps():
    """Its stop begins with the speed of its targets: 250 counts within a millisecond are 384 rad/s."""
    stop, channels = make_stop(40.0)
    slave = channels[1]
    target = slave.units.counts(LAW.at(0.0)[0])
    for back_in in range(40, 60):
        for channel in channels:
            channel.leapt = 0
            channel.statusword, channel.controlword = 0x1237, COMMAND_ENABLE_OPERATION
        channels[0].actual, slave.actual = 0, target
        stop.begin(0.0, 0.0, [0, target])
        stopped_in, jumped_in = None, 0
        for cycle in range(70):
            slave.actual = target - (250 if 5 <= cycle < back_in else 0)
            before = stop.targets[1]
            stop.step()
            jumped_in = cycle if stop.targets[1] != before else jumped_in
            if slave.controlword == COMMAND_QUICK_STOP:
                stopped_in = cycle
                break
        assert stopped_in is not None
        assert stopped_in > jumped_in + 4


def overshoot(stop, channels, target, leapt, phase):
    """How far a drive that sees every other SYNC gets from a target that jumps by ``leapt``, once it has had it.

    At every SYNC that it sees it makes for its target within a cycle, and goes on so for the second one.
    """
    slave = channels[1]
    demand, away = float(target), []
    for cycle in range(60):
        is_seen = cycle % 2 == phase
        slave.silent_cycles = 0 if is_seen else 1
        if is_seen:
            slave.actual = target + (leapt if cycle >= 11 else 0)
            demand = 2.0 * stop.targets[1] - demand
        stop.step()
        if cycle > 22:
            away.append(abs(demand - target - leapt))
    return max(away)


@pytest.mark.parametrize("phase", [0, 1])
@pytest.mark.parametrize("leapt", [250, -499])
def test_a_drive_that_misses_every_other_sync_does_not_swing_about_its_target(leapt, phase):
    outcomes = []
    for rare_cycles in (RARE_CYCLES, 0):
        stop, channels = make_stop(40.0)
        slave = channels[1]
        slave.statusword, slave.controlword = 0x1237, COMMAND_ENABLE_OPERATION
        target = slave.units.counts(LAW.at(0.0)[0])
        slave.actual, slave.rare_cycles = target, rare_cycles
        stop.begin(0.0, 0.0, [0, target])
        outcomes.append(overshoot(stop, channels, target, leapt, phase))
    assert outcomes[0] <= 1.0
    assert outcomes[1] == abs(leapt)
