"""From rest to rest in one piece: s(u) = 10 u^3 - 15 u^4 + 6 u^5 for u from 0 to 1, without a step in acceleration."""


def smooth(u: float) -> tuple[float, float]:
    """s and its derivative, for u held within 0 to 1."""
    if u <= 0.0:
        return 0.0, 0.0
    if u >= 1.0:
        return 1.0, 0.0
    return u * u * u * (10.0 - u * (15.0 - 6.0 * u)), 30.0 * u * u * (1.0 - u) ** 2


def bend_of_smooth(u: float) -> float:
    """The second derivative of s, for u within 0 to 1."""
    return 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u)


def peaks_of_smooth(length: float, duration_s: float) -> tuple[float, float, float]:
    """Greatest velocity, acceleration and jerk of a way of this length (0 or more) that takes so long.

    Of s the greatest first, second and third derivatives are 1.875, 5.774 and 60.
    """
    return 1.875 * length / duration_s, 5.774 * length / duration_s**2, 60.0 * length / duration_s**3


def shortest_smooth_s(length: float, velocity: float, acceleration: float, jerk: float) -> float:
    """The time that a way of this length takes if it is to keep these limits: `peaks_of_smooth` the other way round."""
    return max(1.875 * length / velocity, (5.774 * length / acceleration) ** 0.5, (60.0 * length / jerk) ** (1.0 / 3.0))
