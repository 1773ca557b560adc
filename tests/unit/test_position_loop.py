"""The position loop that the gateway closes, by numbers worked by hand."""

from math import tau

import pytest

from gateway.cyclic.position_loop import PositionLoop
from gateway.units import AxisUnits

COUNT_RAD = tau / 4096
UNITS = AxisUnits(4096, 0.0, 2.0)
"""1000 per mille are 2 N m."""


def loop(limit_Nm=4.0, proportional=100.0, integrating=0.0, derivative=0.0):
    return PositionLoop(UNITS, 0.001, proportional, integrating, derivative, limit_Nm)


def test_each_term_alone():
    # 10 counts are 15.34 mrad: 1.534 N m at 100 N m/rad, 767 per mille of 2 N m.
    assert loop().update(110, 100, 0.0, 0) == 767
    # A wrapped position: from the end of INTEGER32 to its beginning is one count.
    assert loop(proportional=1000.0).update(-(1 << 31), (1 << 31) - 1, 0.0, 0) == 767
    # The sum of two cycles: 2 x 15.34 mrad x 1 ms x 50000 N m/(rad s) = 1.534 N m more than none.
    held = loop(proportional=0.001, integrating=50_000.0)
    assert held.update(110, 100, 0.0, 0) == 384
    assert held.update(110, 100, 0.0, 0) == 767
    # 3 rad/s of demand, 2 counts a cycle (3.068 rad/s) of the axis: -0.068 x 10 N m = -0.68 N m.
    damped = loop(proportional=0.001, derivative=10.0)
    assert damped.update(0, 0, 3.0, 0) == 0, "nothing is known of the axis' velocity yet"
    assert damped.update(2, 2, 3.0, 0) == round((3.0 - 2000 * COUNT_RAD) * 10.0 * 500)
    # Feed-forward goes on top.
    assert loop().update(110, 100, 0.0, -100) == 667


def test_the_limit_holds_and_the_sum_does_not_wind_up():
    wound = loop(limit_Nm=1.0, proportional=100.0, integrating=50_000.0)
    for _ in range(1000):
        assert wound.update(10, 0, 0.0, 0) == 500
    # No sum has been made meanwhile: without an error there is no torque.
    assert wound.update(0, 0, 0.0, 0) == 0
    assert wound.update(-10, 0, 0.0, 2000) == 500, "feed-forward is bounded too"


def test_without_torque_the_past_is_forgotten_and_an_unseen_cycle_keeps_the_torque():
    one = loop(proportional=0.001, integrating=50_000.0, derivative=10.0)
    first = one.update(10, 0, 0.0, 0)
    assert one.hold() == first
    # After a gap the velocity is not taken over two cycles for one.
    assert one.update(20, 10, 1.0, 0) == pytest.approx(2 * first, abs=1)
    assert one.reset() == 0
    assert one.hold() == 0
    assert one.update(10, 0, 0.0, 0) == first
