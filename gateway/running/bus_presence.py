"""Whether the gateway's own controller is on the bus, and for how long a session waits for it if not."""

from typing import Final

from drivers.errors import DriveError
from drivers.master import Master, Procedure

NS_PER_S: Final = 1_000_000_000


class BusOffError(DriveError):
    """The own controller has gone bus-off before anything was in motion."""

    def __init__(self) -> None:
        super().__init__(
            "the gateway's CAN controller has gone bus-off; look at bit rate, wiring and termination of the bus"
        )


class BusGivenUpError(DriveError):
    """The own controller has gone bus-off, and has not come back in time."""


class BusPresence:
    """Written by whoever hears of the controller, asked by the session."""

    def __init__(self, master: Master, timeout_s: float) -> None:
        """``timeout_s``: how long the controller may be off before the bus is given up."""
        self.is_off = False
        self._master = master
        self._timeout_s = timeout_s
        self._off_since_ns = 0

    def note(self, is_off: bool, now_ns: int) -> None:
        """The controller is off, or is back, since ``now_ns``."""
        self.is_off = is_off
        self._off_since_ns = now_ns

    @property
    def is_given_up(self) -> bool:
        """Whether the controller has been off for longer than anybody waits."""
        return self.is_off and self._master.now_ns >= self._off_since_ns + round(self._timeout_s * NS_PER_S)

    def wait(self) -> Procedure[None]:
        """Wait until the controller is on the bus. Raises BusGivenUpError."""
        left_s = self._timeout_s - (self._master.now_ns - self._off_since_ns) / NS_PER_S if self.is_off else 0.0
        if not (yield from self._master.wait_for(lambda: not self.is_off, left_s)):
            raise BusGivenUpError(
                f"the gateway's CAN controller has been bus-off for {self._timeout_s:g} s and is not back"
            )
