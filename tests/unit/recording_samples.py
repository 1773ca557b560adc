"""Hand-made runs for the tests of recording, analysis, report and monitor: all in them can be worked out by hand."""

import math
from dataclasses import replace

import numpy as np

from gateway.record.run_constants import AxisConstants, MechanismConstants, RunConstants
from gateway.record.sample import Phase, SampleArray, SampleLayout

PAPER_MECHANISM = MechanismConstants(
    p_m=0.150, q_m=0.250, r_m=0.300, s_m=0.150, cv_pivot_m=(0.0, 0.0), servo_pivot_m=(0.250, 0.0), closure=1
)
CONSTANTS = RunConstants(
    config_name="hand-made",
    period_s=0.001,
    axes=(AxisConstants("cv", 4096, 1.5), AxisConstants("servo", 4096, 0.5)),
    mechanism=PAPER_MECHANISM,
)
WITHOUT_MECHANISM = replace(CONSTANTS, mechanism=None)
LAYOUT = SampleLayout(CONSTANTS.axis_names)


def steady_run(records: int = 2000, records_a_turn: int = 1000) -> SampleArray:
    """60 rpm from theta2 = 0 without errors, on a perfect clock, the servo axis at rest at 100 counts."""
    samples = np.zeros(records, dtype=LAYOUT.dtype)
    k = np.arange(records)
    samples["cycle"] = k
    samples["sync_ns"] = k * 1_000_000
    samples["sync_period_ns"] = np.where(k > 0, 1_000_000, 0)
    samples["master_position"] = 2 * math.pi * k / records_a_turn
    samples["master_velocity"] = 2 * math.pi
    samples["demand_velocity"] = [2 * math.pi, 0.0]
    samples["phase"] = Phase.CAM
    counts = np.rint(4096 * k / records_a_turn)
    samples["position_demand"] = samples["position_actual"] = np.stack([counts, np.full(records, 100)], axis=1)
    samples["statusword"] = 0x1237
    samples["rpdo_lead_ns"] = 400_000
    samples["tpdo_arrival_ns"] = 300_000
    samples["loop_cpu_ns"] = 60_000
    return samples
