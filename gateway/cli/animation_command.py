"""The command that shows the linkage moving: animate."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.terminal import ConfigArgument, JsonOption, OverwriteOption, print_json, require_absent, results

ANIMATE_EPILOG = """Examples:

\b
  drive-gateway animate paper -o paper.html
  drive-gateway animate my-machine.yaml --cam cam.json -o linkage.gif --seconds 6
"""
GIF_FRAMES = 90
HTML_SAMPLES = 360


def animate(
    config: ConfigArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="FILE.gif or FILE.html to write.")],
    cam: Annotated[
        Path | None, typer.Option(help="Cam file that compile has written  [default: the cam of CONFIG's curve]")
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=12, max=7200, help=f"Samples a cycle  [default: {GIF_FRAMES} in a GIF, {HTML_SAMPLES} in HTML]"
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.5, max=60.0, help="Length of a cycle in a GIF.")] = 4.0,
    is_overwriting: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Animate the linkage over its cycle, with the desired and the traced curve; the page works without a network."""
    from config.conversion import five_bar
    from config.loading import load_config
    from gateway.errors import UsageError
    from gateway.synthesis.animation_gif import gif_of
    from gateway.synthesis.animation_html import html_of
    from gateway.synthesis.linkage_motion import linkage_motion
    from mechanism.cam_file import read_cam_file

    kind = output.suffix.lower()
    if kind not in {".gif", ".html"}:
        raise UsageError(f"{output}: the name must end in .gif or .html")
    settings = load_config(config)
    require_absent(output, is_overwriting)
    made = None
    if cam is not None:
        counts = settings.ordered_axes[1].counts_per_revolution
        made = read_cam_file(cam).require_for(five_bar(settings), counts)
    motion = linkage_motion(settings, frames or (GIF_FRAMES if kind == ".gif" else HTML_SAMPLES), made)
    content = gif_of(motion, seconds) if kind == ".gif" else html_of(motion).encode()
    output.write_bytes(content)
    if as_json:
        print_json({"animation": str(output), "samples": int(motion.theta2.size), "bytes": len(content)})
    else:
        results().print(f"{output}: {motion.theta2.size} positions of {motion.name}", soft_wrap=True, markup=False)
