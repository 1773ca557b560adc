"""Commands that look at runs: report, monitor."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.terminal import ConfigArgument, JsonOption, messages, print_json, results

REPORT_EPILOG = """Examples:

\b
  drive-gateway report paper.mcap -o report
  drive-gateway report paper.mcap -o report --json | jq '.axes.servo.following_error_counts'
  drive-gateway report paper.mcap -o report --candump paper.log    then: candump tools, tshark, python-can
"""
MONITOR_EPILOG = """Examples:

\b
  drive-gateway monitor paper            while a run of paper is going on in another terminal
  drive-gateway monitor paper --once
  drive-gateway monitor paper --json     one JSON object a line, for scripts
"""


def report(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Recording (MCAP) of a run.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write the report to.")],
    candump: Annotated[
        Path | None, typer.Option(help="Also write the recorded CAN frames as a candump log to this file.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make the report of a recording: tables here, report.html, report.json and plots in DIR."""
    from gateway.errors import GatewayError
    from gateway.record.recording import read_recording, write_candump_log
    from gateway.reporting.analysis import analyse
    from gateway.reporting.report import write_report
    from gateway.reporting.report_text import render_report

    read = read_recording(recording)
    figures = analyse(read)
    written = write_report(recording, output)
    if candump is not None:
        frames = read.frames()
        if not len(frames):
            raise GatewayError(f"recording {recording}: holds no CAN frames to export (run with --frames records them)")
        write_candump_log(frames, candump)
    if as_json:
        print_json(figures.to_json())
    else:
        results().print(render_report(figures))
    console = messages()
    for path in written:
        if path.name == "report.html":
            console.print(f"report: {path}", soft_wrap=True)


def monitor_command(
    config: ConfigArgument,
    once: Annotated[bool, typer.Option("--once", help="Print one picture and end.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object a line instead.")] = False,
) -> None:
    """Attach to a running gateway and show the axis errors live. It only reads, and never slows the cycle."""
    from config.loading import load_config
    from gateway.reporting.monitor import monitor

    monitor(load_config(config).name, once=once, as_json=as_json, console=results())
