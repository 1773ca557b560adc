"""Progress of a synthesis on standard error: a live panel on a terminal, else a line now and then."""

import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

if TYPE_CHECKING:
    from gateway.synthesis.run_search import SearchStatus

LINE_EVERY_S = 2.0


class SynthesisProgress:
    """Told of every status; shows evaluations a second, starts, and the terms of the best mechanism."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: Live | None = None
        self._began_s = time.monotonic()
        self._evaluations_before: int | None = None
        self._last_line_s = self._began_s

    @contextmanager
    def shown(self) -> "Generator[SynthesisProgress]":
        """While this lasts the progress is shown."""
        if not sys.stderr.isatty():
            yield self
            return
        with Live(console=self._console, refresh_per_second=8, transient=True) as live:
            self._live = live
            yield self

    def update(self, status: "SearchStatus") -> None:
        """Show where the search stands."""
        now_s = time.monotonic()
        if self._evaluations_before is None:
            # The first slice may have come with compiling the kernels; what it did is no rate.
            self._evaluations_before, self._began_s = status.evaluations, now_s
        if self._live is not None:
            self._live.update(self._panel(status, self._rate(status, now_s)))
        elif now_s - self._last_line_s >= LINE_EVERY_S:
            self._last_line_s = now_s
            self._console.print(f"  {progress_line(status, self._rate(status, now_s))}", soft_wrap=True, markup=False)

    def _rate(self, status: "SearchStatus", now_s: float) -> float | None:
        done = status.evaluations - (self._evaluations_before or 0)
        return done / (now_s - self._began_s) if done > 0 and now_s > self._began_s else None

    def _panel(self, status: "SearchStatus", rate: float | None) -> Table:
        settings = status.settings
        table = Table.grid(padding=(0, 2))
        table.add_row(progress_line(status, rate))
        table.add_row(ProgressBar(total=settings.budget * settings.starts, completed=status.evaluations, width=60))
        best = status.best
        if best is not None:
            for entry, value in zip(settings.task.terms, best.terms, strict=True):
                table.add_row(f"  {entry.term.value:<20}{value:>14.6g}   weight {entry.weight:g}")
        return table


def progress_line(status: "SearchStatus", rate: float | None) -> str:
    """Evaluations, evaluations a second, starts and the best objective, in a line."""
    settings = status.settings
    speed = "" if rate is None else ", " + f"{rate:,.0f} a second".replace(",", " ")
    best = "nothing found yet" if status.best is None else f"best {status.best.objective:.6g}"
    return (
        f"{settings.method.value}: {status.evaluations} of {settings.budget * settings.starts} evaluations{speed}; "
        f"{status.finished_starts} of {settings.starts} starts done; {best}"
    )
