"""From any position of the linkage onto its cam, without coming near a singular position and within the servo's limits.

The plane of (theta2, theta5) is covered with cells. A cell is free where the linkage closes and abs(sin(theta3 -
theta4)) keeps its distance; free cells that touch are joined, so that the closure, which changes only through a
singular position, stays. Cheapest ways from the cam to all cells are found once (Dijkstra), and a way is then only
followed and drawn straight.
"""

from math import ceil, degrees, hypot, inf, pi, radians, remainder, tau
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray
from scipy import sparse  # pyright: ignore[reportMissingTypeStubs]
from scipy.sparse import csgraph  # pyright: ignore[reportMissingTypeStubs]

from mechanism.cam_profile import CamProfile
from mechanism.errors import ApproachError
from mechanism.five_bar import Closure, FiveBar

Float = NDArray[np.float64]
Point = tuple[float, float]
"""(theta2, theta5) in rad."""

# scipy has no type information; what comes out of it is typed in _find_ways.
_SPARSE = cast("Any", sparse)
_CSGRAPH = cast("Any", csgraph)

CELLS_PER_TURN: Final = 180
CELL: Final = tau / CELLS_PER_TURN
MARGIN: Final = 0.03
"""Added to the least sine for the cells' centres: a straight line between two of them does not pass through both."""
OUTSIDE: Final = radians(12.0)
"""How far beyond the servo's limits a machine may stand to be brought back."""
OUTSIDE_COST: Final = 20.0
STEP: Final = radians(0.25)
"""Of the final look at a straight line."""
_AROUND: Final = tuple((over, up) for over in range(-3, 4) for up in range(-3, 4))
_NEIGHBOURS: Final = ((1, 0), (0, 1), (1, 1), (1, -1))


class ApproachField:
    """Ways onto one cam.

    A slave that gains turns on its cam can turn without end, as the master does: its rows close in a circle too, and a
    way ends in the revolution of the slave that is nearest.
    """

    def __init__(
        self,
        five_bar: FiveBar,
        closure: Closure,
        cam: CamProfile,
        minimum_sine: float,
        servo_limits: tuple[float, float] | None = None,
    ) -> None:
        """``minimum_sine`` is that of the angle between q and r; ``servo_limits`` bound theta5 (rad).

        Raises ApproachError for limits of a slave that turns without end.
        """
        self._is_turning = cam.net_turns != 0
        if self._is_turning and servo_limits is not None:
            raise ApproachError("the servo axis gains turns on its cam and can have no limits of its position")
        self._five_bar = five_bar
        self._closure = closure
        self._cam = cam
        self._minimum_sine = minimum_sine
        around = cam.at_many(np.arange(CELLS_PER_TURN) * CELL)[:, 0]
        middle = 0.5 * float(around.min() + around.max())
        if self._is_turning:
            self._low, self._high, self._first, self._rows = -inf, inf, 0.0, CELLS_PER_TURN
        else:
            self._low, self._high = servo_limits or (middle - pi, middle + pi)
            self._first = self._low - OUTSIDE
            self._rows = ceil((self._high + OUTSIDE - self._first) / CELL) + 1
        self._clearance = self._find_clearance()
        self._ways = self._find_ways(around)

    def path(self, theta2: float, theta5: float) -> tuple[Point, ...]:
        """Corners of a way from here (rad) to a point of the cam, both included; theta2 unwrapped along it.

        The master stays where it is if the servo axis alone can reach the cam. Raises ApproachError where the linkage
        stands too near a singular position, beyond the servo's limits, or where no way leads to the cam.
        """
        here = f"the linkage stands at theta2 = {degrees(theta2) % 360.0:.1f} deg, theta5 = {degrees(theta5):.1f} deg"
        if not self._low - OUTSIDE <= theta5 <= self._high + OUTSIDE:
            low, high = degrees(self._low), degrees(self._high)
            raise ApproachError(f"{here}, beyond the servo axis' limits ({low:g} to {high:g} deg)")
        sine = self._least_sine((theta2, theta5), (theta2, theta5))
        if not sine >= self._minimum_sine:
            what = (
                "a position in which it does not close"
                if sine != sine
                else f"where the transmission sine is {sine:.3f}"
            )
            raise ApproachError(f"{here}, {what} (bound {self._minimum_sine:g}); bring it away from there by hand")
        straight = (theta2, self._cam_near(theta2, theta5))
        if self._is_free((theta2, theta5), straight):
            return (theta2, theta5), straight
        cells = self._cells_from(theta2, theta5)
        if cells is None:
            raise ApproachError(
                f"{here}, and no way leads from there to the cam that keeps the transmission sine above "
                f"{self._minimum_sine:g} (a change of closure would be needed); bring it onto the cam by hand"
            )
        last = cells[-1][0]
        points = [(theta2, theta5), *cells, (last, self._cam_near(*cells[-1]))]
        return self._straightened(points)

    def _cam_near(self, theta2: float, theta5: float) -> float:
        """theta5 of the cam where the master is at theta2; of a slave that turns without end, nearest to ``theta5``."""
        on_cam = self._cam.at(theta2)[0]
        return theta5 - remainder(theta5 - on_cam, tau) if self._is_turning else on_cam

    def _find_clearance(self) -> Float:
        """abs(sin(theta3 - theta4)) at the cells' centres, shape (turn, rows); 0 where the linkage does not close."""
        theta2 = np.arange(CELLS_PER_TURN)[:, np.newaxis] * CELL
        theta5 = self._first + np.arange(self._rows)[np.newaxis, :] * CELL
        sines = self._five_bar.transmission_sines(theta2, theta5, self._closure)[..., 0]
        return np.nan_to_num(np.abs(sines), nan=0.0)

    def _find_ways(self, around: Float) -> NDArray[np.intp]:
        """For every cell the next one on the way to the cam; negative where there is none."""
        rows, clearance = self._rows, self._clearance
        free = clearance >= self._minimum_sine + MARGIN
        number = np.arange(CELLS_PER_TURN * rows).reshape(CELLS_PER_TURN, rows)
        theta5 = self._first + np.arange(rows) * CELL
        is_outside = (theta5 < self._low) | (theta5 > self._high)
        cost = np.where(is_outside[np.newaxis, :], OUTSIDE_COST, 1.0) / np.maximum(clearance, 1e-3)
        starts: list[NDArray[np.intp]] = []
        ends: list[NDArray[np.intp]] = []
        weights: list[Float] = []
        for over, up in _NEIGHBOURS:
            to = np.roll(np.roll(number, -over, axis=0), -up, axis=1)
            both = free & free.ravel()[to]
            if not self._is_turning:
                # Nothing goes round from the highest row to the lowest.
                both[:, rows - 1 if up > 0 else 0] &= up == 0
            starts.append(number[both])
            ends.append(to[both])
            weights.append(hypot(over, up) * CELL * 0.5 * (cost[both] + cost.ravel()[to[both]]))
        cam_rows = np.rint((around - self._first) / CELL).astype(np.intp)
        cam_rows = cam_rows % rows if self._is_turning else np.clip(cam_rows, 0, rows - 1)
        cam_cells = number[np.arange(CELLS_PER_TURN), cam_rows]
        source = number.size
        starts.append(np.full(CELLS_PER_TURN, source))
        ends.append(cam_cells)
        weights.append(np.full(CELLS_PER_TURN, 1e-9))
        shape = (source + 1, source + 1)
        graph = _SPARSE.coo_matrix(
            (np.concatenate(weights), (np.concatenate(starts), np.concatenate(ends))), shape=shape
        )
        _, before = _CSGRAPH.dijkstra(graph.tocsr(), directed=False, indices=source, return_predecessors=True)
        return np.asarray(before, dtype=np.intp)

    def _cells_from(self, theta2: float, theta5: float) -> list[Point] | None:
        """Centres of the cells from here to the cam, theta2 unwrapped; None if there is no way."""
        source = CELLS_PER_TURN * self._rows
        column, row = round(theta2 / CELL), round((theta5 - self._first) / CELL)
        # The nearest cell may itself be barred by its margin, and a neighbour may not.
        around = sorted(_AROUND, key=lambda over: hypot(*over))
        places = [(column + over, self._row(row + up)) for over, up in around]
        start = next((place for place in places if self._leads_on(place, (theta2, theta5))), None)
        if start is None:
            return None
        column, row = start
        cell = (column % CELLS_PER_TURN) * self._rows + row % self._rows
        points: list[Point] = []
        while cell != source:
            step = (cell // self._rows - column + CELLS_PER_TURN // 2) % CELLS_PER_TURN - CELLS_PER_TURN // 2
            column += step
            up = cell % self._rows - row
            row += (up + self._rows // 2) % self._rows - self._rows // 2 if self._is_turning else up
            points.append((column * CELL, self._first + row * CELL))
            cell = int(self._ways[cell])
        return points

    def _row(self, row: int) -> int:
        """The row itself, or the nearest there is."""
        return row if self._is_turning else min(max(row, 0), self._rows - 1)

    def _leads_on(self, place: tuple[int, int], start: Point) -> bool:
        column, row = place
        has_way = self._ways[(column % CELLS_PER_TURN) * self._rows + row % self._rows] >= 0
        return bool(has_way) and self._is_free(start, (column * CELL, self._first + row * CELL))

    def _straightened(self, points: list[Point]) -> tuple[Point, ...]:
        """The corners that are left when every straight line that is free replaces the corners within it."""
        corners = [points[0]]
        at = 0
        while at < len(points) - 1:
            reach = len(points) - 1
            while reach > at + 1 and not self._is_free(points[at], points[reach]):
                reach -= max((reach - at) // 8, 1)
            if not self._is_free(points[at], points[reach]):
                raise ApproachError("the way to the cam comes too near a singular position; bring the linkage by hand")
            corners.append(points[reach])
            at = reach
        return tuple(corners)

    def _is_free(self, start: Point, end: Point) -> bool:
        return (
            self._least_sine(start, end) >= self._minimum_sine and self._low - OUTSIDE <= end[1] <= self._high + OUTSIDE
        )

    def _least_sine(self, start: Point, end: Point) -> float:
        """Least abs(sin(theta3 - theta4)) on a straight line; NaN if the linkage opens on it."""
        span = max(abs(end[0] - start[0]), abs(end[1] - start[1]))
        share = np.linspace(0.0, 1.0, max(ceil(span / STEP), 1) + 1)
        theta2 = start[0] + share * (end[0] - start[0])
        theta5 = start[1] + share * (end[1] - start[1])
        sines = np.abs(self._five_bar.transmission_sines(theta2, theta5, self._closure)[:, 0])
        return float(sines.min())
