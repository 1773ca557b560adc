"""The way back from bus-off, and when it is given up: whose business a restart is, how often, how long apart.

Without I/O but for the link that it is given, and the time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from drivers.can_link import LinkState
from drivers.controller import Controller
from drivers.errors import BusError
from drivers.frame import Frame

NS_PER_S: Final = 1_000_000_000
LOOK_NS: Final = 50_000_000
"""How often the link is asked whether its controller is back: not every driver says so by an error frame."""


class Link(Protocol):
    """The interface of the controller."""

    def read(self) -> LinkState:
        """What it says of itself. Raises BusError."""
        ...

    def restart(self) -> None:
        """Bring the controller back. Raises BusError."""
        ...


@dataclass(frozen=True, slots=True)
class RestartSettings:
    """How a controller is brought back where its interface does not do so by itself."""

    delay_s: float = 0.1
    """After bus-off, and between two attempts: the other nodes need the bus to come to rest."""
    limit: int = 3
    """Restarts in all; a controller that goes off again and again disturbs everybody."""


class Restarter:
    """Brings one controller back after bus-off; ``look`` is called now and then while it is off."""

    def __init__(self, controller: Controller, link: Link | None, settings: RestartSettings) -> None:
        """``link`` None: nothing can be done but wait."""
        self._controller = controller
        self._link = link
        self._settings = settings
        self._delay_ns = round(settings.delay_s * NS_PER_S)
        self._is_off = False
        self._look_ns = 0
        self._restart_ns: int | None = None
        self.restarts = 0

    def losing(self, send: Callable[[Frame], bool]) -> Callable[[Frame], bool]:
        """``send``, but for what would be sent while the controller is off: nobody is to send it later."""
        controller = self._controller

        def send_or_lose(frame: Frame) -> bool:
            return controller.is_off or send(frame)

        return send_or_lose

    def look(self, now_ns: int) -> list[str]:
        """Do what is due at ``now_ns``; returns what there is to tell, in sentences."""
        if not self._controller.is_off:
            self._is_off = False
            return []
        if not self._is_off:
            self._is_off = True
            return self._went_off(now_ns)
        link = self._link
        if link is None:
            return []
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + LOOK_NS
            self._ask(link)
            if not self._controller.is_off:
                return []
        if self._restart_ns is not None and now_ns >= self._restart_ns:
            return self._restart(link, now_ns)
        return []

    def _went_off(self, now_ns: int) -> list[str]:
        self._look_ns = now_ns + LOOK_NS
        self._restart_ns = None
        if self._link is None:
            return ["this interface offers no restart: it has to come back by itself"]
        try:
            restart_ms = self._link.read().restart_ms
        except BusError as error:
            return [str(error)]
        if restart_ms:
            return [f"the kernel restarts it after {restart_ms} ms"]
        if self.restarts >= self._settings.limit:
            return [f"it has been restarted {self.restarts} times, and is not restarted any more"]
        self._restart_ns = now_ns + self._delay_ns
        return [f"it is restarted after {self._settings.delay_s * 1e3:g} ms"]

    def _ask(self, link: Link) -> None:
        try:
            state = link.read().state
        except BusError:
            # An interface that has gone is told by its port.
            return
        if state is not None:
            self._controller.change(state)

    def _restart(self, link: Link, now_ns: int) -> list[str]:
        self._restart_ns = None
        self.restarts += 1
        try:
            link.restart()
        except BusError as error:
            return [str(error)]
        # One that does not come back by this is restarted again.
        if self.restarts < self._settings.limit:
            self._restart_ns = now_ns + max(self._delay_ns, LOOK_NS)
        self._look_ns = now_ns
        return [f"it has been restarted ({self.restarts} of at most {self._settings.limit} times)"]
