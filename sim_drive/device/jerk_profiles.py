"""Plans of limited jerk (6086h = 3): pieces of constant jerk that lead to a velocity or a position, found by ruckig."""

from collections.abc import Iterator
from itertools import pairwise
from math import copysign, inf, sqrt
from typing import Any, Final, cast

import ruckig

from sim_drive.device.demand import Piece

# ruckig has no type information; what comes out of it is typed in _pieces.
_RUCKIG: Final = cast("Any", ruckig)
_SHORT_S: Final = 1e-9
_LENGTH: Final = 1000.0
"""Counts in the unit of length that ruckig is given: its thresholds are absolute, and made for numbers about 1."""


def to_velocity(
    velocity: float, acceleration: float, target: float, speeding_up: float, slowing_down: float, jerk: float
) -> list[Piece] | None:
    """From ``velocity`` and ``acceleration`` to ``target`` (counts/s), and on with that; None if there is no such plan.

    ``speeding_up`` and ``slowing_down`` limit the acceleration (counts/s^2), ``jerk`` its change (counts/s^3); of a
    change of direction the first counts throughout. All are positive.
    """
    limit = slowing_down if abs(target) < abs(velocity) and velocity * target >= 0.0 else speeding_up
    request = _request(velocity, acceleration, limit, limit, jerk)
    request.control_interface = _RUCKIG.ControlInterface.Velocity
    request.target_velocity = [target / _LENGTH]
    request.max_velocity = [max(abs(velocity), abs(target), 1.0) / _LENGTH]
    pieces = _solve(request)
    if pieces is not None and target != 0.0:
        pieces.append(Piece(0.0, inf))
    return pieces


def to_position(
    distance: float,
    velocity: float,
    acceleration: float,
    cruise: float,
    speeding_up: float,
    slowing_down: float,
    jerk: float,
    final: float = 0.0,
) -> list[Piece] | None:
    """From ``velocity`` and ``acceleration`` to ``distance`` (counts), not faster than ``cruise``; or None.

    It ends with the velocity ``final`` (counts/s), at rest by default. The limits are those of ``to_velocity``: the
    first of accelerations towards the target, the second of those against it.
    """
    direction = copysign(1.0, distance)
    forwards, backwards = (speeding_up, slowing_down) if direction > 0.0 else (slowing_down, speeding_up)
    request = _request(velocity, acceleration, forwards, backwards, jerk)
    request.target_position = [distance / _LENGTH]
    request.target_velocity = [final / _LENGTH]
    request.max_velocity = [cruise / _LENGTH]
    return _solve(request)


def _request(velocity: float, acceleration: float, forwards: float, backwards: float, jerk: float) -> Any:
    request = _RUCKIG.InputParameter(1)
    request.current_position = [0.0]
    request.current_velocity = [velocity / _LENGTH]
    request.current_acceleration = [acceleration / _LENGTH]
    request.max_acceleration = [forwards / _LENGTH]
    request.min_acceleration = [-backwards / _LENGTH]
    request.max_jerk = [jerk / _LENGTH]
    return request


def _solve(request: Any) -> list[Piece] | None:
    trajectory = _RUCKIG.Trajectory(1)
    try:
        result = _RUCKIG.Ruckig(1).calculate(request, trajectory)
    except _RUCKIG.RuckigError:
        return None
    if result not in (_RUCKIG.Result.Working, _RUCKIG.Result.Finished):
        return None
    acceleration, velocity = float(request.current_acceleration[0]), float(request.current_velocity[0])
    pieces: list[Piece] = []
    for duration_s, jerk in _steps(trajectory.profiles[0][0]):
        for part_s in _between_turns(velocity, acceleration, jerk, duration_s):
            pieces.append(Piece(acceleration * _LENGTH, part_s, jerk * _LENGTH))
            velocity += (acceleration + 0.5 * jerk * part_s) * part_s
            acceleration += jerk * part_s
    return pieces


def _steps(profile: Any) -> Iterator[tuple[float, float]]:
    if profile.brake.duration > 0.0:
        yield from zip(map(float, profile.brake.t), map(float, profile.brake.j), strict=True)
    yield from zip(map(float, profile.t), map(float, profile.j), strict=True)


def _between_turns(velocity: float, acceleration: float, jerk: float, duration_s: float) -> list[float]:
    """``duration_s`` in parts that end where the velocity is zero, so that a piece begins wherever motion turns."""
    turns: list[float] = []
    root = acceleration * acceleration - 2.0 * jerk * velocity
    if jerk != 0.0 and root >= 0.0:
        turns = sorted((-acceleration + sign * sqrt(root)) / jerk for sign in (-1.0, 1.0))
    elif jerk == 0.0 and acceleration != 0.0:
        turns = [-velocity / acceleration]
    edges = [0.0, *(turn for turn in turns if _SHORT_S < turn < duration_s - _SHORT_S), duration_s]
    return [after - before for before, after in pairwise(edges) if after > before]
