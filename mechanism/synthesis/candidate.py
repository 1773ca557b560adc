"""A mechanism that a search has found, with what the task says of it."""

from dataclasses import dataclass
from math import degrees

import numpy as np
from numpy.typing import NDArray

from mechanism.closure import ClosureTrack, track_closure
from mechanism.curve import DesiredCurve, read_only
from mechanism.errors import SynthesisError
from mechanism.five_bar import FiveBar
from mechanism.synthesis.objective import solved_timing
from mechanism.synthesis.task import SynthesisTask, Term

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """``variables`` (8,) in metres, ``terms`` (the task's terms, in their order and units) and the weighted sum."""

    task: SynthesisTask
    variables: Float
    terms: Float
    objective: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "variables", read_only(self.variables))
        object.__setattr__(self, "terms", read_only(self.terms))

    def value(self, term: Term) -> float | None:
        """The value of a term, None where the task does not have it."""
        column = self.task.column(term)
        return None if column is None else float(self.terms[column])

    def five_bar(self) -> FiveBar:
        """The mechanism."""
        return self.task.five_bar(self.variables)

    def curve(self) -> DesiredCurve:
        """The task's curve with its crank angles (solved for if free). Raises CurveError if they do not rise."""
        theta2 = solved_timing(self.task, self.variables)
        return DesiredCurve(theta2, self.task.x, self.task.y, self.task.source)

    def servo_motion(self) -> ClosureTrack:
        """The servo's motion over the cycle, and the structural error point by point. Raises CurveError as `curve`."""
        return track_closure(self.curve(), self.five_bar(), self.task.minimum_sine)

    def require_feasible(self) -> None:
        """Raise SynthesisError with the first term that shows the mechanism to be of no use."""
        for term, what in _FAULTS:
            value = self.value(term)
            if value is not None and value > 0.0:
                raise SynthesisError(
                    f"no feasible mechanism found within the bounds: the term {term.value} cannot be met "
                    f"({what.format(count=round(float(np.cbrt(value))), value=value)})",
                    term.value,
                )
        self._require_tolerances()

    def _require_tolerances(self) -> None:
        tolerances = self.task.tolerances
        if tolerances is None:
            return
        motion = self.servo_motion()
        beyond = motion.structural_error - tolerances
        worst = int(np.argmax(beyond))
        if beyond[worst] > _TOLERANCE_ROUNDING:
            raise SynthesisError(
                "no feasible mechanism found within the bounds: the term structural error cannot be met "
                f"(point {worst + 1}, theta2 = {degrees(float(motion.theta2[worst])):.2f} deg, is missed by "
                f"{motion.structural_error[worst] * 1e3:.3f} mm, tolerance {tolerances[worst] * 1e3:.3f} mm)",
                Term.STRUCTURAL_ERROR.value,
            )


_TOLERANCE_ROUNDING = 1e-9
_FAULTS = (
    (Term.TIMING, "theta2 does not rise over {count} of the steps"),
    (Term.MOBILITY, "links r and s cannot close in {count} positions at best"),
    (Term.SINGULARITY, "the linkage is singular in {count} positions at best"),
    (Term.KEEP_OUT, "{value:.3g} m of links lie in keep-out zones, summed over the positions"),
)
