"""Keeps account of a soak: hours, sessions by what happened and when, the worst figures, and what was left behind."""

import gc
import math
import os
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

from numba.core import event as numba_event
from soak_judge import Figures, Judge
from soak_scenario import Moment
from soak_session import Session

from gateway.record.sample import Phase

IDLE = (Phase.COMMISSIONING, Phase.DISABLED)
STANDING = (*IDLE, Phase.STANDSTILL)
GROWTH_OBJECTS = 200
GROWTH_KIB = 16 * 1024
LEAST_COUNTS = 3
NOTHING = "nothing"
UNKNOWN = dict.fromkeys(
    ("least_sine", "running_deg", "cam_deg", "effector_mm", "rest_s", "torque_off_s", "shaft_torque_Nm"), math.nan
)


@dataclass
class Worst:
    """The worst that was measured, and the seed of it."""

    value: float = math.nan
    seed: int = -1

    def take(self, value: float, seed: int, is_worse: bool) -> None:
        if not math.isnan(value) and (math.isnan(self.value) or is_worse):
            self.value, self.seed = value, seed

    def take_most(self, value: float, seed: int) -> None:
        self.take(value, seed, value > self.value)

    def take_least(self, value: float, seed: int) -> None:
        self.take(value, seed, value < self.value)


@dataclass
class Line:
    """Of one kind of provocation, or of one kind of stop."""

    sessions: int = 0
    by_moment: dict[str, int] = field(default_factory=dict)
    cam_deg: Worst = field(default_factory=Worst)
    least_sine: Worst = field(default_factory=Worst)
    rest_s: Worst = field(default_factory=Worst)
    torque_off_s: Worst = field(default_factory=Worst)
    shaft_torque_Nm: Worst = field(default_factory=Worst)
    effector_mm: Worst = field(default_factory=Worst)

    def take(self, seed: int, figures: Figures) -> None:
        self.sessions += 1
        self.cam_deg.take_most(figures.cam_deg, seed)
        self.least_sine.take_least(figures.least_sine, seed)
        self.rest_s.take_most(figures.rest_s, seed)
        self.torque_off_s.take_most(figures.torque_off_s, seed)
        self.shaft_torque_Nm.take_most(figures.shaft_torque_Nm, seed)
        self.effector_mm.take_most(figures.effector_mm, seed)

    def merge(self, other: "Line") -> None:
        self.sessions += other.sessions
        for moment, count in other.by_moment.items():
            self.by_moment[moment] = self.by_moment.get(moment, 0) + count
        self.least_sine.take_least(other.least_sine.value, other.least_sine.seed)
        for name in ("cam_deg", "rest_s", "torque_off_s", "shaft_torque_Nm", "effector_mm"):
            theirs: Worst = getattr(other, name)
            getattr(self, name).take_most(theirs.value, theirs.seed)


@dataclass
class Tally:
    """The account of one process, or of several."""

    campaigns: int = 0
    sessions: int = 0
    guarded_s: float = 0.0
    """With the drives enabled, under guard."""
    motion_s: float = 0.0
    """Of which on the way onto the cam, on it, or in a stop."""
    session_s: float = 0.0
    """Of whole sessions, commissioning and recovery included."""
    processor_s: float = 0.0
    happened: dict[str, Line] = field(default_factory=dict)
    stops: dict[str, Line] = field(default_factory=dict)
    reasons: dict[str, int] = field(default_factory=dict)
    at_once: dict[int, int] = field(default_factory=dict)
    """Sessions by how many things have happened in them."""
    unheld: dict[str, int] = field(default_factory=dict)
    """Sessions whose linkage nobody could have held, and why; their figures are in no line."""
    running_deg: Worst = field(default_factory=Worst)
    violations: list[str] = field(default_factory=list)
    grown: dict[str, int] = field(default_factory=dict)
    rss_kib: tuple[int, int] = (0, 0)
    """After the warm-up, and last."""

    def take(self, seed: int, session: Session, judge: Judge) -> None:
        self.sessions += 1
        figures = replace(judge.figures, **UNKNOWN) if judge.unheld else judge.figures
        if judge.unheld:
            self.unheld[judge.unheld] = self.unheld.get(judge.unheld, 0) + 1
        for phase, cycles in session.cycles_in.items():
            self.guarded_s += cycles * 1e-3 * (phase not in IDLE)
            self.motion_s += cycles * 1e-3 * (phase not in STANDING)
        self.session_s += (session.ended_ns - session.started_ns) * 1e-9
        self.running_deg.take_most(figures.running_deg, seed)
        self.stops.setdefault(figures.stop, Line()).take(seed, figures)
        reason = "gateway killed" if session.killed_ns is not None else session.core.stopped_by.value
        self.reasons[reason] = self.reasons.get(reason, 0) + 1
        self.at_once[len(session.fired)] = self.at_once.get(len(session.fired), 0) + 1
        for name in {provocation.name for provocation, _, _ in session.fired} or {NOTHING}:
            self.happened.setdefault(name, Line()).take(seed, figures)
        for provocation, moment, _ in session.fired:
            by_moment = self.happened[provocation.name].by_moment
            by_moment[moment.value] = by_moment.get(moment.value, 0) + 1

    def merge(self, other: "Tally") -> None:
        for name in ("campaigns", "sessions", "guarded_s", "motion_s", "session_s", "processor_s"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for mine, theirs in ((self.happened, other.happened), (self.stops, other.stops)):
            for key, line in theirs.items():
                mine.setdefault(key, Line()).merge(line)
        for mine, theirs in (
            (self.reasons, other.reasons),
            (self.unheld, other.unheld),
            (self.at_once, other.at_once),
        ):
            for reason, count in theirs.items():
                mine[reason] = mine.get(reason, 0) + count
        self.running_deg.take_most(other.running_deg.value, other.running_deg.seed)
        self.violations += other.violations
        for name, count in other.grown.items():
            self.grown[name] = max(self.grown.get(name, 0), count)
        self.rss_kib = max(self.rss_kib, other.rss_kib, key=lambda pair: pair[1] - pair[0])


class Compilations(numba_event.Listener):
    """Counts the kernels that numba compiles: each leaves some thousand objects behind, once and for good."""

    def __init__(self) -> None:
        self.count = 0
        numba_event.register("numba:compile", self)

    def on_start(self, event: numba_event.Event) -> None:
        self.count += 1

    def on_end(self, event: numba_event.Event) -> None:
        pass


COMPILATIONS = Compilations()


class LeakWatch:
    """Counts objects by their type, and the process' memory, between two campaigns, when no machine is alive.

    It begins anew when a kernel was compiled since the last count, as a rare campaign is the first to need one.
    """

    def __init__(self, objects: int = GROWTH_OBJECTS) -> None:
        """``objects``: so many more of a type are not yet a leak."""
        self._objects = objects
        self._counts: list[Counter[str]] = []
        self._rss_kib: list[int] = []
        self._compilations = COMPILATIONS.count

    @property
    def is_telling(self) -> bool:
        """Whether it was counted often enough to tell a leak."""
        return len(self._counts) >= LEAST_COUNTS

    def note(self) -> None:
        """Count now."""
        if COMPILATIONS.count != self._compilations:
            self._compilations = COMPILATIONS.count
            self._counts, self._rss_kib = [], []
        gc.collect()
        self._counts.append(Counter(type(thing).__qualname__ for thing in gc.get_objects()))
        self._rss_kib.append(rss_kib())
        if len(self._counts) > 64:
            # Every second one: the first and the last stay, and the account does not grow.
            self._counts[1:-1:2], self._rss_kib[1:-1:2] = [], []

    def growth(self) -> dict[str, int]:
        """Types of which the least in the last third is more than the most in the first third, by so many."""
        if not self.is_telling:
            return {}
        third = len(self._counts) // 3
        first, last = self._counts[:third], self._counts[-third:]
        grown: dict[str, int] = {}
        for name in set().union(*last):
            more = min(counts[name] for counts in last) - max(counts[name] for counts in first)
            if more > self._objects:
                grown[name] = more
        if third > 1 and min(self._rss_kib[-third:]) - max(self._rss_kib[:third]) > GROWTH_KIB:
            grown["memory, KiB"] = min(self._rss_kib[-third:]) - max(self._rss_kib[:third])
        return grown

    @property
    def rss_kib(self) -> tuple[int, int]:
        return (self._rss_kib[0], self._rss_kib[-1]) if self._rss_kib else (0, 0)


def rss_kib() -> int:
    """Memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:  # noqa: PTH123
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def table(tally: Tally) -> str:
    """For people."""
    moments = sorted({moment for line in tally.happened.values() for moment in line.by_moment}, key=_order)
    titles = f"{'cam deg':>9}{'sine':>7}{'rest s':>8}{'torque off s':>14}{'N m':>7}{'mm':>7}"
    lines = [f"{'what happened':22}{'sessions':>9}{titles}"]
    for title, rows in (("", tally.happened), ("by stop", tally.stops)):
        lines += ["", title] if title else []
        for name, line in sorted(rows.items(), key=lambda row: -row[1].sessions):
            lines.append(
                f"{name:22}{line.sessions:9d}{_text(line.cam_deg, 9, 2)}{_text(line.least_sine, 7, 3)}"
                f"{_text(line.rest_s, 8, 2)}{_text(line.torque_off_s, 14, 2)}{_text(line.shaft_torque_Nm, 7, 1)}"
                f"{_text(line.effector_mm, 7, 1)}"
            )
    lines += ["", f"{'how often, and when':22}" + "".join(f"{moment[:11]:>12}" for moment in moments)]
    for name, line in sorted(tally.happened.items(), key=lambda row: -row[1].sessions):
        if line.by_moment:
            lines.append(f"{name:22}" + "".join(f"{line.by_moment.get(moment, 0):12d}" for moment in moments))
    reasons = ", ".join(f"{name} {count}" for name, count in sorted(tally.reasons.items(), key=lambda r: -r[1]))
    lines += ["", f"ended by: {reasons}"]
    at_once = ", ".join(f"{count} with {number}" for number, count in sorted(tally.at_once.items()))
    lines.append(f"sessions by what happened in each: {at_once}")
    unheld = ", ".join(f"{why} {count}" for why, count in tally.unheld.items())
    lines.append(f"not judged by where the linkage went: {unheld or 'none'}")
    lines.append(f"from the cam with nothing amiss: at most{_text(tally.running_deg, 6, 2)} deg")
    return "\n".join(lines)


def _order(moment: str) -> int:
    return [member.value for member in Moment].index(moment)


def _text(worst: Worst, width: int, digits: int) -> str:
    return f"{'-':>{width}}" if math.isnan(worst.value) else f"{worst.value:{width}.{digits}f}"


def as_json(tally: Tally) -> dict[str, Any]:
    """For programs; NaN is null."""

    def plain(value: Any) -> Any:
        if isinstance(value, float):
            return None if math.isnan(value) else value
        if isinstance(value, dict):
            return {key: plain(own) for key, own in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(own) for own in value]
        return plain(vars(value)) if hasattr(value, "__dict__") else value

    return plain(vars(tally))
