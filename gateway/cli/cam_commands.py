"""Commands about the cam itself: check, compile, download."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

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

CHECK_EPILOG = """Examples:

\b
  drive-gateway check paper
  drive-gateway check my-machine.yaml --json
"""
COMPILE_EPILOG = """Examples:

\b
  drive-gateway compile paper -o paper-cam.json
  drive-gateway compile my-machine.yaml -o cam.json --json | jq '.figures.displacement_deg'
"""
DOWNLOAD_EPILOG = """Examples, with an emulated machine in another terminal (sim-drive paper):

\b
  drive-gateway compile paper -o cam.json
  drive-gateway download paper cam.json
  drive-gateway download paper cam.json --slot 2 --no-select --json
"""


def check(config: ConfigArgument, as_json: JsonOption = False) -> None:
    """Check a configuration: its keys, the cam against every limit, bus budget, guard. Nothing is opened or moved."""
    from config.loading import load_config
    from gateway.running.bus_budget import budget_json, budget_table, budget_verdict
    from gateway.running.guard_listing import drive_guards_text, guard_json, guard_table
    from gateway.running.preparation import prepare

    settings = load_config(config)
    prepared = prepare(settings, is_strict=False)
    figures = prepared.cam.report.figures()
    problems = [str(violation) for violation in prepared.violations]
    if as_json:
        print_json(
            {
                "config": str(settings.path),
                "name": settings.name,
                "is_runnable": not problems,
                "problems": problems,
                "figures": figures,
                "bus": budget_json(settings),
                "guard": guard_json(settings),
                "run": {
                    "duration_s": prepared.plan.duration_s,
                    "machine_cycles": settings.motion.machine_cycles,
                    "cruise_start_s": prepared.plan.cruise_start_s,
                    "cruise_end_s": prepared.plan.cruise_end_s,
                },
            }
        )
    else:
        console = results()
        slave = settings.ordered_axes[1].limits
        position = slave.position_deg
        table = Table(title=f"{settings.name}: the cam at {settings.motion.speed_rpm:g} rpm", title_justify="left")
        for name, justify in (("", "left"), ("found", "right"), ("limit", "right"), ("unit", "left")):
            table.add_column(name, justify=justify)  # pyright: ignore[reportArgumentType]
        report = prepared.cam.report
        rows: list[tuple[str, str, str, str]] = [
            (
                "servo position",
                f"{figures['position_minimum_deg']:.2f} to {figures['position_maximum_deg']:.2f}",
                "none" if position is None else f"{position[0]:g} to {position[1]:g}",
                "deg",
            ),
            (
                "servo velocity",
                f"{report.velocity_minimum.value:+.3f} to {report.velocity_maximum.value:+.3f}",
                f"±{slave.velocity_rad_per_s:g}",
                "rad/s",
            ),
            (
                "servo acceleration",
                f"{report.acceleration_minimum.value:+.1f} to {report.acceleration_maximum.value:+.1f}",
                f"±{slave.acceleration_rad_per_s2:g}",
                "rad/s²",
            ),
            (
                "servo jerk",
                f"{report.jerk_minimum.value:+.0f} to {report.jerk_maximum.value:+.0f}",
                "none" if slave.jerk_rad_per_s3 is None else f"±{slave.jerk_rad_per_s3:g}",
                "rad/s³",
            ),
            (
                "structural error",
                f"{report.structural_error.value * 1e3:.4f}",
                f"{settings.motion.structural_error_limit_mm:g}",
                "mm",
            ),
            (
                "least sine of the angle q to r",
                f"{report.crank_sine.value:.3f}",
                f"{settings.machine.minimum_transmission_sine:g}",
                "",
            ),
            (
                "least sine of the angle r to s",
                f"{report.servo_sine.value:.3f}",
                f"{settings.machine.minimum_transmission_sine:g}",
                "",
            ),
            ("greatest step of the demand a bus cycle", f"{report.step_counts.value:.1f}", "", "counts"),
        ]
        for row in rows:
            table.add_row(*row)
        console.print(table)
        console.print(budget_table(settings))
        console.print(budget_verdict(settings), soft_wrap=True)
        console.print(guard_table(settings))
        console.print(drive_guards_text(settings), soft_wrap=True)
        console.print(
            f"run: {prepared.plan.duration_s:.2f} s, of which {settings.motion.machine_cycles} machine cycles or a "
            f"little more at constant speed ({prepared.plan.cruise_end_s - prepared.plan.cruise_start_s:.2f} s)"
        )
        if not problems:
            console.print("[green]everything is within its limits[/green]")
    if problems:
        complain(problems, EXIT_NO)


def compile_command(
    config: ConfigArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Cam file to write.")],
    is_overwriting: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compile the desired curve into a cam, theta5 over theta2, and prove its limits."""
    from config.loading import load_config
    from gateway.running.preparation import prepare
    from mechanism.cam_file import cam_document, write_cam_file

    settings = load_config(config)
    require_absent(output, is_overwriting)
    prepared = prepare(settings)
    write_cam_file(output, prepared.cam)
    report = prepared.cam.report
    if as_json:
        document: dict[str, Any] = cam_document(prepared.cam)
        keys = ("closure", "knots", "counts_per_revolution", "figures", "theta2_deg", "theta5_deg")
        print_json({"cam": str(output), "config": str(settings.path), **{key: document[key] for key in keys}})
        return
    results().print(
        f"{output}: theta5 over theta2 in {report.knots} pieces, displacement {report.displacement_deg:.2f} deg, "
        f"velocity {report.velocity_minimum.value:+.3f} to {report.velocity_maximum.value:+.3f} rad/s at "
        f"{settings.motion.speed_rpm:g} rpm",
        soft_wrap=True,
    )


def download(
    config: ConfigArgument,
    cam: Annotated[Path, typer.Argument(metavar="CAM", help="Cam file that compile has written.")],
    slot: Annotated[int, typer.Option(min=1, max=4, help="Profile slot of the drive.")] = 1,
    select: Annotated[bool, typer.Option(help="Select the slot for the drive's camming mode.")] = True,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    port: PortOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write a cam into a profile slot of the slave axis' drive by SDO, and verify it by read-back, CRC and parse."""
    from dataclasses import asdict

    from config.conversion import five_bar
    from config.loading import load_config
    from drivers.real_time import run_node
    from gateway.running.bus_address import resolve_bus
    from gateway.running.download import DownloadResult, download_image
    from gateway.running.drive_settings import axis_units, build_master, node_settings
    from gateway.running.procedure_core import ProcedureCore
    from mechanism.cam_file import read_cam_file
    from mechanism.cam_image import encode_cam_image

    settings = load_config(config)
    master_axis, slave_axis = settings.ordered_axes
    file = read_cam_file(cam)
    profile = file.require_for(five_bar(settings), slave_axis.counts_per_revolution).profile
    image = encode_cam_image(
        profile,
        settings.motion.cam_points,
        master_axis.counts_per_revolution,
        slave_axis.counts_per_revolution,
        axis_units(slave_axis).home_angle_rad,
    )
    console = messages()
    node = node_settings(settings)[1]
    bus = resolve_bus(settings.bus, interface, channel, port)
    connection = bus.open()
    try:
        core: ProcedureCore[DownloadResult] = ProcedureCore(
            build_master(settings),
            lambda master: download_image(master, node, slot, image, select, lambda step: console.print(f"  {step}")),
        )
        run_node(core, connection, lambda: core.is_done)
    finally:
        connection.close()
    if core.failure is not None:
        raise core.failure
    result = core.result
    if result is None:
        return
    if as_json:
        print_json({"axis": node.name, "bus": str(bus), **asdict(result)})
        return
    selected = ", selected" if result.is_selected else ""
    results().print(
        f"axis {node.name}, slot {result.slot}: {result.points} points in {result.bytes} bytes, "
        f"CRC-32 {result.crc:08X}h, verified{selected} ({result.elapsed_s:.2f} s)",
        soft_wrap=True,
    )
