"""The command tune: gains of both axes together, their margins, and how they come into file, drives and machine."""

import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gateway.cli.run_commands import VirtualTimeOption
from gateway.cli.terminal import (
    EXIT_NO,
    ChannelOption,
    ConfigArgument,
    InterfaceOption,
    JsonOption,
    PortOption,
    complain,
    messages,
    print_json,
    results,
)

if TYPE_CHECKING:
    from config.schema import GatewayConfig
    from gateway.running.bus_address import BusAddress
    from gateway.running.preparation import PreparedRun
    from gateway.running.session import StopSwitch
    from gateway.tuning.controller import GainPair
    from gateway.tuning.margins import LoopModel
    from gateway.tuning.on_machine import MachineTuning, TrialRun
    from gateway.tuning.search import SearchProgress, Tuning
    from gateway.tuning.steady_cycle import SteadyCycle
    from mechanism.cam import CompiledCam

TUNE_EPILOG = """Examples:

\b
  drive-gateway tune my-machine.yaml                     search, show before and after, write into the file
  drive-gateway tune paper -o tuned.yaml                 a shipped configuration is left as it is
  drive-gateway tune my-machine.yaml --check             margins of the gains that are there
  drive-gateway tune my-machine.yaml --download          write what was found into the drives, too
  drive-gateway tune my-machine.yaml --on-machine        try it step by step on the machine before it is written

Ctrl-C ends the search with the best gains so far. Nothing is written that is unstable or misses its margins.
"""
COARSE_POSITIONS = 18
COARSE_FREQUENCIES = 120
TRIAL_CYCLES = 3


@dataclass(frozen=True, slots=True)
class _Bench:
    """What tunes a configuration: its simulated steady cycle, and its loop at all positions and at few of them."""

    config: "GatewayConfig"
    cam: "CompiledCam"
    cycle: "SteadyCycle"
    model: "LoopModel"
    coarse: "LoopModel"

    def state(self, gains: "GainPair") -> "Tuning":
        from gateway.tuning.search import gains_of, state_tuning

        return state_tuning(self.cycle, self.model, gains_of(gains))


def _bench(config: "GatewayConfig") -> _Bench:
    from gateway.running.preparation import compile_config
    from gateway.tuning.margins import loop_model
    from gateway.tuning.steady_cycle import SteadyCycle
    from sim_drive.closed_loop import closed_loop_of

    cam = compile_config(config)
    if cam.violations:
        complain([str(violation) for violation in cam.violations], EXIT_NO)
    return _Bench(
        config,
        cam,
        SteadyCycle(closed_loop_of(config), config, cam.profile),
        loop_model(config, cam.profile, cam.closure),
        loop_model(config, cam.profile, cam.closure, COARSE_POSITIONS, COARSE_FREQUENCIES),
    )


def _rated(config: "GatewayConfig") -> tuple[float, float]:
    master, slave = config.ordered_axes
    return master.rated_torque_Nm, slave.rated_torque_Nm


@contextmanager
def _search_bar(switch: "StopSwitch") -> "Generator[Callable[[SearchProgress], None]]":
    """A progress bar on standard error while signals press ``switch``; nothing where that is no terminal."""
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[best]}"))
    bar = Progress(*columns, TimeElapsedColumn(), console=messages(), transient=True, disable=not sys.stderr.isatty())
    with bar, switch.installed():
        task = bar.add_task("searching gains", total=1.0, best="")

        def show(now: "SearchProgress") -> None:
            figures = now.best_figures
            best = "" if figures is None else "peak {:.0f} and {:.0f} counts".format(*figures.peak_counts)
            bar.update(task, completed=now.evaluations / now.total, best=best)

        yield show


def _search(bench: _Bench, present: "GainPair", evaluations: int, seed: int) -> "tuple[Tuning, int]":
    from gateway.running.session import StopSwitch
    from gateway.tuning.controller import Gains
    from gateway.tuning.search import GainSearch, TuningGoals, gains_of, search_gains

    search = GainSearch(bench.cycle, bench.coarse, _rated(bench.config), TuningGoals())
    switch = StopSwitch()
    with _search_bar(switch) as show:
        found = search_gains(search, gains_of(present), evaluations, seed, show, lambda: bool(switch.request))
    if switch.request:
        messages().print("stopped: going on with the best gains so far")
    return bench.state((Gains.of(found[0].tolist()), Gains.of(found[1].tolist()))), search.evaluations


def _figure_rows(tuning: "Tuning") -> list[tuple[str, str]]:
    from gateway.tuning.controller import GAIN_NAMES

    margins, figures = tuning.robustness.margins, tuning.figures
    rows = [
        (f"{' '.join(GAIN_NAMES)}, {name}", " ".join(map(str, gains.values)))
        for name, gains in zip(("master", "slave"), tuning.gains, strict=True)
    ]
    if figures is not None:
        for label, unit, pair in (
            ("peak errors, master and slave", "counts", figures.peak_counts),
            ("RMS errors", "counts", figures.rms_counts),
            ("RMS torque ripple", "N m", figures.ripple_Nm),
        ):
            rows.append((label, f"{pair[0]:.3g} and {pair[1]:.3g} {unit}"))
    if not tuning.robustness.is_stable:
        return [*rows, ("loop", "unstable")]
    gain, phase, peak = margins.gain_dB, margins.phase_deg, margins.sensitivity_peak
    return [
        *rows,
        ("gain margin", f"{gain.value:.1f} dB at {gain.theta2_deg:.0f} deg, {gain.frequency_hz:.0f} Hz"),
        ("phase margin", f"{phase.value:.1f} deg at {phase.theta2_deg:.0f} deg, {phase.frequency_hz:.0f} Hz"),
        ("sensitivity peak", f"{peak.value:.2f} at {peak.theta2_deg:.0f} deg, {peak.frequency_hz:.0f} Hz"),
        ("stable with more delay up to", f"{tuning.robustness.delay_margin_s * 1e3:.2f} ms"),
    ]


def _show(bench: _Bench, columns: "dict[str, Tuning]") -> None:
    from rich.table import Table

    table = Table(title=f"{bench.config.name}, {bench.config.motion.speed_rpm:g} rpm: both axes in the steady cycle")
    table.add_column("")
    for heading in columns:
        table.add_column(heading)
    rows = [dict(_figure_rows(tuning)) for tuning in columns.values()]
    for label in dict.fromkeys(label for row in rows for label in row):
        table.add_row(label, *(row.get(label, "") for row in rows))
    results().print(table)


def _measured(bench: _Bench, gains: "GainPair", seed: int) -> dict[str, Any]:
    """Margins from the response of the simulated loop to injected sines, where the model has its least gain margin."""
    from math import radians, tau

    from config.loading import parse_config
    from gateway.tuning.response import FINE_COUNTS, frictionless_text, measure_loop
    from gateway.tuning.search import gains_of
    from sim_drive.closed_loop import closed_loop_of

    fine = parse_config(frictionless_text(bench.config), bench.config.path)
    loop = closed_loop_of(fine)
    own = [axis.counts_per_revolution for axis in bench.config.ordered_axes]
    loop.gains = gains_of(gains) * [[counts / FINE_COUNTS] for counts in own]
    deg = bench.state(gains).robustness.margins.gain_dB.theta2_deg
    theta2 = radians(deg)
    scale = FINE_COUNTS / tau
    theta = (theta2, bench.cam.profile.at(theta2)[0])
    margins = measure_loop(loop, theta, (scale, scale), _rated(fine), seed=seed).margins()
    return {
        "theta2_deg": round(deg, 3),
        "gain_margin_dB": margins.gain_dB.to_json(),
        "phase_margin_deg": margins.phase_deg.to_json(),
        "sensitivity_peak": margins.sensitivity_peak.to_json(),
    }


def _say_measured(measured: dict[str, Any]) -> None:
    gain, phase, peak = (measured[key]["value"] for key in ("gain_margin_dB", "phase_margin_deg", "sensitivity_peak"))
    results().print(
        f"measured with injected sines at theta2 = {measured['theta2_deg']:g} deg, held still:"
        f" gain margin {gain:.1f} dB, phase margin {phase:.1f} deg, sensitivity peak {peak:.2f}",
        soft_wrap=True,
    )


def _check(bench: _Bench, present: "GainPair", seed: int, as_json: bool) -> None:
    stated = bench.state(present)
    names = bench.config.axis_names
    problems = stated.robustness.problems()
    measured = _measured(bench, present, seed) if stated.robustness.is_stable else None
    if as_json:
        document = {"config": str(bench.config.path), **stated.to_json(names), "measured": measured}
        print_json({**document, "problems": problems})
    else:
        _show(bench, {"present": stated})
        if measured is not None:
            _say_measured(measured)
    if problems:
        complain([f"{bench.config.path}: {problem}" for problem in problems], EXIT_NO)


def tune(
    config: ConfigArgument,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write the configuration with its new gains here  [default: into CONFIG]"),
    ] = None,
    is_checking: Annotated[bool, typer.Option("--check", help="State the margins of the present gains alone.")] = False,
    is_downloading: Annotated[
        bool, typer.Option("--download", help="Write the gains into the drives by SDO, verified.")
    ] = False,
    on_machine: Annotated[
        bool,
        typer.Option(
            "--on-machine",
            help="Try the gains on the machine: small steps, short runs; reduced error limits stop it on the cam.",
        ),
    ] = False,
    virtual_time: VirtualTimeOption = False,
    evaluations: Annotated[int, typer.Option(min=1, max=1_000_000, help="How many gains the search tries.")] = 1200,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search and of the simulated resolvers.")] = 1,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    port: PortOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find gains of both axes together under bounds on their margins; write them back, on request into the drives."""
    from config.loading import load_config
    from gateway.errors import GatewayError
    from gateway.running.bus_address import resolve_bus
    from gateway.tuning.controller import Gains

    settings = load_config(config)
    target = None if is_checking else _target(settings, output)
    bench = _bench(settings)
    master, slave = (Gains.from_section(axis.emulation.gains) for axis in settings.ordered_axes)
    present = (master, slave)
    if is_checking:
        _check(bench, present, seed, as_json)
        return
    is_on_bus = is_downloading or (on_machine and not virtual_time)
    address = resolve_bus(settings.bus, interface, channel, port) if is_on_bus else None
    before = bench.state(present)
    after, tried = _search(bench, present, evaluations, seed)
    problems = after.robustness.problems()
    if problems:
        raise GatewayError("the best gains that were found miss what is asked, nothing was written: " + problems[0])
    document: dict[str, Any] = {
        "config": str(settings.path),
        "evaluations": tried,
        "before": before.to_json(settings.axis_names),
        "after": after.to_json(settings.axis_names),
        "measured": _measured(bench, after.gains, seed),
    }
    if not as_json:
        _show(bench, {"before": before, "after": after})
        _say_measured(document["measured"])
    gains = after.gains
    if on_machine:
        tuning = _try_on_machine(settings, gains, address, seed)
        document["on_machine"] = _machine_json(tuning, settings.axis_names)
        if tuning.is_aborted:
            if as_json:
                print_json(document)
            complain([_aborted(tuning)], EXIT_NO)
        gains = tuning.in_force
    if is_downloading and address is not None:
        _download(settings, address, gains)
        document["downloaded_to"] = str(address)
    if target is not None:
        _write(settings, target, gains)
        document["written_to"] = str(target)
    if as_json:
        print_json(document)


def _target(config: "GatewayConfig", output: Path | None) -> Path:
    from config.loading import SHIPPED
    from gateway.errors import UsageError

    if output is not None:
        if not output.parent.is_dir():
            raise UsageError(f"{output}: there is no folder {output.parent}")
        return output
    if config.path.resolve().parent == SHIPPED.resolve():
        raise UsageError(f"{config.path}: ships with the program and is not changed (give --output FILE)")
    return config.path


def _write(config: "GatewayConfig", target: Path, gains: "GainPair") -> None:
    from gateway.tuning.gains_file import with_gains

    text = with_gains(config.text, config.path, config.axis_names, gains)
    # Beside the target first: a full disk must not cost the configuration that is there.
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=target.parent, delete=False) as file:
        file.write(text)
    Path(file.name).chmod(target.stat().st_mode if target.exists() else 0o644)
    Path(file.name).replace(target)
    messages().print(f"gains written to {target}", soft_wrap=True, markup=False)


def _download(config: "GatewayConfig", address: "BusAddress", gains: "GainPair") -> None:
    from gateway.cli.bus_machine import BusMachine

    BusMachine(config, address).write_gains(gains)
    messages().print(f"gains written to both drives on {address}, verified", soft_wrap=True, markup=False)


def _try_on_machine(
    config: "GatewayConfig", wanted: "GainPair", address: "BusAddress | None", seed: int
) -> "MachineTuning":
    from gateway.cli.bus_machine import BusMachine
    from gateway.running.preparation import prepare
    from gateway.running.session import StopSwitch
    from gateway.tuning.on_machine import VirtualTimeMachine, trial_config, tune_on_machine
    from gateway.tuning.search import TuningGoals

    trial = trial_config(config)
    prepared: PreparedRun = prepare(trial, TRIAL_CYCLES)
    switch = StopSwitch()
    if address is None:
        from sim_drive.assembly import build_machine

        machine = VirtualTimeMachine(prepared, build_machine(trial, seed), seed)
    else:
        machine = BusMachine(trial, address, prepared, TRIAL_CYCLES, switch)
    console = messages()

    def on_trial(run: "TrialRun", number: int, of: int) -> None:
        peaks = ", ".join(f"{name} {peak:.0f}" for name, peak in zip(config.axis_names, run.peak_counts, strict=True))
        console.print(f"  run {number} of {of}: {run.stopped_by}, peak errors {peaks} counts", markup=False)

    with switch.installed():
        return tune_on_machine(
            machine,
            wanted,
            TuningGoals().peak_counts,
            on_trial=on_trial,
            is_stopped=lambda: bool(switch.request),
        )


def _aborted(tuning: "MachineTuning") -> str:
    last = tuning.trials[-1]
    return (
        f"run {len(tuning.trials)} was stopped by {last.stopped_by}; the gains that were there are in force again, and"
        " nothing was written"
    )


def _machine_json(tuning: "MachineTuning", names: tuple[str, ...]) -> dict[str, Any]:
    return {
        "trials": [trial.to_json(names) for trial in tuning.trials],
        "is_aborted": tuning.is_aborted,
        "in_force": {name: gains.to_json() for name, gains in zip(names, tuning.in_force, strict=True)},
    }
