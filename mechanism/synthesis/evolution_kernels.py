"""Kernels: one generation of differential evolution, from random numbers that come in."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.jit import kernel

Float = NDArray[np.float64]
Integers = NDArray[np.int64]

UNIFORM_DRAWS: Final = 13
"""Uniform numbers a member takes: its memory slot, three partners, one sure variable, and one for each variable."""
_SURE: Final = 4
_TAKE: Final = 5


@kernel
def _index(draw: float, count: int) -> int:
    return min(int(draw * count), count - 1)


@kernel
def make_trials(
    unit: Float,
    order: Integers,
    archive: Float,
    memory: Float,
    uniform: Float,
    normal: Float,
    cauchy: Float,
    greedy_share: float,
    trials: Float,
    crossovers: Float,
    scales: Float,
) -> None:
    """Fill ``trials`` (m, 8) by current-to-best-few mutation and binomial crossover, inside the unit cube.

    unit: the members (m, 8); order: from the best to the worst; archive: who was replaced (k, 8); memory: rates and
    scales that have worked (2, h), a rate below 0 meaning 0 for good; uniform (m, UNIFORM_DRAWS), normal and cauchy
    (m,). What each member took is left in crossovers and scales.
    """
    count = unit.shape[0]
    pool = count + archive.shape[0]
    few = max(int(greedy_share * count + 0.5), 2)
    for i in range(count):
        slot = _index(uniform[i, 0], memory.shape[1])
        rate = memory[0, slot]
        crossover = 0.0 if rate < 0.0 else min(max(rate + 0.1 * normal[i], 0.0), 1.0)
        # Cauchy around the memory's scale; what falls below 0 is drawn again in the original, and mirrored here.
        scale = min(max(abs(memory[1, slot] + 0.1 * cauchy[i]), 1e-3), 1.0)
        best = order[_index(uniform[i, 1], few)]
        first = _index(uniform[i, 2], count - 1)
        if first >= i:
            first += 1
        second = _index(uniform[i, 3], pool - 2)
        if second >= min(i, first):
            second += 1
        if second >= max(i, first):
            second += 1
        sure = _index(uniform[i, _SURE], unit.shape[1])
        for k in range(unit.shape[1]):
            own = unit[i, k]
            trials[i, k] = own
            if k == sure or uniform[i, _TAKE + k] < crossover:
                other = unit[second, k] if second < count else archive[second - count, k]
                mutant = own + scale * (unit[best, k] - own) + scale * (unit[first, k] - other)
                # Half way to the bound that it would pass.
                if mutant < 0.0:
                    mutant = 0.5 * own
                elif mutant > 1.0:
                    mutant = 0.5 * (1.0 + own)
                trials[i, k] = mutant
        crossovers[i] = crossover
        scales[i] = scale
