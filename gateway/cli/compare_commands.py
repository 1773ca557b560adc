"""The command compare: recorded runs side by side."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.terminal import JsonOption, OverwriteOption, messages, print_json, require_absent, results

COMPARE_EPILOG = """Examples:

\b
  drive-gateway compare before.mcap after.mcap
  drive-gateway compare paper.mcap tuned.mcap model.mcap learnt.mcap --plot compare.png
  drive-gateway compare a.mcap b.mcap --label "gains of the paper" --label tuned --json
"""


def compare(
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Recordings (MCAP) of runs.")],
    label: Annotated[
        list[str] | None, typer.Option("--label", "-l", help="Name of a run, once for each  [default: file name]")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Write one page with all runs (PNG).")] = None,
    is_overwriting: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Put recorded runs side by side: errors and torque of each at constant speed, and in its last machine cycle."""
    from rich.table import Table

    from gateway.reporting.comparison import compare_runs, comparison_png

    if plot is not None:
        require_absent(plot, is_overwriting)
    runs = compare_runs(recordings, label or [])
    if plot is not None:
        plot.write_bytes(comparison_png(runs))
        messages().print(f"plot: {plot}", soft_wrap=True, markup=False)
    if as_json:
        print_json({"runs": [run.to_json() for run in runs]})
        return
    table = Table(title="following error at constant speed, peak and RMS in counts")
    table.add_column("run")
    table.add_column("rpm", justify="right")
    table.add_column("cycles", justify="right")
    names = runs[0].data.constants.axis_names
    for name in names:
        for heading in ("whole run", "last cycle", "torque RMS"):
            table.add_column(f"{name}: {heading}", justify="right")
    for run in runs:
        cells = [run.label, f"{run.speed_rpm:.3g}", f"{run.machine_cycles:.1f}"]
        for axis in run.axes:
            cells += [
                f"{axis.peak:.0f} / {axis.rms:.2f}",
                f"{axis.last_peak:.0f} / {axis.last_rms:.2f}",
                f"{axis.torque_rms_Nm:.3f} N m",
            ]
        table.add_row(*cells)
    results().print(table)
