"""What a run takes over from the runs before it, and leaves to those after it, of what has been learned."""

from pathlib import Path
from typing import Final

from config.schema import GatewayConfig
from gateway.cyclic.guard import StopReason
from gateway.errors import UsageError
from gateway.learning.law import Learning, build_learning
from gateway.learning.memory_file import cam_crc32, memory_file, read_memory, write_memory
from gateway.running.core import GatewayCore
from mechanism.cam_profile import CamProfile

KEPT_AFTER: Final = frozenset({StopReason.COMPLETED, StopReason.OPERATOR})
"""Ends of a run after which its memory is kept: what a guard has stopped may have learned from what went wrong."""


class LearningStore:
    """The memory of one cam, read before a run and written after it."""

    __slots__ = ("_config", "_memory", "_profile", "path")

    def __init__(self, config: GatewayConfig, profile: CamProfile, path: Path) -> None:
        """``path``: the file, which need not be there yet, or a folder with one for each profile.

        Raises UsageError for a file that is no memory of this profile, and for one that could not be written.
        """
        crc = cam_crc32(profile)
        self._config = config
        self._profile = profile
        self.path: Final = memory_file(path, config.name, crc)
        if not self.path.parent.is_dir():
            raise UsageError(f"{self.path}: cannot be written (there is no folder {self.path.parent})")
        self._memory = read_memory(self.path, crc, config.axis_names)

    def learning(self) -> Learning:
        """Where the runs before have got to; learning begins anew at a speed that has not been run yet."""
        return build_learning(self._config, self._profile, self._memory.nearest(self._config.speed_rad_per_s))

    def keep(self, core: GatewayCore) -> bool:
        """Write what the core has learned, if the run ended as it should; returns whether it was written.

        Raises UsageError where the file cannot be written.
        """
        learned = core.learned
        if learned is None or core.failure is not None or core.stopped_by not in KEPT_AFTER:
            return False
        write_memory(self.path, self._memory.with_learned(learned))
        return True


def open_store(config: GatewayConfig, profile: CamProfile, learn: Path | None) -> LearningStore | None:
    """The store that the command line (``learn``) or else the configuration names; None if neither does.

    Raises UsageError as `LearningStore` does.
    """
    section = config.learning
    if learn is None and section.enabled and section.memory is not None:
        learn = config.path.parent / section.memory
    return None if learn is None else LearningStore(config, profile, learn)
