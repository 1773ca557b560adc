"""Trapezoidal plans: they end where they should, and never ask for more than they may."""

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_drive.device.demand import Demand, Piece
from sim_drive.device.profiles import to_position, to_velocity

NS_PER_S = 1_000_000_000
positions = st.floats(-1e5, 1e5)
speeds = st.floats(-5e4, 5e4)
rates = st.floats(1e3, 1e6)


@given(positions, speeds, positions, st.floats(10.0, 1e5), rates, rates)
def test_every_move_ends_at_its_target(
    start: float, velocity: float, target: float, cruise: float, acceleration: float, deceleration: float
):
    demand = Demand()
    demand.launch(start, velocity, 0)
    pieces = to_position(target - start, velocity, cruise, acceleration, deceleration)
    assert all(piece.duration_s >= 0.0 for piece in pieces)
    assert all(abs(piece.acceleration) in {0.0, acceleration, deceleration} for piece in pieces)
    demand.plan(pieces, 0)
    span_s = sum(piece.duration_s for piece in pieces)
    assert demand.at(round((span_s + 1.0) * NS_PER_S)) == pytest.approx(target, abs=1e-5)
    bound = max(cruise, abs(velocity)) * (1 + 1e-9)
    before = start
    for step in range(1, 51):
        at_ns = round(span_s * step / 50 * NS_PER_S)
        assert abs(demand.velocity_at(at_ns)) <= bound
        here = demand.at(at_ns)
        assert abs(here - before) <= bound * span_s / 50 + 1e-3
        before = here


def test_velocity_plans_by_hand():
    assert to_velocity(0.0, 0.0, 10.0, 20.0) == []
    assert to_velocity(0.0, 5.0, 10.0, 20.0) == [Piece(10.0, 0.5), Piece(0.0, inf)]
    assert to_velocity(-5.0, 0.0, 10.0, 20.0) == [Piece(20.0, 0.25)]
    assert to_velocity(8.0, 4.0, 10.0, 20.0) == [Piece(-20.0, 0.2), Piece(0.0, inf)]
    assert to_velocity(-4.0, 5.0, 10.0, 20.0) == [Piece(20.0, 0.2), Piece(10.0, 0.5), Piece(0.0, inf)]


def test_what_lies_ahead():
    demand = Demand()
    demand.launch(100.0, 10.0, 0)
    assert demand.span_ahead(0) == (100.0, inf)
    demand.brake(NS_PER_S, 10.0)
    assert demand.span_ahead(NS_PER_S) == (110.0, 115.0)
    demand.launch(0.0, 10.0, 0)
    demand.plan(to_position(-5.0, 10.0, 100.0, 10.0, 10.0), 0)
    assert demand.span_ahead(0) == (-5.0, 5.0)
    assert demand.is_planned
    assert not demand.is_over(NS_PER_S)
