"""What becomes of the own CAN controller's error states: events of the run, and the way back from bus-off."""

from dataclasses import dataclass
from typing import Final, Protocol

from drivers.bus_off import Restarter
from drivers.controller import Controller, ControllerChanged, ErrorState
from drivers.node import Event

TELL_EVERY_NS: Final = 1_000_000_000
"""A controller on the verge changes its state with every other frame: what is not bus-off is told this rarely."""


@dataclass(frozen=True, slots=True)
class RestartTold(Event):
    """What is done about a controller that is bus-off, or why nothing is."""

    text: str


class Listener(Protocol):
    """Who is told."""

    def controller_changed(self, change: ControllerChanged) -> None:
        """The controller has another error state."""
        ...

    def tell(self, event: Event) -> None:
        """Something for the events of the run."""
        ...


class ControllerWatch:
    """Looks at one controller for one listener; to be asked in every pass of a host while that one is restless."""

    def __init__(self, controller: Controller, restarter: Restarter, listener: Listener) -> None:
        self.controller: Final = controller
        self._restarter = restarter
        self._listener = listener
        self._told = ErrorState.ACTIVE
        self._told_ns = -TELL_EVERY_NS

    def look(self, now_ns: int) -> None:
        """Tell what has changed, and do what is due to bring the controller back. While it is off it stays restless."""
        self._tell_state(self.controller, now_ns)
        for text in self._restarter.look(now_ns):
            self._listener.tell(RestartTold(now_ns, text))
        self._tell_state(self.controller, now_ns)

    def _tell_state(self, controller: Controller, now_ns: int) -> None:
        state = controller.state
        is_about_off = state is ErrorState.OFF or self._told is ErrorState.OFF
        if not is_about_off and now_ns - self._told_ns < TELL_EVERY_NS:
            return
        controller.is_restless = state is ErrorState.OFF
        if state is self._told:
            return
        self._told, self._told_ns = state, now_ns
        self._listener.controller_changed(
            ControllerChanged(now_ns, state, controller.transmit_errors, controller.receive_errors)
        )
