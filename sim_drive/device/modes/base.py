"""What every mode of operation is to the axis."""

from typing import ClassVar

from sim_drive.device.motion import Motion


class OperationMode:
    """A mode of operation. It is *active* between ``enter`` and ``leave``: selected, and Operation enabled.

    The base does nothing in every respect.
    """

    __slots__ = ("is_active", "motion")

    is_ticking: ClassVar[bool] = False
    """Whether ``on_tick`` is called while the mode is active."""
    owns_bit_13: ClassVar[bool] = False
    """Whether statusword bit 13 is the mode's, and not the following error's."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.is_active = False

    @property
    def status_bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword, also while the mode is selected and not active."""
        return 0

    def reset(self) -> None:
        """The drive has been reset; the mode is not active."""

    def enter(self, now_ns: int) -> None:
        """The mode has become active: set-points count from now on, and the first one is still to come.

        6040h still holds what was written before, if a controlword is the reason.
        """
        self.is_active = True

    def leave(self, now_ns: int) -> None:
        """The mode is active no longer."""
        self.is_active = False

    def on_tick(self, now_ns: int) -> None:
        """A servo tick, if the mode is active and ``is_ticking``; the demand is read afterwards."""

    def on_sync(self, now_ns: int) -> None:
        """A SYNC, after the synchronous RPDOs have been applied, if the mode is active."""

    def on_controlword(self, value: int, now_ns: int) -> None:
        """A controlword has been written while the mode is active; 6040h still holds the one before."""

    def halt(self, now_ns: int) -> None:
        """Controlword bit 8 has been set while the mode is active, or was set when it became so."""
        self.motion.halt(now_ns)

    def resume(self, now_ns: int) -> None:
        """Controlword bit 8 has been cleared while the mode is active."""


class Holding(OperationMode):
    """Mode 0, no mode: the axis comes to rest, and holds its position."""

    __slots__ = ()

    def enter(self, now_ns: int) -> None:
        """End whatever motion there is."""
        self.is_active = True
        self.motion.slow_down(now_ns)
