"""The gateway's process is killed: the drives stop by themselves, and in one piece."""

import math
from dataclasses import dataclass

import pytest
from guarded_machine import PAPER, Guarded, Silenced, at_theta2, changed

from config.schema import GatewayConfig
from drivers.objects import ABORT_CONNECTION_OPTION_CODE, SET_POINT_AGE, SET_POINT_WATCHDOG

WATCHDOG = "    sync_watchdog: {index: 0x3050, bits: 16, unit: cycles, cycles: 40}\n"


@dataclass(frozen=True, slots=True)
class Stated:
    """What is said of a machine whose gateway is killed, after the gateway's last frame."""

    config: GatewayConfig
    rest_s: float
    """In motion: both axes stand."""
    torque_off_s: float
    """In any phase: no axis has torque."""
    cam_deg: float
    """Farthest from the cam that the slave gets."""


STATED = {
    # 40 cycles and a half; then the brakes take hold.
    "watchdog": Stated(PAPER, 0.05, 0.05, 10.0),
    # 200 ms after the last heartbeat; until then the drives hold where the last set-point was.
    "heartbeat": Stated(changed((WATCHDOG, "")), 0.205, 0.205, 10.0),
}
IN_MOTION = [at_theta2(degrees) for degrees in (0, 45, 90, 186, 230, 300, 312, 318, 324, 330, 345)]
ENABLED_FROM_S = 0.15
PHASES = [0.045, 0.055, 0.070, 0.090, 0.20, 0.6, 1.2, 3.9, 4.3]


def silence(at_s, config):
    # The gateway's core lives on unheard: its own view is of no interest here.
    run = Guarded(config=config, cycles=1, bus_faults=Silenced(at_s))
    for drive in run.machine.drives:
        # Whatever guards the gateway is commissioning's doing, and no default of the drives.
        for index in (ABORT_CONNECTION_OPTION_CODE, SET_POINT_WATCHDOG):
            entry = drive.dictionary.entry(index)
            entry.default = entry.value = 0
    return run.until(at_s + 1.0)


def last_torque_s(run, at_s):
    torques = [record.at_ns * 1e-9 for record in run.machine.records if any(record.torque_commands_Nm)]
    return max(torques, default=at_s) - at_s


def assert_stopped(at_s, stated):
    run = silence(at_s, stated.config)
    assert not run.is_torn
    assert run.is_without_torque
    assert run.core.failure is None
    strain = run.strain(at_s)
    torque_s = last_torque_s(run, at_s)
    assert (torque_s > 0.0) is (at_s > ENABLED_FROM_S), "what is not enabled stands by itself"
    for drive in run.machine.drives if at_s > ENABLED_FROM_S else ():
        assert drive.dictionary.entry(SET_POINT_AGE).value * 1e-6 < stated.torque_off_s
    assert strain.rest_s < stated.rest_s
    assert torque_s < stated.torque_off_s
    assert math.degrees(strain.cam_distance_rad) < stated.cam_deg
    return strain.rest_s, torque_s, math.degrees(strain.cam_distance_rad)


@pytest.mark.parametrize("stated", STATED.values(), ids=STATED.keys())
@pytest.mark.parametrize("at_s", [PHASES[1], at_theta2(324)])
def test_a_killed_gateway_stops_the_machine(at_s, stated):
    assert_stopped(at_s, stated)


@pytest.mark.slow
@pytest.mark.parametrize("by", STATED)
def test_a_killed_gateway_stops_the_machine_in_any_phase(by):
    figures = [assert_stopped(at_s, STATED[by]) for at_s in (*PHASES, *IN_MOTION)]
    worst = [max(column) for column in zip(*figures, strict=True)]
    print(
        f"\n{by}: gateway silenced at {len(figures)} instants: all at rest after {worst[0] * 1e3:.0f} ms, "
        f"without torque after {worst[1] * 1e3:.0f} ms, at most {worst[2]:.1f} deg from the cam"
    )
    assert PAPER.bus.heartbeat_timeout_ms == 200
