"""What the linkage goes through when an axis is lost, with the gateway's reaction and without: a table."""

import math
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "virtual"))

from guarded_machine import CV, PAPER, SERVO, at_theta2
from test_guard_lost_axis import IDLE, lose

from sim_drive.injection.faults import FaultKind


@pytest.mark.bench
def test_losing_an_axis_with_and_without_a_reaction():
    print(
        "\nlost  theta2 | least sine, farthest from the cam, peak shaft torques CV and servo; reacting, then looking on"
    )
    for node in (CV, SERVO):
        for theta2 in (5, 100, 186, 275, 325):
            at_s = at_theta2(theta2)
            columns: list[str] = []
            for config in (PAPER, IDLE):
                run = lose(FaultKind.OVER_CURRENT, node, at_s, config)
                strain = run.strain(at_s, at_s + 1.0)
                torques = ", ".join(f"{torque:5.1f}" for torque in strain.shaft_torques_Nm)
                torn = " torn" if run.is_torn else ""
                columns.append(
                    f"{strain.least_sine:.2f} {math.degrees(strain.cam_distance_rad):6.1f} deg {torques} N m{torn}"
                )
            print(f"{'CV' if node == CV else 'servo':5} {theta2:5} | {' | '.join(columns)}")
