"""The monitor: attaches to a running gateway's ring from another process and shows the axis errors live.

It only reads. What it shows is of the last machine cycle, or of the last second while the machine stands.
"""

import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from drivers.cia402 import State, state_of
from gateway.errors import GatewayError
from gateway.record.histograms import CycleCounts, CycleHistograms, Spread, Timing, count_cycles
from gateway.record.lateness import LATE_ACCOUNT_KIND, LATE_KINDS, LateAccount
from gateway.record.ring import RingReader, RunState, attach
from gateway.record.run_constants import RunConstants
from gateway.record.sample import Phase, SampleArray
from gateway.reporting.number_text import number, row_of_numbers

REFRESH_S: Final = 0.1
JSON_INTERVAL_S: Final = 1.0
_STANDING_S: Final = 1.0
_SPARKS: Final = 48
_SPARK_LEVELS: Final = "▁▂▃▄▅▆▇█"
_SHOWN_EVENTS: Final = 6
_STALE_S: Final = 1.0
_MAX_WINDOW: Final = 200_000
"""Samples kept at most: a machine cycle of minutes is shown by its latest part."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AxisView:
    """One axis, now and over the window."""

    name: str
    state: str
    """Of CiA 402, by the statusword."""
    statusword: int
    position_counts: int
    position_deg: float
    error_counts: int
    """Demand - actual, now."""
    error_max_abs_counts: int
    error_rms_counts: float
    torque_nm: float
    torque_max_abs_nm: float
    torque_of_rated: float
    """Now; 1 is the rated torque."""
    errors_over_cycle: tuple[float | None, ...]
    """Mean error in each of equal parts of the machine cycle; None where there is no sample."""


@dataclass(frozen=True, slots=True)
class MonitorView:
    """What the monitor shows at one instant."""

    config: str
    run_state: str
    phase: str
    cycle: int
    machine_cycle: int
    """Whole revolutions of the master since its start."""
    master_rpm: float
    master_deg: float
    axes: tuple[AxisView, ...]
    sync_period_deviation_us: tuple[float, float, float]
    """|period - cycle|: p50, p99, max over the window."""
    wake_lateness_us: tuple[float, float, float]
    loop_cpu_us: float
    counts: CycleCounts
    """In what this monitor has seen: from the oldest sample in the ring on."""
    spreads: dict[Timing, Spread]
    """Of the same."""
    lost_samples: int
    """That this monitor was too slow for; the recorder has its own reader."""
    events: tuple[str, ...]
    """The latest, with their time since the first."""
    late: LateAccount | None
    """Why demands were late, of the whole run, as the loop told it last; None while it has not."""

    def to_json(self) -> dict[str, Any]:
        """Stable keys; axes by their names."""
        view = asdict(self)
        late = self.late
        view["late"] = None if late is None else {**late.to_event(), "verdict": late.verdict()}
        view["axes"] = {axis.name: {k: v for k, v in asdict(axis).items() if k != "name"} for axis in self.axes}
        for key in ("sync_period_deviation_us", "wake_lateness_us"):
            view[key] = dict(zip(("p50", "p99", "max"), view[key], strict=True))
        view |= view.pop("counts")
        view["spread_us"] = {timing.value: spread for timing, spread in view.pop("spreads").items()}
        return view


class Monitor:
    """Collects from a ring what a ``MonitorView`` needs."""

    def __init__(self, reader: RingReader) -> None:
        self._reader = reader
        self._constants = reader.constants
        self._window: SampleArray = np.empty(0, dtype=reader.layout.dtype)
        self._counts = CycleCounts()
        self._histograms = CycleHistograms()
        self._lost = 0
        self._is_attached = False
        self._start_ns: int | None = None
        self._events: list[str] = []
        self._late: LateAccount | None = None

    def update(self) -> None:
        """Take in whatever is new."""
        samples, lost = self._reader.read_new()
        # What the ring had already overwritten when this monitor came is nobody's loss.
        self._lost += lost if self._is_attached else 0
        self._is_attached = True
        self._counts += count_cycles(samples, len(self._constants.axes))
        self._histograms.add(samples)
        self._window = last_cycle(np.concatenate((self._window, samples))[-_MAX_WINDOW:])
        events, _ = self._reader.read_new_events()
        for event in events:
            if event.data.get("kind") == LATE_ACCOUNT_KIND:
                self._late = LateAccount.of_event(event.data)
            if event.data.get("kind") in LATE_KINDS:
                continue
            at_ns = int(event.data["at_ns"])
            self._start_ns = at_ns if self._start_ns is None else self._start_ns
            since_s = (at_ns - self._start_ns) / 1e9
            self._events.append(f"{since_s:.3f} s  {event.data.get('kind', '')}: {event.data.get('text', '')}")
        del self._events[:-_SHOWN_EVENTS]

    def view(self) -> MonitorView | None:
        """What is known now; None before the first sample."""
        window = self._window
        if not len(window):
            return None
        last = window[-1]
        has_period = window["sync_period_ns"] > 0
        deviation = np.abs(window["sync_period_ns"][has_period] - self._constants.period_s * 1e9)
        return MonitorView(
            config=self._constants.config_name,
            run_state=self._reader.state.name.lower(),
            phase=Phase(int(last["phase"])).name.lower(),
            cycle=int(last["cycle"]),
            machine_cycle=math.floor(float(last["master_position"]) / math.tau),
            master_rpm=round(float(last["master_velocity"]) * 60.0 / math.tau, 3),
            master_deg=round(math.degrees(float(last["master_position"]) % math.tau), 3),
            axes=tuple(_axis_view(window, self._constants, axis) for axis in range(len(self._constants.axes))),
            sync_period_deviation_us=_percentiles(deviation),
            wake_lateness_us=_percentiles(window["wake_lateness_ns"].astype(np.float64)),
            loop_cpu_us=round(float(window["loop_cpu_ns"].mean()) / 1e3, 3),
            counts=self._counts,
            spreads={timing: self._histograms.spread(timing) for timing in Timing},
            lost_samples=self._lost,
            events=tuple(self._events),
            late=self._late,
        )


def last_cycle(samples: SampleArray) -> SampleArray:
    """The samples of the last revolution of the master, or of the last second where it has turned less in that time."""
    if not len(samples):
        return samples
    master = samples["master_position"]
    within_turn = np.flatnonzero(np.abs(master - master[-1]) >= math.tau)
    first_of_turn = int(within_turn[-1]) + 1 if len(within_turn) else 0
    if float(samples["master_velocity"][-1]) == 0.0:
        recent = samples["sync_ns"] > samples["sync_ns"][-1] - int(_STANDING_S * 1e9)
        first_of_turn = max(first_of_turn, int(np.argmax(recent)))
    return samples[first_of_turn:]


def _axis_view(window: SampleArray, constants: RunConstants, axis: int) -> AxisView:
    of_axis = constants.axes[axis]
    last = window[-1]
    actual = int(last["position_actual"][axis])
    valid = (window["flags"] & (1 << axis)) == 0
    error = (window["position_demand"][:, axis].astype(np.float64) - window["position_actual"][:, axis])[valid]
    torque = window["torque_actual"][:, axis] * (of_axis.rated_torque_nm / 1000.0)
    statusword = int(last["statusword"][axis])
    return AxisView(
        name=of_axis.name,
        state=state_of(statusword).value,
        statusword=statusword,
        position_counts=actual,
        position_deg=round(
            math.degrees(of_axis.zero_rad) + of_axis.direction * actual * 360.0 / of_axis.counts_per_revolution, 3
        ),
        error_counts=int(last["position_demand"][axis]) - actual,
        error_max_abs_counts=int(np.abs(error).max()) if len(error) else 0,
        error_rms_counts=round(float(np.sqrt(np.mean(np.square(error)))), 3) if len(error) else 0.0,
        torque_nm=round(float(torque[-1]), 4),
        torque_max_abs_nm=round(float(np.abs(torque).max()), 4),
        torque_of_rated=round(float(last["torque_actual"][axis]) / 1000.0, 4),
        errors_over_cycle=_binned(window["master_position"][valid], error),
    )


def _binned(master: FloatArray, error: FloatArray) -> tuple[float | None, ...]:
    slots = np.minimum((np.mod(master, math.tau) * (_SPARKS / math.tau)).astype(np.int64), _SPARKS - 1)
    counts = np.bincount(slots, minlength=_SPARKS)
    sums = np.bincount(slots, weights=error, minlength=_SPARKS)
    return tuple(round(float(s / n), 3) if n else None for s, n in zip(sums, counts, strict=True))


def _percentiles(nanoseconds: FloatArray) -> tuple[float, float, float]:
    if not len(nanoseconds):
        return 0.0, 0.0, 0.0
    p50, p99, most = np.percentile(nanoseconds, (50, 99, 100), method="higher") / 1e3
    return round(float(p50), 3), round(float(p99), 3), round(float(most), 3)


def sparkline(values: tuple[float | None, ...]) -> str:
    """The values as bars around their zero: the lowest level is the least, the highest the greatest."""
    known = [value for value in values if value is not None]
    if not known:
        return " " * len(values)
    low, high = min(known), max(known)
    span = high - low or 1.0
    top = len(_SPARK_LEVELS) - 1
    return "".join(" " if v is None else _SPARK_LEVELS[round((v - low) / span * top)] for v in values)


def _bar(share: float, width: int = 16) -> Text:
    """A bar from the middle, to the right for positive torque; full at the rated torque."""
    half = width // 2
    filled = min(half, round(abs(share) * half))
    empty = " " * (half - filled)
    text = f"{' ' * half}│{'█' * filled}{empty}" if share >= 0 else f"{empty}{'█' * filled}│{' ' * half}"
    return Text(text, style="red" if abs(share) > 1.0 else "cyan")


def _timing(view: MonitorView) -> list[RenderableType]:
    """Every spread of ``Timing`` and every count of ``CycleCounts``, and why deadlines were missed."""
    grid = Table.grid(padding=(0, 2))
    spreads, counts, late = view.spreads, view.counts, view.late
    period, arrival = spreads[Timing.SYNC_PERIOD], spreads[Timing.TPDO_ARRIVAL]
    lead, loop = spreads[Timing.RPDO_LEAD], spreads[Timing.LOOP_TIME]
    for what, figures, which in (
        ("|SYNC period − cycle|", view.sync_period_deviation_us, "p50 / p99 / max, last turn"),
        ("wake-up lateness", view.wake_lateness_us, "p50 / p99 / max, last turn"),
        ("SYNC period", (period.min, period.p50, period.max), "least / p50 / max, as far as seen"),
        ("last TPDO after SYNC", (arrival.p50, arrival.p99, arrival.max), "p50 / p99 / max, as far as seen"),
        ("last RPDO before SYNC", (lead.min, lead.p1, lead.p50), "least / p1 / p50, as far as seen"),
        ("processor time a cycle", (loop.p50, loop.p99, loop.max), "p50 / p99 / max, as far as seen"),
    ):
        grid.add_row(what, row_of_numbers(*figures), which)
    missed = (
        f"{counts.missed_tpdo} TPDO ({counts.late_tpdo} came late), {counts.missed_rpdo_deadline} deadline, "
        f"{counts.overruns} overrun, {counts.sync_lost} SYNC, {counts.bus_errors} bus error, "
        f"{counts.send_buffer_full} buffer full"
    )
    parts: list[RenderableType] = [
        grid,
        Text(f"missed, as far as seen: {missed}", style="bold red" if counts.total else ""),
    ]
    if late is not None:
        style = "bold red" if late.not_explained else ""
        parts.append(Text(f"deadlines of the run, why missed: {late.verdict()}", style=style))
    return parts


def render_view(view: MonitorView, stale_s: float = 0.0) -> RenderableType:
    """The view for a terminal; ``stale_s`` is how old the loop's last sign of life is."""
    head = Text.assemble(
        (view.config, "bold"),
        f"   {view.run_state}   phase ",
        (view.phase.replace("_", " "), "bold"),
        f"   machine cycle {view.machine_cycle}   θ2 {view.master_deg:5.1f}°   {view.master_rpm:.1f} rpm",
        f"   cycle {number(view.cycle)}",
    )
    if stale_s > _STALE_S:
        head.append(f"   no sign of life for {stale_s:.1f} s", style="bold red")
    axes = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in ("axis", "state"):
        axes.add_column(column)
    for column in ("position", "error", "max", "RMS"):
        axes.add_column(column, justify="right")
    axes.add_column("torque")
    axes.add_column("")
    for axis in view.axes:
        enabled = axis.state == State.OPERATION_ENABLED.value
        fault = axis.state in (State.FAULT.value, State.FAULT_REACTION_ACTIVE.value)
        axes.add_row(
            Text(axis.name, style="bold"),
            Text(axis.state, style="green" if enabled else "bold red" if fault else "yellow"),
            f"{number(axis.position_counts)} ({number(math.fmod(axis.position_deg, 360.0), 1)}°)",
            Text(number(axis.error_counts, sign=True), style="bold"),
            number(axis.error_max_abs_counts),
            number(axis.error_rms_counts, 1),
            _bar(axis.torque_of_rated),
            f"{number(axis.torque_nm, 2, sign=True)} N m",
        )
    sparks = Table.grid(padding=(0, 2))
    for axis in view.axes:
        known = [value for value in axis.errors_over_cycle if value is not None]
        scale = f"{number(min(known), 1, sign=True)} … {number(max(known), 1, sign=True)} counts" if known else ""
        sparks.add_row(Text(axis.name, style="bold"), Text(sparkline(axis.errors_over_cycle), style="cyan"), scale)
    parts: list[RenderableType] = [
        head,
        axes,
        Text("error over the machine cycle, counts", style="dim"),
        sparks,
        Text(),
    ]
    parts.extend(_timing(view))
    if view.events:
        parts.extend((Text(), *(Text(line, style="dim", overflow="ellipsis", no_wrap=True) for line in view.events)))
    return Group(*parts)


def monitor(
    name_or_ring: str | Path,
    *,
    once: bool = False,
    as_json: bool = False,
    console: Console | None = None,
    interval_s: float | None = None,
) -> None:
    """Show a run until it ends, or ``once``; ``as_json`` prints a JSON object a line instead, every second.

    Raises ``GatewayError`` where no such run is going on. Ctrl-C ends the monitor, not the run.
    """
    screen = console or Console()
    with attach(name_or_ring) as reader:
        watcher = Monitor(reader)
        try:
            if once:
                _wait_for_a_sample(reader, watcher)
                _show_once(reader, watcher, screen, as_json)
            elif as_json:
                _print_lines(reader, watcher, screen, interval_s or JSON_INTERVAL_S)
            else:
                _show_live(reader, watcher, screen, interval_s or REFRESH_S)
        except KeyboardInterrupt:
            return


def _wait_for_a_sample(reader: RingReader, watcher: Monitor) -> None:
    watcher.update()
    while watcher.view() is None and not reader.is_over():
        time.sleep(REFRESH_S)
        watcher.update()


def _show_once(reader: RingReader, watcher: Monitor, screen: Console, as_json: bool) -> None:
    view = watcher.view()
    if view is None:
        raise GatewayError(f"run of {reader.constants.config_name} ended before its first cycle")
    if as_json:
        _print_line(screen, view)
    else:
        screen.print(render_view(view))


def _print_line(screen: Console, view: MonitorView) -> None:
    screen.file.write(json.dumps(view.to_json(), allow_nan=False) + "\n")
    screen.file.flush()


def _print_lines(reader: RingReader, watcher: Monitor, screen: Console, interval_s: float) -> None:
    is_over = False
    while not is_over:
        is_over = reader.is_over()
        watcher.update()
        view = watcher.view()
        if view is not None:
            _print_line(screen, view)
        if not is_over:
            time.sleep(interval_s)


def _show_live(reader: RingReader, watcher: Monitor, screen: Console, interval_s: float) -> None:
    waiting = Text(f"{reader.constants.config_name}: waiting for the first cycle", style="dim")
    with Live(waiting, console=screen, auto_refresh=False, transient=False) as live:
        is_over = False
        while not is_over:
            is_over = reader.is_over()
            watcher.update()
            view = watcher.view()
            if view is not None:
                live.update(render_view(view, 0.0 if is_over else _silence_s(reader)), refresh=True)
            if not is_over:
                time.sleep(interval_s)
    if not screen.is_terminal:
        screen.line()
    how = "failed" if reader.state is RunState.FAILED else "is over" if reader.state is RunState.FINISHED else "is gone"
    screen.print(f"the run of {reader.constants.config_name} {how}")


def _silence_s(reader: RingReader) -> float:
    beat = reader.heartbeat_ns
    return max(0.0, (time.monotonic_ns() - beat) / 1e9) if beat else 0.0
