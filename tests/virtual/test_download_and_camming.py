"""A cam downloaded into a profile slot: verified, refused where damaged, and run by the drive on its own."""

import math
import zlib

import numpy as np
import pytest

from config.loading import load_config
from drivers.object_dictionary import DataType
from drivers.pdo import MappingEntry
from drivers.virtual_time import VirtualBus
from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.cycle import CyclicLoop
from gateway.cyclic.demand import CamDemand
from gateway.cyclic.guard import Guard, StopReason
from gateway.cyclic.steering import Steering
from gateway.errors import GatewayError
from gateway.record.sample import Phase, SampleLayout
from gateway.running.commissioning import map_pdo
from gateway.running.core import GatewayCore
from gateway.running.download import download_image
from gateway.running.drive_settings import axis_units, build_master, network_settings, node_settings
from gateway.running.machine_session import MachineSession
from gateway.running.powering import AxisPower, AxisSetup
from gateway.running.preparation import prepare
from gateway.running.procedure_core import ProcedureCore
from mechanism.cam_image import encode_cam_image
from sim_drive.assembly import build_machine

PAPER = load_config("paper")
SECOND = 1_000_000_000
SERVO = node_settings(PAPER)[1]


@pytest.fixture(scope="module")
def prepared():
    return prepare(PAPER, 2)


@pytest.fixture(scope="module")
def image(prepared):
    return encode_cam_image(prepared.cam.profile, 1024)


def carry_out(machine, make):
    core = ProcedureCore(build_master(PAPER), make)
    bus = VirtualBus([core, machine], PAPER.bus.bit_rate)
    bus.run_while(lambda: not core.is_done, 20 * SECOND)
    assert core.is_done
    return core


def test_a_download_is_verified_and_selected(image):
    machine = build_machine(PAPER)
    core = carry_out(machine, lambda master: download_image(master, SERVO, 1, image, True))
    assert core.failure is None
    assert core.result.points == 1024
    assert core.result.crc == zlib.crc32(image)
    reading = carry_out(machine, lambda master: master.read_int(2, 0x3010, 0, DataType.UNSIGNED8))
    assert reading.result == 1


def test_the_drive_itself_refuses_a_damaged_image_and_selects_nothing(image):
    machine = build_machine(PAPER)
    damaged = image[:100] + bytes((image[100] ^ 1,)) + image[101:]
    core = carry_out(machine, lambda master: download_image(master, SERVO, 3, damaged, True))
    assert isinstance(core.failure, GatewayError)
    assert "axis servo: the drive refuses the table in slot 3 (state 3, error " in str(core.failure)
    reading = carry_out(machine, lambda master: master.read_int(2, 0x3010, 0, DataType.UNSIGNED8))
    assert reading.result == 0


def test_a_slot_that_does_not_keep_what_was_written_is_noticed(image):
    machine = build_machine(PAPER)
    entry = machine.drives[1].dictionary.entry(0x3001, 1)
    entry.on_read = lambda now_ns: image[:-1] + b"\x00"
    core = carry_out(machine, lambda master: download_image(master, SERVO, 2, image, True))
    assert f"slot 2 reads back wrong: {len(image)} bytes instead" in str(core.failure) or "differs at byte" in str(
        core.failure
    )


def test_an_image_larger_than_the_slot_is_aborted_by_the_drive():
    core = carry_out(build_machine(PAPER), lambda master: download_image(master, SERVO, 1, bytes(70_000), True))
    assert "out of memory" in str(core.failure)


class CammingSession(MachineSession):
    """The gateway's session, but the servo drive runs the cam by itself: mode -2, fed with the CV axis' TPDO."""

    def _commission(self):
        yield from super()._commission()
        entries = (
            MappingEntry(0x0006, 0, 16),  # the CV drive's statusword, a gap here
            MappingEntry(0x3011, 0, 32),  # its position actual value
            MappingEntry(0x0003, 0, 16),  # its torque, a gap
        )
        yield from map_pdo(self.master, 2, 0x1401, 0x1601, 0x181, entries)


class CammingPower(AxisPower):
    """Puts the servo drive into camming where the gateway means cyclic synchronous position."""

    def set_mode(self, axis, mode):
        yield from super().set_mode(axis, -2 if (axis.node.node_id, mode) == (2, 8) else mode)


def test_the_drive_runs_the_downloaded_cam_against_the_actual_position_of_the_cv_axis(prepared, image):
    machine = build_machine(PAPER)
    carry_out(machine, lambda master: download_image(master, SERVO, 1, image, True))
    layout = SampleLayout(PAPER.axis_names)
    packed = bytearray()

    class Sink:
        def append(self, *values):
            packed.extend(layout.pack(*values))

    channels = [
        AxisChannel(name, axis.node_id, axis_units(axis), axis.limits.following_error_counts)
        for name, axis in zip(PAPER.axis_names, PAPER.ordered_axes, strict=True)
    ]
    setups = [AxisSetup(node, channel, 37) for node, channel in zip(node_settings(PAPER), channels, strict=True)]
    guard = Guard(PAPER.guard, PAPER.axis_names)
    loop = CyclicLoop(Steering(channels, guard), 1_000_000, Sink())
    demand = CamDemand(prepared.cam.profile, (channels[0].units, channels[1].units), 0.001, 6.0, 30.0)
    master = build_master(PAPER)
    session = CammingSession(setups, network_settings(PAPER), master, loop, demand, prepared.plan, guard)
    session.power = CammingPower(master, loop)
    core = GatewayCore(session)
    # The servo's own target must play no part: it stays where it was.
    step = demand.step

    def step_without_servo():
        step()
        demand.targets[1] = 0

    demand.step = step_without_servo
    channels[1].following_error_limit = 1 << 30
    bus = VirtualBus([core, machine], PAPER.bus.bit_rate, start_ns=20 * SECOND)
    bus.run_while(lambda: not core.is_done, 60 * SECOND)
    assert core.failure is None
    assert core.stopped_by is StopReason.COMPLETED
    samples = np.frombuffer(bytes(packed), layout.dtype)
    cam = samples[samples["phase"] == Phase.CAM]
    actual = cam["position_actual"]
    assert actual[:, 1].max() == pytest.approx(1135, abs=20)
    wanted = prepared.cam.profile.at_many(actual[:, 0] * math.tau / 4096)[:, 0] * 4096 / math.tau
    # The drive follows the CV axis' position of one SYNC ago: 12.3 counts more than in cyclic synchronous position.
    assert np.abs(actual[:, 1] - wanted).max() < 60
    assert machine.plant.torn_at_s is None
