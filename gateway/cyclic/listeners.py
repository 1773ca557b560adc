"""Who is told what the cycle does: protocols, so that it knows none of them."""

from collections.abc import Sequence
from typing import Protocol

from gateway.cyclic.lateness import Late


class SampleSink(Protocol):
    """Where the cycle's samples go: the shared-memory ring, or a list in virtual time."""

    def append(self, *values: float) -> None:
        """Take one sample, the values in the order of ``SampleLayout.pack_into``."""
        ...


class LateListener(Protocol):
    """Who is told of what was late."""

    def missed(self, late: Late) -> None:
        """A demand was not on the bus before its SYNC, or a SYNC was a cycle late."""
        ...

    def demand_is_out(self, at_ns: int) -> None:
        """The demand that was told as missed before it was on the bus was there at this time."""
        ...


class ErrorObserver(Protocol):
    """Who is shown the following errors in motion, before the next demand is taken; not those of a missed TPDO."""

    def observe(self, master_position: float, master_velocity: float, errors: Sequence[int], is_steady: bool) -> None:
        """Errors in counts, one an axis, and the master's demand (rad, rad/s) for the instant at which they were.

        ``is_steady``: the machine is at speed on the cam, and nothing that is guarded is amiss.
        """
        ...
