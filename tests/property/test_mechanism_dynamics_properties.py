"""The equations of motion against Lagrange's, derived here from positions alone by finite differences."""

from math import cos, pi, sin

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mechanism.dynamics import DynamicsParameters, LinkParameters, energy, linkage_sine, mass_matrix_and_bias, rk4_step
from mechanism.five_bar import Closure, FiveBar

STEP = 1e-4
links = st.builds(LinkParameters, st.floats(0.1, 2.0), st.floats(-0.1, 0.3), st.floats(-0.1, 0.1), st.floats(0.0, 0.02))
machines = st.builds(
    DynamicsParameters,
    st.builds(
        FiveBar,
        st.floats(0.1, 0.2),
        st.floats(0.2, 0.35),
        st.floats(0.2, 0.35),
        st.floats(0.1, 0.2),
        st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
        st.tuples(st.floats(0.15, 0.35), st.floats(-0.1, 0.1)),
    ),
    links,
    links,
    links,
    links,
    st.floats(0.0, 1.0),
    st.tuples(st.floats(1e-4, 1e-2), st.floats(1e-4, 1e-2)),
    st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0)),
)
angles = st.floats(-pi, pi)
speeds = st.floats(-10.0, 10.0)
closures = st.sampled_from(list(Closure))


def configuration(machine: DynamicsParameters, theta2: float, theta5: float, closure: Closure) -> np.ndarray:
    """Generalised positions: x, y of the five masses, then the four link angles; from the geometry alone."""
    bar = machine.five_bar
    a = complex(*bar.cv_pivot) + bar.p * complex(cos(theta2), sin(theta2))
    d = complex(*bar.servo_pivot) + bar.s * complex(cos(theta5), sin(theta5))
    # Law of cosines in the triangle A, D, C: the angle at A, to the left of A to D for Closure.LEFT.
    base = abs(d - a)
    at_a = np.arccos((bar.q**2 + base**2 - bar.r**2) / (2 * bar.q * base))
    theta3 = np.angle(d - a) + int(closure) * at_a
    c = a + bar.q * np.exp(1j * theta3)
    theta4 = np.angle(c - d)
    points = []
    for link, joint, angle in (
        (machine.p, complex(*bar.cv_pivot), theta2),
        (machine.q, a, theta3),
        (machine.r, d, theta4),
        (machine.s, complex(*bar.servo_pivot), theta5),
    ):
        points.append(joint + (link.com_m + 1j * link.com_perp_m) * np.exp(1j * angle))
    points.append(c)
    return np.array([*(p.real for p in points), *(p.imag for p in points), theta2, theta3, theta4, theta5])


def weights(machine: DynamicsParameters) -> np.ndarray:
    each = (machine.p, machine.q, machine.r, machine.s)
    masses = [*(link.mass_kg for link in each), machine.end_effector_mass_kg]
    inertias = [link.inertia_com_kg_m2 for link in each]
    inertias[0] += machine.rotor_inertia_kg_m2[0]
    inertias[3] += machine.rotor_inertia_kg_m2[1]
    return np.array([*masses, *masses, *inertias])


def difference(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    change = above - below
    change[10:] = (change[10:] + pi) % (2 * pi) - pi
    return change


def jacobian(machine: DynamicsParameters, theta: np.ndarray, closure: Closure, step: float = STEP) -> np.ndarray:
    """Fourth-order central differences of the configuration, (14, 2)."""
    columns = []
    for i in range(2):
        e = np.zeros(2)
        e[i] = step
        near = difference(configuration(machine, *(theta + e), closure), configuration(machine, *(theta - e), closure))
        far = difference(
            configuration(machine, *(theta + 2 * e), closure), configuration(machine, *(theta - 2 * e), closure)
        )
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=1)


def mass(machine: DynamicsParameters, theta: np.ndarray, closure: Closure, step: float = STEP) -> np.ndarray:
    j = jacobian(machine, theta, closure, step)
    return j.T @ (weights(machine)[:, None] * j)


def sound(machine: DynamicsParameters, theta2: float, theta5: float, closure: Closure) -> bool:
    return abs(linkage_sine(machine.to_array(), theta2, theta5, int(closure))) > 0.3


@settings(max_examples=150, deadline=None, derandomize=True)
@given(machines, angles, angles, closures)
def test_mass_matrix_is_the_kinetic_energy_s(
    machine: DynamicsParameters, theta2: float, theta5: float, closure: Closure
) -> None:
    assume(sound(machine, theta2, theta5, closure))
    m11, m12, m22, _, _ = mass_matrix_and_bias(machine.to_array(), theta2, theta5, 0.0, 0.0, int(closure))
    expected = mass(machine, np.array([theta2, theta5]), closure)
    assert np.allclose([[m11, m12], [m12, m22]], expected, rtol=1e-7, atol=1e-9)
    assert m11 > 0.0
    assert m11 * m22 > m12 * m12


@settings(max_examples=150, deadline=None, derandomize=True)
@given(machines, angles, angles, speeds, speeds, closures)
def test_bias_is_lagrange_s(
    machine: DynamicsParameters, theta2: float, theta5: float, omega2: float, omega5: float, closure: Closure
) -> None:
    assume(sound(machine, theta2, theta5, closure))
    theta = np.array([theta2, theta5])
    omega = np.array([omega2, omega5])
    gravity = np.array(machine.gravity_m_s2)
    w = weights(machine)
    step = 1e-3
    gradient = []
    for i in range(2):
        e = np.zeros(2)
        e[i] = step
        near = mass(machine, theta + e, closure, step) - mass(machine, theta - e, closure, step)
        far = mass(machine, theta + 2 * e, closure, step) - mass(machine, theta - 2 * e, closure, step)
        gradient.append((8 * near - far) / (12 * step))
    rate = gradient[0] * omega2 + gradient[1] * omega5
    j = jacobian(machine, theta, closure)
    pull = np.concatenate([w[:5] * gravity[0], w[5:10] * gravity[1], np.zeros(4)])
    expected = rate @ omega - 0.5 * np.array([omega @ g @ omega for g in gradient]) - j.T @ pull
    _, _, _, h1, h2 = mass_matrix_and_bias(machine.to_array(), theta2, theta5, omega2, omega5, int(closure))
    # The differences of differences keep about six digits of the largest term.
    scale = 1.0 + float(np.abs(rate).sum()) * 10.0
    assert np.allclose([h1, h2], expected, rtol=1e-5, atol=1e-5 * scale)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(machines, angles, angles, speeds, speeds, closures)
def test_a_free_machine_keeps_its_energy(
    machine: DynamicsParameters, theta2: float, theta5: float, omega2: float, omega5: float, closure: Closure
) -> None:
    params = machine.to_array()
    state = (theta2, theta5, omega2, omega5)
    before = None
    for _ in range(400):
        assume(sound(machine, state[0], state[1], closure))
        assume(max(abs(state[2]), abs(state[3])) < 30.0)
        kinetic, potential = energy(params, *state, int(closure))
        if before is None:
            before = kinetic + potential
            scale = kinetic + abs(potential) + 1.0
        state = rk4_step(params, *state, 0.0, 0.0, int(closure), 1e-4)
    after = sum(energy(params, *state, int(closure)))
    assert before is not None
    assert abs(after - before) < 1e-7 * scale


@settings(max_examples=100, deadline=None, derandomize=True)
@given(machines, angles, angles, speeds, speeds, closures)
def test_kinetic_energy_is_half_omega_mass_omega(
    machine: DynamicsParameters, theta2: float, theta5: float, omega2: float, omega5: float, closure: Closure
) -> None:
    assume(sound(machine, theta2, theta5, closure))
    kinetic, potential = energy(machine.to_array(), theta2, theta5, omega2, omega5, int(closure))
    theta, omega = np.array([theta2, theta5]), np.array([omega2, omega5])
    assert np.isclose(kinetic, 0.5 * omega @ mass(machine, theta, closure) @ omega, rtol=1e-7)
    points = configuration(machine, theta2, theta5, closure)
    w = weights(machine)
    gx, gy = machine.gravity_m_s2
    expected = -gx * sum(w[:5] * points[:5]) - gy * sum(w[5:10] * points[5:10])
    assert np.isclose(potential, expected, rtol=1e-9, atol=1e-9)
