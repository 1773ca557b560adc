"""What the emulated machine needs of its drives, and what may stand between them and their surroundings."""

from collections.abc import Callable, Sequence
from typing import Protocol

from drivers.frame import Frame
from drivers.node import Event

FrameHandler = Callable[[bytes, int], None]
"""Takes the data of a frame, and the time in ns."""
Latch = Callable[[int], tuple[int, float, int]]
"""Actual values at an instant (ns): position in counts, velocity in counts/s, torque in per mille of rated torque."""


class DriveAxis(Protocol):
    """What the machine needs of one axis of a drive; `sim_drive.device.axis` has the real one."""

    def measure_by(self, latch: Latch) -> None:
        """Take from ``latch`` what the axis' resolver and amplifier show at an instant."""
        ...

    @property
    def position_demand_counts(self) -> float: ...
    @property
    def torque_offset_Nm(self) -> float: ...  # noqa: N802
    @property
    def velocity_offset(self) -> float:
        """Counts/s that the controller's velocity feed-forward is to have beside the demand's own."""
        ...

    @property
    def torque_demand(self) -> float | None:
        """Not None where ``torque_demand_Nm`` is."""
        ...

    @property
    def torque_demand_Nm(self) -> float | None: ...  # noqa: N802
    @property
    def torque_limit_Nm(self) -> float: ...  # noqa: N802
    @property
    def negative_torque_limit_Nm(self) -> float: ...  # noqa: N802
    @property
    def is_powered(self) -> bool: ...
    @property
    def is_brake_released(self) -> bool: ...
    @property
    def gains(self) -> Sequence[int]: ...
    def on_tick(self, now_ns: int, shaft_counts: int) -> None: ...
    def trip(self, error_code: int, register_bits: int, now_ns: int, *, persists: bool = False) -> None: ...


class MachineDrive(Protocol):
    """What the machine needs of a drive, a node of one or more axes; `sim_drive.device.drive` has the real one."""

    subscriptions_changed: bool
    """Set by the drive when `cob_ids` or `handler_of` has changed, reset by the machine."""

    @property
    def is_wake_stale(self) -> bool:
        """Whether `next_wake_ns` may give something else than when it was asked last."""
        ...

    @property
    def watches_events(self) -> bool:
        """Whether `after_servo_tick` has anything to do."""
        ...

    @property
    def axes(self) -> Sequence[DriveAxis]: ...
    @property
    def outbox(self) -> list[Frame]:
        """Frames to send, oldest first; always the same list, which the machine empties in place."""
        ...

    @property
    def events(self) -> list[Event]:
        """Events, oldest first; always the same list, which the machine empties in place."""
        ...

    def cob_ids(self) -> set[int]: ...
    def handler_of(self, cob_id: int) -> FrameHandler | None:
        """What ``receive`` would do with a data frame of this COB-ID, without the frame around it; None: ask that."""
        ...

    def receive(self, frame: Frame, now_ns: int) -> None: ...
    def next_wake_ns(self) -> int | None: ...
    def wake(self, now_ns: int) -> None: ...
    def after_servo_tick(self, now_ns: int) -> None: ...


class AxisTap(Protocol):
    """What may stand between an axis and its motor, to make faults."""

    @property
    def is_brake_broken(self) -> bool:
        """Whether the holding brake does not hold."""
        ...

    def show(self, counts: int) -> int:
        """What the axis is shown in place of the resolver's counts."""
        ...


class DriveTap(Protocol):
    """What may stand between a drive and its surroundings, to make faults; see `EmulatedMachine.put_tap`."""

    @property
    def axes(self) -> Sequence[AxisTap]:
        """One for each axis of the drive."""
        ...

    def hear(self, frame: Frame, now_ns: int) -> Sequence[Frame]:
        """The frames that reach the drive at once in place of ``frame``."""
        ...

    def tell(self, frame: Frame, now_ns: int) -> Sequence[Frame]:
        """The frames that reach the bus at once in place of ``frame``, which the drive has sent."""
        ...
