"""The gateway closes the position loop: both drives, or one of them, in cyclic synchronous torque."""

import pytest
import yaml
from torque_loops import TORQUE_LOOPS

from config.loading import load_config, parse_config
from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import StopReason
from gateway.record.sample import SampleLayout
from gateway.running.assembly import build_core
from gateway.running.preparation import prepare
from sim_drive.assembly import build_machine
from sim_drive.device.cia402 import Mode
from sim_drive.injection.faults import Fault, FaultKind
from sim_drive.injection.injector import Injector

PAPER = load_config("paper")
CV, SERVO = 1, 2
SAMPLE = SampleLayout(PAPER.axis_names)


def machine_with(*axes, is_learning=False):
    document = yaml.safe_load(PAPER.text)
    for name in axes:
        document["axes"][name]["position_loop"] = TORQUE_LOOPS[name]
    if is_learning:
        document["learning"] = {"enabled": True}
        document["motion"]["speed_rpm"] = 30
        for axis in document["axes"].values():
            axis["emulation"]["resolver_noise_counts"] = 0.3
    return parse_config(yaml.safe_dump(document), PAPER.path)


class Run:
    """One session against the emulated machine, with faults; ``samples`` as they would be recorded."""

    def __init__(self, config, *faults, cycles=2):
        self.packed = bytearray()
        prepared = prepare(config, cycles)
        self.machine = build_machine(config, 1)
        self.core = build_core(config, prepared.cam.profile, prepared.plan, self)
        self.modes = set()
        node = Injector(self.machine, faults) if faults else self.machine
        self.bus = VirtualBus([self.core, node], config.bus.bit_rate, 1)
        while not self.core.is_done and self.bus.now_ns < 30_000_000_000:
            self.bus.run_while(lambda: not self.core.is_done, self.bus.now_ns + 100_000_000)
            self.modes.add(tuple(drive.mode for drive in self.machine.drives))

    def append(self, *values):
        self.packed += SAMPLE.pack(*values)

    @property
    def samples(self):
        import numpy as np

        return np.frombuffer(bytes(self.packed), dtype=SAMPLE.dtype)

    @property
    def errors(self):
        moving = self.samples[self.samples["phase"] == 3]
        return abs(moving["position_demand"] - moving["position_actual"]).max(axis=0)


@pytest.mark.parametrize(
    ("axes", "modes"),
    [
        (("cv", "servo"), (Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.CYCLIC_SYNCHRONOUS_TORQUE)),
        (("servo",), (Mode.CYCLIC_SYNCHRONOUS_POSITION, Mode.CYCLIC_SYNCHRONOUS_TORQUE)),
    ],
)
def test_the_machine_runs_on_its_cam_under_the_gateways_own_loops(axes, modes):
    run = Run(machine_with(*axes))
    assert run.core.stopped_by is StopReason.COMPLETED
    assert run.core.failure is None
    assert modes in run.modes
    cv, servo = run.errors
    assert cv <= 2
    assert servo <= 4
    assert not any(drive.is_powered for drive in run.machine.drives)


def test_learning_goes_by_the_loop_that_the_gateway_closes():
    """With the drives' own gains, which have no say in this mode, the axes swing up from cycle to cycle."""
    run = Run(machine_with("cv", "servo", is_learning=True), cycles=8)
    assert run.core.learned is not None
    cv, servo = run.errors
    assert cv <= 3
    assert servo <= 4


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault(FaultKind.OVER_CURRENT, SERVO, 2.0), StopReason.EMERGENCY),
        (Fault(FaultKind.SAFE_TORQUE_OFF, CV, 2.0), StopReason.EMERGENCY),
        (Fault(FaultKind.MUTE_HEARTBEAT, CV, 2.0), StopReason.HEARTBEAT_LOST),
    ],
)
def test_a_fault_stops_it_in_one_piece(fault, reason):
    run = Run(machine_with("cv", "servo"), fault)
    assert run.core.stopped_by is reason
    assert run.machine.plant.torn_at_s is None
    assert not any(drive.is_powered for drive in run.machine.drives)


def test_gains_without_their_limit_are_refused():
    document = yaml.safe_load(PAPER.text)
    document["axes"]["cv"]["position_loop"] = {"proportional_Nm_per_rad": 20}
    with pytest.raises(Exception, match=r"position_loop\.torque_limit_Nm"):
        parse_config(yaml.safe_dump(document), PAPER.path)
