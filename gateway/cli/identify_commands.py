"""The command identify: parameters of the machine from recordings, or from a safe excitation."""

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gateway.cli.run_commands import VirtualTimeOption
from gateway.cli.terminal import (
    ChannelOption,
    InterfaceOption,
    JsonOption,
    OverwriteOption,
    PortOption,
    messages,
    print_json,
    require_absent,
    results,
)

if TYPE_CHECKING:
    from config.schema import GatewayConfig
    from gateway.identification.fit import Identification
    from gateway.record.recording import Recording
    from gateway.running.bus_address import BusAddress
    from gateway.running.preparation import PreparedRun

IDENTIFY_EPILOG = """Examples:

\b
  drive-gateway identify run.mcap slower.mcap              from runs that were recorded, best at several speeds
  drive-gateway identify my-machine.yaml -o model.yaml     excite the machine: the cam at three speeds, steep ramps
  drive-gateway identify paper --virtual-time --plot fit.png

The section feed_forward that -o writes is read by run: put it into the configuration.
"""
RECORDING_SUFFIX = ".mcap"


def identify_command(
    sources: Annotated[
        list[str], typer.Argument(metavar="RECORDING... | CONFIG", help="Recordings of runs, or one configuration.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the section feed_forward with what was found (YAML).")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Write a picture of the fit (PNG).")] = None,
    cycles: Annotated[int, typer.Option("--cycles", "-n", min=1, max=100, help="Machine cycles of each run.")] = 1,
    repeats: Annotated[int, typer.Option(min=1, max=20, help="How often each speed is run.")] = 1,
    virtual_time: VirtualTimeOption = False,
    seed: Annotated[int, typer.Option(min=0, help="With --virtual-time: seed of all that is random.")] = 0,
    torque_delay_us: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=20_000.0, help="Age of the torque actual value at SYNC  [default: half a servo period]"
        ),
    ] = None,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    port: PortOption = None,
    is_overwriting: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate inertia, gravity and friction of the machine, with 95 % intervals, from recordings or an excitation."""
    from config.conversion import nominal_parameters
    from config.loading import load_config, parse_config
    from gateway.errors import UsageError
    from gateway.identification.fit import DEFAULT_TORQUE_DELAY_S, identify, motion_of
    from gateway.identification.model_file import model_text
    from gateway.identification.plot import fit_png
    from gateway.record.recording import read_recording
    from gateway.running.bus_address import resolve_bus
    from mechanism.five_bar import Closure

    for path in (output, plot):
        if path is not None:
            require_absent(path, is_overwriting)
    if any(source.endswith(RECORDING_SUFFIX) for source in sources):
        read = [read_recording(Path(source)) for source in sources]
        config = parse_config(read[0].config_text, Path(sources[0]))
    elif len(sources) > 1:
        raise UsageError(f"{sources[1]}: give one configuration, or any number of recordings (*{RECORDING_SUFFIX})")
    else:
        config = load_config(sources[0])
        address = None if virtual_time else resolve_bus(config.bus, interface, channel, port)
        read = _excite(config, address, cycles, repeats, seed)
    mechanism = read[0].constants.mechanism
    if mechanism is None:
        raise UsageError(f"{sources[0]}: the recording does not say what mechanism it is of")
    result = identify(
        [motion_of(recording.samples, recording.constants) for recording in read],
        nominal_parameters(config),
        Closure(mechanism.closure),
        DEFAULT_TORQUE_DELAY_S if torque_delay_us is None else torque_delay_us * 1e-6,
    )
    if plot is not None:
        plot.write_bytes(fit_png(result, config.axis_names))
    if output is not None:
        output.write_text(model_text(result, config.axis_names), encoding="utf-8")
    if as_json:
        print_json({"sources": sources, **result.to_json()})
        return
    _show(result, config.axis_names)


def _excite(
    config: "GatewayConfig", address: "BusAddress | None", cycles: int, repeats: int, seed: int
) -> "list[Recording]":
    """Run the excitation; the recordings are read and not kept."""
    from gateway.identification.excitation import excitation_runs
    from gateway.record.recording import read_recording

    runs = excitation_runs(config, cycles) * repeats
    console = messages()
    found: list[Recording] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, prepared in enumerate(runs):
            motion = prepared.config.motion
            console.print(
                f"  run {number + 1} of {len(runs)}: {motion.speed_rpm:g} rpm,"
                f" ramps of {motion.ramp_acceleration_rad_per_s2:g} rad/s^2"
            )
            path = Path(folder, f"{number}{RECORDING_SUFFIX}")
            _run(prepared, address, path, seed + number)
            found.append(_completed(read_recording(path)))
    return found


def _run(prepared: "PreparedRun", address: "BusAddress | None", path: Path, seed: int) -> None:
    from gateway.running.session import StopSwitch, run_realtime
    from gateway.running.virtual_run import run_virtual
    from mechanism.cam_file import cam_document
    from sim_drive.assembly import build_machine

    cam = json.dumps(cam_document(prepared.cam))
    if address is None:
        core = run_virtual(prepared, build_machine(prepared.config, seed), path, cam, seed, with_frames=False)
        if core.failure is not None:
            raise core.failure
        return
    switch = StopSwitch()
    with switch.installed():
        run_realtime(prepared, address, path, cam, switch, machine_cycles=prepared.config.motion.machine_cycles)


def _completed(read: "Recording") -> "Recording":
    from gateway.cyclic.guard import StopReason
    from gateway.errors import GatewayError

    if read.stopped_by != StopReason.COMPLETED.value:
        raise GatewayError(f"the excitation did not complete, it was stopped by: {read.stopped_by}")
    return read


def _show(result: "Identification", axis_names: tuple[str, ...]) -> None:
    from rich.table import Table

    table = Table(title=f"identified from {result.samples} samples in which both axes move")
    for heading in ("parameter", "value", "95 % interval", "nominal", "unit", "determined by the data"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for one in result.estimates:
        low, high = one.interval
        row: list[Any] = [one.name, f"{one.value:.6f}", f"{low:.6f} to {high:.6f}", f"{one.nominal:.6f}", one.unit]
        table.add_row(*row, f"{one.determined:.0%}")
    console = results()
    console.print(table)
    console.print(f"{len(result.independent)} of {len(result.estimates)} are independent of each other in this motion")
    for name, left, before in zip(axis_names, result.residual_rms_Nm, result.nominal_residual_rms_Nm, strict=True):
        console.print(
            f"axis {name}: the model leaves {left * 1e3:.1f} mN m RMS of the smoothed torque,"
            f" the nominal one {before * 1e3:.1f} mN m"
        )
