"""Node guarding: the answer to the guard request, and life guarding (CiA 301, 7.2.8.2.2.1; 100Ch, 100Dh)."""

from collections.abc import Callable
from typing import Final

from drivers.frame import Frame
from drivers.nmt import HEARTBEAT_BASE, NmtState
from drivers.objects import GUARD_TIME, LIFE_TIME_FACTOR, PRODUCER_HEARTBEAT_TIME
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import LiveDictionary

_TOGGLE: Final = 0x80
_NS_PER_MS: Final = 1_000_000


class NodeGuard:
    """Answers guard requests with the NMT state and a toggle bit, as long as the drive produces no heartbeat.

    From the first request on it misses the next one after guard time times life time factor, neither of them being 0.
    """

    __slots__ = (
        "_cob_id",
        "_deadline_ns",
        "_factor",
        "_guard_time",
        "_heartbeat",
        "_on_change",
        "_outbox",
        "_toggle",
        "is_lost",
    )

    def __init__(
        self,
        node_id: int,
        dictionary: LiveDictionary,
        outbox: list[Frame],
        on_change: Callable[[bool, int], None],
    ) -> None:
        """``on_change(is_lost, now_ns)``: the guarding master has fallen silent, or is back."""
        self._cob_id = HEARTBEAT_BASE + node_id
        self._outbox = outbox
        self._on_change = on_change
        self._heartbeat = dictionary.entry(PRODUCER_HEARTBEAT_TIME)
        self._guard_time = dictionary.entry(GUARD_TIME)
        self._factor = dictionary.entry(LIFE_TIME_FACTOR)
        self._guard_time.on_write = self._on_time
        self._factor.on_write = self._on_time
        self._toggle = 0
        self._deadline_ns: int | None = None
        self.is_lost = False
        """The master's requests have stayed away, and have not come again."""

    def set_node_id(self, node_id: int) -> None:
        """Answer under another node id from now on."""
        self._cob_id = HEARTBEAT_BASE + node_id

    @property
    def _life_time_ns(self) -> int:
        return self._guard_time.value * self._factor.value * _NS_PER_MS

    def restore(self) -> None:
        """Begin anew, as after a boot-up: the first answer has its toggle bit at 0."""
        self._toggle = 0
        self._deadline_ns = None
        self.is_lost = False

    def next_wake_ns(self) -> int | None:
        """When the master will be missed."""
        return self._deadline_ns

    def wake(self, now_ns: int) -> None:
        """Notice that the master has fallen silent."""
        if self._deadline_ns is not None and now_ns >= self._deadline_ns:
            self._deadline_ns = None
            self.is_lost = True
            self._on_change(True, now_ns)

    def on_request(self, state: NmtState, now_ns: int) -> None:
        """Answer a guard request."""
        # One device does not use both ways of error control; the heartbeat wins (CiA 301, 7.5.2.19).
        if self._heartbeat.value:
            return
        self._outbox.append(Frame(self._cob_id, bytes((state | self._toggle,))))
        self._toggle ^= _TOGGLE
        life_time_ns = self._life_time_ns
        self._deadline_ns = now_ns + life_time_ns if life_time_ns else None
        if self.is_lost:
            self.is_lost = False
            self._on_change(False, now_ns)

    def _on_time(self, value: int, now_ns: int) -> AbortCode | None:
        # The guarding begins anew with the next request.
        self._deadline_ns = None
        if self.is_lost:
            self.is_lost = False
            self._on_change(False, now_ns)
        return None
