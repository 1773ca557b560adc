"""A node of two logical axes: the second has objects, PDOs, errors and a state machine of its own."""

from dataclasses import replace

import pytest
from drive_bench import MS, TICK_NS, Bench, decode_bench_image, described

from drivers.eds import describe_any_node
from drivers.frame import Frame
from sim_drive.assembly import SHIPPED_EDS, settings_of_axes
from sim_drive.device.cia402 import PowerState
from sim_drive.device.drive import Drive, DriveSettings
from sim_drive.device.quirks import Quirk
from sim_drive.logical_axes import eds_of_axes, in_first_axis, of_axis

DESCRIBE_TWO = describe_any_node(SHIPPED_EDS, lambda text: eds_of_axes(text, 2))
TWO = DESCRIBE_TWO(5)
OVER_CURRENT = 0x2310


class TwoAxes(Bench):
    """Node 5 with two axes, whose shafts are where their demands are."""

    def __init__(self, settings: DriveSettings | None = None) -> None:
        super().__init__(boot=False)
        two = settings_of_axes(settings or DriveSettings(), 2)
        self.drive = Drive(5, TWO, two, decode_bench_image)
        self.shafts = [0, 0]
        self.drive.wake(0)
        self.tick()
        self.drive.take_frames()
        self.drive.take_events()

    def run(self, span_ns: int) -> list[str]:
        end_ns = self.now_ns + span_ns
        while self.now_ns < end_ns:
            self.now_ns += TICK_NS
            self.drive.on_servo_tick(self.now_ns, *self.shafts)
            for place, axis in enumerate(self.drive.axes):
                if axis.is_powered:
                    self.shafts[place] = round(axis.position_demand_counts)
            self.wake()
        return self.sent()

    def enable_axis(self, number: int, mode: int = 8) -> None:
        shift = 0x800 * (number - 1)
        self.must(0x6060 + shift, 0, mode, 1)
        self.tick()
        for word in (0x06, 0x07, 0x0F):
            self.must(0x6040 + shift, 0, word, 2)
        assert self.drive.axes[number - 1].state is PowerState.OPERATION_ENABLED

    @property
    def states(self) -> list[PowerState]:
        return [axis.state for axis in self.drive.axes]


@pytest.mark.parametrize(
    ("index", "number", "place"),
    [
        (0x6040, 1, 0x6040),
        (0x6040, 2, 0x6840),
        (0x67FF, 8, 0x9FFF),
        (0x1000, 2, 0x1000),
        (0x3020, 2, 0x3120),
        (0x3030, 2, 0x3030),
        (0x3000, 8, 0x3700),
    ],
)
def test_where_an_axis_has_its_objects(index: int, number: int, place: int):
    assert of_axis(index, number) == place
    assert in_first_axis(place) == index


def test_the_dictionary_has_everything_twice_and_pdos_of_the_second_axis_are_off():
    one = described(5)
    assert TWO.get(0x1000, 0) == replace(one.get(0x1000, 0), default=0xFFFF0192)
    for variable in one:
        moved = 0x6000 <= variable.index < 0x6800
        if moved or variable.index in (0x3000, 0x3010, 0x3011, 0x3012, 0x3020):
            other = TWO.get(variable.index + (0x800 if moved else 0x100), variable.subindex)
            assert other is not None
            assert replace(other, index=variable.index, name=variable.name) == variable
    for index in (0x1440, 0x1443, 0x1840, 0x1843):
        entry = TWO.get(index, 1)
        assert entry is not None
        assert entry.default == 0x80000000
    first = TWO.get(0x1640, 1)
    assert first is not None
    assert first.default == 0x68400010
    assert 0x1444 not in TWO
    assert 0x7040 not in TWO


def test_states_are_the_axes_own():
    bench = TwoAxes()
    bench.enable_axis(2)
    assert bench.states == [PowerState.SWITCH_ON_DISABLED, PowerState.OPERATION_ENABLED]
    assert bench.read(0x6041) == 0x0250
    assert bench.read(0x6841) == 0x1237
    assert bench.read(0x6861) == 8
    assert bench.read(0x6061) == 0


def test_a_fault_is_one_axis_own_and_the_emcy_names_it():
    bench = TwoAxes()
    bench.enable_axis(1)
    bench.enable_axis(2)
    bench.drive.trip(OVER_CURRENT, 0x02, bench.now_ns, axis=2)
    assert bench.sent() == ["085#1023030200000000"]
    bench.run(500 * MS)
    assert bench.states == [PowerState.OPERATION_ENABLED, PowerState.FAULT]
    assert (bench.read(0x603F), bench.read(0x683F), bench.read(0x1001)) == (0, OVER_CURRENT, 0x03)
    assert bench.read(0x1003, 1) == OVER_CURRENT
    # The other axis has a fault of its own: both count, and only the last reset says that there is none.
    bench.drive.trip(0x4310, 0x08, bench.now_ns, axis=1)
    assert bench.sent() == ["085#10430B0100000000"]
    bench.run(500 * MS)
    assert (bench.read(0x603F), bench.read(0x683F), bench.read(0x1001)) == (0x4310, OVER_CURRENT, 0x0B)
    bench.aside.clear()
    bench.must(0x6840, 0, 0x80, 2)
    assert bench.aside == []
    assert (bench.read(0x603F), bench.read(0x683F), bench.read(0x1001)) == (0x4310, 0, 0x09)
    assert bench.states == [PowerState.FAULT, PowerState.SWITCH_ON_DISABLED]
    bench.must(0x6040, 0, 0x80, 2)
    assert bench.aside == ["085#0000000000000000"]
    assert (bench.read(0x603F), bench.read(0x1001)) == (0, 0)


def test_an_error_of_the_node_shows_in_both_axes():
    bench = TwoAxes()
    bench.drive.warn(0x8120, 0x10, bench.now_ns)
    assert bench.sent() == ["085#2081110000000000"]
    assert (bench.read(0x603F), bench.read(0x683F)) == (0x8120, 0x8120)
    bench.drive.end_warning(0x8120, bench.now_ns)
    assert bench.sent() == ["085#0000000000000000"]


def test_a_cause_that_persists_holds_back_the_reset_of_its_axis_alone():
    bench = TwoAxes()
    for axis in (1, 2):
        bench.drive.trip(0xFF30, 0x80, bench.now_ns, persists=axis == 2, axis=axis)
    bench.run(3 * MS)
    for index in (0x6040, 0x6840):
        bench.must(index, 0, 0x80, 2)
    assert bench.states == [PowerState.SWITCH_ON_DISABLED, PowerState.FAULT]
    bench.drive.end_trip(0xFF30, bench.now_ns, axis=2)
    bench.must(0x6840, 0, 0x00, 2)
    bench.must(0x6840, 0, 0x80, 2)
    assert bench.states[1] is PowerState.SWITCH_ON_DISABLED


def test_losing_the_master_stops_both_axes():
    bench = TwoAxes()
    bench.must(0x1016, 1, 0x7F0064, 4)
    bench.enable_axis(1)
    bench.enable_axis(2)
    bench.put(0x77F, "05")
    sent = bench.run(500 * MS)
    assert sent == ["085#3081110100000000", "085#3081110200000000"]
    assert bench.states == [PowerState.FAULT, PowerState.FAULT]


def test_one_sync_samples_and_moves_both_axes():
    bench = TwoAxes()
    positions = {0: 100, 1: 200}
    for place, axis in enumerate(bench.drive.axes):
        axis.latch = lambda now_ns, place=place: (positions[place], 0.0, place + 1)
    bench.map_rpdo(1, 0x205, 1, [0x60400010, 0x607A0020])
    bench.map_rpdo(65, 0x305, 1, [0x68400010, 0x687A0020])
    bench.map_tpdo(1, 0x185, 1, [0x60640020, 0x60770010])
    bench.map_tpdo(65, 0x285, 1, [0x68640020, 0x68770010])
    bench.map_tpdo(66, 0x385, 1, [0x60640020, 0x68640020])
    for number in (1, 2):
        bench.must(of_axis(0x60C2, number), 1, 1, 1)
    bench.nmt(0x01)
    bench.enable_axis(1)
    bench.enable_axis(2)
    assert bench.put(0x205, "0F00" + "0A000000") == []
    assert bench.put(0x305, "0F00" + "14000000") == []
    assert bench.sync() == ["185#640000000100", "285#C80000000200", "385#64000000C8000000"]
    bench.run(2 * MS)
    assert [axis.position_demand_counts for axis in bench.drive.axes] == [10.0 + 10.0, 20.0 + 20.0]


def test_an_rpdo_of_one_axis_leaves_the_other_alone():
    bench = TwoAxes()
    bench.map_rpdo(65, 0x305, 1, [0x68400010, 0x687A0020])
    bench.nmt(0x01)
    bench.enable_axis(1)
    bench.enable_axis(2)
    bench.put(0x305, "0F00" + "0A000000")
    bench.sync()
    bench.run(3 * MS)
    assert bench.shafts[0] == 0
    assert bench.shafts[1] > 0
    # And the missing set-points of the second axis are the second axis' alone.
    bench.run(300 * MS)
    assert bench.states == [PowerState.OPERATION_ENABLED, PowerState.FAULT]
    assert bench.read(0x683F) == 0x8700


def test_an_event_tpdo_of_the_second_axis_is_sent_when_its_statusword_changes():
    bench = TwoAxes()
    bench.must(0x1800, 1, 0xC0000185, 4)
    bench.map_tpdo(65, 0x285, 255, [0x68410010])
    bench.nmt(0x01)
    assert bench.tick() == ["285#5002"]
    bench.must(0x6840, 0, 0x06, 2)
    assert bench.tick() == ["285#3102"]
    bench.must(0x6040, 0, 0x06, 2)
    assert bench.run(5 * MS) == []


def test_the_axes_have_slots_and_gains_of_their_own():
    bench = TwoAxes()
    bench.must(0x3120, 1, 777, 4)
    assert bench.drive.axes[1].gains[0] == 777
    assert bench.drive.axes[0].gains[0] != 777
    assert bench.download(0x3101, 1, b"OK" + bytes(16)) == 0
    bench.must(0x3101, 2, 1, 1)
    assert (bench.read(0x3101, 3), bench.read(0x3001, 3)) == (2, 0)


def test_saved_parameters_of_the_second_axis_come_back_and_its_demands_do_not():
    bench = TwoAxes()
    bench.must(0x6881, 0, 4321, 4)
    bench.must(0x68FF, 0, 99, 4)
    bench.must(0x1010, 1, 0x65766173, 4)
    bench.nmt(0x81)
    bench.tick()
    assert bench.read(0x6881) == 4321
    assert bench.read(0x6081) != 4321
    assert bench.read(0x68FF) == 0


def test_habits_are_every_axis():
    bench = TwoAxes(DriveSettings(quirks=frozenset({Quirk.NO_HOMING_METHOD_0, Quirk.NO_CYCLIC_POSITION_MODE})))
    for shift in (0, 0x800):
        assert bench.write(0x6098 + shift, 0, 0, 1) == 0x06090030
        assert bench.write(0x6060 + shift, 0, 8, 1) == 0x06090030
        assert not bench.read(0x6502 + shift) & 0x80


def test_without_supply_no_axis_does_anything():
    bench = TwoAxes()
    bench.enable_axis(2)
    bench.drive.switch_off(bench.now_ns)
    bench.shafts = [50, 60]
    assert bench.run(5 * MS) == []
    assert bench.states == [PowerState.NOT_READY_TO_SWITCH_ON] * 2
    bench.drive.trip(0xFF30, 0x80, bench.now_ns, persists=True, axis=2)
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    bench.drive.switch_on(bench.now_ns)
    assert bench.run(5 * MS)[0] == "705#00"
    assert bench.states == [PowerState.SWITCH_ON_DISABLED, PowerState.FAULT]
    assert bench.read(0x6864, signed=True) == 60


@pytest.mark.parametrize("axes", [0, 9])
def test_a_node_has_one_to_eight_axes(axes: int):
    with pytest.raises(ValueError, match=f"1 to 8 axes, not {axes}"):
        settings_of_axes(DriveSettings(), axes)


def test_more_axes_than_there_is_room_for_are_refused():
    with pytest.raises(ValueError, match="at most 8 axes, not 9"):
        Drive(5, TWO, DriveSettings(further_axes=(DriveSettings(),) * 8), decode_bench_image)
    with pytest.raises(KeyError, match="703Fh"):
        Drive(5, TWO, settings_of_axes(DriveSettings(), 3), decode_bench_image)


def test_a_remote_frame_samples_the_axis_that_its_tpdo_carries():
    bench = TwoAxes()
    bench.drive.axes[1].latch = lambda now_ns: (77, 0.0, 0)
    bench.must(0x1840, 1, 0x80000285, 4)
    bench.must(0x1A40, 0, 0, 1)
    bench.must(0x1A40, 1, 0x68640020, 4)
    bench.must(0x1A40, 0, 1, 1)
    bench.must(0x1840, 2, 253, 1)
    bench.must(0x1840, 1, 0x285, 4)
    bench.nmt(0x01)
    bench.drive.receive(Frame(0x285, is_remote=True), bench.now_ns)
    assert bench.sent() == ["285#4D000000"]
