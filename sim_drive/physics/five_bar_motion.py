"""The coupled five-bar with both motors rigidly on their links, one servo period at a time: a numba kernel."""

from math import isnan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import motion_terms
from mechanism.jit import kernel
from sim_drive.physics.driveline import (
    DRY_HEAT,
    ENERGY_COUNT,
    STOP_MAXIMUM,
    STOP_MINIMUM,
    VISCOUS_HEAT,
    count_motor,
    dry_friction,
    smooth_resistance,
    torques_of_step,
    within_limit,
)
from sim_drive.physics.friction import impulse_bounds, velocities_after_impulse

Float = NDArray[np.float64]

AxisState = tuple[float, float, float, float, float, float, float, float]
"""Both angles (rad), angular velocities (rad/s), accelerations (rad/s2) and amplifier torques (N m) of the five-bar."""

MOTION_SIZE: Final = 8
"""Floats of an `AxisState`."""
METERED_SIZE: Final = MOTION_SIZE + 2 * ENERGY_COUNT
"""Floats of a state in which the energies are counted too."""


@kernel
def five_bar_acceleration(
    dynamics: Float,
    closure: int,
    theta2: float,
    theta5: float,
    omega2: float,
    omega5: float,
    torque2: float,
    torque5: float,
) -> tuple[float, float, float, float, float, float]:
    """(theta2'', theta5'', m11, m12, m22, |sin(theta3 - theta4)|) under torques that have friction taken off.

    rad/s2 and kg m2.
    """
    m11, m12, m22, h1, h2, sine = motion_terms(dynamics, theta2, theta5, omega2, omega5, closure)
    b1 = torque2 - h1
    b2 = torque5 - h2
    determinant = m11 * m22 - m12 * m12
    return (m22 * b1 - m12 * b2) / determinant, (m11 * b2 - m12 * b1) / determinant, m11, m12, m22, abs(sine)


@kernel
def advance_five_bar(
    state: Float,
    dynamics: Float,
    settings: Float,
    closure: int,
    singular_sine: float,
    step_s: float,
    substeps: int,
    command2: float,
    command5: float,
    brake2: bool,
    brake5: bool,
) -> tuple[float, float, float, float, float, float, float, float, int]:
    """Advance ``state`` (8 floats, see `AxisState`) by ``substeps`` steps of ``step_s`` in place.

    A state of `METERED_SIZE` floats has the energies counted into it as well, which changes nothing in the motion.

    Returns the new state and the step within which the linkage tore, counted from 1; 0 while it is whole. A torn
    linkage is left standing where the step began.

    Each step: the amplifiers' lag exactly, the smooth motion by a classic Runge-Kutta step, then dry friction, brakes
    and end stops as an impulse (`friction`), the angles following by half a step of the change in velocity.
    """
    wanted2, wanted5 = within_limit(settings, 0, command2), within_limit(settings, 1, command5)
    is_metered = state.shape[0] >= METERED_SIZE

    x2, x5, v2, v5 = state[0], state[1], state[2], state[3]
    a2, a5, torque2, torque5 = state[4], state[5], state[6], state[7]
    half = 0.5 * step_s
    sixth = step_s / 6.0
    torn = 0
    for step in range(substeps):
        torque2, middle2, end2 = torques_of_step(settings, 0, wanted2, torque2, v2)
        torque5, middle5, end5 = torques_of_step(settings, 1, wanted5, torque5, v5)

        f2, f5 = smooth_resistance(settings, 0, v2), smooth_resistance(settings, 1, v5)
        p2, p5, _, _, _, worst = five_bar_acceleration(dynamics, closure, x2, x5, v2, v5, torque2 - f2, torque5 - f5)
        vb2, vb5 = v2 + half * p2, v5 + half * p5
        xb2, xb5 = x2 + half * v2, x5 + half * v5
        fb2, fb5 = smooth_resistance(settings, 0, vb2), smooth_resistance(settings, 1, vb5)
        q2, q5, _, _, _, sine = five_bar_acceleration(
            dynamics, closure, xb2, xb5, vb2, vb5, middle2 - fb2, middle5 - fb5
        )
        worst = sine if sine < worst else worst
        vc2, vc5 = v2 + half * q2, v5 + half * q5
        xc2, xc5 = x2 + half * vb2, x5 + half * vb5
        fc2, fc5 = smooth_resistance(settings, 0, vc2), smooth_resistance(settings, 1, vc5)
        r2, r5, _, _, _, sine = five_bar_acceleration(
            dynamics, closure, xc2, xc5, vc2, vc5, middle2 - fc2, middle5 - fc5
        )
        worst = sine if sine < worst else worst
        vd2, vd5 = v2 + step_s * r2, v5 + step_s * r5
        xd2, xd5 = x2 + step_s * vc2, x5 + step_s * vc5
        fd2, fd5 = smooth_resistance(settings, 0, vd2), smooth_resistance(settings, 1, vd5)
        s2, s5, m11, m12, m22, sine = five_bar_acceleration(
            dynamics, closure, xd2, xd5, vd2, vd5, end2 - fd2, end5 - fd5
        )
        worst = sine if sine < worst else worst
        # A stage in which the linkage does not close is NaN, and so is every stage that follows it.
        if not worst >= singular_sine or isnan(s2) or isnan(s5):
            torn = step + 1
            v2 = v5 = a2 = a5 = torque2 = torque5 = 0.0
            break
        y2 = x2 + sixth * (v2 + 2.0 * (vb2 + vc2) + vd2)
        y5 = x5 + sixth * (v5 + 2.0 * (vb5 + vc5) + vd5)
        w2 = v2 + sixth * (p2 + 2.0 * (q2 + r2) + s2)
        w5 = v5 + sixth * (p5 + 2.0 * (q5 + r5) + s5)

        # The mass matrix of the last stage stands for the one at the end of the step: they differ in third order.
        least2, greatest2 = impulse_bounds(
            y2, dry_friction(settings, 0, v2, brake2) * step_s, settings[0, STOP_MINIMUM], settings[0, STOP_MAXIMUM]
        )
        least5, greatest5 = impulse_bounds(
            y5, dry_friction(settings, 1, v5, brake5) * step_s, settings[1, STOP_MINIMUM], settings[1, STOP_MAXIMUM]
        )
        u2, u5 = velocities_after_impulse(m11, m12, m22, w2, w5, least2, greatest2, least5, greatest5)
        if is_metered:
            # Dry friction changes the way by half a step of the change in velocity, and every work along it.
            d2, d5 = u2 - w2, u5 - w5
            work2 = sixth * (torque2 * v2 + 2.0 * middle2 * (vb2 + vc2) + end2 * vd2) + half * end2 * d2
            work5 = sixth * (torque5 * v5 + 2.0 * middle5 * (vb5 + vc5) + end5 * vd5) + half * end5 * d5
            count_motor(state, MOTION_SIZE, settings, 0, step_s, torque2, middle2, end2, work2)
            count_motor(state, MOTION_SIZE + ENERGY_COUNT, settings, 1, step_s, torque5, middle5, end5, work5)
            heat2 = sixth * (f2 * v2 + 2.0 * (fb2 * vb2 + fc2 * vc2) + fd2 * vd2) + half * fd2 * d2
            heat5 = sixth * (f5 * v5 + 2.0 * (fb5 * vb5 + fc5 * vc5) + fd5 * vd5) + half * fd5 * d5
            state[MOTION_SIZE + VISCOUS_HEAT] += heat2
            state[MOTION_SIZE + ENERGY_COUNT + VISCOUS_HEAT] += heat5
            state[MOTION_SIZE + DRY_HEAT] -= 0.5 * (m11 * d2 + m12 * d5) * (v2 + u2)
            state[MOTION_SIZE + ENERGY_COUNT + DRY_HEAT] -= 0.5 * (m12 * d2 + m22 * d5) * (v5 + u5)
        # An axis that stood and still stands has not moved: anything else would let it creep as its load varies.
        if not (v2 == 0.0 and u2 == 0.0):
            x2 = y2 + half * (u2 - w2)
        if not (v5 == 0.0 and u5 == 0.0):
            x5 = y5 + half * (u5 - w5)
        x2 = min(max(x2, settings[0, STOP_MINIMUM]), settings[0, STOP_MAXIMUM])
        x5 = min(max(x5, settings[1, STOP_MINIMUM]), settings[1, STOP_MAXIMUM])
        a2, a5 = (u2 - v2) / step_s, (u5 - v5) / step_s
        v2, v5 = u2, u5
        torque2, torque5 = end2, end5
    state[0], state[1], state[2], state[3] = x2, x5, v2, v5
    state[4], state[5], state[6], state[7] = a2, a5, torque2, torque5
    return x2, x5, v2, v5, a2, a5, torque2, torque5, torn
