"""The command that looks at the machine: doctor."""

from typing import Annotated

import typer
from rich.table import Table

from gateway.cli.terminal import EXIT_NO, ChannelOption, JsonOption, complain, print_json, results

DOCTOR_EPILOG = """Examples:

\b
  drive-gateway doctor                       the host and every CAN interface
  drive-gateway doctor my-machine.yaml       and whether they are what this configuration needs
  drive-gateway doctor -c can0 --json | jq '.findings[] | select(.verdict != "good")'

Nothing is changed: each remedy is a command or a setting for you to decide on. The exit status is 1 where a run on the
bus would not work, not for mere advice.
"""
COLOURS = {"good": "green", "advice": "yellow", "problem": "bold red"}


def doctor(
    config: Annotated[
        str | None,
        typer.Argument(metavar="[CONFIG]", help="Configuration whose bus is looked for.", show_default=False),
    ] = None,
    channel: ChannelOption = None,
    as_json: JsonOption = False,
) -> None:
    """Look at what this machine offers a cyclic loop, and at its CAN interfaces; say what would help."""
    from gateway.running.bus_address import resolve_bus
    from gateway.running.doctor import Wanted, examine, findings_json, is_ready

    wanted = Wanted(channel)
    if config is not None:
        from config.loading import load_config

        bus = load_config(config).bus
        address = resolve_bus(bus, None, channel)
        wanted = Wanted(address.channel if address.interface == "socketcan" else channel, bus.bit_rate, bus.is_virtual)
    findings = examine(wanted)
    if as_json:
        print_json(findings_json(findings))
    else:
        table = Table(title="What this machine offers a cyclic loop", title_justify="left")
        for name in ("", "", "found", "remedy"):
            table.add_column(name, overflow="fold")
        for finding in findings:
            what = f"{finding.topic.value}, {finding.where}" if finding.where else finding.topic.value
            verdict = finding.verdict.value
            table.add_row(what, f"[{COLOURS[verdict]}]{verdict}[/]", finding.found, finding.remedy)
        results().print(table)
    if not is_ready(findings):
        problems = [finding for finding in findings if finding.verdict.value == "problem"]
        complain([f"{finding.topic.value} {finding.where}: {finding.found}" for finding in problems], EXIT_NO)
