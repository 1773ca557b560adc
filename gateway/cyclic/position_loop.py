"""The position loop of one axis, closed by the gateway: its drive gets torques (cst) in place of positions (csp)."""

from math import copysign, tau

from gateway.units import HALF_RANGE, INT16_MAX, RANGE_MASK, AxisUnits


class PositionLoop:
    """Eq. (5) of the paper with K_V = K_F, in SI units, once a cycle.

    torque = proportional x error + integrating x sum of the error + derivative x (demand velocity - actual velocity),
    the actual velocity being a difference over one cycle. The sum goes on only while the torque is within its limit, or
    while the error leads it back.
    """

    __slots__ = (
        "_actual",
        "_derivative",
        "_integrating",
        "_is_fresh",
        "_limit_Nm",
        "_period_s",
        "_permille",
        "_proportional",
        "_rad_per_count",
        "_sum",
        "_units",
    )

    def __init__(
        self,
        units: AxisUnits,
        period_s: float,
        proportional_Nm_per_rad: float,
        integrating_Nm_per_rad_s: float,
        derivative_Nms_per_rad: float,
        limit_Nm: float,
    ) -> None:
        """``limit_Nm`` bounds the torque either way, feed-forward included."""
        self._units = units
        self._period_s = period_s
        self._rad_per_count = tau / units.counts_per_revolution
        self._proportional = proportional_Nm_per_rad
        self._integrating = integrating_Nm_per_rad_s
        self._derivative = derivative_Nms_per_rad
        self._limit_Nm = min(limit_Nm, INT16_MAX * units.rated_torque / 1000.0)
        self._actual = 0
        self._is_fresh = False
        self._sum: float = 0.0
        self._permille = 0

    def reset(self) -> int:
        """The drive gives no torque: forget the past; returns no torque."""
        self._is_fresh = False
        self._sum = 0.0
        self._permille = 0
        return 0

    def hold(self) -> int:
        """Nothing is known of this cycle: the torque that was sent last, in per mille of rated torque."""
        self._is_fresh = False
        return self._permille

    def update(self, target: int, actual: int, demand_velocity: float, offset_permille: int) -> int:
        """Torque for the coming cycle in per mille of rated torque.

        ``target`` and ``actual`` are the counts of one SYNC, ``demand_velocity`` is the demand's at it in rad/s, and
        ``offset_permille`` is the feed-forward that goes with the torque.
        """
        error = ((target - actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE) * self._rad_per_count
        velocity = demand_velocity
        if self._is_fresh:
            moved = (actual - self._actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE
            velocity = moved * self._rad_per_count / self._period_s
        self._actual = actual
        self._is_fresh = True
        error_sum = self._sum + error * self._period_s
        torque = (
            self._proportional * error
            + self._integrating * error_sum
            + self._derivative * (demand_velocity - velocity)
            + offset_permille * self._units.rated_torque / 1000.0
        )
        if -self._limit_Nm < torque < self._limit_Nm:
            self._sum = error_sum
        else:
            if error * torque < 0.0:
                self._sum = error_sum
            torque = copysign(self._limit_Nm, torque)
        self._permille = self._units.permille(torque)
        return self._permille
