"""The figures of a synthesis' report: the paper's figures 2.3 to 2.7 for the mechanism found, and how it was found."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.reporting.figure import (
    Axes,
    Figure,
    Theme,
    legend,
    new_figure,
    over_the_cycle,
    render_png,
    render_svg,
)
from gateway.synthesis.linkage_motion import LinkageMotion
from gateway.synthesis.run_search import SearchStatus
from gateway.synthesis.search_slice import Found
from mechanism.synthesis.candidate import Candidate

Float = NDArray[np.floating[Any]]

_POSITIONS: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class SynthesisData:
    """What page and figures show.

    ``front`` is empty unless the method keeps one, ``chosen`` its chosen member; ``problems``: what the machine fails.
    """

    motion: LinkageMotion
    status: SearchStatus
    candidate: Candidate
    front: tuple[Found, ...] = ()
    chosen: Found | None = None
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SynthesisPlot:
    """A figure: its file name's stem, title, caption, and how to draw it."""

    stem: str
    title: str
    caption: str
    draw: Callable[[SynthesisData, Theme], Figure]

    def png(self, data: SynthesisData) -> bytes:
        """The figure for a light page, with its title."""
        return render_png(lambda theme: self.draw(data, theme), self.title)

    def svg(self, data: SynthesisData) -> str:
        """The figure as an element of a page."""
        return render_svg(lambda theme: self.draw(data, theme), self.title, self.stem)


def _closed_mm(points: Float) -> Float:
    return np.concatenate((points, points[:1])) * 1e3


def _curves(axes: Axes, data: SynthesisData, theme: Theme) -> None:
    motion = data.motion
    axes.plot(*_closed_mm(motion.end_effector).T, color=theme.path, lw=1.8, label="reached")
    axes.plot(*(motion.curve.points * 1e3).T, "o", ms=3.4, mfc="none", mec=theme.ink, mew=0.9, label="desired points")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")


def _positions(data: SynthesisData, theme: Theme) -> Figure:
    motion = data.motion
    figure = new_figure(8.6, 5.6)
    axes = figure.subplots()
    cv, servo = np.array(motion.five_bar.cv_pivot), np.array(motion.five_bar.servo_pivot)
    count = motion.theta2.size
    for number in range(_POSITIONS):
        i = number * count // _POSITIONS
        a, c, d = motion.joint_a[i], motion.end_effector[i], motion.joint_d[i]
        strong = {"lw": 2.6, "alpha": 1.0} if number == 0 else {"lw": 1.1, "alpha": 0.45}
        for points, colour, name in (
            ((a, c, d), theme.muted, "q and r"),
            ((cv, a), theme.cv, "p, CV axis"),
            ((servo, d), theme.servo, "s, servo axis"),
        ):
            axes.plot(
                *(np.stack(points).T * 1e3),
                color=colour,
                marker="o",
                ms=3.2,
                label=name if number == 0 else None,
                **strong,
            )
    for pivot, colour in ((cv, theme.cv), (servo, theme.servo)):
        axes.plot(*(pivot * 1e3), marker="^", ms=11, color=colour, alpha=0.5, ls="none")
    _curves(axes, data, theme)
    legend(axes, theme, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _servo(data: SynthesisData, theme: Theme) -> Figure:
    motion = data.motion
    figure = new_figure(8.6, 6.2)
    panels = figure.subplots(3, 1, sharex=True)
    theta2 = np.degrees(np.append(motion.theta2, 2.0 * np.pi))
    gain = round(float(motion.theta5[-1] - motion.theta5[0]) / (2.0 * np.pi)) * 2.0 * np.pi
    for axes, values, name in (
        (panels[0], np.degrees(np.append(motion.theta5, motion.theta5[0] + gain)), "θ5 (deg)"),
        (panels[1], np.append(motion.velocity, motion.velocity[0]), "velocity (rad/s)"),
        (panels[2], np.append(motion.acceleration, motion.acceleration[0]), "acceleration (rad/s²)"),
    ):
        if values.min() < 0.0 < values.max():
            axes.axhline(0, color=theme.muted, lw=0.8)
        axes.plot(theta2, values, color=theme.servo)
        axes.set_ylabel(name)
        over_the_cycle(axes)
        axes.set_xlabel("")
    panels[-1].set_xlabel("θ2 (deg)")
    return figure


def _path(data: SynthesisData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    _curves(left, data, theme)
    left.set_title("path of the end effector")
    legend(left, theme, loc="best", fontsize=8.5)
    track = data.candidate.servo_motion()
    within = np.degrees(track.theta2) % 360.0
    order = np.argsort(within)
    theta2, error_mm = within[order], track.structural_error[order] * 1e3
    right.plot(theta2, error_mm, "o-", ms=3, lw=1.0, color=theme.path, label="structural error")
    tolerances = data.candidate.task.tolerances
    if tolerances is not None:
        right.step(
            theta2,
            tolerances[order] * 1e3,
            where="mid",
            color=theme.bad,
            lw=1.0,
            label="tolerance",
        )
    right.set_title("distance of the points from q's circle")
    right.set_ylabel("mm")
    over_the_cycle(right)
    right.set_xlabel("θ2 (deg)")
    right.set_ylim(0.0, max(1.2 * right.get_ylim()[1], 1e-3))
    legend(right, theme, loc="upper right")
    return figure


def _torque(data: SynthesisData, theme: Theme) -> Figure:
    motion = data.motion
    figure = new_figure(8.6, 4.4)
    panels = figure.subplots(2, 1, sharex=True)
    theta2 = np.degrees(np.append(motion.theta2, 2.0 * np.pi))
    for axis, (axes, colour, name) in enumerate(zip(panels, (theme.cv, theme.servo), ("CV", "servo"), strict=True)):
        axes.axhline(0, color=theme.muted, lw=0.8)
        axes.plot(theta2, np.append(motion.torque[:, axis], motion.torque[0, axis]), color=colour)
        axes.set_ylabel(f"{name} motor (N m)")
        over_the_cycle(axes)
        axes.set_xlabel("")
    panels[-1].set_xlabel("θ2 (deg)")
    return figure


def _convergence(data: SynthesisData, theme: Theme) -> Figure:
    figure = new_figure(8.6, 3.6)
    axes = figure.subplots()
    best = data.status.best_start
    values: list[float] = []
    for start in data.status.starts:
        if not start.improvements:
            continue
        evaluations, objective = np.array((*start.improvements, (start.evaluations, start.improvements[-1][1]))).T
        values.extend(objective.tolist())
        chosen = start is best
        axes.step(
            evaluations,
            objective,
            where="post",
            color=theme.path if chosen else theme.muted,
            lw=1.8 if chosen else 0.8,
            alpha=1.0 if chosen else 0.6,
            zorder=3 if chosen else 2,
            label=f"seed {start.seed}, the best" if chosen else None,
        )
    axes.set_xscale("log")
    if values and min(values) > 0.0:
        axes.set_yscale("log")
    axes.set_xlabel("mechanisms evaluated, of each start")
    axes.set_ylabel("best weighted objective")
    legend(axes, theme, loc="upper right")
    return figure


def _front(data: SynthesisData, theme: Theme) -> Figure:
    task = data.candidate.task
    counted = [index for index, entry in enumerate(task.terms) if entry.weight > 0.0]
    terms = np.array([found.terms for found in data.front])
    varied = [index for index in counted if np.ptp(terms[:, index]) > 0.0]
    across, *others = varied if len(varied) > 1 else (counted * 2)[:2]
    figure = new_figure(8.6, 3.8)
    panels = np.atleast_1d(figure.subplots(1, len(others[:3])))
    for axes, index in zip(panels, others[:3], strict=True):
        axes.plot(terms[:, across], terms[:, index], "o", ms=4, mfc="none", mec=theme.path, label="front")
        if data.chosen is not None:
            axes.plot(data.chosen.terms[across], data.chosen.terms[index], "o", ms=8, color=theme.servo, label="chosen")
        axes.set_xlabel(task.terms[across].term.value)
        axes.set_ylabel(task.terms[index].term.value)
        if terms[:, across].min() > 0.0 and np.ptp(np.log10(terms[:, across])) > 1.5:
            axes.set_xscale("log")
    legend(panels[0], theme, loc="upper right")
    return figure


def synthesis_plots(data: SynthesisData) -> tuple[SynthesisPlot, ...]:
    """The figures that this synthesis allows, in the order of the report."""
    plots = [
        SynthesisPlot(
            "positions",
            "The mechanism in several positions",
            f"Every {360 // _POSITIONS} degrees of the CV axis, strong at θ2 = 0; the curve reached and the points "
            "desired.",
            _positions,
        ),
        SynthesisPlot(
            "servo",
            "Motion of the servo axis",
            "Displacement, velocity and acceleration over the cycle at constant CV speed (as the paper's figures 2.3 "
            "to 2.5).",
            _servo,
        ),
        SynthesisPlot(
            "path",
            "Motion of the end effector",
            "The path reached through the desired points (as the paper's figure 2.6), and what link q misses each "
            "point by.",
            _path,
        ),
        SynthesisPlot(
            "torque",
            "Torques of both motors",
            "By the dynamic model, friction and gravity included (as the paper's figure 2.7).",
            _torque,
        ),
        SynthesisPlot(
            "convergence",
            "Convergence",
            "The best objective of every start over the mechanisms it evaluated.",
            _convergence,
        ),
    ]
    if data.front:
        plots.append(
            SynthesisPlot(
                "front",
                "Pareto front",
                "Mechanisms of which none is better than another in every counted term.",
                _front,
            )
        )
    return tuple(plots)
