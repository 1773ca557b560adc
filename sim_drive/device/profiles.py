"""Plans of trapezoidal velocity (6086h = 0): pieces of constant acceleration that lead to a velocity or a position."""

from math import copysign, inf, sqrt

from sim_drive.device.demand import Piece


def to_velocity(velocity: float, target: float, acceleration: float, deceleration: float) -> list[Piece]:
    """From ``velocity`` to ``target`` (counts/s), and on with that; speeding up and slowing down have their own rates.

    A change of direction slows down to zero first. Both rates are positive, in counts/s^2.
    """
    pieces: list[Piece] = []
    if velocity * target < 0.0 or (target == 0.0 and velocity != 0.0):
        pieces.append(Piece(-copysign(deceleration, velocity), abs(velocity) / deceleration))
        velocity = 0.0
    if velocity != target:
        is_faster = abs(target) > abs(velocity)
        rate = acceleration if is_faster else deceleration
        pieces.append(Piece(copysign(rate, target - velocity), abs(target - velocity) / rate))
    if target != 0.0:
        pieces.append(Piece(0.0, inf))
    return pieces


def to_position(
    distance: float, velocity: float, cruise: float, acceleration: float, deceleration: float
) -> list[Piece]:
    """From ``velocity`` to rest at ``distance`` (counts) from here, not faster than ``cruise`` (counts/s, positive).

    Where the velocity is too great to stop in time, or leads away, it brakes to rest first, and returns.
    """
    pieces: list[Piece] = []
    braking = velocity * abs(velocity) / (2.0 * deceleration)
    direction = copysign(1.0, distance - braking)
    if velocity * direction < 0.0:
        pieces.append(Piece(direction * deceleration, abs(velocity) / deceleration))
        distance -= braking
        velocity = 0.0
    distance = abs(distance)
    speed = abs(velocity)
    if speed > cruise:
        pieces.append(Piece(-direction * deceleration, (speed - cruise) / deceleration))
        distance -= (speed * speed - cruise * cruise) / (2.0 * deceleration)
        speed = peak = cruise
    else:
        reach = distance + speed * speed / (2.0 * acceleration)
        peak = min(cruise, sqrt(2.0 * reach * acceleration * deceleration / (acceleration + deceleration)))
        peak = max(peak, speed)
        if peak > speed:
            pieces.append(Piece(direction * acceleration, (peak - speed) / acceleration))
            distance -= (peak * peak - speed * speed) / (2.0 * acceleration)
    distance -= peak * peak / (2.0 * deceleration)
    if distance > 0.0 and peak > 0.0:
        pieces.append(Piece(0.0, distance / peak))
    if peak > 0.0:
        pieces.append(Piece(-direction * deceleration, peak / deceleration))
    return pieces


def through_position(
    distance: float, velocity: float, cruise: float, acceleration: float, deceleration: float, end: float
) -> list[Piece]:
    """From ``velocity`` through ``distance`` (counts) with the speed ``end``, or what is nearest to it, and on with it.

    ``cruise`` and ``end`` are positive, in counts/s. Where the velocity leads away, it brakes to rest first.
    """
    pieces: list[Piece] = []
    direction = copysign(1.0, distance)
    if velocity * direction < 0.0:
        pieces.append(Piece(direction * deceleration, abs(velocity) / deceleration))
        distance -= velocity * abs(velocity) / (2.0 * deceleration)
        velocity = 0.0
    distance = abs(distance)
    speed = abs(velocity)
    squares = 2.0 * distance * acceleration * deceleration
    peak = sqrt((squares + speed * speed * deceleration + end * end * acceleration) / (acceleration + deceleration))
    if peak < end:
        # Too short to become as fast as that.
        peak = sqrt(speed * speed + 2.0 * acceleration * distance)
        end_there = peak
    elif peak < speed:
        # Too short to become as slow as that.
        peak = speed
        end_there = sqrt(max(speed * speed - 2.0 * deceleration * distance, 0.0))
    else:
        peak = max(min(peak, cruise), end)
        end_there = end
    if speed != peak:
        rate = acceleration if peak > speed else -deceleration
        pieces.append(Piece(direction * rate, (peak - speed) / rate))
        distance -= (peak * peak - speed * speed) / (2.0 * rate)
    distance -= (peak * peak - end_there * end_there) / (2.0 * deceleration)
    if distance > 0.0 and peak > 0.0:
        pieces.append(Piece(0.0, distance / peak))
    if peak > end_there:
        pieces.append(Piece(-direction * deceleration, (peak - end_there) / deceleration))
    pieces += to_velocity(direction * end_there, direction * end, acceleration, deceleration)
    return pieces
