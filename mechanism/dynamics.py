"""Rigid-body dynamics of the five-bar in the coordinates (theta2, theta5): M theta'' + h(theta, theta') = torque.

Every link's centre of mass has a velocity J theta' and an acceleration J theta'' + a0 (a0: what is left at theta'' =
0); the principle of virtual power then gives M = sum m J'J + I k k', h = sum m J'(a0 - g) + I k alpha0, where k =
d(link angle)/d(theta2, theta5) and alpha0 the link's angular acceleration at theta'' = 0. The friction of the axes is
kept apart.

The kernels take the flat array of `DynamicsParameters.to_array` and may be called from other kernels. In a singular
position (sin(theta3 - theta4) = 0) or where the linkage does not close their results are infinite or NaN: guard with
`linkage_sine`.
"""

from dataclasses import dataclass
from math import tanh
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.errors import ParameterError, finite
from mechanism.five_bar import Closure, FiveBar, assemble
from mechanism.jit import kernel

Float = NDArray[np.float64]

STANDARD_GRAVITY: Final = (0.0, -9.80665)
"""Gravity vector of a vertical plane, m/s^2."""

# Layout of the flat parameter array; kernels see these as compile-time constants. 0 to 7 are FiveBar.to_array().
_LINKS: Final = 8
_LINK_SIZE: Final = 4
_END_EFFECTOR_MASS: Final = 24
_ROTOR: Final = 25
_GRAVITY: Final = 27
_VISCOUS: Final = 29
_COULOMB: Final = 31
PARAMETER_COUNT: Final = 33


@dataclass(frozen=True, slots=True)
class LinkParameters:
    """Mass properties of one link.

    mass_kg; com_m: distance of the centre of mass from the link's first joint along the link (p from the CV pivot, q
    from A, r from D, s from the servo pivot); com_perp_m: perpendicular to it, counter-clockwise positive;
    inertia_com_kg_m2 about the centre of mass.
    """

    mass_kg: float
    com_m: float
    com_perp_m: float
    inertia_com_kg_m2: float

    def __post_init__(self) -> None:
        if not finite(self.mass_kg, self.com_m, self.com_perp_m, self.inertia_com_kg_m2):
            raise ParameterError("a link's mass property", self, "finite")
        if self.mass_kg < 0.0:
            raise ParameterError("mass_kg", self.mass_kg, "zero or more")
        if self.inertia_com_kg_m2 < 0.0:
            raise ParameterError("inertia_com_kg_m2", self.inertia_com_kg_m2, "zero or more")


@dataclass(frozen=True, slots=True)
class DynamicsParameters:
    """Everything the equations of motion need; pairs are (CV axis, servo axis).

    rotor_inertia_kg_m2 has the motor and its coupling and must be positive (it keeps the mass matrix regular);
    gravity_m_s2 is a vector, (0, 0) = off; viscous in N m s/rad, Coulomb in N m.
    """

    five_bar: FiveBar
    p: LinkParameters
    q: LinkParameters
    r: LinkParameters
    s: LinkParameters
    end_effector_mass_kg: float
    rotor_inertia_kg_m2: tuple[float, float]
    gravity_m_s2: tuple[float, float] = (0.0, 0.0)
    viscous_N_m_s: tuple[float, float] = (0.0, 0.0)
    coulomb_N_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (finite(self.end_effector_mass_kg) and self.end_effector_mass_kg >= 0.0):
            raise ParameterError("end_effector_mass_kg", self.end_effector_mass_kg, "zero or more")
        if not (finite(*self.rotor_inertia_kg_m2) and min(self.rotor_inertia_kg_m2) > 0.0):
            raise ParameterError("rotor_inertia_kg_m2", self.rotor_inertia_kg_m2, "positive on both axes")
        if not finite(*self.gravity_m_s2):
            raise ParameterError("gravity_m_s2", self.gravity_m_s2, "finite")
        for name, pair in (("viscous_N_m_s", self.viscous_N_m_s), ("coulomb_N_m", self.coulomb_N_m)):
            if not (finite(*pair) and min(pair) >= 0.0):
                raise ParameterError(name, pair, "zero or more on both axes")

    def to_array(self) -> Float:
        """The flat array (33 floats) that every kernel of this module takes."""
        links = [
            value
            for link in (self.p, self.q, self.r, self.s)
            for value in (link.mass_kg, link.com_m, link.com_perp_m, link.inertia_com_kg_m2)
        ]
        return np.array(
            [
                *self.five_bar.to_array().tolist(),
                *links,
                self.end_effector_mass_kg,
                *self.rotor_inertia_kg_m2,
                *self.gravity_m_s2,
                *self.viscous_N_m_s,
                *self.coulomb_N_m,
            ],
            dtype=np.float64,
        )


@kernel
def _add_point(
    mass: float,
    j2x: float,
    j2y: float,
    j5x: float,
    j5y: float,
    a0x: float,
    a0y: float,
    m11: float,
    m12: float,
    m22: float,
    h1: float,
    h2: float,
) -> tuple[float, float, float, float, float]:
    """Add a point mass with Jacobian columns j2, j5 and bias acceleration a0 (gravity already taken off)."""
    return (
        m11 + mass * (j2x * j2x + j2y * j2y),
        m12 + mass * (j2x * j5x + j2y * j5y),
        m22 + mass * (j5x * j5x + j5y * j5y),
        h1 + mass * (j2x * a0x + j2y * a0y),
        h2 + mass * (j5x * a0x + j5y * a0y),
    )


@kernel
def mass_matrix_and_bias(
    params: Float, theta2: float, theta5: float, omega2: float, omega5: float, closure: int
) -> tuple[float, float, float, float, float]:
    """(m11, m12, m22, h1, h2) of M theta'' + h = torque: kg m^2 and N m; h has Coriolis and gravity, no friction.

    theta in rad, omega in rad/s, closure +1 or -1 (`Closure`). M is symmetric; index 1 is the CV axis, 2 the servo
    axis.
    """
    m11, m12, m22, h1, h2, _ = motion_terms(params, theta2, theta5, omega2, omega5, closure)
    return m11, m12, m22, h1, h2


@kernel
def motion_terms(
    params: Float, theta2: float, theta5: float, omega2: float, omega5: float, closure: int
) -> tuple[float, float, float, float, float, float]:
    """`mass_matrix_and_bias`, and after it `linkage_sine`, for which the linkage is assembled but once."""
    p = params[0]
    q = params[1]
    r = params[2]
    s = params[3]
    gx = params[_GRAVITY]
    gy = params[_GRAVITY + 1]
    e2x, e2y, e3x, e3y, e4x, e4y, e5x, e5y, sine = assemble(params, theta2, theta5, closure)

    # Loop p n2 w2 + q n3 w3 = s n5 w5 + r n4 w4 (n = e turned by +90 deg), dotted with e4 and with e3.
    inverse_q = 1.0 / (q * sine)
    inverse_r = 1.0 / (r * sine)
    k32 = p * (e2x * e4y - e2y * e4x) * inverse_q
    k35 = -s * (e5x * e4y - e5y * e4x) * inverse_q
    k42 = p * (e2x * e3y - e2y * e3x) * inverse_r
    k45 = -s * (e5x * e3y - e5y * e3x) * inverse_r
    omega3 = k32 * omega2 + k35 * omega5
    omega4 = k42 * omega2 + k45 * omega5

    # Angular accelerations at theta'' = 0, from the loop's acceleration equation in the same two directions.
    w2 = omega2 * omega2
    w3 = omega3 * omega3
    w4 = omega4 * omega4
    w5 = omega5 * omega5
    bx = p * w2 * e2x + q * w3 * e3x - s * w5 * e5x - r * w4 * e4x
    by = p * w2 * e2y + q * w3 * e3y - s * w5 * e5y - r * w4 * e4y
    alpha3 = -(bx * e4x + by * e4y) * inverse_q
    alpha4 = -(bx * e3x + by * e3y) * inverse_r

    m11 = params[_ROTOR]
    m12 = 0.0
    m22 = params[_ROTOR + 1]
    h1 = 0.0
    h2 = 0.0

    # Link p turns about the CV pivot.
    mass = params[_LINKS]
    along = params[_LINKS + 1]
    across = params[_LINKS + 2]
    m11 += params[_LINKS + 3] + mass * (along * along + across * across)
    h1 -= mass * ((-along * e2y - across * e2x) * gx + (along * e2x - across * e2y) * gy)

    # Link s turns about the servo pivot.
    mass = params[_LINKS + 3 * _LINK_SIZE]
    along = params[_LINKS + 3 * _LINK_SIZE + 1]
    across = params[_LINKS + 3 * _LINK_SIZE + 2]
    m22 += params[_LINKS + 3 * _LINK_SIZE + 3] + mass * (along * along + across * across)
    h2 -= mass * ((-along * e5y - across * e5x) * gx + (along * e5x - across * e5y) * gy)

    # Link q is carried by A: u is the centre of mass as seen from A, t = u turned by +90 deg.
    mass = params[_LINKS + _LINK_SIZE]
    along = params[_LINKS + _LINK_SIZE + 1]
    across = params[_LINKS + _LINK_SIZE + 2]
    inertia = params[_LINKS + _LINK_SIZE + 3]
    ux = along * e3x - across * e3y
    uy = along * e3y + across * e3x
    m11, m12, m22, h1, h2 = _add_point(
        mass,
        -p * e2y - k32 * uy,
        p * e2x + k32 * ux,
        -k35 * uy,
        k35 * ux,
        -p * w2 * e2x - alpha3 * uy - w3 * ux - gx,
        -p * w2 * e2y + alpha3 * ux - w3 * uy - gy,
        m11,
        m12,
        m22,
        h1,
        h2,
    )
    m11 += inertia * k32 * k32
    m12 += inertia * k32 * k35
    m22 += inertia * k35 * k35
    h1 += inertia * k32 * alpha3
    h2 += inertia * k35 * alpha3

    # The end effector's own mass, at the far end of q.
    ux = q * e3x
    uy = q * e3y
    m11, m12, m22, h1, h2 = _add_point(
        params[_END_EFFECTOR_MASS],
        -p * e2y - k32 * uy,
        p * e2x + k32 * ux,
        -k35 * uy,
        k35 * ux,
        -p * w2 * e2x - alpha3 * uy - w3 * ux - gx,
        -p * w2 * e2y + alpha3 * ux - w3 * uy - gy,
        m11,
        m12,
        m22,
        h1,
        h2,
    )

    # Link r is carried by D.
    mass = params[_LINKS + 2 * _LINK_SIZE]
    along = params[_LINKS + 2 * _LINK_SIZE + 1]
    across = params[_LINKS + 2 * _LINK_SIZE + 2]
    inertia = params[_LINKS + 2 * _LINK_SIZE + 3]
    ux = along * e4x - across * e4y
    uy = along * e4y + across * e4x
    m11, m12, m22, h1, h2 = _add_point(
        mass,
        -k42 * uy,
        k42 * ux,
        -s * e5y - k45 * uy,
        s * e5x + k45 * ux,
        -s * w5 * e5x - alpha4 * uy - w4 * ux - gx,
        -s * w5 * e5y + alpha4 * ux - w4 * uy - gy,
        m11,
        m12,
        m22,
        h1,
        h2,
    )
    m11 += inertia * k42 * k42
    m12 += inertia * k42 * k45
    m22 += inertia * k45 * k45
    h1 += inertia * k42 * alpha4
    h2 += inertia * k45 * alpha4
    return m11, m12, m22, h1, h2, sine


@kernel
def acceleration(
    params: Float,
    theta2: float,
    theta5: float,
    omega2: float,
    omega5: float,
    torque2: float,
    torque5: float,
    closure: int,
) -> tuple[float, float]:
    """theta2'', theta5'' (rad/s^2) under the torques (N m) on the two axes, friction already taken off them."""
    m11, m12, m22, h1, h2 = mass_matrix_and_bias(params, theta2, theta5, omega2, omega5, closure)
    b1 = torque2 - h1
    b2 = torque5 - h2
    determinant = m11 * m22 - m12 * m12
    return (m22 * b1 - m12 * b2) / determinant, (m11 * b2 - m12 * b1) / determinant


@kernel
def friction_torque(params: Float, omega2: float, omega5: float, coulomb_velocity: float) -> tuple[float, float]:
    """Friction that resists the two axes, N m, positive with positive velocity: viscous, and Coulomb smoothed by tanh.

    coulomb_velocity (rad/s) is where the smoothed Coulomb friction reaches tanh(1) = 76 %; zero or less leaves it out.
    """
    friction2 = params[_VISCOUS] * omega2
    friction5 = params[_VISCOUS + 1] * omega5
    if coulomb_velocity > 0.0:
        friction2 += params[_COULOMB] * tanh(omega2 / coulomb_velocity)
        friction5 += params[_COULOMB + 1] * tanh(omega5 / coulomb_velocity)
    return friction2, friction5


@kernel
def inverse_dynamics(
    params: Float,
    theta2: float,
    theta5: float,
    omega2: float,
    omega5: float,
    alpha2: float,
    alpha5: float,
    closure: int,
    coulomb_velocity: float,
) -> tuple[float, float]:
    """Motor torques (tau2, tau5) in N m for a wanted motion: M theta'' + h + `friction_torque`."""
    m11, m12, m22, h1, h2 = mass_matrix_and_bias(params, theta2, theta5, omega2, omega5, closure)
    friction2, friction5 = friction_torque(params, omega2, omega5, coulomb_velocity)
    return m11 * alpha2 + m12 * alpha5 + h1 + friction2, m12 * alpha2 + m22 * alpha5 + h2 + friction5


@kernel
def energy(
    params: Float, theta2: float, theta5: float, omega2: float, omega5: float, closure: int
) -> tuple[float, float]:
    """Kinetic and potential energy in J; the potential is zero with every centre of mass at the origin."""
    m11, m12, m22, _, _ = mass_matrix_and_bias(params, theta2, theta5, omega2, omega5, closure)
    kinetic = 0.5 * (m11 * omega2 * omega2 + m22 * omega5 * omega5) + m12 * omega2 * omega5
    e2x, e2y, e3x, e3y, e4x, e4y, e5x, e5y, _ = assemble(params, theta2, theta5, closure)
    ax = params[4] + params[0] * e2x
    ay = params[5] + params[0] * e2y
    dx = params[6] + params[3] * e5x
    dy = params[7] + params[3] * e5y
    gx = params[_GRAVITY]
    gy = params[_GRAVITY + 1]
    potential = -params[_END_EFFECTOR_MASS] * (gx * (ax + params[1] * e3x) + gy * (ay + params[1] * e3y))
    for link in range(4):
        if link == 0:
            ox, oy, ex, ey = params[4], params[5], e2x, e2y
        elif link == 1:
            ox, oy, ex, ey = ax, ay, e3x, e3y
        elif link == 2:
            ox, oy, ex, ey = dx, dy, e4x, e4y
        else:
            ox, oy, ex, ey = params[6], params[7], e5x, e5y
        first = _LINKS + _LINK_SIZE * link
        along = params[first + 1]
        across = params[first + 2]
        x = ox + along * ex - across * ey
        y = oy + along * ey + across * ex
        potential -= params[first] * (gx * x + gy * y)
    return kinetic, potential


@kernel
def joint_positions(
    params: Float, theta2: float, theta5: float, closure: int
) -> tuple[float, float, float, float, float, float]:
    """(Ax, Ay, Cx, Cy, Dx, Dy) in metres; C is NaN where the linkage does not close."""
    e2x, e2y, e3x, e3y, _, _, e5x, e5y, _ = assemble(params, theta2, theta5, closure)
    ax = params[4] + params[0] * e2x
    ay = params[5] + params[0] * e2y
    return (
        ax,
        ay,
        ax + params[1] * e3x,
        ay + params[1] * e3y,
        params[6] + params[3] * e5x,
        params[7] + params[3] * e5y,
    )


@kernel
def linkage_sine(params: Float, theta2: float, theta5: float, closure: int) -> float:
    """sin(theta3 - theta4), dimensionless: 0 in a singular position, NaN where the linkage does not close."""
    _, _, _, _, _, _, _, _, sine = assemble(params, theta2, theta5, closure)
    return sine


@kernel
def inverse_dynamics_along(
    params: Float,
    theta: Float,
    omega: Float,
    alpha: Float,
    closure: int,
    coulomb_velocity: float,
    torque: Float,
) -> None:
    """`inverse_dynamics` of n states: theta, omega, alpha and torque are (n, 2), columns CV axis and servo axis."""
    for i in range(theta.shape[0]):
        torque[i, 0], torque[i, 1] = inverse_dynamics(
            params,
            theta[i, 0],
            theta[i, 1],
            omega[i, 0],
            omega[i, 1],
            alpha[i, 0],
            alpha[i, 1],
            closure,
            coulomb_velocity,
        )


@kernel
def rk4_step(
    params: Float,
    theta2: float,
    theta5: float,
    omega2: float,
    omega5: float,
    torque2: float,
    torque5: float,
    closure: int,
    step_s: float,
) -> tuple[float, float, float, float]:
    """One classic Runge-Kutta step of (theta2, theta5, omega2, omega5) under constant torques, without friction."""
    half = 0.5 * step_s
    a2, a5 = acceleration(params, theta2, theta5, omega2, omega5, torque2, torque5, closure)
    v2, v5 = omega2 + half * a2, omega5 + half * a5
    b2, b5 = acceleration(params, theta2 + half * omega2, theta5 + half * omega5, v2, v5, torque2, torque5, closure)
    u2, u5 = omega2 + half * b2, omega5 + half * b5
    c2, c5 = acceleration(params, theta2 + half * v2, theta5 + half * v5, u2, u5, torque2, torque5, closure)
    t2, t5 = omega2 + step_s * c2, omega5 + step_s * c5
    d2, d5 = acceleration(params, theta2 + step_s * u2, theta5 + step_s * u5, t2, t5, torque2, torque5, closure)
    sixth = step_s / 6.0
    return (
        theta2 + sixth * (omega2 + 2.0 * v2 + 2.0 * u2 + t2),
        theta5 + sixth * (omega5 + 2.0 * v5 + 2.0 * u5 + t5),
        omega2 + sixth * (a2 + 2.0 * b2 + 2.0 * c2 + d2),
        omega5 + sixth * (a5 + 2.0 * b5 + 2.0 * c5 + d5),
    )


class Dynamics:
    """The equations of motion of one machine, for callers outside kernels; plain floats in and out."""

    __slots__ = ("closure", "parameters", "params")

    def __init__(self, parameters: DynamicsParameters, closure: Closure) -> None:
        self.parameters = parameters
        self.closure = closure
        self.params = parameters.to_array()

    def torque(
        self,
        theta: tuple[float, float],
        omega: tuple[float, float],
        alpha: tuple[float, float],
        coulomb_velocity: float = 0.0,
    ) -> tuple[float, float]:
        """`inverse_dynamics`: motor torques (CV, servo) in N m; coulomb_velocity in rad/s, 0 leaves Coulomb friction
        out.
        """
        return inverse_dynamics(self.params, *theta, *omega, *alpha, int(self.closure), coulomb_velocity)

    def energy(self, theta: tuple[float, float], omega: tuple[float, float]) -> tuple[float, float]:
        """Kinetic and potential energy, J."""
        return energy(self.params, *theta, *omega, int(self.closure))
