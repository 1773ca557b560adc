"""The motion profile of profile modes: trapezoids of velocity, or ramps of limited jerk, as 6086h chooses."""

from enum import IntEnum, unique
from math import copysign, inf

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.device import jerk_profiles, profiles
from sim_drive.device.demand import Piece
from sim_drive.device.motion import Motion


@unique
class ProfileType(IntEnum):
    """Motion profile types 6086h that the drive has; 1 and 2 of CiA 402-2 (sine square, jerk-free) it has not."""

    TRAPEZOID = 0
    """Linear ramps of velocity."""
    JERK_LIMITED = 3
    """Within the profile jerk 60A4h:01."""


class MotionProfile:
    """Plans from where the demand of an axis is now. Ramps of stops (halt, quick stop, limits) are linear always."""

    __slots__ = ("_jerk", "_motion", "_type")

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._type = motion.entry(objects.MOTION_PROFILE_TYPE)
        self._type.on_write = _check_type
        self._jerk = motion.entry(objects.PROFILE_JERK, 1)

    def to_velocity(self, target: float, now_ns: int) -> list[Piece]:
        """To ``target`` (counts/s) with 6083h and 6084h, and on with that."""
        motion = self._motion
        velocity = motion.demand.velocity_at(now_ns)
        limits = motion.acceleration, motion.deceleration
        if self._type.value == ProfileType.JERK_LIMITED:
            jerk = motion.rate_of(self._jerk.value)
            start = motion.demand.acceleration_at(now_ns)
            planned = jerk_profiles.to_velocity(velocity, start, target, *limits, jerk)
            if planned is not None:
                return planned
        return profiles.to_velocity(velocity, target, *limits)

    def to_position(
        self, distance: float, cruise: float, limits: tuple[float, float], end: float, now_ns: int
    ) -> list[Piece]:
        """To ``distance`` (counts) from here at up to ``cruise``, within ``limits`` of acceleration and deceleration.

        It comes to rest there; with an ``end`` velocity (counts/s, not negative) it passes there with that, and goes on
        with it.
        """
        motion = self._motion
        velocity = motion.demand.velocity_at(now_ns)
        if self._type.value == ProfileType.JERK_LIMITED and cruise > 0.0:
            jerk = motion.rate_of(self._jerk.value)
            start = motion.demand.acceleration_at(now_ns)
            final = copysign(end, distance) if end else 0.0
            planned = jerk_profiles.to_position(distance, velocity, start, cruise, *limits, jerk, final)
            if planned is not None:
                return [*planned, Piece(0.0, inf)] if end else planned
        if end:
            return profiles.through_position(distance, velocity, cruise, *limits, end)
        return profiles.to_position(distance, velocity, cruise, *limits)


def _check_type(value: int, now_ns: int) -> AbortCode | None:
    return None if value in {int(kind) for kind in ProfileType} else AbortCode.VALUE_RANGE_EXCEEDED
