"""The fast closed loop against the emulated machine on a bus in virtual time: the same counts, one for one."""

import math
from collections import deque

import numpy as np
import pytest

import sim_drive.closed_loop as fast
from config.loading import load_config, parse_config
from drivers.virtual_time import VirtualBus
from gateway.cyclic.cycle import RPDO_LAYOUT, TPDO_LAYOUT
from gateway.running.assembly import build_core
from gateway.running.preparation import prepare
from sim_drive.assembly import build_machine
from sim_drive.closed_loop import closed_loop_of

PAPER = load_config("paper")
SECOND = 1_000_000_000
SYNC, RPDO, TPDO = 0x080, (0x201, 0x202), (0x181, 0x182)


def changed(*replacements):
    text = PAPER.text
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return parse_config(text, PAPER.path)


class OffsetDemand:
    """A demand whose torque offsets wander, so that the instant at which they act can be told."""

    def __init__(self, demand):
        self.demand = demand
        self.steps = 0

    def __getattr__(self, name):
        return getattr(self.demand, name)

    def step(self):
        self.demand.step()
        self.steps += 1
        self.demand.torque_offsets = [round(90 * math.sin(0.31 * self.steps)), round(60 * math.cos(0.17 * self.steps))]


def run_emulator(config, from_s, until_s):
    """The fast loop as the machine is at ``from_s``, the last RPDOs, homing offsets, and the frames from then on."""
    prepared = prepare(config, 1)
    machine = build_machine(config)
    core = build_core(config, prepared.cam.profile, prepared.plan, type("Sink", (), {"append": lambda *_: None})())
    core.session.demand = OffsetDemand(core.session.demand)
    frames = deque()
    bus = VirtualBus([core, machine], config.bus.bit_rate, trace=lambda at_ns, frame: frames.append((at_ns, frame)))
    bus.run_until(round(from_s * SECOND))
    loop = closed_loop_of(config)
    copy_state(machine, loop)
    pending = [RPDO_LAYOUT.unpack_from(next(f.data for _, f in reversed(frames) if f.cob_id == c)) for c in RPDO]
    frames.clear()
    bus.run_until(round(until_s * SECOND))
    assert all(drive.is_powered for drive in machine.drives)
    return loop, pending, np.array([drive.axis.offset for drive in machine.drives]), frames


def copy_state(machine, loop):
    loop._state[:] = machine.plant.state
    loop._clock[fast._TICK] = machine._tick
    loop._clock[fast._TICK_NS] = machine._tick_ns
    for number, motor in enumerate(machine._motors):
        memory, servo, demand = loop._memory[number], motor.servo, motor.drive_axis.demand
        memory[fast._ERROR_SUM] = servo._error_sum
        memory[fast._ERROR_BEFORE] = servo._error_before
        memory[fast._POSITION_BEFORE] = servo._position_before
        memory[fast._DEMAND_BEFORE] = servo._demand_before
        memory[fast._COMMAND] = machine._torques[number]
        memory[fast._DELAYED] = motor.delayed_torque
        memory[fast._TORQUE_OFFSET] = motor.drive_axis.torque_offset_Nm
        memory[fast._LINE_POSITION] = demand.position
        memory[fast._LINE_VELOCITY] = demand.velocity
        memory[fast._LINE_DURATION] = demand.duration_s
        loop._clock[fast._LINE_START_NS + number] = demand.start_ns


def set_points(pending, frames):
    """Instants of the SYNCs, what acts at each, and what the drives send upon it."""
    sync_ns, targets, offsets, actual, torque = [], [], [], [], []
    latest = list(pending)
    for at_ns, frame in frames:
        if frame.cob_id == SYNC:
            sync_ns.append(at_ns)
            targets.append([target for _, target, _ in latest])
            offsets.append([offset for _, _, offset in latest])
            actual.append([0, 0])
            torque.append([0, 0])
        elif frame.cob_id in RPDO:
            latest[RPDO.index(frame.cob_id)] = RPDO_LAYOUT.unpack_from(frame.data)
        elif frame.cob_id in TPDO and actual:
            _, actual[-1][TPDO.index(frame.cob_id)], torque[-1][TPDO.index(frame.cob_id)] = TPDO_LAYOUT.unpack_from(
                frame.data
            )
    return tuple(np.array(column[:-1]) for column in (sync_ns, targets, offsets, actual, torque))


@pytest.mark.parametrize(
    ("replacements", "from_s", "until_s"),
    [
        ((), 0.45, 2.2),
        ((("output_delay_periods: 1", "output_delay_periods: 0\n      resolver_eccentricity_counts: 7.5"),), 1.7, 2.4),
        (
            (("K_P: 5000, K_I: 200, K_D: 0,", "K_P: 3000, K_I: 7, K_D: 9000,"), ("cycle_us: 1000", "cycle_us: 2000")),
            1,
            2,
        ),
    ],
    ids=["from standstill", "without output delay, eccentric resolvers", "all gains, another cycle"],
)
def test_the_fast_loop_gives_the_emulator_s_counts(replacements, from_s, until_s):
    config = changed(*replacements)
    loop, pending, home_counts, frames = run_emulator(config, from_s, until_s)
    sync_ns, targets, offsets, actual, torque = set_points(pending, frames)
    run = loop.run(targets - home_counts, offsets, sync_ns=sync_ns)
    assert len(actual) > 400
    assert np.ptp(actual[:, 0]) > 100
    np.testing.assert_array_equal(run.actual_counts + home_counts, actual)
    np.testing.assert_array_equal(np.floor(run.torque_Nm * 1000.0 / 1.5 + 0.5), torque)


def test_the_error_is_that_of_the_target_that_acted_one_sync_before():
    loop = closed_loop_of(PAPER)
    targets = np.array([[0, 0], [40, 0], [40, 0], [40, 0]])
    run = loop.run(targets)
    np.testing.assert_array_equal(run.error_counts, [[0, 0], [0, 0], [40, 0], [40, 0]] - run.actual_counts)


def test_running_in_two_goes_is_running_in_one():
    targets = np.stack([np.arange(200) * 4, np.zeros(200, dtype=int)], axis=1)
    offsets = np.full((200, 2), 30.0)
    loop = closed_loop_of(PAPER)
    whole = loop.run(targets, offsets)
    loop.reset()
    parts = [loop.run(targets[:77], offsets[:77]), loop.run(targets[77:], offsets[77:])]
    np.testing.assert_array_equal(whole.actual_counts, np.vstack([part.actual_counts for part in parts]))
    np.testing.assert_array_equal(whole.error_counts, np.vstack([part.error_counts for part in parts]))


def test_noise_is_the_seed_s():
    config = changed(("torque_per_volt_Nm: 0.45", "torque_per_volt_Nm: 0.45\n      resolver_noise_counts: 1.0"))
    targets = np.zeros((300, 2), dtype=np.int64)
    loop = closed_loop_of(config, seed=3)
    first = loop.run(targets).actual_counts
    loop.reset(seed=3)
    np.testing.assert_array_equal(loop.run(targets).actual_counts, first)
    loop.reset(seed=4)
    assert (loop.run(targets).actual_counts != first).any()
    assert 0.5 < np.std(first[:, 1]) < 2.0


def test_a_torn_linkage_ends_the_run():
    loop = closed_loop_of(PAPER)
    targets = np.stack([np.arange(4000) * 4, -np.arange(4000) * 3], axis=1)
    run = loop.run(targets)
    assert run.is_torn
    assert 0 < len(run.actual_counts) < 4000


def test_shapes_that_do_not_fit_are_refused():
    loop = closed_loop_of(PAPER)
    with pytest.raises(ValueError, match=r"shape \(5, 2\) with torque offsets of shape \(4, 2\)"):
        loop.run(np.zeros((5, 2), dtype=np.int64), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="3 SYNCs for 5 targets"):
        loop.run(np.zeros((5, 2), dtype=np.int64), sync_ns=np.arange(3))
