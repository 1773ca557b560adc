"""``drive-gateway demo --paper``: the paper's measurements on the emulated machine, in virtual time."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gateway.cli.terminal import messages, print_json, results

if TYPE_CHECKING:
    from config.gain_sets import GainSet
    from config.schema import GatewayConfig
    from gateway.reporting.paper_comparison import FirstCycle, TorqueDemand, TunedRun
    from gateway.reporting.paper_figures import ServoTicks
    from gateway.running.preparation import PreparedRun
    from sim_drive.machine import EmulatedMachine

LEAST_CYCLES: Final = 2
"""One to settle, one to measure."""
_POINTS: Final = 3600

VirtualRunner = Callable[["PreparedRun", str, Path, "EmulatedMachine"], None]


def paper_demo(
    config: "GatewayConfig", cycles: int, output: Path, seed: int, as_json: bool, run: VirtualRunner
) -> None:
    """Run every set of gains of ``config/gains/paper.yaml``, and print its figures beside the paper's.

    ``run`` carries out a prepared run with a machine in virtual time, and records it in ``output``.
    """
    from config.gain_sets import load_gain_sets
    from gateway.reporting.paper_comparison import compare, to_markdown, to_table
    from gateway.reporting.paper_plot import plot_reproduction

    console = messages()
    runs: list[TunedRun] = []
    shown: list[tuple[str, ServoTicks, slice]] = []
    for name, gains in load_gain_sets("paper").items():
        console.print(f"{gains.title}: {cycles} machine cycles in virtual time", markup=False)
        tuned, ticks, last_cycle = _run_tuning(config, name, gains, cycles, output / f"paper-{name}.mcap", seed, run)
        runs.append(tuned)
        shown.append((f"{name}: {gains.title}", ticks, last_cycle))
    names = [own.name for own in runs]
    rows = compare(runs, _required_torque(config))
    (output / "paper.md").write_text(to_markdown(rows, names), encoding="utf-8")
    (output / "paper.png").write_bytes(plot_reproduction(shown))
    document: dict[str, Any] = {
        "tunings": {own.name: own.to_json() for own in runs},
        "comparison": [row.to_json(names) for row in rows],
    }
    (output / "paper.json").write_text(json.dumps(document, indent=2, ensure_ascii=False), encoding="utf-8")
    if as_json:
        print_json(document)
        return
    results().print(to_table(rows, names))
    for own in runs:
        gains_text = "; ".join(f"{axis} {','.join(map(str, values.values()))}" for axis, values in own.gains.items())
        results().print(f"{own.name}: {own.note} (K_P,K_I,K_D,K_V,K_F: {gains_text})", markup=False)
    console.print(f"written: paper.md, paper.json and paper.png in {output}", soft_wrap=True, markup=False)


def _run_tuning(
    config: "GatewayConfig", name: str, gains: "GainSet", cycles: int, recording: Path, seed: int, run: VirtualRunner
) -> "tuple[TunedRun, ServoTicks, slice]":
    """A tuning's figures, its servo ticks, and which of them are the last machine cycle at full speed."""
    from config.gain_sets import with_gain_set
    from gateway.errors import GatewayError
    from gateway.reporting.paper_comparison import TunedRun
    from gateway.reporting.paper_figures import reproduce
    from gateway.running.preparation import prepare
    from mechanism.cam_file import cam_document
    from sim_drive.assembly import build_machine
    from sim_drive.physics.driveline import SERVO_PERIOD_S

    tuned = with_gain_set(config, gains)
    prepared = prepare(tuned, max(cycles, LEAST_CYCLES))
    plan = prepared.plan
    ticks_kept = int((plan.duration_s + 2.0) / SERVO_PERIOD_S)
    machine = build_machine(tuned, seed, record_ticks=ticks_kept)
    run(prepared, json.dumps(cam_document(prepared.cam)), recording, machine)
    ticks = _ticks_of(machine, tuned.ordered_axes[0].counts_per_revolution)
    # The first whole revolution at full speed still has the ramp in it.
    full_turn = 2.0 * np.pi
    first = int(np.ceil(plan.at(plan.cruise_start_s)[0] / full_turn - 1e-9)) + 1
    last = int(np.floor(plan.at(plan.cruise_end_s)[0] / full_turn + 1e-9))
    last = max(last, first + 1)
    if ticks.revolutions[-1] < last:
        raise GatewayError(f"the run with the gains {name!r} was stopped early, see the events in {recording}")
    window = ticks.between(float(first), float(last))
    run_figures = TunedRun(
        name=name,
        title=gains.title,
        note=gains.note,
        gains={"cv": gains.master.model_dump(), "servo": gains.slave.model_dump()},
        steady=reproduce(ticks, window, prepared.cam.cam.five_bar, prepared.cam.closure),
        ramped=_first_cycle(ticks),
        at_once=_first_cycle(_started_at_once(tuned, prepared)),
    )
    return run_figures, ticks, ticks.between(float(last - 1), float(last))


def _ticks_of(machine: "EmulatedMachine", counts_per_revolution: int) -> "ServoTicks":
    from gateway.reporting.paper_figures import ServoTicks

    records = machine.records
    return ServoTicks(
        demand_counts=np.array([record.demands_counts for record in records]),
        counts=np.array([record.counts for record in records], dtype=np.float64),
        torque_Nm=np.array([record.torques_Nm for record in records]),
        drawn_J=np.array([record.drawn_J for record in records]),
        counts_per_revolution=float(counts_per_revolution),
    )


def _started_at_once(config: "GatewayConfig", prepared: "PreparedRun") -> "ServoTicks":
    """The first revolution and a little more, its demand at full speed from the first SYNC on."""
    from gateway.reporting.paper_figures import ServoTicks
    from sim_drive.closed_loop import closed_loop_of

    loop = closed_loop_of(config)
    steps = np.arange(1, round(1.02 * 2.0 * np.pi / config.speed_rad_per_s / config.cycle_s))
    theta2 = steps * config.cycle_s * config.speed_rad_per_s
    theta5 = prepared.cam.profile.at_many(theta2)[:, 0]
    per_rad = np.array([axis.counts_per_revolution for axis in config.ordered_axes]) / (2.0 * np.pi)
    targets = np.floor(np.stack([theta2, theta5], axis=1) * per_rad + 0.5).astype(np.int64)
    ticks = loop.run(targets, record_ticks=True).ticks
    return ServoTicks(
        demand_counts=ticks[:, :, 1],
        counts=ticks[:, :, 0],
        torque_Nm=ticks[:, :, 3],
        drawn_J=np.empty((0, 2)),
        counts_per_revolution=float(config.ordered_axes[0].counts_per_revolution),
    )


def _first_cycle(ticks: "ServoTicks") -> "FirstCycle":
    from gateway.reporting.paper_comparison import FirstCycle

    errors = ticks.errors[ticks.between(0.0, 1.0)]
    master, slave = (float(errors[int(np.argmax(np.abs(errors[:, axis]))), axis]) for axis in (0, 1))
    return FirstCycle(master, slave)


def _required_torque(config: "GatewayConfig") -> "tuple[TorqueDemand, TorqueDemand]":
    from config.conversion import dynamics_parameters
    from gateway.reporting.paper_comparison import TorqueDemand
    from gateway.running.preparation import compile_config
    from mechanism.dynamics import inverse_dynamics_along

    cam = compile_config(config)
    speed = config.speed_rad_per_s
    theta2 = np.arange(_POINTS) * (2.0 * np.pi / _POINTS)
    along = cam.profile.at_many(theta2)
    theta, omega, alpha, torque = (np.empty((_POINTS, 2), dtype=np.float64) for _ in range(4))
    theta[:, 0], theta[:, 1] = theta2, along[:, 0]
    omega[:, 0], omega[:, 1] = speed, along[:, 1] * speed
    alpha[:, 0], alpha[:, 1] = 0.0, along[:, 2] * speed * speed
    params = dynamics_parameters(config)
    viscous = np.array(params.viscous_N_m_s)
    inverse_dynamics_along(params.to_array(), theta, omega, alpha, int(cam.closure), 0.0, torque)
    torque -= viscous * omega
    master, slave = (
        TorqueDemand(float(column.max()), float(column.min()), float(np.sqrt(np.mean(column**2))))
        for column in torque.T
    )
    return master, slave
