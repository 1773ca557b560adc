"""Stick-slip impulses: hand-worked cases, and the optimality conditions for any two coupled axes."""

from hypothesis import assume, given
from hypothesis import strategies as st

from sim_drive.physics.friction import STOP_IMPULSE, impulse_bounds, velocities_after_impulse, velocity_after_impulse


def test_single_axis_slides_on_with_what_friction_leaves() -> None:
    # 2 kg m2 at 1 rad/s; 0.5 N m s take 0.25 rad/s.
    assert velocity_after_impulse(2.0, 1.0, -0.5, 0.5) == 0.75
    assert velocity_after_impulse(2.0, -1.0, -0.5, 0.5) == -0.75


def test_single_axis_sticks_at_exactly_zero() -> None:
    assert velocity_after_impulse(0.1, 0.3, -0.04, 0.04) == 0.0


def test_one_of_two_coupled_axes_sticks() -> None:
    # M = [2 1; 1 2], v = (1, 0), bounds 1 each. To stop both needs (-2, -1). Axis 1 slides with -1; then
    # v2 = 1/3 + 2/3 i2 = 0 at i2 = -1/2, and v1 = 1 - 2/3 + 1/6 = 1/2.
    v1, v2 = velocities_after_impulse(2.0, 1.0, 2.0, 1.0, 0.0, -1.0, 1.0, -1.0, 1.0)
    assert abs(v1 - 0.5) < 1e-15
    assert v2 == 0.0


def test_friction_of_one_axis_may_set_the_other_in_motion() -> None:
    # Axis 2 has no friction: i1 = -3/2 stops axis 1 (1 + 2/3 i1... W = [2 -1; -1 2]/3), and drags axis 2 to +1/2.
    v1, v2 = velocities_after_impulse(2.0, 1.0, 2.0, 1.0, 0.0, -5.0, 5.0, 0.0, 0.0)
    assert v1 == 0.0
    assert abs(v2 - 0.5) < 1e-15


def test_without_friction_nothing_changes() -> None:
    assert velocities_after_impulse(2.0, 1.0, 2.0, 1.25, -3.5, 0.0, 0.0, 0.0, 0.0) == (1.25, -3.5)


def test_end_stop_pushes_back_only() -> None:
    assert impulse_bounds(1.0, 0.1, -1.0, 1.0) == (-STOP_IMPULSE, 0.1)
    assert impulse_bounds(-1.0, 0.1, -1.0, 1.0) == (-0.1, STOP_IMPULSE)
    assert impulse_bounds(0.5, 0.1, -1.0, 1.0) == (-0.1, 0.1)


velocities = st.floats(-100.0, 100.0)
bounds = st.floats(0.0, 2.0)
inertias = st.floats(1e-3, 10.0)


@given(inertias, inertias, st.floats(-0.95, 0.95), velocities, velocities, bounds, bounds)
def test_impulses_obey_the_law_of_friction(
    m11: float, m22: float, coupling: float, v1: float, v2: float, bound1: float, bound2: float
) -> None:
    m12 = coupling * (m11 * m22) ** 0.5
    u1, u2 = velocities_after_impulse(m11, m12, m22, v1, v2, -bound1, bound1, -bound2, bound2)
    i1 = m11 * (u1 - v1) + m12 * (u2 - v2)
    i2 = m12 * (u1 - v1) + m22 * (u2 - v2)
    small = 1e-12 * (max(m11, m22) * max(abs(v1), abs(v2), 1.0)) / (1.0 - coupling * coupling)
    for velocity, impulse, bound in ((u1, i1, bound1), (u2, i2, bound2)):
        assert abs(impulse) <= bound + small
        if velocity != 0.0 and abs(velocity) > small / min(m11, m22):
            assert abs(impulse + (bound if velocity > 0.0 else -bound)) <= small
    before = 0.5 * (m11 * v1 * v1 + m22 * v2 * v2) + m12 * v1 * v2
    after = 0.5 * (m11 * u1 * u1 + m22 * u2 * u2) + m12 * u1 * u2
    assert after <= before * (1.0 + 1e-12) + 1e-12


@given(inertias, inertias, st.floats(-0.9, 0.9), velocities, velocities, bounds, bounds)
def test_the_order_of_the_axes_does_not_matter(
    m11: float, m22: float, coupling: float, v1: float, v2: float, bound1: float, bound2: float
) -> None:
    assume(bound1 + bound2 > 0.0)
    m12 = coupling * (m11 * m22) ** 0.5
    u1, u2 = velocities_after_impulse(m11, m12, m22, v1, v2, -bound1, bound1, -bound2, bound2)
    w2, w1 = velocities_after_impulse(m22, m12, m11, v2, v1, -bound2, bound2, -bound1, bound1)
    assert abs(u1 - w1) <= 1e-9 * (1.0 + abs(v1) + abs(v2))
    assert abs(u2 - w2) <= 1e-9 * (1.0 + abs(v1) + abs(v2))
