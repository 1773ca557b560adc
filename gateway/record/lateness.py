"""Why demands were late: the causes, and the account of them that a run leaves in its events.

A demand that missed its deadline is *explained* when what was seen in that very cycle, of things that are not the
loop's own, covers at least the time by which it came too late; in doubt it is not explained.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final, Self

LATE_DEMAND_KIND: Final = "late_demand"
"""Event of one late demand."""
LATE_ACCOUNT_KIND: Final = "late_account"
"""Event of all late demands of the run so far."""
LATE_KINDS: Final = frozenset({LATE_DEMAND_KIND, LATE_ACCOUNT_KIND})
US: Final = 1000


class LateKind(Enum):
    """What was late."""

    RPDO_DEADLINE = "rpdo_deadline"
    """The demand was not on the bus before SYNC."""
    OVERRUN = "overrun"
    """SYNC was a whole cycle late, or more."""


class Cause(Enum):
    """What made a demand late."""

    ANOTHER_PROCESS = "another_process"
    """The loop was ready, and had to wait for a processor."""
    WOKEN_LATE = "woken_late"
    """It slept on beyond its time without being ready: a late timer, an idle state, a host that was away."""
    STOLEN = "stolen"
    """It had the processor by the kernel's account, and got no time: the host ran something else."""
    SYNC_IRREGULAR = "sync_irregular"
    """By the kernel's stamps SYNC was early, or the cycle short."""
    DRIVES_LATE = "drives_late"
    """The loop was awake in time, and the TPDOs were not there."""
    BUS_FULL = "bus_full"
    """The bus did not take the demand at once, or not at all: the own controller was bus-off."""
    PAGE_FAULT = "page_fault"
    """The loop waited for a page of its memory."""
    OWN_CALL = "own_call"
    """The loop gave the processor away in a call of its own, or it cannot be told from that."""
    OWN_WORK = "own_work"
    """The loop itself computed for longer than its share of the cycle."""
    NOT_EXPLAINED = "not_explained"
    """Nothing that was seen covers it."""


IN_WORDS: Final[Mapping[Cause, str]] = {
    Cause.ANOTHER_PROCESS: "another process had the processor",
    Cause.WOKEN_LATE: "woken late",
    Cause.STOLEN: "stolen by the host",
    Cause.SYNC_IRREGULAR: "SYNC irregular",
    Cause.DRIVES_LATE: "drives late",
    Cause.BUS_FULL: "bus full",
    Cause.PAGE_FAULT: "page fault",
    Cause.OWN_CALL: "own call that waits",
    Cause.OWN_WORK: "own work",
    Cause.NOT_EXPLAINED: "no cause seen",
}
OUTSIDE: Final = frozenset(
    {
        Cause.ANOTHER_PROCESS,
        Cause.WOKEN_LATE,
        Cause.STOLEN,
        Cause.SYNC_IRREGULAR,
        Cause.DRIVES_LATE,
        Cause.BUS_FULL,
    }
)
"""Causes that are not the gateway's: these alone explain a miss."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Why one demand, or SYNC, was late."""

    kind: LateKind
    cycle: int
    deadline_ns: int
    missed_by_ns: int
    shares_ns: tuple[tuple[Cause, int], ...]
    """How much of ``missed_by_ns`` each cause covers; their sum is ``missed_by_ns``."""

    @property
    def is_explained(self) -> bool:
        """Whether what is not the gateway's covers all of it."""
        return sum(span for cause, span in self.shares_ns if cause in OUTSIDE) >= self.missed_by_ns

    @property
    def cause(self) -> Cause:
        """The cause to count it under: of one that is not explained, the greatest of those that are the gateway's."""
        is_explained = self.is_explained
        judged = [(span, cause) for cause, span in self.shares_ns if (cause in OUTSIDE) is is_explained]
        return max(judged, key=lambda pair: pair[0])[1] if judged else Cause.NOT_EXPLAINED

    def sentence(self) -> str:
        """In words, microseconds."""
        what = "demand" if self.kind is LateKind.RPDO_DEADLINE else "SYNC"
        shares = ", ".join(f"{IN_WORDS[cause]} {span // US} us" for cause, span in self.shares_ns)
        return f"{what} of cycle {self.cycle} late by {self.missed_by_ns // US} us: {shares}"

    def to_event(self) -> dict[str, str | int | bool]:
        """What the event of it carries beside the sentence."""
        return {
            "what": self.kind.value,
            "cycle": self.cycle,
            "missed_by_us": self.missed_by_ns // US,
            "cause": self.cause.value,
            "is_explained": self.is_explained,
            "shares_us": " ".join(f"{cause.value}:{span // US}" for cause, span in self.shares_ns),
        }


@dataclass(slots=True)
class LateAccount:
    """How many demands were late, and why; grows by ``add``."""

    counts: dict[Cause, int] = field(default_factory=dict[Cause, int])
    spans_us: dict[Cause, int] = field(default_factory=dict[Cause, int])
    """Lateness covered by each cause, of all late demands together."""
    missed: int = 0
    explained: int = 0
    overruns: int = 0
    overruns_explained: int = 0

    def add(self, explanation: Explanation) -> None:
        """Count one."""
        if explanation.kind is LateKind.OVERRUN:
            self.overruns += 1
            self.overruns_explained += explanation.is_explained
            return
        self.missed += 1
        self.explained += explanation.is_explained
        self.counts[explanation.cause] = self.counts.get(explanation.cause, 0) + 1
        for cause, span_ns in explanation.shares_ns:
            self.spans_us[cause] = self.spans_us.get(cause, 0) + span_ns // US

    @property
    def not_explained(self) -> int:
        return self.missed - self.explained

    def verdict(self, missed: int | None = None) -> str:
        """One line: how many of what cause, and how many are not explained.

        ``missed``: how many the samples count, where that is known; those that the account lacks are not explained.
        """
        total = max(self.missed, missed or 0)
        parts = self._parts(cause for cause in Cause if cause in OUTSIDE)
        own = self._parts(cause for cause in Cause if cause not in OUTSIDE and cause is not Cause.NOT_EXPLAINED)
        parts.append(f"{total - self.explained} not explained" + (f" (of these {', '.join(own)})" if own else ""))
        return f"{total}: " + ", ".join(parts) if total else "0"

    def _parts(self, causes: Iterable[Cause]) -> list[str]:
        return [
            f"{self.counts[cause]} {IN_WORDS[cause]} ({self.spans_us.get(cause, 0) / 1000:.1f} ms)"
            for cause in causes
            if self.counts.get(cause)
        ]

    def to_event(self) -> dict[str, str | int]:
        """As the event carries it: few bytes, for an event's slot is small."""
        causes = " ".join(
            f"{cause.value}:{self.counts.get(cause, 0)}:{self.spans_us.get(cause, 0)}"
            for cause in Cause
            if cause in self.counts or cause in self.spans_us
        )
        return {
            "missed": self.missed,
            "explained": self.explained,
            "overruns": self.overruns,
            "overruns_explained": self.overruns_explained,
            "causes": causes,
        }

    @classmethod
    def of_event(cls, data: Mapping[str, Any]) -> Self:
        """The account in an event's data. Raises ValueError or KeyError for one that is none."""
        account = cls(
            missed=int(data["missed"]),
            explained=int(data["explained"]),
            overruns=int(data["overruns"]),
            overruns_explained=int(data["overruns_explained"]),
        )
        for word in str(data["causes"]).split():
            name, count, span_us = word.split(":")
            if int(count):
                account.counts[Cause(name)] = int(count)
            account.spans_us[Cause(name)] = int(span_us)
        return account


@dataclass(frozen=True, slots=True)
class LateDemand:
    """One late demand, as the recording has it."""

    what: LateKind
    cycle: int
    at_ns: int
    missed_by_us: int
    cause: Cause
    is_explained: bool
    shares_us: tuple[tuple[Cause, int], ...]


@dataclass(frozen=True, slots=True)
class LateRecord:
    """What the events of a run say of late demands."""

    account: LateAccount
    worst: tuple[LateDemand, ...]
    """Of those that were told one by one; first those that are not explained, then the latest."""

    def to_json(self, missed: int) -> dict[str, Any]:
        """Stable keys; ``missed``: how many the samples count, so that none can be left out of the account."""
        account = self.account
        total = max(missed, account.missed)
        return {
            "missed_rpdo_deadline": total,
            "explained": account.explained,
            "not_explained": total - account.explained,
            "verdict": account.verdict(missed),
            "by_cause": {
                cause.value: {"count": account.counts.get(cause, 0), "lateness_us": account.spans_us.get(cause, 0)}
                for cause in Cause
                if cause in account.counts or cause in account.spans_us
            },
            "overruns": account.overruns,
            "overruns_explained": account.overruns_explained,
            "worst": [
                {
                    "what": demand.what.value,
                    "cycle": demand.cycle,
                    "missed_by_us": demand.missed_by_us,
                    "cause": demand.cause.value,
                    "is_explained": demand.is_explained,
                    "shares_us": {cause.value: span for cause, span in demand.shares_us},
                }
                for demand in self.worst
            ],
        }


MOST_SHOWN: Final = 50


def late_record(events: Iterable[Mapping[str, Any]], most: int = MOST_SHOWN) -> LateRecord | None:
    """What ``events`` say, with the worst ``most`` demands; None for a run that kept no account."""
    account: LateAccount | None = None
    demands: list[LateDemand] = []
    for data in events:
        if data.get("kind") == LATE_ACCOUNT_KIND:
            account = LateAccount.of_event(data)
        elif data.get("kind") == LATE_DEMAND_KIND and "shares_us" in data:
            demands.append(_late_demand(data))
    if account is None:
        return None
    demands.sort(key=lambda demand: (demand.is_explained, -demand.missed_by_us, demand.cycle))
    return LateRecord(account, tuple(demands[:most]))


def _late_demand(data: Mapping[str, Any]) -> LateDemand:
    pairs = (word.split(":") for word in str(data["shares_us"]).split())
    return LateDemand(
        LateKind(data["what"]),
        int(data["cycle"]),
        int(data["at_ns"]),
        int(data["missed_by_us"]),
        Cause(data["cause"]),
        bool(data["is_explained"]),
        tuple((Cause(name), int(span)) for name, span in pairs),
    )
