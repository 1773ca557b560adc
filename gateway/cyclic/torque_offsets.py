"""Torque offsets (60B2h): what the model of the machine and what has been learned say that the motion will take.

A demand asks once a cycle, with the master's position, velocity and acceleration at the instant of the target that it
sends. The torque sent with that target acts at another instant; see ``torque_lead_s``.
"""

from collections.abc import Sequence
from math import copysign, degrees, tau
from typing import Final

import numpy as np

from config.conversion import (
    closure_at_home,
    drive_damping,
    nominal_parameters,
    torque_delay_s,
    torque_offset_limit,
)
from config.schema import GatewayConfig
from gateway.cyclic.feed_forward import FeedForward
from gateway.errors import GatewayError
from gateway.learning.law import LearnedTorque, Learning
from gateway.units import INT16_MAX, AxisUnits
from mechanism.cam_profile import CamProfile
from mechanism.slave_law import SlaveLaw

TORQUE_GRID: Final = 1024


def torque_lead_s(cycle_s: float, torque_delay_s: float) -> float:
    """How much later than its target the torque sent with it acts, seconds.

    A target is reached one cycle after the SYNC that applies it; the torque begins to act at that SYNC, is held for a
    cycle (on average: half of it), and takes ``torque_delay_s`` more for the drive's sampling and its amplifier.
    """
    return torque_delay_s - 0.5 * cycle_s


class TorqueOffsets:
    """The torque offsets of both axes in per mille of rated torque, model and learning together, bounded."""

    __slots__ = ("_feed_forward", "_lead_s", "_learning", "_limits", "_rad_per_count", "_units")

    def __init__(
        self,
        units: tuple[AxisUnits, AxisUnits],
        limits_Nm: tuple[float, float],
        lead_s: float,
        feed_forward: FeedForward | None = None,
        learning: Learning | None = None,
    ) -> None:
        """``limits_Nm`` bounds either axis' offset, both ways; ``lead_s``: see ``torque_lead_s``."""
        self._units = units
        limit2, limit5 = (
            min(limit, INT16_MAX * unit.rated_torque / 1000.0) for unit, limit in zip(units, limits_Nm, strict=True)
        )
        self._limits = limit2, limit5
        self._rad_per_count = tuple(tau / unit.counts_per_revolution for unit in units)
        self._lead_s = lead_s
        self._feed_forward = feed_forward
        self._learning = learning

    @property
    def is_learning(self) -> bool:
        """Whether anything is made of what ``observe`` is shown."""
        return self._learning is not None

    @property
    def learned(self) -> LearnedTorque | None:
        """What has been learned until now, a copy; None if nothing has."""
        return None if self._learning is None else self._learning.learned

    def at(self, position: float, velocity: float, acceleration: float, law: SlaveLaw, share: float = 1.0) -> list[int]:
        """Offsets to be sent with the target of this state of the master (rad, rad/s, rad/s^2), times ``share``.

        ``law`` is where the slave is. The model holds on a shifted cam, what has been learned does not. A parked slave
        is told no torque: its target stands, and a resolver that dies then shows by the load alone, which its
        controller holds.
        """
        lead = self._lead_s
        position += lead * (velocity + 0.5 * lead * acceleration)
        velocity += lead * acceleration
        master = slave = 0.0
        model = self._feed_forward
        if model is not None and law.is_plain:
            master, slave = model.torques(position, velocity, acceleration)
        elif model is not None:
            theta5, omega5, alpha5 = law.motion(position, velocity, acceleration, lead)
            torques = model.torques_of_motion(position, theta5, velocity, omega5, acceleration, alpha5)
            engaged = law.engaged_share(position)
            master, slave = engaged * torques[0], engaged * torques[1]
        if self._learning is not None:
            learned = self._learning.torques(position, velocity)
            plainness = law.plainness(position)
            master += plainness * learned[0]
            slave += plainness * learned[1]
        limit2, limit5 = self._limits
        if not -limit2 <= master <= limit2:
            master = copysign(limit2, master)
        if not -limit5 <= slave <= limit5:
            slave = copysign(limit5, slave)
        units = self._units
        return [units[0].permille(share * master), units[1].permille(share * slave)]

    def observe(self, master_position: float, master_velocity: float, errors: Sequence[int], is_steady: bool) -> None:
        """Learn from the following errors of a cycle; see `gateway.cyclic.listeners.ErrorObserver`."""
        if self._learning is not None:
            master, slave = self._rad_per_count
            self._learning.observe(master_position, master_velocity, is_steady, master * errors[0], slave * errors[1])


def build_torque_offsets(
    config: GatewayConfig, profile: CamProfile, units: tuple[AxisUnits, AxisUnits], learning: Learning | None = None
) -> TorqueOffsets | None:
    """The torque offsets that a configuration asks for on this cam; None if it asks for none.

    Raises mechanism.errors.MechanismError for a curve that cannot be read.
    """
    if not config.feed_forward.enabled and learning is None:
        return None
    master, slave = config.axis_names
    return TorqueOffsets(
        units,
        (torque_offset_limit(config, master), torque_offset_limit(config, slave)),
        torque_lead_s(config.cycle_s, torque_delay_s(config)),
        build_feed_forward(config, profile) if config.feed_forward.enabled else None,
        learning,
    )


def build_feed_forward(config: GatewayConfig, profile: CamProfile) -> FeedForward:
    """The model of the configuration's machine along this cam; see ``build_torque_offsets``."""
    master, slave = config.axis_names
    return FeedForward(
        nominal_parameters(config),
        closure_at_home(config),
        profile,
        config.feed_forward.coulomb_velocity_rad_per_s,
        (drive_damping(config, master), drive_damping(config, slave)),
    )


def torque_violations(config: GatewayConfig, profile: CamProfile) -> list[GatewayError]:
    """A sentence for each axis whose feed-forward needs more torque at the cam's full speed than its bound allows."""
    if not config.feed_forward.enabled:
        return []
    model = build_feed_forward(config, profile)
    theta2 = np.arange(TORQUE_GRID) * (tau / TORQUE_GRID)
    torques = np.abs([model.torques(position, config.speed_rad_per_s, 0.0) for position in theta2.tolist()])
    violations: list[GatewayError] = []
    for axis, name in enumerate(config.axis_names):
        worst = int(np.argmax(torques[:, axis]))
        needed, bound = float(torques[worst, axis]), torque_offset_limit(config, name)
        if needed > bound:
            violations.append(
                GatewayError(
                    f"feed_forward: axis {name} needs {needed:.3f} Nm at theta2 = {degrees(theta2[worst]):.1f} deg at "
                    f"{config.motion.speed_rpm:g} rpm (bound {bound:g} Nm)"
                )
            )
    return violations
