"""Cost of one servo period of the plant (4 sub-steps): the kernel alone, and as Python calls it."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from config.conversion import closure_at_home, dynamics_parameters
from config.loading import load_config
from mechanism.jit import kernel
from sim_drive.physics.compliant import CompliantPlant, advance_compliant
from sim_drive.physics.coupling import Coupling
from sim_drive.physics.driveline import AxisDriveline
from sim_drive.physics.five_bar_motion import MOTION_SIZE, advance_five_bar
from sim_drive.physics.plant import CoupledPlant, PlantParameters

PERIODS = 20_000
OFF = (False, False)


@kernel
def many_rigid(state, dynamics, settings, closure, singular_sine, step_s, substeps, periods):
    """So many servo periods in one call, so that what a call from Python costs does not count."""
    for period in range(periods):
        torque = 0.62 if period % 2 else 0.6
        advance_five_bar(state, dynamics, settings, closure, singular_sine, step_s, substeps, torque, 0.1, False, False)


@kernel
def many_compliant(state, dynamics, settings, couplings, scratch, closure, singular_sine, step_s, substeps, periods):
    """As `many_rigid`."""
    for period in range(periods):
        torque = 0.62 if period % 2 else 0.6
        advance_compliant(
            state,
            dynamics,
            settings,
            couplings,
            scratch,
            closure,
            singular_sine,
            step_s,
            substeps,
            torque,
            0.1,
            False,
            False,
        )


def parameters(**driveline) -> PlantParameters:
    config = load_config("paper")
    axis = AxisDriveline(**driveline)
    return PlantParameters(dynamics_parameters(config), closure_at_home(config), (axis, axis), singular_sine=1e-9)


def best_us(work: Callable[[], None]) -> float:
    """Processor time of the fastest of some runs of PERIODS, in us a period: the machine is shared."""
    work()
    spans = []
    for _ in range(7):
        started = time.process_time()
        work()
        spans.append(time.process_time() - started)
    return min(spans) / PERIODS * 1e6


def kernel_us(many, plant, size: int | None = None) -> float:
    standing = plant._state.copy()
    state = standing[:size].copy()

    def work() -> None:
        # From the same state again and again: over PERIODS the machine stays within its first revolutions.
        for _ in range(PERIODS // 200):
            state[:] = standing[:size]
            many(state, *plant._constants, 200)

    return best_us(work)


def called_us(plant) -> float:
    def work() -> None:
        for _ in range(PERIODS // 200):
            plant.set_motion((0.3, 0.4), (0.0, 0.0))
            for _ in range(200):
                plant.advance((0.6, 0.1), OFF)

    return best_us(work)


@pytest.mark.bench
def test_a_servo_period_of_the_plant():
    rigid = CoupledPlant(parameters(), 0.3, 0.4)
    smooth = CoupledPlant(parameters(friction_smoothing_rad_per_s=0.05), 0.3, 0.4)
    coupling = Coupling(600.0, 0.02, backlash_rad=0.002)
    soft = CompliantPlant(replace(parameters()), (coupling, coupling), 0.3, 0.4)
    rows = [
        ("rigid, stick-slip, kernel", kernel_us(many_rigid, rigid, MOTION_SIZE)),
        ("rigid, stick-slip, kernel, energies counted", kernel_us(many_rigid, rigid)),
        ("rigid, smoothed friction, kernel, energies counted", kernel_us(many_rigid, smooth)),
        ("flexible couplings with play, kernel, energies counted", kernel_us(many_compliant, soft)),
        ("rigid, called from Python", called_us(rigid)),
        ("flexible, called from Python", called_us(soft)),
    ]
    print("\none servo period (4 sub-steps) of the coupled plant, us")
    for what, span in rows:
        print(f"  {what:56} {span:6.2f}")
    assert all(np.isfinite(span) for _, span in rows)
