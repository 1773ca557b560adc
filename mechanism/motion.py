"""Jerk-limited motion of the master (theta2): a run of whole revolutions, and a controlled stop from any state.

The time-optimal ramps are ruckig's. A plan is a list of pieces of constant jerk, evaluated in constant time.
"""

from bisect import bisect_right
from dataclasses import dataclass
from enum import IntEnum, unique
from math import ceil, copysign, inf, tau
from typing import Any, Final, cast

import ruckig

from mechanism.errors import MotionError, finite

# ruckig has no type information; what comes out of it is typed in _ramp_steps.
_RUCKIG = cast("Any", ruckig)

_REVOLUTION_TOLERANCE: Final = 1e-9


@unique
class MasterPhase(IntEnum):
    """Where a plan is at an instant."""

    RAMP_UP = 0
    CRUISE = 1
    RAMP_DOWN = 2
    FINISHED = 3


@dataclass(frozen=True, slots=True)
class _Piece:
    """Constant jerk from ``start_s`` on: position, velocity, acceleration at its start, and the jerk."""

    start_s: float
    position: float
    velocity: float
    acceleration: float
    jerk: float


@dataclass(frozen=True, slots=True)
class MasterPlan:
    """A planned motion of the master: rad, rad/s, rad/s^2, seconds from its start.

    cruise_start_s and cruise_end_s are both 0 in a stop, which is all ramp down. Before 0 s the plan stands at its
    start, from duration_s on it rests exactly at ``end_position``.
    """

    pieces: tuple[_Piece, ...]
    starts_s: tuple[float, ...]
    duration_s: float
    cruise_start_s: float
    cruise_end_s: float
    cruise_speed: float
    end_position: float

    def at(self, t_s: float) -> tuple[float, float, float]:
        """Position, velocity and acceleration at t_s."""
        if t_s >= self.duration_s:
            return self.end_position, 0.0, 0.0
        if t_s < 0.0:
            t_s = 0.0
        piece = self.pieces[bisect_right(self.starts_s, t_s) - 1]
        t = t_s - piece.start_s
        acceleration = piece.acceleration
        jerk = piece.jerk
        return (
            piece.position + t * (piece.velocity + t * (0.5 * acceleration + t * jerk / 6.0)),
            piece.velocity + t * (acceleration + 0.5 * t * jerk),
            acceleration + t * jerk,
        )

    def phase_at(self, t_s: float) -> MasterPhase:
        """The phase at t_s; a boundary belongs to the later phase."""
        if t_s >= self.duration_s:
            return MasterPhase.FINISHED
        if t_s < self.cruise_start_s:
            return MasterPhase.RAMP_UP
        if t_s < self.cruise_end_s:
            return MasterPhase.CRUISE
        return MasterPhase.RAMP_DOWN


def _check_limits(acceleration_limit: float, jerk_limit: float) -> None:
    for name, unit, value in (
        ("acceleration", "rad/s^2", acceleration_limit),
        ("jerk", "rad/s^3", jerk_limit),
    ):
        if not (finite(value) and value > 0.0):
            raise MotionError(f"the master's {name} limit is {value:g} {unit}, but must be positive and finite")


def _ramp_steps(
    velocity: float, acceleration: float, target_velocity: float, acceleration_limit: float, jerk_limit: float
) -> list[tuple[float, float]]:
    """The fastest change of velocity as (duration, jerk) steps."""
    request = _RUCKIG.InputParameter(1)
    request.control_interface = _RUCKIG.ControlInterface.Velocity
    request.current_position = [0.0]
    request.current_velocity = [velocity]
    request.current_acceleration = [acceleration]
    request.target_velocity = [target_velocity]
    request.target_acceleration = [0.0]
    # Not looked at where the velocity itself is the target, but it has to be there.
    request.max_velocity = [max(abs(velocity), abs(target_velocity), 1.0)]
    request.max_acceleration = [acceleration_limit]
    request.max_jerk = [jerk_limit]
    trajectory = _RUCKIG.Trajectory(1)
    try:
        result = _RUCKIG.Ruckig(1).calculate(request, trajectory)
    except _RUCKIG.RuckigError as error:
        reason = " ".join(str(error).split())[:80]
        raise MotionError(f"no ramp of the master from {velocity:g} to {target_velocity:g} rad/s ({reason})") from None
    if result not in (_RUCKIG.Result.Working, _RUCKIG.Result.Finished):
        raise MotionError(f"no ramp of the master from {velocity:g} to {target_velocity:g} rad/s ({result})")
    profile = trajectory.profiles[0][0]
    steps: list[tuple[float, float]] = []
    if profile.brake.duration > 0.0:
        steps += zip(map(float, profile.brake.t), map(float, profile.brake.j), strict=True)
    steps += zip(map(float, profile.t), map(float, profile.j), strict=True)
    return [step for step in steps if step[0] > 0.0]


def _ramp(
    start_s: float,
    position: float,
    velocity: float,
    acceleration: float,
    target_velocity: float,
    acceleration_limit: float,
    jerk_limit: float,
) -> tuple[list[_Piece], float, float]:
    """The fastest change of velocity: its pieces, when it ends, and the position there."""
    steps = _ramp_steps(velocity, acceleration, target_velocity, acceleration_limit, jerk_limit)
    pieces: list[_Piece] = []
    now, p, v, a = start_s, position, velocity, acceleration
    for duration, jerk in steps:
        pieces.append(_Piece(now, p, v, a, jerk))
        p += duration * (v + duration * (0.5 * a + duration * jerk / 6.0))
        v += duration * (a + 0.5 * duration * jerk)
        a += duration * jerk
        now += duration
    return pieces, now, p


def _plan(
    pieces: list[_Piece], duration_s: float, cruise_start_s: float, cruise_end_s: float, speed: float, end: float
) -> MasterPlan:
    if not pieces:
        pieces = [_Piece(0.0, end, 0.0, 0.0, 0.0)]
    starts = tuple(piece.start_s for piece in pieces)
    return MasterPlan(tuple(pieces), starts, duration_s, cruise_start_s, cruise_end_s, speed, end)


def plan_run(
    start_position: float,
    cruise_speed: float,
    cycles: float,
    acceleration_limit: float,
    jerk_limit: float,
    end_at_multiple_of_revolution: bool = True,
) -> MasterPlan:
    """From rest at ``start_position`` (rad) up to ``cruise_speed`` (rad/s, either sign), at least ``cycles``
    revolutions at it, and down to rest; all within the limits (rad/s^2, rad/s^3).

    The cruise is made longer so that the run ends at a whole multiple of 2 pi, unless told otherwise. Raises
    MotionError.
    """
    _check_limits(acceleration_limit, jerk_limit)
    if not finite(start_position, cruise_speed, cycles):
        raise MotionError("the master's start position, speed and number of cycles must be finite")
    if cruise_speed == 0.0:
        raise MotionError("the master's cruise speed is 0 rad/s, but must be positive or negative")
    if cycles < 0:
        raise MotionError(f"the number of cycles is {cycles:g}, but must be 0 or more")
    up, up_end_s, up_end = _ramp(0.0, start_position, 0.0, 0.0, cruise_speed, acceleration_limit, jerk_limit)
    _, _, down_distance = _ramp(0.0, 0.0, cruise_speed, 0.0, 0.0, acceleration_limit, jerk_limit)
    direction = copysign(1.0, cruise_speed)
    end = up_end + direction * cycles * tau + down_distance
    if end_at_multiple_of_revolution:
        end = direction * ceil(direction * end / tau - _REVOLUTION_TOLERANCE) * tau
    cruise_s = max((end - down_distance - up_end) / cruise_speed, 0.0)
    cruise_end_s = up_end_s + cruise_s
    down_start = end - down_distance
    down, duration_s, _ = _ramp(cruise_end_s, down_start, cruise_speed, 0.0, 0.0, acceleration_limit, jerk_limit)
    pieces = [*up, _Piece(up_end_s, up_end, cruise_speed, 0.0, 0.0), *down]
    return _plan(pieces, duration_s, up_end_s, cruise_end_s, cruise_speed, end)


def plan_stop(
    position: float, velocity: float, acceleration: float, acceleration_limit: float, jerk_limit: float
) -> MasterPlan:
    """A controlled stop from any state (rad, rad/s, rad/s^2) within the limits (rad/s^2, rad/s^3).

    An acceleration beyond its limit is first brought back to it at the jerk limit. Raises MotionError.
    """
    _check_limits(acceleration_limit, jerk_limit)
    if not finite(position, velocity, acceleration):
        raise MotionError("the master's position, velocity and acceleration must be finite")
    pieces, duration_s, end = _ramp(0.0, position, velocity, acceleration, 0.0, acceleration_limit, jerk_limit)
    return _plan(pieces, duration_s, 0.0, 0.0, 0.0, end)


def plan_change(
    position: float,
    velocity: float,
    acceleration: float,
    speed: float,
    end: float,
    acceleration_limit: float,
    jerk_limit: float,
) -> MasterPlan:
    """From any state (rad, rad/s, rad/s^2) to another speed (rad/s, positive), on at it, and down to rest at ``end``.

    Where ``end`` is too near to stop at, the plan ends so many whole revolutions later. Raises MotionError.
    """
    _check_limits(acceleration_limit, jerk_limit)
    if not (finite(position, velocity, acceleration, speed, end) and speed > 0.0):
        raise MotionError(f"the master cannot go on at {speed:g} rad/s: the speed must be positive and finite")
    limits = acceleration_limit, jerk_limit
    up, up_end_s, up_end = _ramp(0.0, position, velocity, acceleration, speed, *limits)
    _, _, down_distance = _ramp(0.0, 0.0, speed, 0.0, 0.0, *limits)
    end += max(ceil((up_end + down_distance - end) / tau - _REVOLUTION_TOLERANCE), 0) * tau
    cruise_end_s = up_end_s + max((end - down_distance - up_end) / speed, 0.0)
    down, duration_s, _ = _ramp(cruise_end_s, end - down_distance, speed, 0.0, 0.0, *limits)
    pieces = [*up, _Piece(up_end_s, up_end, speed, 0.0, 0.0), *down]
    return _plan(pieces, duration_s, up_end_s, cruise_end_s, speed, end)


def plan_jog(
    position: float, velocity: float, acceleration: float, speed: float, acceleration_limit: float, jerk_limit: float
) -> MasterPlan:
    """From any state (rad, rad/s, rad/s^2) to a speed (rad/s, either sign), and on at it without end.

    Raises MotionError.
    """
    _check_limits(acceleration_limit, jerk_limit)
    if not finite(position, velocity, acceleration, speed):
        raise MotionError("the master's position, velocity, acceleration and speed must be finite")
    up, up_end_s, up_end = _ramp(0.0, position, velocity, acceleration, speed, acceleration_limit, jerk_limit)
    return _plan([*up, _Piece(up_end_s, up_end, speed, 0.0, 0.0)], inf, up_end_s, inf, speed, up_end)
