"""Stability margins of the coupled two-axis loop over all positions of the machine cycle.

The loop is broken at the controllers' outputs: a 2 x 2 transfer L(z) = K(z) G(z) of the controllers K (diagonal, 1024
Hz) and the machine G with its amplifiers, output delay and zero-order hold, linear about each position of the cycle at
speed (`mechanism.linear_model`). Because the axes disturb each other, margins of one axis alone say little; these are
taken from the whole loop:

- sensitivity peak: the greatest singular value of (I + L)^-1, the inverse of the return difference's distance to 0;
- gain margin: by how much the gains may be raised together, or of either axis while the other stays, before the loop is
  unstable; the least of the three (and, where lowering them is what destabilises, by how much they may be lowered);
- phase margin: of either axis' loop while the other one is closed; the lesser;
- delay margin: the additional delay in both loops at which the first position becomes unstable.

The same figures can be taken of a measured loop transfer (`gateway.tuning.response`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log10
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from config.conversion import dynamics_parameters
from config.schema import GatewayConfig
from gateway.tuning.controller import GAIN_SCALE, SERVO_RATE_HZ, AxisLoop, GainPair, axis_loop, controller_response
from mechanism.cam_profile import CamProfile
from mechanism.five_bar import Closure
from mechanism.linear_model import frequency_response, linearise, sample, state_matrices

Float = NDArray[np.float64]
Complex = NDArray[np.complex128]
Bool = NDArray[np.bool_]

SERVO_PERIOD_S: Final = 1.0 / SERVO_RATE_HZ
DEFAULT_POSITIONS: Final = 72
DEFAULT_FREQUENCIES: Final = 400
LOWEST_HZ: Final = 0.5
HIGHEST_SHARE: Final = 0.4999
"""Of the sample rate: to just below half of it, where the response of a sampled loop is real."""
ASKED_DELAY_S: Final = 0.002
"""Additional delay with which every loop must still be stable."""
ASKED_GAIN_MARGIN_DB: Final = 8.0
MAX_DELAY_S: Final = 0.05
_STABLE: Final = 1.0 - 1e-9
_DELAY_STEPS: Final = 14
_P, _I, _D, _V, _F = range(5)


@dataclass(frozen=True, slots=True)
class LoopModel:
    """The machine of a configuration, linear at n positions of its cycle, and its response at m frequencies.

    ``theta2`` (n,) in rad; ``a``, ``b``: `mechanism.linear_model.state_matrices`; ``response`` (n, m, 2, 2): counts of
    both axes by units of both outputs.
    """

    theta2: Float
    axes: tuple[AxisLoop, AxisLoop]
    a: Float
    b: Float
    frequencies_hz: Float
    response: Complex


@dataclass(frozen=True, slots=True)
class Margin:
    """A margin, and where in the cycle (theta2, deg) and at which frequency it is the least."""

    value: float
    theta2_deg: float
    frequency_hz: float

    def to_json(self) -> dict[str, float | None]:
        """None for a margin without bound."""
        value = None if self.value in (inf, -inf) else round(self.value, 4)
        return {
            "value": value,
            "theta2_deg": round(self.theta2_deg, 3) if value is not None else None,
            "frequency_hz": round(self.frequency_hz, 3) if value is not None else None,
        }


@dataclass(frozen=True, slots=True)
class Margins:
    """Of a loop over all its positions: in dB, degrees, and a ratio; see the module."""

    gain_dB: Margin
    phase_deg: Margin
    sensitivity_peak: Margin


@dataclass(frozen=True, slots=True)
class Robustness:
    """What is stated with each tuning."""

    is_stable: bool
    margins: Margins
    delay_margin_s: float
    """Additional delay that every position stands; `MAX_DELAY_S` for more."""

    def problems(self, gain_margin_dB: float = ASKED_GAIN_MARGIN_DB, delay_s: float = ASKED_DELAY_S) -> list[str]:
        """A sentence for each demand that is not met."""
        if not self.is_stable:
            return ["the gains make the loop unstable"]
        problems: list[str] = []
        gain = self.margins.gain_dB
        if gain.value < gain_margin_dB:
            where = f"theta2 = {gain.theta2_deg:.0f} deg"
            problems.append(f"the gain margin is {gain.value:.1f} dB at {where} (bound {gain_margin_dB:g} dB)")
        if self.delay_margin_s < delay_s:
            problems.append(
                f"the loop becomes unstable with {self.delay_margin_s * 1e3:.2f} ms of additional delay"
                f" (bound {delay_s * 1e3:g} ms)"
            )
        return problems

    def to_json(self) -> dict[str, Any]:
        """Plain values; margins of an unstable loop mean nothing and are left out."""
        margins = self.margins
        return {
            "is_stable": self.is_stable,
            "gain_margin_dB": margins.gain_dB.to_json() if self.is_stable else None,
            "phase_margin_deg": margins.phase_deg.to_json() if self.is_stable else None,
            "sensitivity_peak": margins.sensitivity_peak.to_json() if self.is_stable else None,
            "delay_margin_ms": round(self.delay_margin_s * 1e3, 4) if self.is_stable else None,
        }


def loop_model(
    config: GatewayConfig,
    profile: CamProfile,
    closure: Closure,
    positions: int = DEFAULT_POSITIONS,
    frequencies: int = DEFAULT_FREQUENCIES,
) -> LoopModel:
    """The loop of a configuration along its cam at its speed.

    Raises mechanism.errors.ParameterError for a machine that is singular on its path, or without amplifier lag.
    """
    theta2 = np.linspace(0.0, 2.0 * np.pi, positions, endpoint=False)
    speed = config.speed_rad_per_s
    theta5, first, second = profile.at_many(theta2)[:, :3].T
    theta = np.stack([theta2, theta5], axis=1)
    omega = np.stack([np.full(positions, speed), first * speed], axis=1)
    alpha = np.stack([np.zeros(positions), second * speed**2], axis=1)
    return model_at(config, theta, omega, alpha, closure, frequencies)


def model_at(
    config: GatewayConfig,
    theta: Float,
    omega: Float,
    alpha: Float,
    closure: Closure,
    frequencies: int = DEFAULT_FREQUENCIES,
    hz: Float | None = None,
) -> LoopModel:
    """The loop at n operating points: theta (rad), omega (rad/s), alpha (rad/s^2) are (n, 2), columns as the axes.

    Its response is that at ``frequencies`` of them, evenly spaced on a logarithmic scale, or at those of ``hz``.
    """
    master, slave = (axis_loop(axis) for axis in config.ordered_axes)
    dynamics = dynamics_parameters(config).to_array()
    linear = linearise(dynamics, theta, omega, alpha, int(closure))
    a, b = state_matrices(linear, (master.time_constant_s, slave.time_constant_s))
    if hz is None:
        hz = np.geomspace(LOWEST_HZ, HIGHEST_SHARE * SERVO_RATE_HZ, frequencies)
    response = _response(a, b, (master, slave), hz)
    return LoopModel(theta[:, 0], (master, slave), a, b, hz, response)


def _response(a: Float, b: Float, axes: tuple[AxisLoop, AxisLoop], frequencies_hz: Float) -> Complex:
    response = frequency_response(sample(a, b, SERVO_PERIOD_S), frequencies_hz)
    counts = np.array([axis.counts_per_rad for axis in axes])
    units = np.array([axis.torque_per_unit_Nm for axis in axes])
    delays = np.array([axis.output_delay_periods for axis in axes])
    late = np.exp(-2j * np.pi * frequencies_hz[:, None] * SERVO_PERIOD_S * delays)
    return response * counts[:, None] * units * late[:, None, :]


def gain_array(gains: GainPair) -> Float:
    """(2, 5), rows master and slave."""
    return np.array([pair.values for pair in gains], dtype=np.float64)


def loop_transfer(model: LoopModel, gains: Float) -> Complex:
    """L (n, m, 2, 2) at the outputs: what comes back, negative, for a unit at either output; ``gains`` is (2, 5)."""
    controllers = np.stack([controller_response(row.tolist(), model.frequencies_hz) for row in gains], axis=1)
    return controllers[None, :, :, None] * model.response


def margins_of(transfer: Complex, frequencies_hz: Float, theta2: Float) -> Margins:
    """Margins of a loop transfer (n, m, 2, 2) at m frequencies and n positions; see the module for what they are."""
    degrees = np.degrees(theta2)
    l11, l12, l21, l22 = transfer[..., 0, 0], transfer[..., 0, 1], transfer[..., 1, 0], transfer[..., 1, 1]
    cross = l12 * l21
    alone = (l11 - cross / (1.0 + l22), l22 - cross / (1.0 + l11))
    # Raised together, the loop is unstable where an eigenvalue of k L encloses -1.
    loops = (*alone, *_characteristic_loci(l11 + l22, l11 * l22 - cross))
    gains = [_gain_margin(loop, frequencies_hz, degrees) for loop in loops]
    phases = [_phase_margin(loop, frequencies_hz, degrees) for loop in alone]
    peaks = _sensitivity(l11, l12, l21, l22)
    at, k = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
    return Margins(
        min(gains, key=lambda margin: margin.value),
        min(phases, key=lambda margin: margin.value),
        Margin(float(peaks[at, k]), float(degrees[at]), float(frequencies_hz[k])),
    )


def _sensitivity(l11: Complex, l12: Complex, l21: Complex, l22: Complex) -> Float:
    """Greatest singular value of (I + L)^-1, in closed form: that of I + L over its determinant."""
    determinant = np.abs((1.0 + l11) * (1.0 + l22) - l12 * l21)
    square = np.abs(1.0 + l11) ** 2 + np.abs(1.0 + l22) ** 2 + np.abs(l12) ** 2 + np.abs(l21) ** 2
    root = np.sqrt(np.maximum(square * square - 4.0 * determinant * determinant, 0.0))
    return np.sqrt(0.5 * (square + root)) / determinant


def _crossings(values: Float) -> tuple[Any, Any, Float]:
    """Where ``values`` (n, m) change sign along m: rows, columns before, and the share of the step at which they do."""
    before, after = values[:, :-1], values[:, 1:]
    rows, columns = np.nonzero((before < 0.0) != (after < 0.0))
    first, second = before[rows, columns], after[rows, columns]
    return rows, columns, first / (first - second)


def _between(values: Float, rows: Any, columns: Any, share: Float) -> Float:
    return values[rows, columns] * (1.0 - share) + values[rows, columns + 1] * share


def _least(values: Float, rows: Any, columns: Any, frequencies_hz: Float, degrees: Float) -> Margin:
    if not len(values):
        return Margin(inf, 0.0, 0.0)
    k = int(np.argmin(values))
    return Margin(float(values[k]), float(degrees[rows[k]]), float(frequencies_hz[columns[k]]))


def _gain_margin(loop: Complex, frequencies_hz: Float, degrees: Float) -> Margin:
    """The factor, up or down, at which a scalar loop meets -1: where it passes the negative real axis."""
    rows, columns, share = _crossings(loop.imag)
    amplitude = -_between(loop.real, rows, columns, share)
    there = amplitude > 0.0
    decibel = np.abs(20.0 * np.log10(amplitude[there]))
    return _least(decibel, rows[there], columns[there], frequencies_hz, degrees)


def _characteristic_loci(trace: Complex, determinant: Complex) -> tuple[Complex, Complex]:
    """Both eigenvalues (n, m) of the loop transfer, each continuous along the frequencies."""
    root = np.sqrt(0.25 * trace * trace - determinant)
    first, second = 0.5 * trace + root, 0.5 * trace - root
    kept = np.abs(np.diff(first)) + np.abs(np.diff(second))
    swapped = np.abs(second[:, 1:] - first[:, :-1]) + np.abs(first[:, 1:] - second[:, :-1])
    is_swapped = np.zeros(trace.shape, dtype=np.bool_)
    is_swapped[:, 1:] = np.cumsum(swapped < kept, axis=1) % 2 == 1
    return np.where(is_swapped, second, first), np.where(is_swapped, first, second)


def _phase_margin(loop: Complex, frequencies_hz: Float, degrees: Float) -> Margin:
    rows, columns, share = _crossings(np.log(np.abs(loop)))
    here = loop[rows, columns] * (1.0 - share) + loop[rows, columns + 1] * share
    return _least(np.abs(np.degrees(np.angle(-here))), rows, columns, frequencies_hz, degrees)


def spectral_radius(model: LoopModel, gains: Float, extra_delay_s: float = 0.0) -> Float:
    """(n,): the greatest absolute eigenvalue of the closed loop at each position; below 1 it is stable."""
    return np.abs(np.linalg.eigvals(_closed_loop(model, gains, extra_delay_s))).max(axis=1)


def _closed_loop(model: LoopModel, gains: Float, extra_delay_s: float) -> Float:
    """(n, k, k): the difference equation of machine, controllers and delays, from one servo tick to the next."""
    delays = [axis.output_delay_periods for axis in model.axes]
    sampled = sample(model.a, model.b, SERVO_PERIOD_S, extra_delay_s)
    lags = [sampled.delay_periods + delay for delay in delays]
    depth = max(lags) + 1
    # State: machine (6), positions before (2), error sums (2), outputs from newest to oldest (2 each).
    outputs = 10
    count, size = len(model.a), outputs + 2 * depth
    step = np.zeros((count, size, size))
    feedback = np.zeros((count, 2, size))
    for axis, loop in enumerate(model.axes):
        k_p, k_i, k_d, k_v, _ = gains[axis]
        scale = loop.torque_per_unit_Nm / GAIN_SCALE
        counts = loop.counts_per_rad
        feedback[:, axis, axis] = -(k_p + k_i + k_d + k_v) * scale * counts
        feedback[:, axis, 6 + axis] = (k_d + k_v) * scale
        feedback[:, axis, 8 + axis] = k_i * scale
        step[:, 6 + axis, axis] = counts
        if k_i:
            step[:, 8 + axis, 8 + axis] = 1.0
            step[:, 8 + axis, axis] = -counts
    step[:, 0:6, 0:6] = sampled.transition
    for axis, lag in enumerate(lags):
        _add_input(step, feedback, sampled.recent, axis, lag, outputs)
        _add_input(step, feedback, sampled.older, axis, lag + 1, outputs)
    step[:, outputs : outputs + 2] = feedback
    for place in range(outputs + 2, size):
        step[:, place, place - 2] = 1.0
    return step


def _add_input(step: Float, feedback: Float, gain: Float, axis: int, lag: int, outputs: int) -> None:
    """Let the output of ``axis`` of ``lag`` ticks ago act on the machine."""
    column = gain[:, :, axis]
    if lag == 0:
        step[:, 0:6, :] += column[:, :, None] * feedback[:, axis, None, :]
    elif column.any():
        step[:, 0:6, outputs + 2 * (lag - 1) + axis] += column


def is_stable(model: LoopModel, gains: Float, extra_delay_s: float = 0.0) -> bool:
    """Whether the loop is stable at every position, with ``extra_delay_s`` in both axes."""
    return bool(spectral_radius(model, gains, extra_delay_s).max() < _STABLE)


def delay_margin_s(model: LoopModel, gains: Float, until_s: float = MAX_DELAY_S) -> float:
    """Additional delay (s) up to which every position is stable; found by halving, 0 where it is not stable at all."""
    if not is_stable(model, gains):
        return 0.0
    low, high = 0.0, SERVO_PERIOD_S
    while high < until_s and is_stable(model, gains, high):
        low, high = high, 2.0 * high
    if low >= until_s:
        return until_s
    for _ in range(_DELAY_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(model, gains, middle) else (low, middle)
    return min(low, until_s)


def robustness(model: LoopModel, gains: Float) -> Robustness:
    """Everything that is stated about the loop with ``gains`` (2, 5)."""
    margins = margins_of(loop_transfer(model, gains), model.frequencies_hz, model.theta2)
    return Robustness(is_stable(model, gains), margins, delay_margin_s(model, gains))


def raised(gains: Float, factors: Sequence[float]) -> Float:
    """The feedback gains (2, 5) of each axis times its factor; K_F feeds nothing back and stays."""
    changed = gains.copy()
    changed[:, :_F] *= np.asarray(factors)[:, None]
    return changed


def decibel(ratio: float) -> float:
    """20 log10 of a ratio."""
    return 20.0 * log10(ratio)
