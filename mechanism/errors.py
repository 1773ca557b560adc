"""Errors of the mechanism; each carries, in SI units, the values that explain it. Messages speak in mm, degrees and
rad/s.
"""

from enum import IntEnum, unique
from math import degrees, isfinite


class MechanismError(Exception):
    """Root of every error that ``mechanism`` raises."""


class ParameterError(MechanismError):
    """A parameter of the mechanism is impossible.

    Attributes: ``name`` (of the parameter), ``value`` and ``bound`` (what it has to satisfy, in words).
    """

    def __init__(self, name: str, value: object, bound: str) -> None:
        super().__init__(f"{name} is {value}, but must be {bound}")
        self.name = name
        self.value = value
        self.bound = bound


class UnreachableError(MechanismError):
    """The linkage cannot place its end effector where it is wanted.

    Attributes: ``point_index`` (None where no list of points was given), ``theta2_rad``, ``distance_m`` (by how much
    it is missed), ``bound_m`` and ``what`` (which condition is broken, in words).
    """

    def __init__(
        self, point_index: int | None, theta2_rad: float, distance_m: float, bound_m: float, what: str
    ) -> None:
        where = f"theta2 = {degrees(theta2_rad):.2f} deg"
        if point_index is not None:
            where = f"point {point_index} ({where})"
        super().__init__(f"{where} is out of reach by {distance_m * 1e3:.3f} mm (bound {bound_m * 1e3:.3f} mm): {what}")
        self.point_index = point_index
        self.theta2_rad = theta2_rad
        self.distance_m = distance_m
        self.bound_m = bound_m
        self.what = what


class SingularError(MechanismError):
    """The linkage comes too near a singular position.

    Attributes: ``theta2_rad``, ``sine`` (of the transmission angle there), ``bound`` and ``which`` (the angle, in
    words).
    """

    def __init__(self, theta2_rad: float, sine: float, bound: float, which: str) -> None:
        super().__init__(
            f"the linkage comes too near a singular position at theta2 = {degrees(theta2_rad):.2f} deg: "
            f"the sine of the angle between {which} is {sine:.4f}, bound {bound:.4f}"
        )
        self.theta2_rad = theta2_rad
        self.sine = sine
        self.bound = bound
        self.which = which


class CamLimitError(MechanismError):
    """A cam passes a limit of its axis.

    Attributes: ``what``, ``value``, ``limit`` (both in ``unit``) and ``theta2_rad`` (where).
    """

    def __init__(self, what: str, value: float, limit: float, unit: str, theta2_rad: float) -> None:
        super().__init__(
            f"the cam's {what} is {value:.6g} {unit} at theta2 = {degrees(theta2_rad):.2f} deg, "
            f"limit {limit:.6g} {unit}"
        )
        self.what = what
        self.value = value
        self.limit = limit
        self.unit = unit
        self.theta2_rad = theta2_rad


class CurveError(MechanismError):
    """A desired curve cannot be used.

    Attributes: ``reason`` and, where there are some, ``source`` (file) and ``row`` (1 is the first row of data).
    """

    def __init__(self, reason: str, source: str | None = None, row: int | None = None) -> None:
        where = "" if source is None else f"{source}: "
        if row is not None:
            where += f"row {row}: "
        super().__init__(where + reason)
        self.reason = reason
        self.source = source
        self.row = row


class MotionError(MechanismError):
    """A motion of the master cannot be planned within its limits; ``reason`` says why."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class ApproachError(MechanismError):
    """The linkage cannot be brought from where it stands onto its cam; ``reason`` says why."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class SynthesisError(MechanismError):
    """A synthesis cannot be done as asked; ``reason`` says why, ``term`` names the term that cannot be met."""

    def __init__(self, reason: str, term: str | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.term = term


class CamFileError(MechanismError):
    """A cam file or cam image cannot be used.

    Attributes: ``source`` (file, or what the bytes are) and ``why``.
    """

    def __init__(self, source: str, why: str) -> None:
        super().__init__(f"{source}: {why}")
        self.source = source
        self.why = why


@unique
class CamImageFault(IntEnum):
    """Why a drive refuses a cam image; the value is what its profile slot shows as the error."""

    NONE = 0
    BAD_MAGIC = 1
    BAD_VERSION = 2
    TOO_FEW_POINTS = 3
    NOT_A_POWER_OF_TWO = 4
    WRONG_LENGTH = 5
    WRONG_CRC = 6
    VALUE_OUT_OF_RANGE = 7


class CamImageError(CamFileError):
    """A binary cam image is refused; ``reason`` is the code that a profile slot shows."""

    def __init__(self, reason: CamImageFault, why: str) -> None:
        super().__init__("cam image", f"{why} (reason {int(reason)})")
        self.reason = reason


def finite(*values: float) -> bool:
    """Whether every value is a finite number."""
    return all(isfinite(value) for value in values)
