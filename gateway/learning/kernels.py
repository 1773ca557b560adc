"""The arithmetic of learning from cycle to cycle, as numba kernels: a few hundred nanoseconds a cycle, no allocation.

A torque correction u(theta2) is kept for either axis at equal bins of the master's revolution. While the master turns
at constant speed, the mean following error E of every bin is taken. The torque that was missing is what the position
controller made of that error, and what the error's acceleration takes of the mass matrix M. So the bin that lies half a
window behind becomes

    u <- Q (u + gain (P E + I integral of E + D E' + M E''))

P, I and D being the controller's own gains as torques. Q is a window that is symmetric in theta2, so without phase
shift: a zero-phase low pass. The filter walks along with the master, one bin at a time, so that no cycle has more to do
than another.
"""

from math import cos, floor, pi, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel

Float = NDArray[np.float64]

AXES: Final = 2
MAXIMUM_HALF_WINDOW: Final = 64
"""Bins on either side that the low pass may take."""
SPEED_TOLERANCE: Final = 1e-3
"""Share by which the master's speed may differ from that of the memory and still count as the same."""
STEADY_TOLERANCE: Final = 1e-4
"""Share by which the master's speed may change and still count as constant."""

# Rows of the work array, two rows (axes) each where it says so.
SUM: Final = 0
"""Errors summed in the bin (2 rows)."""
ERROR: Final = 2
"""Mean error of the bin at its last passage, rad (2 rows)."""
WANTED: Final = 4
"""The correction in force at that passage, and the gain's share of P and I of its error, N m (2 rows)."""
ROWS: Final = 6

# Rows of the mass matrix at the bins, kg m^2.
M11: Final = 0
M12: Final = 1
M22: Final = 2
MASSES: Final = 3

# The state: single numbers that the kernels keep.
SPEED: Final = 0
"""Master speed that the memory belongs to, rad/s; 0 for none yet."""
BIN: Final = 1
"""The bin that is being filled; -1 for none."""
COUNT: Final = 2
"""Samples in it."""
RUN: Final = 3
"""Bins filled one after the other, without a gap."""
HALF: Final = 4
"""Half width of the window, bins."""
LAST_SPEED: Final = 5
"""Master speed since it has changed last."""
STEADY: Final = 6
"""Samples since the speed has changed last."""
UPDATES: Final = 7
"""Bins that have been learned."""
INTEGRAL: Final = 8
"""Integral of the error, rad s (2 numbers); it forgets within a radian of the master's turn."""
MEAN: Final = 10
"""Running mean of the error over a revolution, rad (2 numbers)."""
STATES: Final = 12

# The settings: constants of a run.
GAIN: Final = 0
PROPORTIONAL: Final = 1
"""N m / rad (2 numbers)."""
INTEGRATING: Final = 3
"""N m / rad s (2 numbers)."""
DERIVATIVE: Final = 5
"""N m s / rad (2 numbers)."""
BOUND: Final = 7
"""N m (2 numbers)."""
WINDOW_S: Final = 9
"""Half width of the window, s."""
SETTLE: Final = 10
"""Cycles of constant speed before learning begins."""
SETTINGS: Final = 11


@kernel
def correction(memory: Float, state: Float, position: float, speed: float) -> tuple[float, float]:
    """The learned torques (N m) of both axes at theta2 = ``position`` (rad) and this master speed (rad/s).

    Away from the speed at which it was learned it goes with the square of the speed, as forces of inertia do, and is
    never more than it was.
    """
    learned_at = state[SPEED]
    if learned_at <= 0.0:
        return 0.0, 0.0
    ratio = speed / learned_at
    share = 1.0 if ratio * ratio > 1.0 else ratio * ratio
    bins = memory.shape[1]
    x = position * (bins / tau) - 0.5
    whole = floor(x)
    f = x - whole
    b = int(whole) % bins
    c = b + 1 if b + 1 < bins else 0
    return (
        share * (memory[0, b] + f * (memory[0, c] - memory[0, b])),
        share * (memory[1, b] + f * (memory[1, c] - memory[1, b])),
    )


@kernel
def _set_window(taps: Float, state: Float, settings: Float, bins: int, speed: float) -> None:
    """Lay the window for this speed into ``taps``: row 0 the low pass, row 1 and 2 its derivatives in time.

    All have one bin more on either side than the low pass has weights.
    """
    per_s = bins * speed / tau
    half = floor(settings[WINDOW_S] * per_s + 0.5)
    half = max(1, min(half, MAXIMUM_HALF_WINDOW - 1, bins // 4))
    state[HALF] = half + 1
    width = 2 * half + 3
    total = 0.0
    for n in range(width):
        # 0 at both ends.
        weight = 0.5 + 0.5 * cos(pi * (n - half - 1) / (half + 1))
        taps[0, n] = weight
        total += weight
    for n in range(width):
        taps[0, n] /= total
    for n in range(width):
        before = taps[0, n - 1] if n > 0 else 0.0
        after = taps[0, n + 1] if n + 1 < width else 0.0
        # The window is laid over what is to be differentiated the other way round.
        taps[1, n] = 0.5 * (before - after) * per_s
        taps[2, n] = (before - 2.0 * taps[0, n] + after) * per_s * per_s


@kernel
def _learn_bin(
    memory: Float, work: Float, masses: Float, taps: Float, state: Float, settings: Float, centre: int
) -> None:
    bins = memory.shape[1]
    half = int(state[HALF])
    wanted2 = 0.0
    wanted5 = 0.0
    rate2 = 0.0
    rate5 = 0.0
    acceleration2 = 0.0
    acceleration5 = 0.0
    for n in range(2 * half + 1):
        b = (centre - half + n) % bins
        wanted2 += taps[0, n] * work[WANTED, b]
        wanted5 += taps[0, n] * work[WANTED + 1, b]
        rate2 += taps[1, n] * work[ERROR, b]
        rate5 += taps[1, n] * work[ERROR + 1, b]
        acceleration2 += taps[2, n] * work[ERROR, b]
        acceleration5 += taps[2, n] * work[ERROR + 1, b]
    inertia2 = masses[M11, centre] * acceleration2 + masses[M12, centre] * acceleration5
    inertia5 = masses[M12, centre] * acceleration2 + masses[M22, centre] * acceleration5
    wanted2 += settings[GAIN] * (settings[DERIVATIVE] * rate2 + inertia2)
    wanted5 += settings[GAIN] * (settings[DERIVATIVE + 1] * rate5 + inertia5)
    memory[0, centre] = min(max(wanted2, -settings[BOUND]), settings[BOUND])
    memory[1, centre] = min(max(wanted5, -settings[BOUND + 1]), settings[BOUND + 1])
    state[UPDATES] += 1.0


@kernel
def _close_bin(memory: Float, work: Float, state: Float, settings: Float, last: int, passed: int) -> None:
    """Mean error of the bin that the master has left, ``passed`` bins ago, and of those that it has jumped over."""
    bins = memory.shape[1]
    bin_s = tau / (bins * state[SPEED])
    kept = 1.0 - tau / bins
    for axis in range(AXES):
        error = work[SUM + axis, last] / state[COUNT]
        for step in range(passed):
            b = (last + step) % bins
            # A controller that integrates has the mean of the error at 0, whatever the mean of the correction is: the
            # rest that resolution leaves of it says nothing, and would let the correction drift.
            state[MEAN + axis] += (error - state[MEAN + axis]) / bins
            swing = error - state[MEAN + axis] if settings[INTEGRATING + axis] > 0.0 else error
            # Half of the bin before its middle, half of it after.
            state[INTEGRAL + axis] = kept * state[INTEGRAL + axis] + 0.5 * bin_s * swing
            missing = settings[PROPORTIONAL + axis] * swing + settings[INTEGRATING + axis] * state[INTEGRAL + axis]
            state[INTEGRAL + axis] += 0.5 * bin_s * swing
            work[ERROR + axis, b] = error
            work[WANTED + axis, b] = memory[axis, b] + settings[GAIN] * missing


@kernel
def _rescale(memory: Float, state: Float, settings: Float, speed: float) -> None:
    """Let the memory be one of another speed, as if it were all forces of inertia: a beginning, no more."""
    if state[SPEED] > 0.0:
        ratio = speed / state[SPEED]
        share = ratio * ratio
        for axis in range(AXES):
            bound = settings[BOUND + axis]
            for b in range(memory.shape[1]):
                memory[axis, b] = min(max(share * memory[axis, b], -bound), bound)
    state[SPEED] = speed


@kernel
def observe(
    memory: Float,
    work: Float,
    masses: Float,
    taps: Float,
    state: Float,
    settings: Float,
    position: float,
    speed: float,
    is_valid: bool,
    error2: float,
    error5: float,
) -> None:
    """Take the following errors (rad) that both axes had with the master at ``position`` (rad) and ``speed`` (rad/s).

    Nothing is learned while the speed changes, nor from samples that are not valid; what has been learned stays.
    """
    bins = memory.shape[1]
    if not is_valid or speed <= 0.0 or abs(speed - state[LAST_SPEED]) > STEADY_TOLERANCE * speed:
        state[LAST_SPEED] = speed
        state[STEADY] = 0.0
        state[BIN] = -1.0
        state[RUN] = 0.0
        state[INTEGRAL] = 0.0
        state[INTEGRAL + 1] = 0.0
        return
    if state[STEADY] < settings[SETTLE]:
        state[STEADY] += 1.0
        return
    if state[HALF] == 0.0 or abs(speed - state[SPEED]) > SPEED_TOLERANCE * speed:
        _rescale(memory, state, settings, speed)
        _set_window(taps, state, settings, bins, speed)
    b = floor(position * (bins / tau)) % bins
    last = int(state[BIN])
    if b != last:
        if last >= 0:
            passed = (b - last) % bins
            if passed > bins // 8:
                state[RUN] = 0.0
                passed = 0
            _close_bin(memory, work, state, settings, last, passed)
            for step in range(passed):
                state[RUN] += 1.0
                if state[RUN] > 2.0 * state[HALF]:
                    centre = (last + step - int(state[HALF])) % bins
                    _learn_bin(memory, work, masses, taps, state, settings, centre)
        state[BIN] = b
        state[COUNT] = 0.0
        work[SUM, b] = 0.0
        work[SUM + 1, b] = 0.0
    work[SUM, b] += error2
    work[SUM + 1, b] += error5
    state[COUNT] += 1.0
