"""The program ``drive-gateway``: its commands and how it ends."""

import sys
from typing import Annotated, Final

import typer

from gateway.cli.animation_command import ANIMATE_EPILOG, animate
from gateway.cli.cam_commands import CHECK_EPILOG, COMPILE_EPILOG, DOWNLOAD_EPILOG, check, compile_command, download
from gateway.cli.compare_commands import COMPARE_EPILOG, compare
from gateway.cli.control_commands import CONTROL_EPILOG, control
from gateway.cli.doctor_command import DOCTOR_EPILOG, doctor
from gateway.cli.identify_commands import IDENTIFY_EPILOG, identify_command
from gateway.cli.run_commands import DEMO_EPILOG, RUN_EPILOG, demo, run
from gateway.cli.synthesis_commands import SYNTHESIZE_EPILOG, synthesize
from gateway.cli.terminal import errors_answered
from gateway.cli.tune_commands import TUNE_EPILOG, tune
from gateway.cli.watch_commands import MONITOR_EPILOG, REPORT_EPILOG, monitor_command, report

HELP: Final = """Run a hybrid five-bar machine over CANopen: compile a cam from a desired curve, download or stream it
to two CiA 402 drives, and see the axis errors. `drive-gateway demo` does all of it against an emulated machine."""

app: Final = typer.Typer(
    help=HELP, add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)
app.command("demo", epilog=DEMO_EPILOG)(demo)
app.command("check", epilog=CHECK_EPILOG)(check)
app.command("compile", epilog=COMPILE_EPILOG)(compile_command)
app.command("run", epilog=RUN_EPILOG)(run)
app.command("report", epilog=REPORT_EPILOG)(report)
app.command("download", epilog=DOWNLOAD_EPILOG)(download)
app.command("synthesize", epilog=SYNTHESIZE_EPILOG)(synthesize)
app.command("animate", epilog=ANIMATE_EPILOG)(animate)
app.command("doctor", epilog=DOCTOR_EPILOG)(doctor)
app.command("tune", epilog=TUNE_EPILOG)(tune)
app.command("compare", epilog=COMPARE_EPILOG)(compare)
app.command("identify", epilog=IDENTIFY_EPILOG)(identify_command)
app.command("monitor", epilog=MONITOR_EPILOG)(monitor_command)
app.command("control", epilog=CONTROL_EPILOG)(control)


def _show_version(is_asked: bool) -> None:
    if is_asked:
        from gateway.record.recording import product_version

        print(f"drive-gateway {product_version()}")
        raise typer.Exit


@app.callback()
def common(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options of the program itself."""


def main() -> None:
    """Entry point: foreseen errors are answered with a sentence and an exit status."""
    with errors_answered():
        app()
    sys.exit(0)
