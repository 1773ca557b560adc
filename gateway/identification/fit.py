"""Inertia, gravity and friction of the machine by least squares on the regressor form, with confidence intervals.

Positions are smoothed without phase shift, differentiated and put into the regressor; regressor and measured torque
then go through the same smoothing, so that what it takes away is taken from both sides. Samples near a standstill of an
axis are left out, for dry friction then may be anything up to its bound.

What the motion cannot tell apart must come from somewhere: the nominal parameters are known to a share of themselves
(``PRIOR_SHARE``), and the estimate is the one that is most likely with the data and that knowledge. So parameters that
the data say nothing about keep their nominal value and its wide interval, and the result can always be used as a model.
``determined`` says of each parameter how much the data have narrowed it down.

Residuals are neither white nor independent: what the model leaves out repeats with the position of the cycle. Their
weight is therefore that of clusters, samples of one stretch of theta2 counting together. And a controller that runs at
another rate than the SYNC is not sampled evenly: some of its ripple may stay in the mean. Every run therefore may have
a constant torque of its own on each axis, as large as a share of that ripple.
"""

from dataclasses import dataclass
from math import tau
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.errors import GatewayError, UsageError
from gateway.record.run_constants import RunConstants
from gateway.record.sample import SampleArray
from gateway.reporting.run_data import FOLLOWING_PHASES
from mechanism.dynamics import DynamicsParameters
from mechanism.five_bar import Closure
from mechanism.regressor import PARAMETER_NAMES, base_columns, from_vector, regressor, to_vector, unit_of

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int = NDArray[np.intp]

PRIOR_SHARE: Final = 0.5
"""Standard deviation of what is known beforehand, of the nominal value."""
FRICTION_SHARE: Final = 1.0
POSITION_SMOOTHING_S: Final = 0.005
TORQUE_SMOOTHING_S: Final = 0.012
"""Standard deviations of the Gaussian windows: of the positions, and after them of torque and regressor."""
STANDSTILL_RAD_PER_S: Final = 0.25
COULOMB_VELOCITY: Final = 0.02
DEFAULT_TORQUE_DELAY_S: Final = 0.5 / 1024.0
"""Age of the torque actual value at SYNC: that of the drive's last servo tick."""
CONFIDENCE_FACTOR: Final = 2.0
"""Half the width of a 95 % interval in standard deviations, of the t distribution at the usual number of clusters."""
CLUSTERS: Final = 48
ALIASED_SHARE: Final = 0.03
"""Of the ripple; 1024 servo ticks a second against 1000 SYNCs leave out one of 43."""
_LEAST_OFFSET_NM: Final = 1e-4
LEAST_SAMPLES: Final = 500
LEAST_TRAVEL_RAD: Final = 1.0
_WINDOW: Final = 3.0
_ABSOLUTE: Final[dict[str, float]] = {"viscous": 0.002, "coulomb": 0.02, "moment_across": 2e-4}
_MAX_INFLATION: Final = 1e4
_PASSES: Final = 3


@dataclass(frozen=True, slots=True)
class Motion:
    """What a recording tells of the motion: n instants, ``period_s`` apart, columns master and slave.

    ``angle_rad`` unwrapped, ``torque_Nm``; ``is_usable`` where the axes followed the cam and every TPDO came.
    """

    period_s: float
    angle_rad: Float
    torque_Nm: Float
    is_usable: Bool


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter: value, half the width of its 95 % interval, and what was known before."""

    name: str
    unit: str
    value: float
    half_width: float
    nominal: float
    determined: float
    """1: by the data alone; 0: not at all, it keeps its nominal value."""

    @property
    def interval(self) -> tuple[float, float]:
        """95 %."""
        return self.value - self.half_width, self.value + self.half_width

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "unit": self.unit,
            "value": self.value,
            "interval_95": list(self.interval),
            "nominal": self.nominal,
            "determined": round(self.determined, 4),
        }


@dataclass(frozen=True, slots=True)
class Identification:
    """The result. ``predicted_Nm`` and ``measured_Nm`` (n, 2), smoothed alike, at ``theta2_rad`` (n,) for the plot."""

    estimates: tuple[Estimate, ...]
    parameters: DynamicsParameters
    residual_rms_Nm: tuple[float, float]
    nominal_residual_rms_Nm: tuple[float, float]
    samples: int
    independent: tuple[str, ...]
    """A largest set of parameters that the motion could tell apart if there were no noise; the others follow them."""
    theta2_rad: Float
    measured_Nm: Float
    predicted_Nm: Float

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "parameters": {estimate.name: estimate.to_json() for estimate in self.estimates},
            "residual_rms_Nm": [round(value, 6) for value in self.residual_rms_Nm],
            "nominal_residual_rms_Nm": [round(value, 6) for value in self.nominal_residual_rms_Nm],
            "samples": self.samples,
            "independent": list(self.independent),
        }


@dataclass(frozen=True, slots=True)
class _Rows:
    """Rows of the least squares problem: regressor (n, 2, 19), torque (n, 2), theta2 (n,); RMS ripple (2,), N m."""

    matrix: Float
    torque: Float
    theta2: Float
    ripple: Float


def motion_of(samples: SampleArray, constants: RunConstants) -> Motion:
    """The motion of a recording's samples, master first. Raises UsageError for one of other than two axes."""
    if len(constants.axes) != 2:
        raise UsageError(f"the recording has {len(constants.axes)} axes, identification needs two")
    axes = [constants.axes[constants.master_axis], constants.axes[constants.slave_axis]]
    order = [constants.master_axis, constants.slave_axis]
    counts = np.unwrap(samples["position_actual"][:, order].astype(np.float64), axis=0, period=2.0**32)
    scale = np.array([axis.direction * tau / axis.counts_per_revolution for axis in axes])
    zero = np.array([axis.zero_rad for axis in axes])
    rated = np.array([axis.rated_torque_nm for axis in axes])
    torque = samples["torque_actual"][:, order] * rated / 1000.0
    usable = np.isin(samples["phase"], FOLLOWING_PHASES) & (samples["flags"] == 0)
    return Motion(constants.period_s, zero + scale * counts, torque, usable)


def identify(
    motions: list[Motion],
    nominal: DynamicsParameters,
    closure: Closure,
    torque_delay_s: float = DEFAULT_TORQUE_DELAY_S,
) -> Identification:
    """The parameters that are most likely, from one or more motions; linkage and gravity are ``nominal``'s.

    Raises GatewayError where there is no motion to learn from, ParameterError where the result is that of no body.
    """
    rows = [rows for motion in motions if (rows := _rows_of(motion, nominal, closure, torque_delay_s)) is not None]
    count = sum(len(each.theta2) for each in rows)
    if count < LEAST_SAMPLES:
        raise GatewayError(
            f"there is no motion to learn from: {count} samples in which both axes move (bound {LEAST_SAMPLES})"
        )
    matrix = np.concatenate([each.matrix for each in rows])
    torque = np.concatenate([each.torque for each in rows])
    theta2 = np.concatenate([each.theta2 for each in rows])
    if np.ptp(theta2) < LEAST_TRAVEL_RAD:
        travel = f"the master turns by {np.ptp(theta2):.2f} rad (bound {LEAST_TRAVEL_RAD:g})"
        raise GatewayError(f"there is no motion to learn from: {travel}")
    prior = to_vector(nominal)
    spread = _spread(prior, nominal)
    offsets = _run_offsets(rows)
    estimate, covariance = _solve(
        np.concatenate([matrix, offsets], axis=2),
        torque,
        _cluster(theta2),
        np.concatenate([prior, np.zeros(offsets.shape[2])]),
        np.concatenate([spread, *(ALIASED_SHARE * each.ripple + _LEAST_OFFSET_NM for each in rows)]),
    )
    deviation = np.sqrt(np.diag(covariance))[: len(prior)]
    estimate = estimate[: len(prior)]
    predicted = matrix @ estimate
    return Identification(
        tuple(
            Estimate(name, unit_of(name), float(value), float(CONFIDENCE_FACTOR * width), float(before), float(share))
            for name, value, width, before, share in zip(
                PARAMETER_NAMES, estimate, deviation, prior, 1.0 - np.square(deviation / spread), strict=True
            )
        ),
        from_vector(estimate, nominal),
        _rms(torque - predicted),
        _rms(torque - matrix @ prior),
        count,
        tuple(PARAMETER_NAMES[k] for k in base_columns(matrix.reshape(-1, len(prior)), spread)),
        theta2,
        torque,
        predicted,
    )


def _run_offsets(rows: list[_Rows]) -> Float:
    """Columns (n, 2, 2 r) of r runs: a constant torque of each run, on each axis."""
    count = sum(len(each.theta2) for each in rows)
    columns = np.zeros((count, 2, 2 * len(rows)))
    first = 0
    for run, each in enumerate(rows):
        last = first + len(each.theta2)
        columns[first:last, 0, 2 * run] = columns[first:last, 1, 2 * run + 1] = 1.0
        first = last
    return columns


def _rms(residual: Float) -> tuple[float, float]:
    both = np.sqrt(np.square(residual).mean(axis=0))
    return float(both[0]), float(both[1])


def _spread(prior: Float, nominal: DynamicsParameters) -> Float:
    """Standard deviation of what is known of each parameter beforehand."""
    spread = np.zeros(len(prior))
    for k, name in enumerate(PARAMETER_NAMES):
        kind = name.split(".")[0] if name.startswith(("viscous", "coulomb")) else name.split(".")[1]
        share = FRICTION_SHARE if kind in ("viscous", "coulomb") else PRIOR_SHARE
        spread[k] = max(share * abs(prior[k]), _ABSOLUTE.get(kind, 1e-6))
        if kind == "moment_across":
            # A centre of mass off the link's line by a tenth of its distance along it.
            spread[k] = max(spread[k], 0.1 * abs(prior[k - 1]))
    return spread


def _solve(matrix: Float, torque: Float, clusters: Int, prior: Float, spread: Float) -> tuple[Float, Float]:
    """Estimate and covariance with a prior; noise of each axis and dependence of its residuals come from the data."""
    weight = np.ones(2)
    inflation = 1.0
    estimate, covariance = prior, np.diag(np.square(spread))
    for _ in range(_PASSES):
        scaled = (matrix * spread / np.sqrt(weight)[None, :, None]).reshape(-1, len(prior))
        wanted = ((torque - matrix @ prior) / np.sqrt(weight)).reshape(-1)
        information = scaled.T @ scaled / inflation
        inverse = np.linalg.inv(information + np.eye(len(prior)))
        offset = inverse @ (scaled.T @ wanted) / inflation
        estimate = prior + spread * offset
        covariance = spread[:, None] * inverse * spread
        residual = torque - matrix @ estimate
        weight = np.maximum(np.square(residual).mean(axis=0), 1e-12)
        whitened = (residual / np.sqrt(weight)).reshape(-1)
        scaled = (matrix * spread / np.sqrt(weight)[None, :, None]).reshape(-1, len(prior))
        inflation = _inflation(scaled, whitened, np.repeat(clusters, 2))
    return estimate, covariance


def _inflation(scaled: Float, residual: Float, clusters: Int) -> float:
    """By how much the residuals' dependence within clusters widens the intervals: variance, of the worst direction.

    Directions that the data determine; the others keep what was known.
    """
    gram = scaled.T @ scaled
    values, vectors = np.linalg.eigh(gram)
    kept = vectors[:, values > 10.0]
    projected = (scaled @ kept) * residual[:, None]
    sums = np.zeros((CLUSTERS, kept.shape[1]))
    np.add.at(sums, clusters, projected)
    robust = np.square(sums).sum(axis=0) * CLUSTERS / (CLUSTERS - 1.0)
    return float(np.clip((robust / values[values > 10.0]).max(initial=1.0), 1.0, _MAX_INFLATION))


def _cluster(theta2: Float) -> Int:
    return (np.mod(theta2, tau) / tau * CLUSTERS).astype(np.intp) % CLUSTERS


def _rows_of(motion: Motion, nominal: DynamicsParameters, closure: Closure, torque_delay_s: float) -> _Rows | None:
    first = _gaussian(POSITION_SMOOTHING_S, motion.period_s)
    second = _gaussian(TORQUE_SMOOTHING_S, motion.period_s)
    reach = (len(first) + len(second)) // 2 + 1
    if len(motion.angle_rad) <= 2 * reach or not motion.is_usable.any():
        return None
    smooth = _convolve(motion.angle_rad, first)
    omega = np.gradient(smooth, motion.period_s, axis=0)
    alpha = _second_difference(smooth, motion.period_s)
    moving = motion.is_usable & (np.abs(omega) > STANDSTILL_RAD_PER_S).all(axis=1)
    kept = _eroded(moving, reach)
    if not kept.any():
        return None
    matrix = regressor(nominal, closure, smooth, omega, alpha, COULOMB_VELOCITY)
    matrix = _convolve(np.nan_to_num(matrix.reshape(len(matrix), -1)), second).reshape(matrix.shape)
    instants = np.arange(len(motion.torque_Nm)) * motion.period_s
    torque = np.stack(
        [np.interp(instants, instants - torque_delay_s, motion.torque_Nm[:, axis]) for axis in (0, 1)], axis=1
    )
    smoothed = _convolve(_convolve(torque, first), second)
    ripple = np.sqrt(np.square(torque - smoothed)[kept].mean(axis=0))
    return _Rows(matrix[kept], smoothed[kept], smooth[kept, 0], ripple)


def _gaussian(deviation_s: float, period_s: float) -> Float:
    reach = max(1, round(_WINDOW * deviation_s / period_s))
    window = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) * period_s / deviation_s))
    return window / window.sum()


def _convolve(values: Float, window: Float) -> Float:
    padded = np.pad(values, ((len(window) // 2, len(window) // 2), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, window, mode="valid") for column in padded.T], axis=1)


def _second_difference(values: Float, period_s: float) -> Float:
    result = np.zeros_like(values)
    result[1:-1] = (values[2:] - 2.0 * values[1:-1] + values[:-2]) / period_s**2
    return result


def _eroded(mask: Bool, reach: int) -> Bool:
    """Where ``mask`` holds for ``reach`` samples on either side."""
    around = np.convolve(mask.astype(np.float64), np.ones(2 * reach + 1), mode="same")
    return around > 2 * reach + 0.5
