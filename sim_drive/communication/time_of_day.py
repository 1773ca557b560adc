"""Consumer of TIME messages (CiA 301, 7.2.6; 1012h), which keeps the time of day between them."""

from collections.abc import Callable
from typing import Final, NamedTuple

from drivers.objects import COB_ID_TIME, TIME_OF_DAY
from drivers.sdo import AbortCode
from sim_drive.communication.cob_ids import COB_ID_MASK, is_refused
from sim_drive.communication.dictionary import LiveDictionary

TIME_LENGTH: Final = 6
MS_PER_DAY: Final = 86_400_000

_CONSUME: Final = 1 << 31
_PRODUCE: Final = 1 << 30
_MILLISECONDS_MASK: Final = 0x0FFFFFFF
_MAX_DAYS: Final = 0xFFFF
_NS_PER_MS: Final = 1_000_000


class TimeOfDay(NamedTuple):
    """TIME_OF_DAY of CiA 301, 7.1.6.5: UNSIGNED28 milliseconds after midnight, UNSIGNED16 days since 1984-01-01."""

    days: int
    milliseconds: int


class TimeConsumer:
    """Takes TIME messages where 1012h says so; 3030h shows the time of day, 0 before the first message."""

    __slots__ = ("_cob_id", "_heard", "_heard_at_ns", "_on_subscription")

    def __init__(self, dictionary: LiveDictionary, on_subscription: Callable[[], None]) -> None:
        """``on_subscription()``: ``cob_id`` has changed."""
        self._on_subscription = on_subscription
        self._heard: TimeOfDay | None = None
        self._heard_at_ns = 0
        self._cob_id = dictionary.entry(COB_ID_TIME)
        self._cob_id.on_write = self._on_cob_id
        dictionary.entry(TIME_OF_DAY, 1).on_read = lambda now_ns: (self.now(now_ns) or _NEVER_SET).milliseconds
        dictionary.entry(TIME_OF_DAY, 2).on_read = lambda now_ns: (self.now(now_ns) or _NEVER_SET).days

    @property
    def cob_id(self) -> int | None:
        """Where TIME messages are expected; None if they are not."""
        value = self._cob_id.value
        return value & COB_ID_MASK if value & _CONSUME else None

    def forget(self) -> None:
        """The clock has stopped, as after a power cycle."""
        self._heard = None

    def now(self, now_ns: int) -> TimeOfDay | None:
        """The time of day at ``now_ns``, None as long as no TIME message has come."""
        if self._heard is None:
            return None
        passed_ms = (now_ns - self._heard_at_ns) // _NS_PER_MS
        more_days, milliseconds = divmod(self._heard.milliseconds + passed_ms, MS_PER_DAY)
        return TimeOfDay((self._heard.days + more_days) & _MAX_DAYS, milliseconds)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take a TIME message; one of another length, or with more than a day of milliseconds, is none."""
        milliseconds = int.from_bytes(data[:4], "little") & _MILLISECONDS_MASK
        if len(data) != TIME_LENGTH or milliseconds >= MS_PER_DAY:
            return
        self._heard = TimeOfDay(int.from_bytes(data[4:6], "little"), milliseconds)
        self._heard_at_ns = now_ns

    def _on_cob_id(self, value: int, now_ns: int) -> AbortCode | None:
        if value & _PRODUCE or is_refused(value, self._cob_id.value, _CONSUME):
            return AbortCode.VALUE_RANGE_EXCEEDED
        self._cob_id.value = value
        self._on_subscription()
        return None


_NEVER_SET: Final = TimeOfDay(0, 0)
