"""Cores for the tests of the hosts: they do what they are told, and write down what is done to them."""

from collections.abc import Callable

from drivers.frame import Frame
from drivers.node import Event


class ScriptedNode:
    """Sends given frames at given instants, answers frames by a function, keeps a log of (what, instant)."""

    def __init__(
        self,
        sends: dict[int, list[Frame]] | None = None,
        answer: Callable[[Frame, int], list[Frame]] = lambda frame, now_ns: [],
        initial: list[Frame] | None = None,
    ) -> None:
        self.sends = sorted((sends or {}).items())
        self.answer = answer
        self.out = list(initial or [])
        self.events: list[Event] = []
        self.log: list[tuple[str, int]] = []

    @property
    def received(self) -> list[tuple[str, int]]:
        return [entry for entry in self.log if entry[0] != "wake"]

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.log.append((str(frame), now_ns))
        self.events.append(Event(now_ns))
        self.out += self.answer(frame, now_ns)

    def next_wake_ns(self) -> int | None:
        return self.sends[0][0] if self.sends else None

    def wake(self, now_ns: int) -> None:
        self.log.append(("wake", now_ns))
        due = self.next_wake_ns()
        assert due is not None
        assert now_ns >= due
        self.out += self.sends.pop(0)[1]

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        events, self.events = self.events, []
        return events


class PeriodicNode(ScriptedNode):
    """Wakes every ``period_ns`` from ``start_ns`` on, and sends ``frame`` each time if there is one."""

    def __init__(self, period_ns: int, start_ns: int = 0, frame: Frame | None = None) -> None:
        super().__init__()
        self.period_ns = period_ns
        self.due_ns = start_ns
        self.frame = frame

    def next_wake_ns(self) -> int | None:
        return self.due_ns

    def wake(self, now_ns: int) -> None:
        self.log.append(("wake", now_ns))
        self.due_ns = now_ns + self.period_ns
        if self.frame is not None:
            self.out.append(self.frame)


class StuckNode(ScriptedNode):
    """Always wants to be woken at once."""

    def next_wake_ns(self) -> int | None:
        return 0

    def wake(self, now_ns: int) -> None:
        pass
