"""The guard table of a configuration: every condition with its limit, its persistence and its reaction."""

from enum import Enum
from typing import Annotated, Self

from pydantic import Field, model_validator

from config.model import Model

COUNT_RESOLUTION = 2
"""Counts within which a position is not known: a limit below that trips by itself."""
_MAX_INTEGER16 = 32767
_LONGEST_PERSISTENCE_S = 10.0
"""Whatever has held for so long without a reaction is never going to be stopped in time."""
_MAX_VELOCITY_PERCENT = 1000.0
FRICTION_SLACK = 2.2
"""An axis that stands is held against twice its dry friction: from all of it one way to all of it the other way."""

Persistence = Annotated[int, Field(ge=1, le=100_000)]
ErrorCode = Annotated[int, Field(ge=1, le=0xFFFF)]


class Reaction(Enum):
    """What the gateway does when a guarded condition holds."""

    WARN = "warn"
    """Tell it, and go on."""
    CONTROLLED_STOP = "controlled_stop"
    """The master ramps down with limited jerk, the slave stays on the cam."""
    QUICK_STOP = "quick_stop"
    """The master by its drive's quick stop, the slave on the cam of where the master is, until both stand."""
    DISABLE = "disable"
    """The axis that it is about loses its torque at once, the other one stops as in a quick stop."""


class ConditionSection(Model):
    """A guarded condition: how many cycles in a row it must hold, and what is then done."""

    persistence_cycles: Persistence = 1
    reaction: Reaction


class AngleCondition(ConditionSection):
    """A condition whose limit is an angle of the slave's link, or of any link."""

    limit_deg: Annotated[float, Field(gt=0.0)]


class PercentCondition(ConditionSection):
    """A condition whose limit is a share of the axis' own limit."""

    limit_percent: float

    @model_validator(mode="after")
    def _is_between(self) -> Self:
        if self.limit_percent <= 100.0:
            raise ValueError(
                f"limit_percent: {self.limit_percent:g} would trip in motions that the axis' limits allow "
                "(bound: above 100)"
            )
        if self.limit_percent > _MAX_VELOCITY_PERCENT:
            raise ValueError(
                f"limit_percent: {self.limit_percent:g} can never trip, no axis turns at ten times its limit "
                f"(bound {_MAX_VELOCITY_PERCENT:g})"
            )
        return self


class TorqueCondition(ConditionSection):
    """A condition whose limit is a torque, in per mille of the axis' rated torque."""

    limit_permille: Annotated[int, Field(ge=1)]

    @model_validator(mode="after")
    def _can_be_told(self) -> Self:
        if self.limit_permille >= _MAX_INTEGER16:
            raise ValueError(
                f"limit_permille: {self.limit_permille} can never trip, 6077h tells no more than {_MAX_INTEGER16}"
            )
        return self


class PushCondition(TorqueCondition):
    """A torque that nothing comes of."""

    def lasting_permille(self, friction_permille: int) -> int:
        """What is as bad if it lasts: half the limit, but more than dry friction, either way, holds an axis against."""
        return min(max(self.limit_permille // 2, round(FRICTION_SLACK * friction_permille)), self.limit_permille)


class LengthCondition(ConditionSection):
    """A condition whose limit is a distance of the end effector."""

    limit_mm: Annotated[float, Field(gt=0.0)]


class EventCondition(Model):
    """A condition that is an event: it has happened, and does not hold from cycle to cycle."""

    reaction: Reaction


class CyclesCondition(EventCondition):
    """An event that is one from so many cycles on."""

    limit_cycles: Annotated[int, Field(ge=1)]


class CodesCondition(EventCondition):
    """An event of some emergency error codes alone."""

    codes: frozenset[ErrorCode]


class StopSection(Model):
    """How somebody's wish for a stop is carried out."""

    reaction: Reaction = Reaction.CONTROLLED_STOP

    @model_validator(mode="after")
    def _stops(self) -> Self:
        if self.reaction is Reaction.WARN:
            raise ValueError("reaction: warn would leave the machine running when somebody asks for a stop")
        return self


_WARN, _CONTROLLED, _QUICK, _DISABLE = Reaction


_OF_THE_BUS = frozenset({"missed_tpdo", "axis_silent", "missed_deadline", "bus_off"})
"""Conditions for which the drives, or the gateway, have a time-out of their own."""


class GuardSection(Model):
    """Every condition that the cycle watches, each with one reaction."""

    following_error: ConditionSection = ConditionSection(reaction=_QUICK)
    """The demand less the actual value of an axis; its limit is ``axes.*.limits.following_error_counts``."""
    cam_window: AngleCondition = AngleCondition(limit_deg=20.0, reaction=_QUICK)
    """The slave's distance from the cam of the master's actual position."""
    velocity: PercentCondition = PercentCondition(limit_percent=130.0, persistence_cycles=5, reaction=_QUICK)
    """An axis' velocity against ``axes.*.limits.velocity_rad_per_s``."""
    torque: TorqueCondition = TorqueCondition(limit_permille=2500, persistence_cycles=100, reaction=_CONTROLLED)
    """The torque actual value, either way."""
    end_effector_error: LengthCondition = LengthCondition(limit_mm=50.0, persistence_cycles=5, reaction=_QUICK)
    """Distance of the end effector from where the demand has it."""
    frozen_actual: AngleCondition = AngleCondition(limit_deg=1.0, persistence_cycles=3, reaction=_DISABLE)
    """The demand has gone so far away from the actual value while that has not changed by a single count."""
    unanswered_torque: PushCondition = PushCondition(limit_permille=250, persistence_cycles=8, reaction=_DISABLE)
    """The torque actual value has changed so far, or for 80 cycles half as far, with the torque offset and without,
    while the actual value has not changed by a single count: a blocked axis, or a dead resolver. Without torque offsets
    it must be more than what one axis in motion puts on another that stands."""
    missed_tpdo: ConditionSection = ConditionSection(persistence_cycles=5, reaction=_CONTROLLED)
    axis_silent: ConditionSection = ConditionSection(persistence_cycles=5, reaction=_QUICK)
    """An axis' TPDO is missing while another axis' have come: it is that drive, not the bus or the host."""
    missed_deadline: ConditionSection = ConditionSection(persistence_cycles=20, reaction=_CONTROLLED)
    emergency: EventCondition = EventCondition(reaction=_QUICK)
    emergency_warning: CodesCondition = CodesCondition(codes=frozenset({0x8110, 0x8120}), reaction=_WARN)
    """EMCY codes that are none of an axis' own faults: overrun and error passive of its CAN controller."""
    drive_fault: ConditionSection = ConditionSection(reaction=_QUICK)
    """The statusword is not that of Operation enabled."""
    heartbeat_lost: EventCondition = EventCondition(reaction=_QUICK)
    bus_off: ConditionSection = ConditionSection(persistence_cycles=20, reaction=_QUICK)
    """No drive is heard at all for so long, or, at once, the gateway's own controller has left the bus."""
    sync_lost: CyclesCondition = CyclesCondition(limit_cycles=5, reaction=_QUICK)
    """So many SYNCs in a row have not been sent, as after a host that was away: the drives stand meanwhile."""
    operator_stop: StopSection = StopSection()
    sigint: StopSection = StopSection()
    """The first SIGINT; a second one is a quick stop in any case."""
    sigterm: StopSection = StopSection()

    def check_cycle(self, cycle_us: int, heartbeat_timeout_ms: int) -> None:
        """Raise ValueError for a limit that the bus settings make pointless."""
        gap_ms = self.sync_lost.limit_cycles * cycle_us / 1000.0
        if gap_ms >= heartbeat_timeout_ms:
            raise ValueError(
                f"guard.sync_lost.limit_cycles: {self.sync_lost.limit_cycles} can never trip in time, after "
                f"{gap_ms:g} ms the drives have missed the gateway's heartbeat (bound {heartbeat_timeout_ms} ms)"
            )
        for key in type(self).model_fields:
            condition = getattr(self, key)
            if not isinstance(condition, ConditionSection):
                continue
            span_ms = condition.persistence_cycles * cycle_us / 1000.0
            if key in _OF_THE_BUS and span_ms >= heartbeat_timeout_ms:
                raise ValueError(
                    f"guard.{key}.persistence_cycles: {condition.persistence_cycles} can never trip in time, after "
                    f"{span_ms:g} ms the heartbeats are missed (bound: below {heartbeat_timeout_ms} ms)"
                )
            if span_ms > 1000.0 * _LONGEST_PERSISTENCE_S:
                raise ValueError(
                    f"guard.{key}.persistence_cycles: {condition.persistence_cycles} can never trip in time, they are "
                    f"{span_ms / 1000.0:g} s (bound {_LONGEST_PERSISTENCE_S:g} s)"
                )

    def check_axis(self, name: str, counts_per_revolution: int, drive_counts: int, gateway_counts: int) -> None:
        """Raise ValueError for an axis' limit that can never trip, or always trips.

        ``drive_counts`` and ``gateway_counts``: following errors at which the drive and the gateway react.
        """
        half = counts_per_revolution // 2
        if drive_counts >= half:
            raise ValueError(
                f"axes.{name}.limits.following_error_counts: {drive_counts} can never trip, half a "
                f"revolution away from its demand the linkage is torn (bound: below {half})"
            )
        if gateway_counts < COUNT_RESOLUTION:
            raise ValueError(
                f"axes.{name}.limits: a following error of {gateway_counts} counts would always trip, a position is "
                f"not known better than to {COUNT_RESOLUTION} (bound {COUNT_RESOLUTION})"
            )
        for key, condition in (("cam_window", self.cam_window), ("frozen_actual", self.frozen_actual)):
            counts = condition.limit_deg / 360.0 * counts_per_revolution
            if counts < COUNT_RESOLUTION:
                raise ValueError(
                    f"guard.{key}.limit_deg: {condition.limit_deg:g} would always trip, it is less than "
                    f"{COUNT_RESOLUTION} counts of axis {name} "
                    f"(bound {COUNT_RESOLUTION * 360.0 / counts_per_revolution:.2g})"
                )
        if self.cam_window.limit_deg >= 180.0:
            raise ValueError(
                f"guard.cam_window.limit_deg: {self.cam_window.limit_deg:g} can never trip, no angle is farther from "
                "another (bound: below 180)"
            )
        travel = self.frozen_actual.limit_deg / 360.0 * counts_per_revolution
        if travel >= drive_counts:
            raise ValueError(
                f"guard.frozen_actual.limit_deg: {self.frozen_actual.limit_deg:g} can never trip, the following error "
                f"of axis {name} does so first (bound {drive_counts * 360.0 / counts_per_revolution:.3g})"
            )

    def check_end_effector(self, reach_mm: float, counts_per_revolution: int) -> None:
        """Raise ValueError for a limit that is beyond the linkage (``reach_mm``: farthest the point gets), or within
        what the resolvers cannot tell apart."""
        limit = self.end_effector_error.limit_mm
        least = COUNT_RESOLUTION * 6.3 * reach_mm / counts_per_revolution
        if limit >= 2.0 * reach_mm:
            raise ValueError(
                f"guard.end_effector_error.limit_mm: {limit:g} can never trip, the linkage reaches {reach_mm:g} mm "
                f"(bound: below {2.0 * reach_mm:g})"
            )
        if limit < least:
            raise ValueError(
                f"guard.end_effector_error.limit_mm: {limit:g} would always trip, the resolvers tell the end effector "
                f"to {least:.2g} mm"
            )
