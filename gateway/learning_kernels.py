"""The arithmetic of learning from cycle to cycle, as numba kernels: a few hundred nanoseconds a cycle, no allocation.

A torque correction u(theta2) is kept for either axis at equal bins of the master's revolution. While the master turns
at constant speed, the mean following error E of every bin is taken, and the bin that lies half a window behind becomes

    u <- Q (u + gain (P E + D dE/dt))

Q is a window that is symmetric in theta2, so without phase shift: a zero-phase low pass. P and D are those of the
drive's own position controller: what the controller had to add last time is what the correction gives it next time.
The filter walks along with the master, one bin at a time, so that no cycle has more to do than another.
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
"""Share by which the master's speed may differ and still count as the same."""

# Rows of the work array, two rows (axes) each where it says so.
SUM: Final = 0
"""Errors summed in the bin (2 rows)."""
ERROR: Final = 2
"""Mean error of the bin at its last passage, rad (2 rows)."""
PASSED: Final = 4
"""The correction that was in force at that passage, N m (2 rows)."""
ROWS: Final = 6

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
"""Master speed of the sample before."""
STEADY: Final = 6
"""Samples since the speed has changed last."""
UPDATES: Final = 7
"""Bins that have been learned."""
STATES: Final = 8

# The settings: constants of a run.
GAIN: Final = 0
PROPORTIONAL: Final = 1
"""N m / rad (2 numbers)."""
DERIVATIVE: Final = 3
"""N m s / rad (2 numbers)."""
BOUND: Final = 5
"""N m (2 numbers)."""
WINDOW_S: Final = 7
"""Half width of the window, s."""
SETTLE: Final = 8
"""Cycles of constant speed before learning begins."""
SETTINGS: Final = 9


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
    """Lay the window for this speed into ``taps``: row 0 the low pass, row 1 its derivative with respect to time."""
    per_s = bins * speed / tau
    half = floor(settings[WINDOW_S] * per_s + 0.5)
    half = max(1, min(half, MAXIMUM_HALF_WINDOW, bins // 4))
    state[HALF] = half
    total = 0.0
    for h in range(-half, half + 1):
        weight = 0.5 + 0.5 * cos(pi * h / (half + 1))
        taps[0, half + h] = weight
        total += weight
    moment = 0.0
    for h in range(-half, half + 1):
        taps[0, half + h] /= total
        moment += h * h * taps[0, half + h]
    for h in range(-half, half + 1):
        # The slope of the weighted least-squares line through the window.
        taps[1, half + h] = taps[0, half + h] * h / moment * per_s


@kernel
def _learn_bin(memory: Float, work: Float, taps: Float, state: Float, settings: Float, centre: int) -> None:
    bins = memory.shape[1]
    half = int(state[HALF])
    for axis in range(AXES):
        smooth = 0.0
        error = 0.0
        rate = 0.0
        for h in range(2 * half + 1):
            b = (centre - half + h) % bins
            smooth += taps[0, h] * work[PASSED + axis, b]
            error += taps[0, h] * work[ERROR + axis, b]
            rate += taps[1, h] * work[ERROR + axis, b]
        wanted = smooth + settings[GAIN] * (settings[PROPORTIONAL + axis] * error + settings[DERIVATIVE + axis] * rate)
        bound = settings[BOUND + axis]
        memory[axis, centre] = min(max(wanted, -bound), bound)
    state[UPDATES] += 1.0


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
    if not is_valid or speed <= 0.0 or abs(speed - state[LAST_SPEED]) > SPEED_TOLERANCE * speed:
        state[LAST_SPEED] = speed
        state[STEADY] = 0.0
        state[BIN] = -1.0
        state[RUN] = 0.0
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
            else:
                for axis in range(AXES):
                    work[ERROR + axis, last] = work[SUM + axis, last] / state[COUNT]
                    work[PASSED + axis, last] = memory[axis, last]
                # A bin that the master has jumped over had the error of the one before.
                for step in range(passed):
                    full = (last + step) % bins
                    if step > 0:
                        for axis in range(AXES):
                            work[ERROR + axis, full] = work[ERROR + axis, last]
                            work[PASSED + axis, full] = memory[axis, full]
                    state[RUN] += 1.0
                    if state[RUN] > 2.0 * state[HALF]:
                        _learn_bin(memory, work, taps, state, settings, (full - int(state[HALF])) % bins)
        state[BIN] = b
        state[COUNT] = 0.0
        work[SUM, b] = 0.0
        work[SUM + 1, b] = 0.0
    work[SUM, b] += error2
    work[SUM + 1, b] += error5
    state[COUNT] += 1.0
