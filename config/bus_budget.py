"""What a configuration puts on the bus, in microseconds of wire time at worst-case bit stuffing."""

import math
from dataclasses import dataclass
from typing import Final

from drivers.frame import WORST_CASE_BITS

MAX_BUS_LOAD: Final = 0.9
"""Share of the cycle that may be taken; the rest is for EMCY, NMT, repeated frames and a clock that is not ours."""
CYCLIC_FRAME_BYTES: Final = 8
"""RPDO and TPDO each carry a word, a position and a torque."""
HEARTBEAT_BYTES: Final = 1
SDO_BYTES: Final = 8
LATEST_TPDO: Final = 0.8
"""The TPDOs' deadline is at this share of the cycle at the latest."""
HOST_LEAST_US: Final = 250.0
"""What the gateway's own work may take on a bus without a wire: python-can's sockets and a busy host."""
HOST_MARGIN: Final = 0.05
"""Share of the cycle that the gateway's own work may take after the TPDOs' deadline."""
_MAX_VALUE: Final = 255


@dataclass(frozen=True, slots=True)
class BudgetRow:
    """One kind of frame."""

    what: str
    data_bytes: int
    frames_a_cycle: float
    wire_us: float
    """Wire time a cycle, in the mean."""


@dataclass(frozen=True, slots=True)
class BusBudget:
    """The frames of a cycle, and what they leave of it."""

    cycle_us: int
    bit_rate: int
    axes: int
    rows: tuple[BudgetRow, ...]

    @property
    def wire_us(self) -> float:
        """Wire time of all rows a cycle."""
        return sum(row.wire_us for row in self.rows)

    @property
    def load(self) -> float:
        """Share of the cycle that is taken."""
        return self.wire_us / self.cycle_us

    @property
    def is_within_bound(self) -> bool:
        return self.load <= MAX_BUS_LOAD

    @property
    def shortest_cycle_us(self) -> int:
        """The shortest cycle that fits and can be said in 60C2h."""
        heartbeats = sum(row.wire_us for row in self.rows if row.what == HEARTBEATS) / self.cycle_us
        fixed_us = sum(row.wire_us for row in self.rows if row.what != HEARTBEATS)
        return representable_cycle_us(math.ceil(round(fixed_us / (MAX_BUS_LOAD - heartbeats), 6)))

    @property
    def tpdo_deadline_us(self) -> float:
        """How long after SYNC TPDOs can be waited for, so that the RPDOs are still on the bus before the next SYNC.

        Before it the RPDOs, one frame that has just begun, and the host's own work must find their time.
        """
        frame_us = _wire_us(CYCLIC_FRAME_BYTES, self.bit_rate)
        left_us = self.cycle_us * (1.0 - HOST_MARGIN) - (self.axes + 1) * frame_us
        # On a bus so full that nothing is left, the TPDOs must at least have had the time that they take.
        least_us = _wire_us(0, self.bit_rate) + self.axes * frame_us
        return min(LATEST_TPDO * self.cycle_us, max(left_us, least_us))


HEARTBEATS: Final = "heartbeats"


def deadline_without_wire_us(cycle_us: int) -> float:
    """How long after SYNC TPDOs can be waited for where frames take no time."""
    return max(min(LATEST_TPDO * cycle_us, cycle_us - HOST_LEAST_US), 0.5 * cycle_us)


def bus_budget(axes: int, cycle_us: int, bit_rate: int, heartbeat_ms: int, sdo_frames_a_cycle: int) -> BusBudget:
    """The budget of ``axes`` drives: SYNC, a PDO each way, heartbeats of drives and gateway, the reserve for SDO."""

    def row(what: str, data_bytes: int, frames: float) -> BudgetRow:
        return BudgetRow(what, data_bytes, frames, frames * _wire_us(data_bytes, bit_rate))

    rows = (
        row("SYNC", 0, 1),
        row("RPDOs", CYCLIC_FRAME_BYTES, axes),
        row("TPDOs", CYCLIC_FRAME_BYTES, axes),
        row(HEARTBEATS, HEARTBEAT_BYTES, (axes + 1) * cycle_us / (heartbeat_ms * 1000)),
        row("SDO reserve", SDO_BYTES, sdo_frames_a_cycle),
    )
    return BusBudget(cycle_us, bit_rate, axes, rows)


def representable_cycle_us(cycle_us: int) -> int:
    """The shortest cycle from ``cycle_us`` on that 60C2h can say: 1 to 255 times a power of ten."""
    unit = 1
    while -(-cycle_us // unit) > _MAX_VALUE:
        unit *= 10
    return -(-cycle_us // unit) * unit


def _wire_us(data_bytes: int, bit_rate: int) -> float:
    return WORST_CASE_BITS[data_bytes] / bit_rate * 1e6
