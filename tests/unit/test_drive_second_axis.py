"""An axis whose objects are those of logical axis 1 of a node, 800h further on."""

from dataclasses import replace

from drive_bench import described

from drivers.object_dictionary import ObjectDictionary
from sim_drive.axis import Axis
from sim_drive.cam_slots import CamSlots
from sim_drive.cia402 import PowerState
from sim_drive.dictionary import LiveDictionary
from sim_drive.emcy import EmergencyProducer
from sim_drive.settings import DriveSettings


def no_cam(image: bytes):
    raise AssertionError(image)


def test_objects_of_the_second_axis_are_its_own():
    described_axis = list(described(5))
    second = [replace(v, index=v.index + 0x800) for v in described_axis if 0x6000 <= v.index <= 0x67FF]
    variables = [*described_axis, *second]
    codes = {v.index: described(5).object_code(v.index - 0x800 if v.index >= 0x6800 else v.index) for v in variables}
    live = LiveDictionary(ObjectDictionary(variables, codes))
    emergency = EmergencyProducer(5, live, [], [])
    axis = Axis(5, live, DriveSettings(), CamSlots(live, no_cam), emergency, [], base=0x800)
    for tick in range(2):
        axis.on_tick(tick, 7)
    for word in (0x06, 0x07, 0x0F):
        assert live.write(0x6840, 0, word.to_bytes(2, "little"), 0) is None
    assert axis.state is PowerState.OPERATION_ENABLED
    assert live.entry(0x6841).value & 0x6F == 0x27
    assert live.entry(0x6041).value == 0
