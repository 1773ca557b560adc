"""The coupled axes, linear about an operating point: M x'' + C x' + K x = torque, its amplifiers, and both sampled.

Small deviations of (theta2, theta5) from a motion through (theta, omega, alpha), with the motion's values held fixed:
M is the mass matrix, C = d(torque)/d(omega) with viscous friction and Coriolis terms, K = d(torque)/d(theta) with
gravity. Dry friction has no small-signal gain while an axis slides, and is left out. The amplifiers are first-order
lags.

A digital controller sees this through a zero-order hold: `sample` gives the exact difference equation for a torque
command that is held over a sample period and acts after a delay that need not be a whole number of periods.
"""

from dataclasses import dataclass
from math import ceil, floor, log2
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import inverse_dynamics, linkage_sine, mass_matrix_and_bias
from mechanism.errors import ParameterError

Float = NDArray[np.float64]
Complex = NDArray[np.complex128]

_STEP_RAD: Final = 1e-5
_STEP_RAD_PER_S: Final = 1e-4
_STATES: Final = 6
_SINGULAR_SINE: Final = 1e-3
_NO_DRY_FRICTION: Final = 0.0
_WHOLE_PERIOD: Final = 1e-9
"""Share of a sample period that is rounding."""
_TAYLOR_TERMS: Final = 14
"""Of exp(x) with |x| <= 1/4: what is left out is below 1e-19."""


@dataclass(frozen=True, slots=True)
class LinearAxes:
    """n operating points: ``mass``, ``damping``, ``stiffness`` are (n, 2, 2), rows and columns CV axis and servo axis.

    kg m^2, N m s/rad, N m/rad.
    """

    mass: Float
    damping: Float
    stiffness: Float


@dataclass(frozen=True, slots=True)
class SampledAxes:
    """x(k+1) = transition x(k) + recent u(k-delay) + older u(k-delay-1); both angles are the first two states.

    ``transition`` (n, 6, 6), ``recent`` and ``older`` (n, 6, 2); u are torque commands in N m. ``older`` is zero for a
    delay of whole periods.
    """

    transition: Float
    recent: Float
    older: Float
    delay_periods: int
    period_s: float


def linearise(params: Float, theta: Float, omega: Float, alpha: Float, closure: int) -> LinearAxes:
    """Linear axes at n operating points; theta (rad), omega (rad/s), alpha (rad/s^2) are (n, 2), columns as the axes.

    ``params`` is DynamicsParameters.to_array(); C and K are central differences of the inverse dynamics.

    Raises ParameterError where the linkage is singular or does not close.
    """
    count = len(theta)
    mass, damping, stiffness = (np.zeros((count, 2, 2)) for _ in range(3))

    def torque(x: Float, v: Float, a: Float) -> Float:
        return np.array(inverse_dynamics(params, x[0], x[1], v[0], v[1], a[0], a[1], closure, _NO_DRY_FRICTION))

    for i in range(count):
        x, v, a = theta[i], omega[i], alpha[i]
        m11, m12, m22, _, _ = mass_matrix_and_bias(params, x[0], x[1], v[0], v[1], closure)
        mass[i] = (m11, m12), (m12, m22)
        for axis in range(2):
            step = np.zeros(2)
            step[axis] = 1.0
            up, down = x + _STEP_RAD * step, x - _STEP_RAD * step
            stiffness[i, :, axis] = (torque(up, v, a) - torque(down, v, a)) / (2.0 * _STEP_RAD)
            up, down = v + _STEP_RAD_PER_S * step, v - _STEP_RAD_PER_S * step
            damping[i, :, axis] = (torque(x, up, a) - torque(x, down, a)) / (2.0 * _STEP_RAD_PER_S)
        if not abs(linkage_sine(params, x[0], x[1], closure)) > _SINGULAR_SINE:
            raise ParameterError("an operating point", f"at {x[0]:g}, {x[1]:g} rad", "away from singular positions")
    return LinearAxes(mass, damping, stiffness)


def state_matrices(axes: LinearAxes, time_constants_s: tuple[float, float]) -> tuple[Float, Float]:
    """A (n, 6, 6) and B (n, 6, 2) of x' = A x + B u: both angles, velocities and amplifier torques; u commands in N m.

    Raises ParameterError unless both time constants are positive.
    """
    if not min(time_constants_s) > 0.0:
        raise ParameterError("torque_time_constant_s", time_constants_s, "positive on both axes")
    count = len(axes.mass)
    inverse = np.linalg.inv(axes.mass)
    rates = np.diag([1.0 / time_constant for time_constant in time_constants_s])
    a = np.zeros((count, _STATES, _STATES))
    a[:, 0:2, 2:4] = np.eye(2)
    a[:, 2:4, 0:2] = -inverse @ axes.stiffness
    a[:, 2:4, 2:4] = -inverse @ axes.damping
    a[:, 2:4, 4:6] = inverse
    a[:, 4:6, 4:6] = -rates
    b = np.zeros((count, _STATES, 2))
    b[:, 4:6, :] = rates
    return a, b


def sample(a: Float, b: Float, period_s: float, delay_s: float = 0.0) -> SampledAxes:
    """x' = A x + B u, sampled exactly, with u held over each period and acting ``delay_s`` (zero or more) later."""
    periods = delay_s / period_s
    whole = floor(periods + _WHOLE_PERIOD)
    late_s = max(0.0, periods - whole) * period_s
    if late_s < _WHOLE_PERIOD * period_s:
        late_s = 0.0
    rest, of_recent = _held(a, b, period_s - late_s)
    start, of_older = _held(a, b, late_s)
    return SampledAxes(rest @ start, of_recent, rest @ of_older, whole, period_s)


def _held(a: Float, b: Float, span_s: float) -> tuple[Float, Float]:
    """exp(A span) and the integral of exp(A s) B over the span."""
    count, states, inputs = b.shape
    joined = np.zeros((count, states + inputs, states + inputs))
    joined[:, :states, :states] = a * span_s
    joined[:, :states, states:] = b * span_s
    power = _exponential(joined)
    return power[:, :states, :states], power[:, :states, states:]


def _exponential(matrices: Float) -> Float:
    """exp of every matrix (n, k, k): Taylor's series of a small enough part, squared as often as it was halved."""
    norm = float(np.abs(matrices).sum(axis=-1).max(initial=0.0))
    halvings = max(0, ceil(log2(norm)) + 2) if norm > 0.0 else 0
    part = matrices / 2.0**halvings
    power = term = np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape)
    for k in range(1, _TAYLOR_TERMS):
        term = term @ part / k
        power = power + term
    for _ in range(halvings):
        power = power @ power
    return power


def frequency_response(sampled: SampledAxes, frequencies_hz: Float) -> Complex:
    """Angles (rad) by torque commands (N m), (n, m, 2, 2), of n points at m frequencies up to half the sample rate."""
    z = np.exp(2j * np.pi * frequencies_hz * sampled.period_s)
    count, states = sampled.transition.shape[:2]
    response = np.zeros((count, len(z), 2, 2), dtype=np.complex128)
    identity = np.eye(states)
    for k, each in enumerate(z):
        inputs = (sampled.recent + sampled.older / each) * each**-sampled.delay_periods
        response[:, k] = np.linalg.solve(each * identity - sampled.transition, inputs)[:, :2]
    return response
