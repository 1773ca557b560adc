"""One axis as the cycle sees it."""

import math
from dataclasses import dataclass
from typing import Final

from drivers.cia402 import COMMAND_DISABLE_VOLTAGE
from drivers.pdo import RPDO_BASE, TPDO_BASE
from gateway.cyclic.position_loop import PositionLoop
from gateway.record.sample import INT32_MAX
from gateway.units import AxisUnits

LEAP_GAP_CYCLES: Final = 2
"""A leap is told over so many missed TPDOs; an axis that was told nothing for longer may have gone as far."""

RARE_CYCLES: Final = 6
"""Whose TPDO has been missing within so many cycles may miss SYNCs, and see the next ones as rarely."""


class AxisChannel:
    """What the cycle sends to a drive, and what came back last."""

    __slots__ = (
        "actual",
        "controlword",
        "following_error_limit",
        "leap_limit",
        "leapt",
        "name",
        "node_id",
        "position_loop",
        "rare_cycles",
        "rpdo_cob_id",
        "silent_cycles",
        "statusword",
        "target",
        "torque",
        "torque_offset",
        "tpdo_cob_id",
        "units",
    )

    def __init__(
        self,
        name: str,
        node_id: int,
        units: AxisUnits,
        following_error_limit: int,
        position_loop: PositionLoop | None = None,
    ) -> None:
        """``position_loop``: the gateway closes it and sends torques; None leaves it to the drive."""
        self.name = name
        self.node_id = node_id
        self.units = units
        self.following_error_limit = following_error_limit
        self.position_loop = position_loop
        self.rpdo_cob_id = RPDO_BASE[0] + node_id
        self.tpdo_cob_id = TPDO_BASE[0] + node_id
        self.controlword = COMMAND_DISABLE_VOLTAGE
        self.target = 0
        self.torque_offset = 0
        self.statusword = 0
        self.actual = 0
        self.torque = 0
        self.silent_cycles = 0
        """Cycles in a row that have been without its TPDO."""
        self.rare_cycles = 0
        """As many as are left of ``RARE_CYCLES``."""
        self.leap_limit = math.inf
        """Counts in a cycle, beyond those expected, that no axis goes: its resolver has leapt."""
        self.leapt = 0
        """Counts that the actual value shows too much, as far as its resolver has been seen to leap."""

    def sees_leap(self, moved: int, expected: float) -> bool:
        """Whether the resolver has leapt, and not the axis moved, where the actual value has changed by ``moved``.

        ``expected``: counts that the axis has gone in that time, as far as anybody can know. What is farther from that
        than ``leap_limit`` is a leap, and is kept in ``leapt``; what is nearer is taken for motion.
        """
        if abs(moved - expected) <= self.leap_limit:
            return False
        self.leapt += round(moved - expected)
        return True


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """What is guarded of one axis; the following error's limit is the channel's own."""

    velocity_counts_per_cycle: float
    torque_permille: int
    frozen_counts: int
    """Travel of the demand while the actual value stays the same."""
    unanswered_permille: int
    """Change of torque while the actual value stays the same."""
    pushed_permille: int
    """The same, if it lasts; see `answer.PUSHED_CYCLES`."""


NO_LIMITS: Final = AxisLimits(float("inf"), INT32_MAX, INT32_MAX, INT32_MAX, INT32_MAX)
