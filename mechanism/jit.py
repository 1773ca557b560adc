"""The one door to numba: everything else of this room sees typed functions.

A kernel takes and returns floats, ints, tuples and arrays, is defined at module level (numba cannot cache closures) and
follows IEEE arithmetic: a division by zero gives an infinity, never an exception, and no operation is reordered, so
that results are the same from run to run. numba judges its on-disk cache by the source file of the kernel alone:
after editing a kernel that kernels of *other* files call, remove the ``*.nbi`` and ``*.nbc`` files of those.

Where numba is missing, kernels are plain Python: hundreds of times slower, with the same results.
"""

from collections.abc import Callable
from typing import Any, Final, ParamSpec, TypeVar, cast

try:
    import numba
except ImportError:
    numba = None

P = ParamSpec("P")
R = TypeVar("R")

COMPILED: Final = numba is not None
"""Whether kernels are compiled."""


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` at its first call, and keep the machine code on disk for the next process."""
    if numba is None:
        return function
    compile_with = cast("Any", numba).njit(cache=True, error_model="numpy", fastmath=False)
    return cast("Callable[P, R]", compile_with(function))
