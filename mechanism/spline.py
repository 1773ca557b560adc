"""The one door to scipy's splines (which have no type information): a periodic quintic spline, typed."""

from typing import Any, Final, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

Float = NDArray[np.float64]

DEGREE: Final = 5


class Spline(Protocol):
    """A spline: call it with x and, for a derivative, its order ``nu``; outside its period it repeats."""

    def __call__(self, x: Float, nu: int = 0) -> Float: ...


def periodic_quintic(x: Float, y: Float) -> Spline:
    """The quintic spline (C4) through the points y(x), shape (n,), n > 5; x rises over one period and y[-1] is y[0]."""
    make = cast("Any", make_interp_spline)
    return cast("Spline", make(x, y, k=DEGREE, bc_type="periodic"))
