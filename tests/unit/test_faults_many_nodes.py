"""Any number of drives in one process: a whole bus of them, and several machines on one."""

from pathlib import Path

import pytest

from config.loading import load_config
from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from sim_drive.assembly import build_machine, free_machine
from sim_drive.device.drive import Drive
from sim_drive.injection.faults import Fault, FaultKind
from sim_drive.injection.injector import Injector
from sim_drive.settings import DriveSettings

MS = 1_000_000


class Caller:
    """Sends frames that are put into ``out``, and keeps what it hears."""

    def __init__(self) -> None:
        self.out: list[Frame] = []
        self.heard: list[Frame] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.heard.append(frame)

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        raise AssertionError("nobody asked for it")

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


def test_a_whole_bus_boots_in_the_order_of_arbitration_and_each_node_has_its_own_serial_number() -> None:
    caller = Caller()
    bus = VirtualBus([caller, free_machine(range(127, 0, -1))], 1_000_000)
    bus.run_until(20 * MS)
    first, *others = (frame.cob_id - 0x700 for frame in caller.heard)
    assert first == 127, "the first to be asked had the bus to itself"
    assert sorted([first, *others]) == list(range(1, 128))
    caller.heard.clear()
    for node_id in (1, 64, 127):
        caller.out.append(Frame(0x600 + node_id, b"\x40\x18\x10\x04\0\0\0\0"))
    bus.run_until(25 * MS)
    assert [(frame.cob_id - 0x580, frame.data[4]) for frame in caller.heard] == [(1, 1), (64, 64), (127, 127)]


def test_several_machines_share_a_bus_and_only_one_of_them_fails() -> None:
    caller = Caller()
    machines = [build_machine(load_config("paper")), free_machine([10, 11]), free_machine([20])]
    faulty = Injector(machines[1], [Fault(FaultKind.POWER_CYCLE, 10, 0.1, 0.2)])
    bus = VirtualBus([caller, machines[0], faulty, machines[2]], 1_000_000)
    bus.run_until(50 * MS)
    assert sorted(frame.cob_id - 0x700 for frame in caller.heard) == [1, 2, 10, 11, 20]
    caller.heard.clear()
    bus.run_until(200 * MS)
    caller.out.append(Frame(0x000, b"\x81\x00"))
    bus.run_until(250 * MS)
    assert sorted(frame.cob_id - 0x700 for frame in caller.heard) == [1, 2, 11, 20]
    caller.heard.clear()
    bus.run_until(350 * MS)
    assert caller.heard == [Frame(0x70A, b"\0")]


def test_settings_are_of_every_drive() -> None:
    machine = free_machine([3, 4], settings=DriveSettings(counts_per_revolution=65536, gains=(1, 2, 3, 4, 5)))
    for drive in machine.drives:
        assert isinstance(drive, Drive)
        assert drive.axis.gains == (1, 2, 3, 4, 5)
        assert drive.dictionary.read(0x608F, 1, 0) == bytes((0, 0, 1, 0))
    assert [axis.counts_per_revolution for axis in machine.axes] == [65536, 65536]


def test_every_drive_has_a_parameter_file_of_its_own(tmp_path: Path) -> None:
    machine = free_machine([3, 4], settings=DriveSettings(parameter_file=tmp_path / "row.json"))
    files = [drive.settings.parameter_file for drive in machine.drives if isinstance(drive, Drive)]
    assert files == [tmp_path / "row-3.json", tmp_path / "row-4.json"]


@pytest.mark.parametrize(
    ("node_ids", "sentence"),
    [
        ([], "a machine needs a node"),
        ([1, 2, 1], "node id 1 is given twice, every node id must be unique"),
        ([0], "node_id must be 1 to 127, not 0"),
        ([128], "node_id must be 1 to 127, not 128"),
    ],
)
def test_impossible_node_ids_are_refused(node_ids: list[int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        free_machine(node_ids)
