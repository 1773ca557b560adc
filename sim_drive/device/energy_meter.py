"""The energy meter of a drive: what its axis has drawn, done and lost, as object 3040h in mJ."""

from collections.abc import Callable
from typing import Final

from drivers import objects
from sim_drive.device.motion import Motion, wrap_int32
from sim_drive.physics.driveline import AxisEnergy

_MJ_PER_J: Final = 1000.0


def attach_energy_meter(axis: Motion, energy: Callable[[], AxisEnergy]) -> None:
    """Let 3040h of ``axis`` show what ``energy`` tells; INTEGER32, so modulo 2^32 mJ."""

    def show(subindex: int, tell: Callable[[AxisEnergy], float]) -> None:
        def read(now_ns: int) -> int:
            return wrap_int32(round(tell(energy()) * _MJ_PER_J))

        axis.entry(objects.DRIVE_ENERGY, subindex).on_read = read

    show(1, lambda now: now.drawn)
    show(2, lambda now: now.shaft)
    show(3, lambda now: now.copper)
