"""Commands that move a machine, real or emulated: run, demo."""

import json
import math
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from gateway.cli.terminal import (
    EXIT_NO,
    ChannelOption,
    ConfigArgument,
    InterfaceOption,
    JsonOption,
    OverwriteOption,
    PortOption,
    complain,
    messages,
    print_json,
    require_absent,
    results,
)

if TYPE_CHECKING:
    from config.schema import GatewayConfig
    from gateway.cli.event_lines import EventLines
    from gateway.cli.paper_demo import VirtualRunner
    from gateway.record.recording import Recording
    from gateway.running.bus_address import BusAddress
    from gateway.running.learning_store import LearningStore
    from gateway.running.preparation import PreparedRun
    from sim_drive.machine import EmulatedMachine

RUN_EPILOG = """Examples:

\b
  drive-gateway run paper                                  on the configured bus, e.g. against sim-drive
  drive-gateway run my-machine.yaml -i socketcan -c can0 --cycles 100 --record run.mcap
  drive-gateway run paper --from-here                      after a stop, from where the linkage stands
  drive-gateway run paper --virtual-time --seed 1 --json   gateway and emulator in virtual time
  drive-gateway run paper --learn memory.json              learn from cycle to cycle, go on where the last run ended

The first Ctrl-C does what guard.sigint says (by default a controlled stop: the master ramps down, the slave stays on
the cam). A second one is a quick stop: the master's drive stops on its own ramp, the slave stays on the cam meanwhile.
"""
DEMO_EPILOG = """Examples:

\b
  drive-gateway demo                     vcan0 where it is up, else socketcand on 127.0.0.1
  drive-gateway demo --channel vcan1     another interface
  drive-gateway demo --cycles 3 -o /tmp/demo --json
  drive-gateway demo --paper             the paper's measurements beside the emulated machine's, in virtual time
"""
VirtualTimeOption = Annotated[
    bool,
    typer.Option("--virtual-time", help="Gateway and emulated machine together in virtual time, no bus, no waiting."),
]
CyclesOption = Annotated[
    int | None,
    typer.Option(
        "--cycles", "-n", min=1, max=1_000_000, help="Machine cycles at constant speed  [default: from CONFIG]"
    ),
]


@contextmanager
def _progress() -> Generator[tuple[Progress, Any]]:
    """A progress bar on standard error; nothing where that is no terminal."""
    progress = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[figure]}"),
        TimeElapsedColumn(),
        console=messages(),
        transient=True,
        disable=not sys.stderr.isatty(),
    )
    with progress:
        yield progress, progress.add_task("preparing", total=1.0, figure="")


@contextmanager
def _event_lines(console: Console) -> "Generator[EventLines]":
    """The events of a run on the progress bar's own console, which makes room for them; its steps too where there is
    no terminal, and so no bar.
    """
    from gateway.cli.event_lines import EventLines

    lines = EventLines(
        lambda text, style: console.print(text, style=style, markup=False, soft_wrap=True),
        with_steps=not console.is_terminal,
    )
    try:
        yield lines
    finally:
        lines.close()


def _prepare(config: "GatewayConfig", cycles: int | None) -> "tuple[PreparedRun, str]":
    from gateway.running.preparation import prepare
    from mechanism.cam_file import cam_document

    prepared = prepare(config, cycles)
    return prepared, json.dumps(cam_document(prepared.cam))


def _run_on_bus(
    prepared: "PreparedRun",
    cam: str,
    address: "BusAddress",
    recording: Path,
    cycles: int,
    is_overwriting: bool,
    frames: bool | None,
    is_homing_again: bool = False,
    learn: Path | None = None,
    is_starting_anywhere: bool = False,
) -> None:
    from gateway.running.session import Progress as RunProgress
    from gateway.running.session import StopSwitch, run_realtime

    switch = StopSwitch()
    with _progress() as (progress, task), switch.installed(), _event_lines(progress.console) as lines:

        def on_progress(now: RunProgress) -> None:
            lines.tick(time.monotonic_ns())
            progress.update(
                task,
                description=now.step,
                completed=now.machine_cycles / now.total_machine_cycles,
                figure=f"{now.machine_cycles:.1f} of {now.total_machine_cycles:.0f} revolutions",
            )

        run_realtime(
            prepared,
            address,
            recording,
            cam,
            switch,
            machine_cycles=cycles,
            is_overwriting=is_overwriting,
            with_frames=address.interface == "socketcan" if frames is None else frames,
            is_homing_again=is_homing_again,
            is_starting_anywhere=is_starting_anywhere,
            learn=learn,
            on_progress=on_progress,
            on_event=lines.tell,
        )


def _paper_runner(seed: int) -> "VirtualRunner":
    def run(prepared: "PreparedRun", cam: str, recording: Path, machine: "EmulatedMachine") -> None:
        _run_virtually(prepared, cam, recording, seed, True, False, machine=machine)

    return run


def _run_virtually(
    prepared: "PreparedRun",
    cam: str,
    recording: Path,
    seed: int,
    is_overwriting: bool,
    with_frames: bool = True,
    store: "LearningStore | None" = None,
    machine: "EmulatedMachine | None" = None,
) -> float:
    """Carry out the run in virtual time; returns machine seconds per second. ``machine``: not the configuration's."""
    from gateway.running.core import GatewayCore
    from gateway.running.cyclic_process import pass_on_stop
    from gateway.running.session import StopSwitch
    from gateway.running.virtual_run import run_virtual
    from sim_drive.assembly import build_machine

    if machine is None:
        machine = build_machine(prepared.config, seed)
    switch = StopSwitch()
    started = time.monotonic()
    reached_s = 0.0
    answered = 0
    with _progress() as (progress, task), switch.installed(), _event_lines(progress.console) as lines:

        def on_progress(at_s: float, core: GatewayCore) -> None:
            nonlocal reached_s, answered
            reached_s = at_s
            answered = pass_on_stop(core, switch.request, answered)
            speed = at_s / max(time.monotonic() - started, 1e-9)
            progress.update(
                task,
                description="virtual time",
                completed=at_s / (prepared.plan.duration_s + 0.3),
                figure=f"{at_s:.1f} s, {speed:.0f} times real time",
            )

        core = run_virtual(
            prepared,
            machine,
            recording,
            cam,
            seed,
            is_overwriting=is_overwriting,
            with_frames=with_frames,
            learning=None if store is None else store.learning(),
            on_progress=on_progress,
            on_event=lines.tell,
        )
    if store is not None and store.keep(core):
        messages().print(f"what was learned is in {store.path}", soft_wrap=True, markup=False)
    if core.failure is not None:
        raise core.failure
    return reached_s / (time.monotonic() - started)


def _where_the_machine_stands(read: "Recording") -> str:
    """Angles of the axes at a recording's end; nothing if they never left home."""
    from gateway.reporting.run_data import prepare

    data = prepare(read.samples, read.constants)
    if not data.is_following.any():
        return ""
    angles = zip(read.constants.axis_names, data.angle_rad[-1], strict=True)
    return ", ".join(f"{name} at {math.degrees(angle) % 360.0:.1f} deg" for name, angle in angles)


def _show(recording: Path, as_json: bool, report_folder: Path | None, is_machine_left: bool = False) -> None:
    """Print the figures of a recording, write the report if asked, and end with 1 if the machine was stopped early.

    ``is_machine_left``: the machine stays where the run left it, and the next run must not take that for home.
    """
    from gateway.cyclic.guard import StopReason
    from gateway.record.recording import read_recording
    from gateway.reporting.analysis import analyse
    from gateway.reporting.report import write_report
    from gateway.reporting.report_text import render_report

    read = read_recording(recording)
    if not len(read.samples):
        complain([f"the run ended before its first cycle, it was stopped by: {read.stopped_by}"], EXIT_NO)
    figures = analyse(read)
    written = write_report(recording, report_folder) if report_folder is not None else []
    if as_json:
        print_json(figures.to_json())
    else:
        results().print(render_report(figures))
    console = messages()
    for path in written:
        if path.name == "report.html":
            console.print(f"report: {path}", soft_wrap=True, markup=False)
    if read.stopped_by != StopReason.COMPLETED.value:
        sentences = [f"the run did not complete, it was stopped by: {read.stopped_by}"]
        if is_machine_left and (where := _where_the_machine_stands(read)):
            sentences.append(
                f"the linkage stands with {where}: bring it home before the next run, or give that one --from-here"
            )
        complain(sentences, EXIT_NO)


def run(
    config: ConfigArgument,
    cycles: CyclesOption = None,
    record: Annotated[
        Path | None, typer.Option("--record", "-r", help="Recording to write  [default: NAME-DATE-TIME.mcap here]")
    ] = None,
    virtual_time: VirtualTimeOption = False,
    seed: Annotated[int, typer.Option(min=0, help="With --virtual-time: seed of all that is random.")] = 0,
    frames: Annotated[
        bool | None,
        typer.Option("--frames/--no-frames", help="Record every CAN frame  [default: on socketcan, in virtual time]"),
    ] = None,
    home_here: Annotated[
        bool,
        typer.Option("--home-here", help="Home the axes where they stand, even if their drives are homed already."),
    ] = False,
    from_here: Annotated[
        bool,
        typer.Option(
            "--from-here",
            help="Go slowly onto the cam from wherever the linkage stands, clear of its singular positions.",
        ),
    ] = False,
    learn: Annotated[
        Path | None,
        typer.Option(
            "--learn",
            metavar="PATH",
            help="Learn from cycle to cycle: resume from this file and write to it; in a folder, one file a profile.",
        ),
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    port: PortOption = None,
    is_overwriting: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Commission the drives, ramp up, run the machine cycles on the cam, ramp down, disable; record and report it."""
    from config.loading import load_config
    from gateway.running.bus_address import resolve_bus
    from gateway.running.learning_store import open_store

    settings = load_config(config)
    recording = record or Path(f"{settings.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap")
    require_absent(recording, is_overwriting)
    prepared, cam = _prepare(settings, cycles)
    store = open_store(settings, prepared.cam.profile, learn)
    if virtual_time:
        _run_virtually(prepared, cam, recording, seed, is_overwriting, frames is not False, store)
    else:
        count = settings.motion.machine_cycles if cycles is None else cycles
        address = resolve_bus(settings.bus, interface, channel, port)
        _run_on_bus(prepared, cam, address, recording, count, is_overwriting, frames, home_here, learn, from_here)
    _show(recording, as_json, None, is_machine_left=not virtual_time)


def demo(
    cycles: CyclesOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for recording, cam and report.")
    ] = Path("drive-gateway-report"),
    channel: Annotated[
        str | None, typer.Option("--channel", "-c", help="SocketCAN interface to use  [default: vcan0 where it is up]")
    ] = None,
    virtual_time: VirtualTimeOption = False,
    paper: Annotated[
        bool, typer.Option("--paper", help="In virtual time, with the paper's tuning: its figures side by side.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random in the emulated machine.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """The whole chain against an emulated machine: compile, commission, run 10 machine cycles, report."""
    from config.loading import load_config
    from gateway.cli.paper_demo import paper_demo
    from gateway.errors import UsageError
    from gateway.running.session import emulator_process
    from mechanism.cam_file import write_cam_file

    settings = load_config("paper")
    console = messages()
    output.mkdir(parents=True, exist_ok=True)
    if paper:
        if channel is not None:
            raise UsageError("--paper runs in virtual time and takes no --channel")
        count = settings.motion.machine_cycles if cycles is None else cycles
        paper_demo(settings, count, output, seed, as_json, _paper_runner(seed))
        return
    console.print(f"compiling the cam of {settings.description}", markup=False)
    prepared, cam = _prepare(settings, cycles)
    write_cam_file(output / "cam.json", prepared.cam)
    recording = output / "demo.mcap"
    if virtual_time:
        _run_virtually(prepared, cam, recording, seed, True)
    else:
        console.print("starting the emulated machine (the first start compiles its equations of motion)")
        interface = "socketcan" if channel is not None else None
        with emulator_process(settings.path, interface=interface, channel=channel, seed=seed) as address:
            console.print(f"the emulated machine is on {address}", markup=False)
            count = settings.motion.machine_cycles if cycles is None else cycles
            _run_on_bus(prepared, cam, address, recording, count, True, None)
    _show(recording, as_json, output)
