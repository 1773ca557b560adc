"""The coupled five-bar with flexible couplings, and play in them, between the motors and their links.

The resolver, dry and viscous friction, the brake and the end stops of such an axis are on the motor's side; on the
link's side are the linkage and the coupling's other half. An axis without a coupling has its motor on its link, as in
`sim_drive.physics.five_bar_motion`; the two kinds may be mixed.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, isnan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import energy, linkage_sine
from mechanism.jit import kernel
from sim_drive.physics.coupling import MOTOR_INERTIA, STIFFNESS, Coupling, coupling_row, coupling_torques
from sim_drive.physics.driveline import (
    DRY_HEAT,
    ENERGY_COUNT,
    STOP_MAXIMUM,
    STOP_MINIMUM,
    VISCOUS_HEAT,
    AxisEnergy,
    count_motor,
    dry_friction,
    energy_of,
    smooth_resistance,
    torques_of_step,
    within_limit,
)
from sim_drive.physics.five_bar_motion import METERED_SIZE, MOTION_SIZE, five_bar_acceleration
from sim_drive.physics.friction import impulse_bounds, velocities_after_impulse, velocity_after_impulse
from sim_drive.physics.plant import FiveBarPlant, PlantParameters

Float = NDArray[np.float64]

# Layout of the state: that of a metered five-bar, in which the angles are the motors', then these.
_LINK: Final = METERED_SIZE
"""Both links' angles, then their velocities."""
_COUPLING_HEAT: Final = _LINK + 4
STATE_SIZE: Final = _COUPLING_HEAT + 2

# Layout of what is integrated in a step: angles of motors and links, their velocities, then the energies.
_WORK: Final = 8
_FRICTION: Final = 10
_FLOW: Final = 12
_VARIABLES: Final = 14


@kernel
def _axis_torques(
    settings: Float,
    couplings: Float,
    axis: int,
    motor_angle: float,
    motor_velocity: float,
    link_angle: float,
    link_velocity: float,
    torque: float,
) -> tuple[float, float, float, float]:
    """(acceleration of the motor if it has a coupling, torque on the link, smooth friction, coupling's heat flow)."""
    friction = smooth_resistance(settings, axis, motor_velocity)
    if couplings[axis, STIFFNESS] == inf:
        return 0.0, torque - friction, friction, 0.0
    rate = motor_velocity - link_velocity
    passed, elastic = coupling_torques(couplings, axis, motor_angle - link_angle, rate)
    return (torque - friction - passed) / couplings[axis, MOTOR_INERTIA], passed, friction, (passed - elastic) * rate


@kernel
def _slopes(
    dynamics: Float,
    settings: Float,
    couplings: Float,
    closure: int,
    torque2: float,
    torque5: float,
    is_held2: bool,
    is_held5: bool,
    y: Float,
    slope: Float,
) -> tuple[float, float, float, float]:
    """Fill ``slope`` with that of ``y`` (see ``_VARIABLES``); returns m11, m12, m22 and |sin(theta3 - theta4)|.

    A motor that ``is_held`` has no acceleration: see `_holds`.
    """
    a2, on2, friction2, flow2 = _axis_torques(settings, couplings, 0, y[0], y[4], y[2], y[6], torque2)
    a5, on5, friction5, flow5 = _axis_torques(settings, couplings, 1, y[1], y[5], y[3], y[7], torque5)
    link2, link5, m11, m12, m22, sine = five_bar_acceleration(dynamics, closure, y[2], y[3], y[6], y[7], on2, on5)
    for i in range(4):
        slope[i] = y[i + 4]
    slope[4] = 0.0 if is_held2 else (a2 if couplings[0, STIFFNESS] < inf else link2)
    slope[5] = 0.0 if is_held5 else (a5 if couplings[1, STIFFNESS] < inf else link5)
    slope[6] = link2
    slope[7] = link5
    slope[_WORK] = torque2 * y[4]
    slope[_WORK + 1] = torque5 * y[5]
    slope[_FRICTION] = friction2 * y[4]
    slope[_FRICTION + 1] = friction5 * y[5]
    slope[_FLOW] = flow2
    slope[_FLOW + 1] = flow5
    return m11, m12, m22, sine


@kernel
def _holds(state: Float, settings: Float, couplings: Float, axis: int, torque: float, brake: bool) -> bool:
    """Whether dry friction and brake hold a motor behind a coupling for a step, under ``torque`` of its amplifier.

    Left to the impulse at the end of the step, a motor that is held would swing within it, light as it is, and the
    coupling's damper would feel that.
    """
    if couplings[axis, STIFFNESS] == inf or state[2 + axis] != 0.0:
        return False
    passed, _ = coupling_torques(couplings, axis, state[axis] - state[_LINK + axis], -state[_LINK + 2 + axis])
    return abs(torque - passed) <= dry_friction(settings, axis, 0.0, brake)


@kernel
def _motor_impulse(
    settings: Float, couplings: Float, axis: int, step_s: float, angle: float, before: float, after: float, brake: bool
) -> tuple[float, float, float]:
    """(velocity of the motor after friction, brake and stops, least and greatest impulse on its link).

    ``angle`` and ``after``: where the smooth step has led; ``before``: the velocity at its start. Behind a coupling no
    such impulse reaches the link; without one the link takes it, and the velocity is not worked out here.
    """
    least, greatest = impulse_bounds(
        angle,
        dry_friction(settings, axis, before, brake) * step_s,
        settings[axis, STOP_MINIMUM],
        settings[axis, STOP_MAXIMUM],
    )
    if couplings[axis, STIFFNESS] == inf:
        return after, least, greatest
    return velocity_after_impulse(couplings[axis, MOTOR_INERTIA], after, least, greatest), 0.0, 0.0


@kernel
def _settle(
    state: Float, settings: Float, couplings: Float, axis: int, step_s: float, smooth: Float, motor: float, link: float
) -> float:
    """End a step of an axis at these velocities of motor and link; returns the change that friction has made.

    ``smooth``: by how much the smooth step changes each variable.
    """
    is_flexible = couplings[axis, STIFFNESS] < inf
    before = state[2 + axis]
    change = motor - (before + smooth[4 + axis])
    link_change = link - (state[_LINK + 2 + axis] + smooth[6 + axis])
    # An axis that stood and still stands has not moved: anything else would let it creep as its load varies.
    if not (before == 0.0 and motor == 0.0):
        angle = state[axis] + smooth[axis] + 0.5 * step_s * change
        state[axis] = min(max(angle, settings[axis, STOP_MINIMUM]), settings[axis, STOP_MAXIMUM])
    if is_flexible:
        state[_LINK + axis] += smooth[2 + axis] + 0.5 * step_s * link_change
    else:
        state[_LINK + axis] = state[axis]
    state[4 + axis] = (motor - before) / step_s
    state[2 + axis] = motor
    state[_LINK + 2 + axis] = link
    return change


@kernel
def advance_compliant(
    state: Float,
    dynamics: Float,
    settings: Float,
    couplings: Float,
    scratch: Float,
    closure: int,
    singular_sine: float,
    step_s: float,
    substeps: int,
    command2: float,
    command5: float,
    brake2: bool,
    brake5: bool,
) -> int:
    """Advance ``state`` (`STATE_SIZE` floats) in place; returns the step within which the linkage tore, 0 for none.

    As `five_bar_motion.advance_five_bar`: a step is a Runge-Kutta step of motors and links together, then the
    impulses of dry friction, brakes and end stops. ``dynamics`` has the inertia of what is on the links' side;
    ``scratch`` (3, 14) holds nothing between two calls.
    """
    y, slope, smooth = scratch[0], scratch[1], scratch[2]
    wanted2, wanted5 = within_limit(settings, 0, command2), within_limit(settings, 1, command5)
    for step in range(substeps):
        start2, middle2, end2 = torques_of_step(settings, 0, wanted2, state[6], state[2])
        start5, middle5, end5 = torques_of_step(settings, 1, wanted5, state[7], state[3])
        is_held2 = _holds(state, settings, couplings, 0, start2, brake2)
        is_held5 = _holds(state, settings, couplings, 1, start5, brake5)
        smooth[:] = 0.0
        slope[:] = 0.0
        worst = inf
        m11, m12, m22 = 0.0, 0.0, 0.0
        for stage in range(4):
            reach = 0.5 * step_s
            weight = step_s / 3.0
            t2, t5 = middle2, middle5
            if stage == 0:
                reach, weight, t2, t5 = 0.0, step_s / 6.0, start2, start5
            elif stage == 3:
                reach, weight, t2, t5 = step_s, step_s / 6.0, end2, end5
            for i in range(2):
                y[i] = state[i] + reach * slope[i]
                y[i + 2] = state[_LINK + i] + reach * slope[i + 2]
                y[i + 4] = state[i + 2] + reach * slope[i + 4]
                y[i + 6] = state[_LINK + 2 + i] + reach * slope[i + 6]
            m11, m12, m22, sine = _slopes(dynamics, settings, couplings, closure, t2, t5, is_held2, is_held5, y, slope)
            worst = sine if not sine >= worst else worst
            for i in range(_VARIABLES):
                smooth[i] += weight * slope[i]
        if not worst >= singular_sine or isnan(smooth[6]) or isnan(smooth[7]):
            state[2:8] = 0.0
            state[_LINK + 2 : _LINK + 4] = 0.0
            return step + 1

        before2, before5 = state[2], state[3]
        y2, least2, greatest2 = _motor_impulse(
            settings, couplings, 0, step_s, state[0] + smooth[0], before2, before2 + smooth[4], brake2
        )
        y5, least5, greatest5 = _motor_impulse(
            settings, couplings, 1, step_s, state[1] + smooth[1], before5, before5 + smooth[5], brake5
        )
        w2, w5 = state[_LINK + 2] + smooth[6], state[_LINK + 3] + smooth[7]
        u2, u5 = velocities_after_impulse(m11, m12, m22, w2, w5, least2, greatest2, least5, greatest5)
        impulse2, impulse5 = m11 * (u2 - w2) + m12 * (u5 - w5), m12 * (u2 - w2) + m22 * (u5 - w5)
        if couplings[0, STIFFNESS] < inf:
            impulse2 = couplings[0, MOTOR_INERTIA] * (y2 - (before2 + smooth[4]))
        else:
            y2 = u2
        if couplings[1, STIFFNESS] < inf:
            impulse5 = couplings[1, MOTOR_INERTIA] * (y5 - (before5 + smooth[5]))
        else:
            y5 = u5
        change2 = _settle(state, settings, couplings, 0, step_s, smooth, y2, u2)
        change5 = _settle(state, settings, couplings, 1, step_s, smooth, y5, u5)
        state[6], state[7] = end2, end5

        # Dry friction changes the way by half a step of the change in velocity, and every work along it.
        work2 = smooth[_WORK] + 0.5 * step_s * end2 * change2
        work5 = smooth[_WORK + 1] + 0.5 * step_s * end5 * change5
        count_motor(state, MOTION_SIZE, settings, 0, step_s, start2, middle2, end2, work2)
        count_motor(state, MOTION_SIZE + ENERGY_COUNT, settings, 1, step_s, start5, middle5, end5, work5)
        for axis in range(2):
            first = MOTION_SIZE + axis * ENERGY_COUNT
            change, impulse = (change2, impulse2) if axis == 0 else (change5, impulse5)
            before = before2 if axis == 0 else before5
            friction = smooth_resistance(settings, axis, before + smooth[4 + axis])
            state[first + VISCOUS_HEAT] += smooth[_FRICTION + axis] + 0.5 * step_s * friction * change
            state[first + DRY_HEAT] -= 0.5 * impulse * (before + state[2 + axis])
            state[_COUPLING_HEAT + axis] += smooth[_FLOW + axis]
    return 0


class CompliantPlant(FiveBarPlant):
    """The five-bar with a flexible coupling on one axis or both; angles, velocities and torques are the motors'.

    Raises ValueError where the linkage is singular, or does not close, at the initial angles (rad), which are those of
    motors and links, with every coupling at rest in the middle of its play.
    """

    __slots__ = ("_constants", "couplings")

    def __init__(
        self,
        parameters: PlantParameters,
        couplings: tuple[Coupling | None, Coupling | None],
        theta2_rad: float,
        theta5_rad: float,
    ) -> None:
        super().__init__(parameters, theta2_rad, theta5_rad, STATE_SIZE)
        self.couplings: Final = couplings
        rotors = parameters.dynamics.rotor_inertia_kg_m2
        on_links = replace(
            parameters.dynamics,
            rotor_inertia_kg_m2=(_on_link(rotors[0], couplings[0]), _on_link(rotors[1], couplings[1])),
        )
        self._dynamics = on_links.to_array()
        self._constants = (
            self._dynamics,
            self._settings,
            np.array([coupling_row(coupling, rotor) for coupling, rotor in zip(couplings, rotors, strict=True)]),
            np.zeros((3, _VARIABLES)),
            int(parameters.closure),
            parameters.singular_sine,
            self._step_s,
            parameters.substeps,
        )
        self.set_motion((theta2_rad, theta5_rad), (0.0, 0.0))
        # Compiled here rather than in the first servo period, where it would make a real-time host seconds late.
        advance_compliant(self._state.copy(), *self._constants, 0.0, 0.0, False, False)

    def set_motion(self, theta: tuple[float, float], omega: tuple[float, float]) -> None:
        """See FiveBarPlant; motors and links are put at the same angles and velocities."""
        super().set_motion(theta, omega)
        self._state[_LINK : _LINK + 4] = (*theta, *omega)

    def advance(self, torque_commands_Nm: Sequence[float], brakes_engaged: Sequence[bool]) -> None:
        """One servo period (1/1024 s) under constant torque commands (N m) for the CV and the servo axis."""
        self._steps += 1
        if self.torn_at_s is not None:
            return
        command2, command5 = torque_commands_Nm
        brake2, brake5 = brakes_engaged
        torn = advance_compliant(self._state, *self._constants, command2, command5, brake2, brake5)
        self._take((*self._state[:MOTION_SIZE].tolist(), torn))

    def link_angle(self, axis: int) -> float:
        """Angle of an axis' link in rad at the end of the last servo period."""
        return float(self._state[_LINK + axis])

    def energy(self) -> float:
        """Kinetic and potential energy in J, that of motors and couplings included."""
        x2, x5, v2, v5 = self._state[_LINK : _LINK + 4].tolist()
        kinetic, potential = energy(self._dynamics, x2, x5, v2, v5, int(self.parameters.closure))
        total = kinetic + potential
        for axis, coupling in enumerate(self.couplings):
            if coupling is not None:
                stretched = max(abs(self.angle(axis) - self.link_angle(axis)) - 0.5 * coupling.backlash_rad, 0.0)
                total += 0.5 * coupling.stiffness_N_m_per_rad * stretched * stretched
                total += 0.5 * self.parameters.dynamics.rotor_inertia_kg_m2[axis] * self.velocity(axis) ** 2
        return total

    def linkage_sine(self) -> float:
        """sin(theta3 - theta4): how far the linkage is from a singular position (0)."""
        return linkage_sine(self._dynamics, self.link_angle(0), self.link_angle(1), int(self.parameters.closure))

    def axis_energy(self, axis: int) -> AxisEnergy:
        """What an axis has drawn, done and lost so far."""
        first = MOTION_SIZE + ENERGY_COUNT * axis
        counted: list[float] = self._state[first : first + ENERGY_COUNT].tolist()
        heat = float(self._state[_COUPLING_HEAT + axis])
        return energy_of(counted, self.parameters.axes[axis].motor, self.time_s, heat)


def _on_link(rotor_inertia: float, coupling: Coupling | None) -> float:
    return rotor_inertia if coupling is None else coupling.link_side_inertia_kg_m2
