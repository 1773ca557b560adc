"""Each quirk of real drives: the same stimulus with and without it, and what differs on the bus."""

import struct

import pytest
from fault_line import Line

from config.quirks import Quirk
from sim_drive.assembly import FREE_AXIS_GAINS
from sim_drive.device.quirks import describe_quirks
from sim_drive.settings import DriveSettings

NODE = 5


def line_with(*quirks: Quirk) -> Line:
    line = Line(settings=DriveSettings(gains=FREE_AXIS_GAINS, quirks=frozenset(quirks)))
    line.until(0.1)
    return line


def test_no_boot_up_and_a_short_one() -> None:
    booting = {
        quirk: Line(settings=DriveSettings(quirks=frozenset({quirk} if quirk else ()))).until(0.1)
        for quirk in (None, Quirk.NO_BOOT_UP, Quirk.SHORT_BOOT_UP)
    }
    assert booting == {None: ["705#00"], Quirk.NO_BOOT_UP: [], Quirk.SHORT_BOOT_UP: ["705#"]}
    line = line_with(Quirk.NO_BOOT_UP)
    assert line.put(0x000, "8105") == []
    assert line.read(0x1000) == 0x20192


def map_target_position(line: Line) -> None:
    """RPDO 1 at 205h: 6040h and 607Ah, at every SYNC."""
    for index, subindex, value, size in (
        (0x1400, 1, 0x80000205, 4),
        (0x1400, 2, 1, 1),
        (0x1600, 0, 0, 1),
        (0x1600, 1, 0x60400010, 4),
        (0x1600, 2, 0x607A0020, 4),
        (0x1600, 0, 2, 1),
        (0x1400, 1, 0x205, 4),
    ):
        assert line.write(index, subindex, value, size) == 0


@pytest.mark.parametrize(("quirks", "before_the_sync"), [((), 0), ((Quirk.RPDO_ACTS_ON_RECEIPT,), 100)])
def test_rpdo_acts_on_receipt(quirks: tuple[Quirk, ...], before_the_sync: int) -> None:
    line = line_with(*quirks)
    map_target_position(line)
    line.enable()
    line.put(0x205, struct.pack("<Hi", 0x0F, 100).hex())
    assert line.read(0x607A) == before_the_sync
    line.put(0x080)
    assert line.read(0x607A) == 100


def test_synchronous_tpdos_are_refused() -> None:
    line = line_with(Quirk.SYNCHRONOUS_TPDO_REFUSED)
    for number in range(4):
        assert [line.write(0x1800 + number, 2, kind, 1) for kind in (0, 1, 240)] == [0x06090030] * 3
        assert line.write(0x1800 + number, 2, 255, 1) == 0
        assert line.read(0x1800 + number, 2) == 255
    assert line_with().write(0x1800, 2, 1, 1) == 0


def test_the_rtr_bit_must_be_kept() -> None:
    line = line_with(Quirk.RTR_BIT_MUST_BE_KEPT)
    assert line.read(0x1800, 1) & 0x40000000
    assert line.write(0x1800, 1, 0x80000185, 4) == 0x06090030
    assert line.write(0x1800, 1, 0xC0000185, 4) == 0
    assert line_with().write(0x1800, 1, 0x80000185, 4) == 0


def test_remap_is_refused_in_operational() -> None:
    for quirks, code in (((), 0), ((Quirk.REMAP_REFUSED_IN_OPERATIONAL,), 0x08000022)):
        line = line_with(*quirks)
        assert line.write(0x1800, 1, 0xC0000185, 4) == 0
        line.put(0x000, "0105")
        assert line.write(0x1A00, 0, 0, 1) == code
        assert line.write(0x1800, 2, 255, 1) == code
        assert line.write(0x1400, 1, 0x80000205, 4) == code
        line.put(0x000, "8005")
        assert line.write(0x1A00, 0, 0, 1) == 0


def test_the_wrong_order_of_mapping_has_another_abort_code() -> None:
    for quirks, code in (((), 0x06010000), ((Quirk.OTHER_REMAP_ABORT_CODE,), 0x06090030)):
        line = line_with(*quirks)
        line.write(0x1800, 1, 0x40000185, 4)
        assert line.write(0x1A00, 0, 0, 1) == code
        assert line.write(0x1A00, 1, 0x60410010, 4) == code


def test_block_transfer_is_an_unknown_command() -> None:
    upload, download = "A40810007F000000", "C6003001E8030000"
    line = line_with()
    assert [answer[:8] for answer in line.sdo(upload)] == ["C6081000"]
    assert line.sdo("8008100000000000") == []
    assert [answer[:8] for answer in line.sdo(download)] == ["A4003001"]
    line = line_with(Quirk.NO_BLOCK_TRANSFER)
    for request in (upload, download):
        assert [answer[-8:] for answer in line.sdo(request)] == ["01000405"]
    assert line.read(0x1000) == 0x20192


def test_homing_method_0_is_refused() -> None:
    assert line_with().write(0x6098, 0, 0, 1) == 0
    line = line_with(Quirk.NO_HOMING_METHOD_0)
    assert line.write(0x6098, 0, 0, 1) == 0x06090030
    assert line.write(0x6098, 0, 37, 1) == 0


def test_bit_12_is_set_whenever_operation_is_enabled() -> None:
    for quirks, bit in (((), 0), ((Quirk.SET_POINT_ACKNOWLEDGE_STAYS,), 0x1000)):
        line = line_with(*quirks)
        line.enable()
        assert line.write(0x6060, 0, 6, 1) == 0
        line.run(0.01)
        assert line.read(0x6041) & 0x1000 == bit
        assert line.write(0x6040, 0, 0x07, 2) == 0
        line.run(0.01)
        assert line.read(0x6041) & 0x106F == 0x0023


def test_a_slow_mode_switch_shows_the_mode_when_it_is_entered() -> None:
    for quirks, shown in (((), [8, 8, 8]), ((Quirk.SLOW_MODE_SWITCH,), [0, 0, 8])):
        line = line_with(*quirks)
        line.until(1.0)
        assert line.write(0x6060, 0, 8, 1) == 0
        modes = []
        for at_s in (1.01, 1.09, 1.11):
            line.until(at_s)
            modes.append(line.read(0x6061))
        assert modes == shown
        assert line.read(0x6060) == 8


def test_a_mode_that_is_asked_for_meanwhile_starts_the_slow_switch_anew() -> None:
    line = line_with(Quirk.SLOW_MODE_SWITCH)
    line.until(1.0)
    line.write(0x6060, 0, 8, 1)
    line.until(1.05)
    line.write(0x6060, 0, 6, 1)
    line.until(1.12)
    assert line.read(0x6061) == 0
    line.until(1.16)
    assert line.read(0x6061) == 6


def test_the_interpolation_time_is_in_milliseconds() -> None:
    for quirks, code in (((), 0), ((Quirk.INTERPOLATION_TIME_IN_MILLISECONDS,), 0x06090030)):
        line = line_with(*quirks)
        assert line.write(0x60C2, 2, -4, 1) == code
        assert line.write(0x60C2, 2, -3, 1) == 0


def test_cyclic_modes_need_the_cycle_period() -> None:
    line = line_with(Quirk.CYCLE_PERIOD_NEEDED)
    assert line.write(0x6060, 0, 8, 1) == 0x08000022
    assert line.write(0x6060, 0, 6, 1) == 0
    assert line.write(0x1006, 0, 1000, 4) == 0
    assert line.write(0x6060, 0, 8, 1) == 0
    assert line_with().write(0x6060, 0, 8, 1) == 0


def test_there_is_no_cyclic_position_mode() -> None:
    usual, line = line_with(), line_with(Quirk.NO_CYCLIC_POSITION_MODE)
    assert line.read(0x6502) == usual.read(0x6502) & ~0x80
    assert line.write(0x6060, 0, 8, 1) == 0x06090030
    assert line.read(0x6061) == 0
    assert usual.write(0x6060, 0, 8, 1) == 0


def test_the_torque_offset_cannot_be_mapped() -> None:
    for quirks, code in (((), 0), ((Quirk.TORQUE_OFFSET_NOT_MAPPABLE,), 0x06040041)):
        line = line_with(*quirks)
        assert line.write(0x1400, 1, 0x80000205, 4) == 0
        assert line.write(0x1600, 0, 0, 1) == 0
        assert line.write(0x1600, 1, 0x60B20010, 4) == code
        assert line.write(0x1600, 1, 0x60400010, 4) == 0
        assert line.write(0x60B2, 0, 5, 2) == 0


def test_every_quirk_is_listed() -> None:
    assert describe_quirks().splitlines() == [quirk.value for quirk in Quirk]


@pytest.mark.parametrize("quirks", [(), (Quirk.LATE_SYNC_FREEZES,)])
def test_a_late_sync_freezes_the_axis(quirks: tuple[Quirk, ...]) -> None:
    line = line_with(*quirks)
    map_target_position(line)
    assert line.write(0x1006, 0, 10_000, 4) == 0
    assert line.write(0x60C2, 1, 10, 1) == 0
    line.enable()
    target = 0
    for _ in range(10):
        target += 100
        line.put(0x205, struct.pack("<Hi", 0x0F, target).hex(), 0.001)
        line.put(0x080, span_s=0.009)
    assert not line.read(0x6041) & 0x8000
    # The last target was to be reached 10 ms after its SYNC; then the next one is late, and a drive without the habit
    # goes on for one interpolation time more.
    line.run(0.009)
    is_frozen = bool(quirks)
    assert bool(line.read(0x6041) & 0x8000) is is_frozen
    assert line.drive().position_demand_counts == pytest.approx(target + (0 if is_frozen else 75), abs=35)
    assert line.read(0x6041) & 0x6F == 0x27
    line.put(0x205, struct.pack("<Hi", 0x0F, target).hex(), 0.001)
    line.put(0x080, span_s=0.005)
    assert not line.read(0x6041) & 0x8000
    assert line.write(0x6040, 0, 0x07, 2) == 0


def test_without_a_cycle_period_no_sync_is_late() -> None:
    line = line_with(Quirk.LATE_SYNC_FREEZES)
    map_target_position(line)
    line.enable()
    line.put(0x205, struct.pack("<Hi", 0x0F, 0).hex())
    line.put(0x080)
    line.run(0.003)
    assert not line.read(0x6041) & 0x8000


def test_the_abort_option_may_not_be_there_or_not_be_kept() -> None:
    for quirks, answer, read in (((), 0, 3), ((Quirk.ABORT_OPTION_STAYS,), 0, 0)):
        line = line_with(*quirks)
        assert line.write(0x6007, 0, 3, 2) == answer
        assert line.read(0x6007) == read
    assert line_with(Quirk.NO_ABORT_OPTION).write(0x6007, 0, 1, 2) == 0x06020000


@pytest.mark.parametrize(
    ("quirks", "state"), [((), 0x08), ((Quirk.ABORT_OPTION_STAYS,), 0x27), ((Quirk.NO_ABORT_OPTION,), 0x27)]
)
def test_without_the_abort_option_a_lost_master_stops_nothing(quirks: tuple[Quirk, ...], state: int) -> None:
    line = line_with(*quirks)
    line.write(0x6007, 0, 1, 2)
    assert line.write(0x1016, 1, 0x7F0032, 4) == 0
    line.put(0x77F, "05")
    line.enable()
    line.run(0.2)
    assert line.read(0x6041) & 0x6F == state
