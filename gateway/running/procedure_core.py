"""A core that carries out one procedure with a master, and is then done: downloads and other work without a cycle."""

from collections.abc import Callable
from typing import Generic, TypeVar

from drivers.errors import DriveError
from drivers.frame import Frame
from drivers.master import Master, Procedure
from drivers.node import Event
from gateway.errors import GatewayError

T = TypeVar("T")


class ProcedureCore(Generic[T]):
    """Implements ``drivers.node.Node``; ``result`` is what the procedure returned, ``failure`` why it did not."""

    def __init__(self, master: Master, make: Callable[[Master], Procedure[T]]) -> None:
        self.is_done = False
        self.result: T | None = None
        self.failure: DriveError | GatewayError | None = None
        self._master = master
        self._procedure = make(master)
        self._resume_at_ns = 0

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Take a frame."""
        self._master.receive(frame, now_ns)
        self._resume(now_ns)

    def next_wake_ns(self) -> int | None:
        """When the procedure or the master's heartbeat is next due; None when the procedure is done."""
        if self.is_done:
            return None
        due = self._master.next_wake_ns()
        return self._resume_at_ns if due is None else min(due, self._resume_at_ns)

    def wake(self, now_ns: int) -> None:
        """Do what is due."""
        self._master.wake(now_ns)
        if now_ns >= self._resume_at_ns:
            self._resume(now_ns)

    def take_frames(self) -> list[Frame]:
        """Frames to send."""
        frames, self._master.outbox = self._master.outbox, []
        return frames

    def take_events(self) -> list[Event]:
        """The master's events."""
        events, self._master.events = self._master.events, []
        return events

    def _resume(self, now_ns: int) -> None:
        if self.is_done:
            return
        self._master.now_ns = now_ns
        try:
            self._resume_at_ns = next(self._procedure)
        except StopIteration as end:
            self.result = end.value
            self.is_done = True
        except (DriveError, GatewayError) as error:
            self.failure = error
            self.is_done = True
