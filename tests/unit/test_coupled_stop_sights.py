"""The observer of a lost master that is seen only now and then."""

import math

import pytest

from config.loading import load_config
from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.guard import Guard
from gateway.cyclic.reactions import CoupledStop
from gateway.running.drive_settings import axis_units
from gateway.running.preparation import compile_config
from mechanism.slave_law import SlaveLaw

CONFIG = load_config("paper")
LAW = SlaveLaw(compile_config(CONFIG).profile)


@pytest.mark.parametrize("apart", [1, 2, 6, 20, 50])
def test_rare_sights_of_the_master_do_not_make_its_velocity_swing_up(apart):
    """It coasts at 1 rev/s, seen every so many cycles: what the observer takes for its speed stays near that."""
    channels = [AxisChannel(name, 1, axis_units(axis), 100) for name, axis in CONFIG.axes.items()]
    stop = CoupledStop(LAW, channels, Guard(CONFIG.guard, CONFIG.axis_names), CONFIG.cycle_s, 0.0)
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
