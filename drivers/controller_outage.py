"""A node whose CAN controller goes bus-off and comes back, on any host: a run's trial by injected faults."""

from collections.abc import Iterable
from typing import Final, Protocol

from drivers.controller import ControllerChanged, ErrorState
from drivers.frame import Frame
from drivers.node import Event, Node

OFF_TRANSMIT_ERRORS: Final = 248
"""The transmit error counter just before bus-off: every failed frame counts 8 (ISO 11898-1), up to 255."""


class ControlledNode(Node, Protocol):
    """A node that wants to know how its controller is."""

    def controller_changed(self, change: ControllerChanged) -> None:
        """The controller has another error state."""
        ...


class ControllerOutage:
    """The node, cut off from the bus for spans of time: it neither hears nor is heard, and is told so."""

    def __init__(self, node: ControlledNode, spans_ns: Iterable[tuple[int, int | None]]) -> None:
        """``spans_ns``: when the controller goes off and when it is back, in order and apart; None: never."""
        self._node = node
        self._turns = [turn for span in spans_ns for turn in span if turn is not None]
        self.is_off = False

    def receive(self, frame: Frame, now_ns: int) -> bool | None:
        """See Node."""
        has_turned = self._turn(now_ns)
        answer = False if self.is_off else self._node.receive(frame, now_ns)
        return None if has_turned else answer

    def next_wake_ns(self) -> int | None:
        """See Node."""
        due_ns = self._node.next_wake_ns()
        if not self._turns:
            return due_ns
        return self._turns[0] if due_ns is None else min(due_ns, self._turns[0])

    def wake(self, now_ns: int) -> bool | None:
        """See Node."""
        has_turned = self._turn(now_ns)
        due_ns = self._node.next_wake_ns()
        answer = self._node.wake(now_ns) if due_ns is not None and due_ns <= now_ns else False
        return None if has_turned else answer

    def take_frames(self) -> list[Frame]:
        """See Node."""
        frames = self._node.take_frames()
        return [] if self.is_off else frames

    def take_events(self) -> list[Event]:
        """See Node."""
        return self._node.take_events()

    def _turn(self, now_ns: int) -> bool:
        has_turned = False
        while self._turns and self._turns[0] <= now_ns:
            at_ns = self._turns.pop(0)
            self.is_off = not self.is_off
            state = ErrorState.OFF if self.is_off else ErrorState.ACTIVE
            self._node.controller_changed(ControllerChanged(at_ns, state, OFF_TRANSMIT_ERRORS * self.is_off, 0))
            has_turned = True
        return has_turned
