"""How far the linkage is from its cam, and the end effector from where the cam has it."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.cyclic.guard import Condition, Guard
from gateway.record.sample import INT32_MAX
from mechanism.deviation import end_effector_miss
from mechanism.slave_law import SlaveLaw

MICROMETRES: Final = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class CamWindow:
    """The linkage as `mechanism.deviation` takes it, where its slave is to be, and how far it may be from there."""

    geometry: NDArray[np.float64]
    closure: int
    law: SlaveLaw
    rad_per_count: tuple[float, float]
    """Master, slave."""
    window_rad: float
    end_effector_m: float
    harmless_counts: tuple[int, int]
    """Errors of master and slave on the cam itself that cannot exceed either limit: see ``harmless_error`` there."""

    def __post_init__(self) -> None:
        # The first call loads the machine code, which must not happen within a cycle.
        end_effector_miss(self.geometry, self.closure, 0.0, 0.0, 0.0, 0.0)

    def check(self, guard: Guard, master_error: int, slave_error: int, master_position: float, now_ns: int) -> None:
        """One cycle's following errors (counts), with the master demanded at ``master_position`` (rad)."""
        law = self.law
        master_scale, slave_scale = self.rad_per_count
        error2, error5 = master_error * master_scale, slave_error * slave_scale
        theta5 = law.at(master_position)[0]
        miss = end_effector_miss(self.geometry, self.closure, master_position, theta5, error2, error5)
        window = theta5 - error5 - law.at(master_position - error2)[0]
        if not -self.window_rad <= window <= self.window_rad:
            guard.hold(
                Condition.CAM_WINDOW, 0, _counts(window, slave_scale), _counts(self.window_rad, slave_scale), now_ns
            )
        elif not guard.is_quiet:
            guard.clear(Condition.CAM_WINDOW, 0)
        if not miss <= self.end_effector_m:
            guard.hold(
                Condition.END_EFFECTOR_ERROR,
                0,
                _counts(miss, 1.0 / MICROMETRES),
                _counts(self.end_effector_m, 1.0 / MICROMETRES),
                now_ns,
            )
        elif not guard.is_quiet:
            guard.clear(Condition.END_EFFECTOR_ERROR, 0)


def _counts(value: float, unit: float) -> int:
    """``value`` in units, as an integer that any event can carry; a linkage that does not close is infinitely far."""
    return min(round(abs(value) / unit), INT32_MAX) if value == value else INT32_MAX
