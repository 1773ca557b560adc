"""The linkage over its cycle as a GIF."""

from io import BytesIO
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from gateway.errors import UsageError
from gateway.reporting.figure import PNG_THEME, Axes, Figure, figure_style, legend, new_figure
from gateway.synthesis.linkage_motion import LinkageMotion

_mpl: Any = matplotlib

MAXIMUM_FRAMES: Final = 720
_DOTS_PER_INCH: Final = 100
_INCHES: Final = 6.4
_COLOURS: Final = 64
LEAST_FRAME_MS: Final = 20
"""Viewers show a GIF's frame for at least this long, whatever it says."""


def gif_of(motion: LinkageMotion, seconds: float) -> bytes:
    """One frame a sample, the cycle in ``seconds``, endless. Raises UsageError for too many frames or too short a time.

    The still parts are drawn once; each frame only adds the linkage.
    """
    count = motion.theta2.size
    if count > MAXIMUM_FRAMES:
        raise UsageError(f"{count} frames in a GIF, bound {MAXIMUM_FRAMES}")
    frame_ms = round(seconds * 1e3 / count)
    if frame_ms < LEAST_FRAME_MS:
        raise UsageError(f"{count} frames in {seconds:g} s are {frame_ms} ms each, bound {LEAST_FRAME_MS} ms")
    with _mpl.rc_context(figure_style(PNG_THEME)):
        frames = _frames(motion)
    palette = frames[0].quantize(colors=_COLOURS, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    stream = BytesIO()
    indexed[0].save(stream, format="GIF", save_all=True, append_images=indexed[1:], duration=frame_ms, loop=0)
    return stream.getvalue()


def _still(motion: LinkageMotion) -> tuple[Figure, Axes]:
    theme = PNG_THEME
    left, bottom, right, top = (1e3 * edge for edge in motion.extent())
    shape = min(max((top - bottom) / (right - left), 0.6), 1.6)
    figure = new_figure(_INCHES, _INCHES * shape)
    canvas: Any = FigureCanvasAgg(figure)
    figure.set_dpi(_DOTS_PER_INCH)
    axes = figure.subplots()
    closed = np.concatenate((motion.end_effector, motion.end_effector[:1])) * 1e3
    wanted = np.concatenate((motion.curve.points, motion.curve.points[:1])) * 1e3
    axes.plot(*closed.T, color=theme.path, lw=1.8, label="traced")
    axes.plot(*wanted.T, color=theme.ink, lw=1.0, ls=(0, (5, 3)), label="desired")
    for pivot, colour in ((motion.five_bar.cv_pivot, theme.cv), (motion.five_bar.servo_pivot, theme.servo)):
        axes.plot(pivot[0] * 1e3, pivot[1] * 1e3, marker="^", ms=13, color=colour, alpha=0.45, ls="none")
    axes.set_aspect("equal")
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")
    axes.set_title(motion.name)
    legend(axes, theme, loc="upper right")
    canvas.draw()
    return figure, axes


def _frames(motion: LinkageMotion) -> list[Image.Image]:
    theme = PNG_THEME
    figure, axes = _still(motion)
    canvas = figure.canvas
    background = canvas.copy_from_bbox(figure.bbox)
    look = {"lw": 3.4, "marker": "o", "ms": 6, "mfc": theme.paper, "mew": 1.6, "solid_capstyle": "round"}
    coupler = axes.plot([], [], color=theme.muted, **look)[0]
    crank = axes.plot([], [], color=theme.cv, **look)[0]
    servo = axes.plot([], [], color=theme.servo, **look)[0]
    tip = axes.plot([], [], "o", color=theme.path, ms=7)[0]
    text = axes.text(0.015, 0.985, "", transform=axes.transAxes, va="top", color=theme.ink, family="DejaVu Sans Mono")
    frames: list[Image.Image] = []
    cv, servo_pivot = np.array(motion.five_bar.cv_pivot), np.array(motion.five_bar.servo_pivot)
    for i in range(motion.theta2.size):
        a, c, d = motion.joint_a[i], motion.end_effector[i], motion.joint_d[i]
        for line, points in ((coupler, (a, c, d)), (crank, (cv, a)), (servo, (servo_pivot, d)), (tip, (c,))):
            line.set_data(*(np.stack(points).T * 1e3))
        text.set_text(
            f"θ2 {np.degrees(motion.theta2[i]):6.1f}°  θ5 {np.degrees(motion.theta5[i]):7.2f}°"
            f"  C ({c[0] * 1e3:7.1f}, {c[1] * 1e3:7.1f}) mm"
        )
        canvas.restore_region(background)
        for artist in (coupler, crank, servo, tip, text):
            axes.draw_artist(artist)
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    return frames
