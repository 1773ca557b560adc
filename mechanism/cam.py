"""Compile a desired curve into a cam: slow, and it proves the limits, so that evaluating the cam can be fast and blind.

The chain: closure tracking, a periodic quintic spline theta5(theta2), then every limit checked over the whole cycle
at the master's speed. All violations are collected; `CompiledCam.require` raises the first.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, pi, tau

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mechanism.cam_image import make_cam_image
from mechanism.cam_profile import CamProfile, check_knots, periodic_spline
from mechanism.closure import ClosureTrack, track_closure
from mechanism.curve import DesiredCurve, read_only
from mechanism.errors import (
    CamImageError,
    CamLimitError,
    MechanismError,
    ParameterError,
    SingularError,
    UnreachableError,
    finite,
)
from mechanism.five_bar import Closure, FiveBar

__all__ = ["Cam", "CamLimits", "CamProfile", "CamReport", "CompiledCam", "Extreme", "compile_cam"]

Float = NDArray[np.float64]

_SAMPLES_PER_KNOT = 8
_END_EFFECTOR_POINTS = 720
_REFINEMENTS = 60
_IMAGE_SAMPLES = 4096
# A spline that touches a limit passes it by rounding; no end stop is that sharp (rad, rad/s, ..., counts).
_TOLERANCE = 1e-7


@dataclass(frozen=True, slots=True)
class CamLimits:
    """What a cam has to keep; None leaves a limit out.

    Of the servo axis, at the master's speed: velocity (rad/s), acceleration (rad/s^2), jerk (rad/s^3), position (rad,
    as theta5). Of the linkage: structural error (m) and the least abs sine of both transmission angles. Of the table:
    how far profile and binary image may be from the spline through the curve's points (counts), and the greatest step
    of the demand from one bus cycle to the next (counts).
    """

    velocity_rad_per_s: float
    acceleration_rad_per_s2: float
    jerk_rad_per_s3: float | None = None
    position_minimum_rad: float | None = None
    position_maximum_rad: float | None = None
    structural_error_m: float = 1e-3
    minimum_transmission_sine: float = 0.1
    resolution_counts: float = 0.5
    step_counts: float | None = None

    def __post_init__(self) -> None:
        for name, value in (
            ("velocity_rad_per_s", self.velocity_rad_per_s),
            ("acceleration_rad_per_s2", self.acceleration_rad_per_s2),
            ("jerk_rad_per_s3", self.jerk_rad_per_s3),
            ("structural_error_m", self.structural_error_m),
            ("minimum_transmission_sine", self.minimum_transmission_sine),
            ("resolution_counts", self.resolution_counts),
            ("step_counts", self.step_counts),
        ):
            if value is not None and not (finite(value) and value > 0.0):
                raise ParameterError(name, value, "positive and finite")
        if self.minimum_transmission_sine >= 1.0:
            raise ParameterError("minimum_transmission_sine", self.minimum_transmission_sine, "below 1")
        for name, value in (
            ("position_minimum_rad", self.position_minimum_rad),
            ("position_maximum_rad", self.position_maximum_rad),
        ):
            if value is not None and not finite(value):
                raise ParameterError(name, value, "finite")


@dataclass(frozen=True, slots=True)
class Extreme:
    """A greatest or least value, and the theta2 (rad, within 0 to 2 pi) where it is."""

    value: float
    theta2_rad: float


@dataclass(frozen=True, slots=True)
class CamReport:
    """The figures of a compiled cam; motion figures are of the servo axis at the master's speed.

    position: rad; velocity: rad/s; acceleration: rad/s^2; jerk: rad/s^3; structural_error: m, at the curve's points,
    the distance of the desired point from q's circle; path_error: m, at the curve's points, the distance of the
    profile's end effector from the desired point; crank_sine, servo_sine: the least abs sines of the angles between q
    and r and between r and s; profile_error_counts: of the profile against the spline through the curve's points;
    image_error_counts: of the drive's binary table against the profile; step_counts: the greatest step of the demand
    in one bus cycle.
    """

    master_speed_rad_per_s: float
    counts_per_revolution: int
    cycle_s: float
    curve_points: int
    knots: int
    net_turns: int
    immobile_points: int
    position_minimum: Extreme
    position_maximum: Extreme
    velocity_minimum: Extreme
    velocity_maximum: Extreme
    acceleration_minimum: Extreme
    acceleration_maximum: Extreme
    jerk_minimum: Extreme
    jerk_maximum: Extreme
    structural_error: Extreme
    path_error: Extreme
    crank_sine: Extreme
    servo_sine: Extreme
    profile_error_counts: Extreme
    image_error_counts: Extreme
    step_counts: Extreme

    @property
    def displacement_rad(self) -> float:
        """How far link s swings."""
        return self.position_maximum.value - self.position_minimum.value

    @property
    def displacement_deg(self) -> float:
        """How far link s swings, in degrees."""
        return degrees(self.displacement_rad)

    def figures(self) -> dict[str, float]:
        """Every figure as one flat mapping whose keys carry the units, for files and scripts."""
        flat: dict[str, float] = {
            "master_speed_rad_per_s": self.master_speed_rad_per_s,
            "counts_per_revolution": self.counts_per_revolution,
            "cycle_s": self.cycle_s,
            "curve_points": self.curve_points,
            "knots": self.knots,
            "net_turns": self.net_turns,
            "immobile_points": self.immobile_points,
            "displacement_deg": self.displacement_deg,
        }
        in_degrees = degrees(1.0)
        for key, extreme, factor in (
            ("position_minimum_deg", self.position_minimum, in_degrees),
            ("position_maximum_deg", self.position_maximum, in_degrees),
            ("velocity_minimum_rad_per_s", self.velocity_minimum, 1.0),
            ("velocity_maximum_rad_per_s", self.velocity_maximum, 1.0),
            ("acceleration_minimum_rad_per_s2", self.acceleration_minimum, 1.0),
            ("acceleration_maximum_rad_per_s2", self.acceleration_maximum, 1.0),
            ("jerk_minimum_rad_per_s3", self.jerk_minimum, 1.0),
            ("jerk_maximum_rad_per_s3", self.jerk_maximum, 1.0),
            ("structural_error_mm", self.structural_error, 1e3),
            ("path_error_mm", self.path_error, 1e3),
            ("minimum_crank_sine", self.crank_sine, 1.0),
            ("minimum_servo_sine", self.servo_sine, 1.0),
            ("profile_error_counts", self.profile_error_counts, 1.0),
            ("image_error_counts", self.image_error_counts, 1.0),
            ("step_counts", self.step_counts, 1.0),
        ):
            flat[key] = extreme.value * factor
            flat[f"{key}_at_master_deg"] = extreme.theta2_rad * in_degrees
        return flat


@dataclass(frozen=True, slots=True, eq=False)
class Cam:
    """A cam and the linkage that it was made for: all that running it takes."""

    profile: CamProfile
    five_bar: FiveBar
    closure: Closure

    def desired_point(self, theta2: float) -> tuple[float, float]:
        """Where the end effector is to be at theta2 (rad): x, y in metres, from the profile by forward kinematics."""
        point = self.five_bar.end_effector(theta2, self.profile.at(theta2)[0], self.closure)
        return float(point[0]), float(point[1])

    def desired_points(self, theta2: ArrayLike) -> Float:
        """`desired_point` of an array of angles: shape (..., 2)."""
        angles = np.asarray(theta2, dtype=np.float64)
        return self.five_bar.end_effector(angles, self.profile.at_many(angles)[..., 0], self.closure)


@dataclass(frozen=True, slots=True, eq=False)
class CompiledCam:
    """A cam, what it was made of, its figures, and every limit it breaks.

    end_effector: where the profile brings the end effector, (720, 2) m at equal steps of theta2 from 0 on.
    """

    cam: Cam
    curve: DesiredCurve
    limits: CamLimits
    report: CamReport
    end_effector: Float
    violations: tuple[MechanismError, ...]

    def require(self) -> "CompiledCam":
        """This cam, proven: raises the first violation, if there is one."""
        if self.violations:
            raise self.violations[0]
        return self

    @property
    def profile(self) -> CamProfile:
        """theta5(theta2)."""
        return self.cam.profile

    @property
    def five_bar(self) -> FiveBar:
        """The linkage."""
        return self.cam.five_bar

    @property
    def closure(self) -> Closure:
        """How the linkage is assembled."""
        return self.cam.closure

    def desired_point(self, theta2: float) -> tuple[float, float]:
        """`Cam.desired_point`: x, y in metres at theta2 (rad)."""
        return self.cam.desired_point(theta2)

    def desired_points(self, theta2: ArrayLike) -> Float:
        """`Cam.desired_points`: shape (..., 2), metres."""
        return self.cam.desired_points(theta2)


def _greatest(function: Callable[[Float], Float], theta2: Float) -> Extreme:
    """The greatest value of a smooth function over a closed grid of theta2, refined by golden-section search.

    A value that is not a number counts as the greatest of all.
    """
    values = function(theta2)
    if bool(np.any(np.isnan(values))):
        return Extreme(float("nan"), float(theta2[int(np.argmax(np.isnan(values)))]) % tau)
    best = int(np.argmax(values))
    spacing = float(theta2[1] - theta2[0])
    low = float(theta2[best]) - spacing
    high = float(theta2[best]) + spacing
    ratio = 0.5 * (5.0**0.5 - 1.0)
    for _ in range(_REFINEMENTS):
        inner = high - ratio * (high - low)
        outer = low + ratio * (high - low)
        pair = function(np.array([inner, outer]))
        if pair[0] >= pair[1]:
            high = outer
        else:
            low = inner
    middle = 0.5 * (low + high)
    refined = float(function(np.array([middle]))[0])
    if refined > values[best]:
        return Extreme(refined, middle % tau)
    return Extreme(float(values[best]), float(theta2[best]) % tau)


def _least(function: Callable[[Float], Float], theta2: Float) -> Extreme:
    found = _greatest(lambda at: -function(at), theta2)
    return Extreme(-found.value, found.theta2_rad)


def _worst_point(values: Float, theta2: Float) -> tuple[Extreme, int]:
    worst = int(np.argmax(np.where(np.isnan(values), np.inf, values)))
    return Extreme(float(values[worst]), float(theta2[worst]) % tau), worst


def _closure_of(track: ClosureTrack, five_bar: FiveBar) -> Closure:
    """The closure of most of the points, where it is not the same for all."""
    if track.closure is not None:
        return track.closure
    joint_a = five_bar.crank_end(track.theta2)
    line = five_bar.servo_end(track.theta5) - joint_a
    offset = track.actual - joint_a
    side = np.sign(line[:, 0] * offset[:, 1] - line[:, 1] * offset[:, 0])
    return Closure.LEFT if float(np.sum(side)) >= 0.0 else Closure.RIGHT


def _image_error(profile: CamProfile, points: int, counts_per_revolution: int) -> Extreme:
    """The drive's table, interpolated between its points, against the profile; counts."""
    try:
        image = make_cam_image(profile, points, counts_per_revolution, counts_per_revolution)
    except CamImageError:
        return Extreme(float("nan"), 0.0)
    stride = max(counts_per_revolution // _IMAGE_SAMPLES, 1)
    master = np.arange(0, counts_per_revolution, stride)
    theta2 = (master * (tau / counts_per_revolution)).astype(np.float64)
    wanted = profile.at_many(theta2)[:, 0] * (counts_per_revolution / tau)
    given = np.array([image.slave_position(counts) for counts in master.tolist()], dtype=np.float64)
    return _worst_point(np.abs(given - wanted), theta2)[0]


def compile_cam(
    curve: DesiredCurve,
    five_bar: FiveBar,
    limits: CamLimits,
    master_speed_rad_per_s: float,
    counts_per_revolution: int = 4096,
    cycle_s: float = 0.001,
    knots: int = 1024,
    image_points: int = 1024,
) -> CompiledCam:
    """Compile the desired curve for the linkage and check every limit at the master's speed (rad/s, constant).

    The servo motion is theta5(theta2), unwrapped, theta5 within -pi to pi at the curve's first point. knots,
    image_points: pieces of the profile and points of the binary table, powers of two. Limits that are broken are
    collected in `CompiledCam.violations`, not raised; raises ParameterError for an impossible parameter.
    """
    for name, value in (("master_speed_rad_per_s", abs(master_speed_rad_per_s)), ("cycle_s", cycle_s)):
        if not (finite(value) and value > 0.0):
            raise ParameterError(name, value, "finite and not 0")
    if not 4 <= counts_per_revolution <= 2**24:
        raise ParameterError("counts_per_revolution", counts_per_revolution, "from 4 to 16777216")
    check_knots(knots)
    check_knots(image_points)

    track = track_closure(curve, five_bar, limits.minimum_transmission_sine)
    closure = _closure_of(track, five_bar)
    profile = CamProfile.through(track.theta2, track.theta5, track.net_turns, knots)
    spline = periodic_spline(track.theta2, track.theta5, track.net_turns)
    counts = counts_per_revolution / tau
    speed = master_speed_rad_per_s
    grid = np.linspace(0.0, tau, knots * _SAMPLES_PER_KNOT + 1)

    def motion(order: int) -> Callable[[Float], Float]:
        return lambda theta2: profile.at_many(theta2)[:, order] * speed**order

    def sine(which: int) -> Callable[[Float], Float]:
        def evaluate_sine(theta2: Float) -> Float:
            both = five_bar.transmission_sines(theta2, profile.at_many(theta2)[:, 0], closure)
            # A linkage that does not close has lost its grip altogether.
            return np.nan_to_num(np.abs(both[:, which]), nan=0.0)

        return evaluate_sine

    def profile_error(theta2: Float) -> Float:
        within = (theta2 - track.theta2[0]) % tau
        drift = track.net_turns * (theta2 - track.theta2[0])
        return np.abs(profile.at_many(theta2)[:, 0] - drift - spline(within + track.theta2[0])) * counts

    def step(theta2: Float) -> Float:
        ahead = profile.at_many(theta2 + abs(speed) * cycle_s)[:, 0]
        return np.abs(ahead - profile.at_many(theta2)[:, 0]) * counts

    reached = five_bar.end_effector(track.theta2, profile.at_many(track.theta2)[:, 0], closure)
    path_error, _ = _worst_point(np.hypot(*(reached - curve.points).T), track.theta2)
    structural_error, worst_point = _worst_point(track.structural_error, track.theta2)
    report = CamReport(
        master_speed_rad_per_s=speed,
        counts_per_revolution=counts_per_revolution,
        cycle_s=cycle_s,
        curve_points=int(track.theta2.size),
        knots=knots,
        net_turns=track.net_turns,
        immobile_points=track.immobile_points,
        position_minimum=_least(motion(0), grid),
        position_maximum=_greatest(motion(0), grid),
        velocity_minimum=_least(motion(1), grid),
        velocity_maximum=_greatest(motion(1), grid),
        acceleration_minimum=_least(motion(2), grid),
        acceleration_maximum=_greatest(motion(2), grid),
        jerk_minimum=_least(motion(3), grid),
        jerk_maximum=_greatest(motion(3), grid),
        structural_error=structural_error,
        path_error=path_error,
        crank_sine=_least(sine(0), grid),
        servo_sine=_least(sine(1), grid),
        profile_error_counts=_greatest(profile_error, grid),
        image_error_counts=_image_error(profile, image_points, counts_per_revolution),
        step_counts=_greatest(step, grid),
    )
    all_round = np.arange(_END_EFFECTOR_POINTS) * (tau / _END_EFFECTOR_POINTS)
    return CompiledCam(
        cam=Cam(profile, five_bar, closure),
        curve=curve,
        limits=limits,
        report=report,
        end_effector=read_only(five_bar.end_effector(all_round, profile.at_many(all_round)[:, 0], closure)),
        violations=(
            *_linkage_violations(track, five_bar, limits, report, worst_point),
            *_axis_violations(limits, report),
        ),
    )


def _linkage_violations(
    track: ClosureTrack, five_bar: FiveBar, limits: CamLimits, report: CamReport, worst_point: int
) -> list[MechanismError]:
    found: list[MechanismError] = []
    if not report.structural_error.value <= limits.structural_error_m:
        found.append(
            UnreachableError(
                worst_point,
                report.structural_error.theta2_rad,
                report.structural_error.value,
                limits.structural_error_m,
                "link q, from the crank's end, does not meet it",
            )
        )
    try:
        track.require_mobile(five_bar)
    except UnreachableError as error:
        found.append(error)
    for which, extreme in (("links q and r", report.crank_sine), ("links r and s", report.servo_sine)):
        if not extreme.value >= limits.minimum_transmission_sine:
            found.append(SingularError(extreme.theta2_rad, extreme.value, limits.minimum_transmission_sine, which))
    if track.closure is None and not any(isinstance(error, SingularError) for error in found):
        found.append(SingularError(float(track.theta2[0]), 0.0, limits.minimum_transmission_sine, "links q and r"))
    return found


def _axis_violations(limits: CamLimits, report: CamReport) -> list[MechanismError]:
    found: list[MechanismError] = []
    one = 1.0
    in_degrees = 180.0 / pi
    upper = [
        ("velocity", report.velocity_maximum, limits.velocity_rad_per_s, "rad/s", one),
        ("acceleration", report.acceleration_maximum, limits.acceleration_rad_per_s2, "rad/s^2", one),
        ("jerk", report.jerk_maximum, limits.jerk_rad_per_s3, "rad/s^3", one),
        ("position", report.position_maximum, limits.position_maximum_rad, "deg", in_degrees),
        ("distance from the curve's spline", report.profile_error_counts, limits.resolution_counts, "counts", one),
        ("binary table's error", report.image_error_counts, limits.resolution_counts, "counts", one),
        ("step in one bus cycle", report.step_counts, limits.step_counts, "counts", one),
    ]
    lower = [
        ("velocity", report.velocity_minimum, -limits.velocity_rad_per_s, "rad/s", one),
        ("acceleration", report.acceleration_minimum, -limits.acceleration_rad_per_s2, "rad/s^2", one),
        (
            "jerk",
            report.jerk_minimum,
            None if limits.jerk_rad_per_s3 is None else -limits.jerk_rad_per_s3,
            "rad/s^3",
            one,
        ),
        ("position", report.position_minimum, limits.position_minimum_rad, "deg", in_degrees),
    ]
    for what, extreme, limit, unit, factor in upper:
        # Written so that a figure that is not a number is a violation too.
        if limit is not None and not extreme.value <= limit + _TOLERANCE:
            found.append(CamLimitError(what, extreme.value * factor, limit * factor, unit, extreme.theta2_rad))
    for what, extreme, limit, unit, factor in lower:
        if limit is not None and not extreme.value >= limit - _TOLERANCE:
            found.append(CamLimitError(what, extreme.value * factor, limit * factor, unit, extreme.theta2_rad))
    return found
