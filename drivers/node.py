"""The seam: what every protocol and control core looks like to the host that drives it."""

from dataclasses import dataclass
from typing import Protocol

from drivers.frame import Frame


@dataclass(frozen=True, slots=True)
class Event:
    """Something a core has noticed; ``at_ns`` is the time it was handed when it noticed."""

    at_ns: int


class Node(Protocol):
    """A core: it is given frames and the time and never asks for them.

    The host's duties: time never runs backwards; ``wake`` is called at or after ``next_wake_ns``, never before, and
    before any frame received later than it; ``take_frames`` is called after every ``receive`` and ``wake`` whose answer
    is not False.
    """

    def receive(self, frame: Frame, now_ns: int) -> bool | None:
        """Take a frame that another node has sent.

        False: nothing has come of it, neither a frame nor an event, and ``next_wake_ns`` is what it was, so that the
        host need not ask. A core that answers nothing is asked.
        """
        ...

    def next_wake_ns(self) -> int | None:
        """When the core next wants ``wake``, or None while it waits for frames alone."""
        ...

    def wake(self, now_ns: int) -> bool | None:
        """Do whatever is due at ``now_ns``.

        False: neither a frame nor an event has come of it, so that the host need ask for the next wake alone.
        """
        ...

    def take_frames(self) -> list[Frame]:
        """Frames to be sent, oldest first; they are the caller's from here on."""
        ...

    def take_events(self) -> list[Event]:
        """Events since the last call, oldest first."""
        ...
