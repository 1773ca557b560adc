"""The switches on an axis, and the index pulse of its encoder: what homing looks for, and 60FDh shows."""

from dataclasses import dataclass
from enum import IntFlag
from math import inf


class DigitalInput(IntFlag):
    """Bits of the digital inputs 60FDh."""

    NEGATIVE_LIMIT = 1 << 0
    POSITIVE_LIMIT = 1 << 1
    HOME = 1 << 2


@dataclass(frozen=True, slots=True)
class Switches:
    """Positions in shaft counts: those of the plant's angle, which do not depend on homing.

    The negative limit switch is on at and below its position, the positive one at and above; the home switch from its
    first position to its last, both included, either of which may be infinite. An infinite limit or None is a switch
    that is not fitted. The index pulse comes once a revolution.

    Raises ValueError if positions are in the wrong order.
    """

    negative_limit: float = -inf
    positive_limit: float = inf
    home: tuple[float, float] | None = None
    index: int = 0

    def __post_init__(self) -> None:
        if not self.negative_limit < self.positive_limit:
            raise ValueError(
                f"negative_limit = {self.negative_limit!r} must be below positive_limit = {self.positive_limit!r}"
            )
        if self.home is not None and not self.home[0] <= self.home[1]:
            raise ValueError(f"home = {self.home!r}, must not be reversed")

    @property
    def fitted(self) -> DigitalInput:
        """The switches that there are."""
        fitted = DigitalInput(0)
        if self.negative_limit > -inf:
            fitted |= DigitalInput.NEGATIVE_LIMIT
        if self.positive_limit < inf:
            fitted |= DigitalInput.POSITIVE_LIMIT
        if self.home is not None:
            fitted |= DigitalInput.HOME
        return fitted

    def inputs(self, counts: int) -> int:
        """Which DigitalInput are on with the shaft at ``counts``."""
        bits = 0
        if counts <= self.negative_limit:
            bits = 1
        if counts >= self.positive_limit:
            bits |= 2
        if self.home is not None and self.home[0] <= counts <= self.home[1]:
            bits |= 4
        return bits

    def edge(self, switch: DigitalInput, before: int, after: int) -> int:
        """The count at which ``switch`` changed on the way between two counts at which it differs.

        It is the first count in the new state, as a capture input would have latched it.
        """
        was = self.inputs(before) & switch
        while abs(after - before) > 1:
            middle = (before + after) // 2
            if self.inputs(middle) & switch == was:
                before = middle
            else:
                after = middle
        return after

    def next_index(self, counts: int, direction: int, counts_per_revolution: int) -> int:
        """The first index pulse at ``counts`` or beyond in ``direction`` (1 or -1)."""
        beyond = (counts - self.index) * direction
        return self.index - direction * (-beyond // counts_per_revolution) * counts_per_revolution
