"""The drive's own watch over SYNC and set-points: no standard has an object for it, so the configuration names it."""

from enum import Enum
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from config.model import Model


class WatchdogUnit(Enum):
    """What the drive counts its watchdog in."""

    CYCLES = "cycles"
    """Missed cycles, SYNCs or interpolation times."""
    MILLISECONDS = "ms"
    HUNDRED_MICROSECONDS = "100us"
    MICROSECONDS = "us"


_UNIT_US: Final = {
    WatchdogUnit.MILLISECONDS: 1000,
    WatchdogUnit.HUNDRED_MICROSECONDS: 100,
    WatchdogUnit.MICROSECONDS: 1,
}


class SyncWatchdogSection(Model):
    """A manufacturer's object by which the drive faults when SYNC, or its set-point, has not come for some cycles.

    Commissioning writes it and reads it back. A drive whose watchdog cannot be set needs none of this.
    """

    index: Annotated[int, Field(ge=0x1000, le=0x9FFF)]
    subindex: Annotated[int, Field(ge=0, le=254)] = 0
    bits: Literal[8, 16, 32] = 16
    """Width of the object, an unsigned integer."""
    unit: WatchdogUnit = WatchdogUnit.CYCLES
    cycles: Annotated[int, Field(ge=2, le=10_000)]
    """Cycles without a SYNC after which the drive is to fault."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.unit is WatchdogUnit.CYCLES and self.cycles >> self.bits:
            raise ValueError(f"cycles: {self.cycles} does not fit the object's {self.bits} bits")
        return self

    def value(self, cycle_us: int) -> int:
        """What the object is to hold at this cycle; a time that the unit cannot say is rounded up."""
        if self.unit is WatchdogUnit.CYCLES:
            return self.cycles
        return -(-self.cycles * cycle_us // _UNIT_US[self.unit])

    def check(self, name: str, cycle_us: int, sync_gap_cycles: int) -> None:
        """Raise ValueError if it does not fit the bus' cycle, or trips before the gateway's own guard.

        ``name``: of the axis; ``sync_gap_cycles``: ``guard.sync_lost.limit_cycles``.
        """
        value = self.value(cycle_us)
        if value >> self.bits:
            raise ValueError(
                f"axes.{name}.sync_watchdog.cycles: {self.cycles} cycles of {cycle_us} us are {value} "
                f"{self.unit.value}, which does not fit the object's {self.bits} bits"
            )
        if self.cycles <= sync_gap_cycles:
            raise ValueError(
                f"axes.{name}.sync_watchdog.cycles: {self.cycles} is not above guard.sync_lost.limit_cycles "
                f"({sync_gap_cycles}), the drive would fault before the gateway could stop both axes together"
            )
