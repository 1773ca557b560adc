"""The gateway's process is killed: the drives stop by themselves, and in one piece."""

import math

import pytest
from guarded_machine import PAPER, Guarded, Silenced, at_theta2

STATED_REST_S = 0.05
"""In motion: how long after the gateway's last frame both axes stand."""
STATED_TORQUE_OFF_S = 0.30
"""In any phase: how long after the gateway's last frame no axis has torque: the heartbeat's time-out and a ramp."""
BOUND_CAM_RAD = math.radians(12.0)
IN_MOTION = [at_theta2(degrees) for degrees in (0, 45, 90, 186, 230, 300, 312, 318, 324, 330, 345)]
PHASES = [0.045, 0.055, 0.070, 0.090, 0.20, 0.6, 1.2, 3.9, 4.3]


def silence(at_s):
    # The gateway's core lives on unheard: its own view is of no interest here.
    return Guarded(cycles=1, bus_faults=Silenced(at_s)).until(at_s + 1.0)


def last_torque_s(run, at_s):
    torques = [record.at_ns * 1e-9 for record in run.machine.records if any(record.torque_commands_Nm)]
    return max(torques, default=at_s) - at_s


def assert_stopped(at_s):
    run = silence(at_s)
    assert not run.is_torn
    assert run.is_without_torque
    strain = run.strain(at_s)
    torque_s = last_torque_s(run, at_s)
    assert strain.rest_s < STATED_REST_S
    assert torque_s < STATED_TORQUE_OFF_S
    assert strain.cam_distance_rad < BOUND_CAM_RAD
    return strain.rest_s, torque_s, math.degrees(strain.cam_distance_rad)


@pytest.mark.parametrize("at_s", [PHASES[1], at_theta2(324)])
def test_a_killed_gateway_stops_the_machine(at_s):
    assert_stopped(at_s)


@pytest.mark.slow
def test_a_killed_gateway_stops_the_machine_in_any_phase():
    worst = [max(figures) for figures in zip(*(assert_stopped(at_s) for at_s in (*PHASES, *IN_MOTION)), strict=True)]
    print(
        f"\ngateway silenced at {len(PHASES) + len(IN_MOTION)} instants: all at rest after {worst[0] * 1e3:.0f} ms, "
        f"without torque after {worst[1] * 1e3:.0f} ms, at most {worst[2]:.1f} deg from the cam"
    )
    assert PAPER.bus.heartbeat_timeout_ms == 200
