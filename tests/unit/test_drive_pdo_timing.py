"""SYNC counter and window, RPDO event timers, and remote requests of the emulated drive (CiA 301, 7.2.2, 7.2.5)."""

import pytest
from drive_bench import MS, Bench

from drivers.frame import Frame

RANGE = 0x06090030
DEVICE_STATE = 0x08000022


@pytest.fixture
def bench() -> Bench:
    return Bench()


def request(bench: Bench, cob_id: int) -> list[str]:
    bench.drive.receive(Frame(cob_id, b"", is_remote=True), bench.now_ns)
    return bench.sent()


# -- SYNC counter ------------------------------------------------------------------------------------------------------


def test_counter_makes_the_sync_one_byte_long(bench: Bench):
    bench.must(0x1019, 0, 10, 1)
    bench.map_tpdo(1, 0x185, 1, [0x60610008])
    bench.nmt(0x01)
    assert bench.put(0x080, "01") == ["185#00"]
    assert bench.put(0x080, "") == ["085#4082110000000000"]
    assert bench.put(0x080, "0203") == []
    assert bench.put(0x080, "02") == ["085#0000000000000000", "185#00"]
    bench.must(0x1019, 0, 0, 1)
    assert bench.put(0x080, "") == ["185#00"]


@pytest.mark.parametrize(("value", "code"), [(1, RANGE), (241, 0x06090031), (255, 0x06090031), (2, 0), (240, 0)])
def test_counter_overflow_value_is_0_or_2_to_240(bench: Bench, value: int, code: int):
    assert bench.write(0x1019, 0, value, 1) == code
    assert bench.read(0x1019) == (0 if code else value)


def test_counter_overflow_value_stays_while_there_is_a_cycle_period(bench: Bench):
    bench.must(0x1006, 0, 1000, 4)
    assert bench.write(0x1019, 0, 10, 1) == DEVICE_STATE
    bench.must(0x1006, 0, 0, 4)
    bench.must(0x1019, 0, 10, 1)


def set_start(bench: Bench, number: int, value: int) -> None:
    cob_id = bench.read(0x1800 + number - 1, 1)
    bench.must(0x1800 + number - 1, 1, 0x80000000 | cob_id, 4)
    bench.must(0x1800 + number - 1, 6, value, 1)
    bench.must(0x1800 + number - 1, 1, cob_id, 4)


def test_start_value_lets_a_pdo_begin_at_its_own_sync(bench: Bench):
    bench.must(0x1019, 0, 4, 1)
    bench.map_tpdo(1, 0x185, 2, [0x60610008])
    bench.map_tpdo(2, 0x285, 2, [0x10010008])
    bench.map_tpdo(3, 0x385, 1, [0x60610008])
    set_start(bench, 1, 2)
    set_start(bench, 2, 3)
    set_start(bench, 3, 4)
    bench.nmt(0x01)
    assert [bench.put(0x080, f"0{n}") for n in (4, 1, 2, 3, 4, 1, 2, 3)] == [
        ["385#00"],
        ["385#00"],
        ["385#00"],  # the first SYNC of TPDO 1
        ["185#00", "385#00"],  # its second, and the first of TPDO 2
        ["285#00", "385#00"],
        ["185#00", "385#00"],
        ["285#00", "385#00"],
        ["185#00", "385#00"],
    ]
    # Becoming operational begins anew.
    bench.nmt(0x80)
    bench.nmt(0x01)
    assert bench.put(0x080, "02") == []
    assert bench.put(0x080, "03") == ["185#00"]


def test_start_value_means_nothing_without_a_counter(bench: Bench):
    bench.map_tpdo(1, 0x185, 1, [0x60610008])
    set_start(bench, 1, 7)
    bench.nmt(0x01)
    assert bench.sync() == ["185#00"]


def test_start_value_stays_while_the_pdo_is_valid(bench: Bench):
    assert bench.write(0x1800, 6, 1, 1) == RANGE
    bench.must(0x1800, 1, 0xC0000185, 4)
    bench.must(0x1800, 6, 240, 1)
    assert bench.write(0x1800, 6, 241, 1) == 0x06090031
    assert bench.read(0x1800, 6) == 240


# -- synchronous window ------------------------------------------------------------------------------------------------


def test_what_comes_after_the_window_is_not_used(bench: Bench):
    bench.must(0x1007, 0, 2000, 4)  # 2 ms
    bench.map_rpdo(1, 0x205, 1, [0x60660010])
    bench.map_rpdo(2, 0x305, 255, [0x60650020])
    bench.nmt(0x01)
    bench.put(0x205, "1100")  # there is no window before the first SYNC
    bench.sync()
    assert bench.read(0x6066) == 0x11
    bench.run(2 * MS)
    bench.put(0x205, "2200")  # at its very end
    bench.sync()
    assert bench.read(0x6066) == 0x22
    bench.run(3 * MS)
    assert bench.put(0x205, "3300") == []
    assert bench.put(0x305, "44000000") == []  # no concern of an event-driven one
    bench.sync()
    assert bench.read(0x6066) == 0x22
    assert bench.read(0x6065) == 0x44
    bench.put(0x205, "5500")
    bench.sync()
    assert bench.read(0x6066) == 0x55


def test_window_may_be_closed_again(bench: Bench):
    bench.must(0x1007, 0, 1000, 4)
    bench.map_rpdo(1, 0x205, 1, [0x60660010])
    bench.nmt(0x01)
    bench.sync()
    bench.run(5 * MS)
    bench.must(0x1007, 0, 0, 4)
    bench.put(0x205, "1100")
    bench.sync()
    assert bench.read(0x6066) == 0x11


# -- RPDO event timer --------------------------------------------------------------------------------------------------


def test_rpdo_that_fails_to_come_is_told_once_and_forgiven_when_it_comes(bench: Bench):
    bench.must(0x1400, 5, 20, 2)
    bench.map_rpdo(1, 0x205, 255, [0x60650020])
    bench.nmt(0x01)
    assert bench.run(100 * MS) == ["185#5002"]  # nothing is missed before it has come once
    bench.put(0x205, "11000000")
    assert bench.run(19 * MS) == []
    bench.put(0x205, "12000000")
    assert bench.run(19 * MS) == []
    assert bench.run(1 * MS) == ["085#5082110000000000"]
    assert bench.read(0x1001) == 0x11
    assert bench.read(0x1003, 1) == 0x8250
    assert bench.run(100 * MS) == []
    assert bench.put(0x205, "13000000") == ["085#0000000000000000"]
    assert bench.read(0x6065) == 0x13


def test_two_rpdos_are_forgiven_when_both_have_come(bench: Bench):
    for number, cob_id, word in ((1, 0x205, 0x60650020), (2, 0x305, 0x60660010)):
        bench.must(0x1400 + number - 1, 5, 10 * number, 2)
        bench.map_rpdo(number, cob_id, 255, [word])
    bench.nmt(0x01)
    bench.put(0x205, "11000000")
    bench.put(0x305, "1100")
    assert [frame for frame in bench.run(50 * MS) if frame.startswith("085")] == ["085#5082110000000000"]
    assert bench.put(0x205, "11000000") == []
    assert bench.put(0x305, "1100") == ["085#0000000000000000"]


def test_short_rpdo_is_no_arrival(bench: Bench):
    bench.must(0x1400, 5, 20, 2)
    bench.map_rpdo(1, 0x205, 255, [0x60650020])
    bench.nmt(0x01)
    bench.put(0x205, "11000000")
    bench.run(10 * MS)
    bench.put(0x205, "110000")
    assert bench.run(9 * MS) == []
    assert bench.run(1 * MS) == ["085#5082110000000000"]


def test_leaving_operational_and_reconfiguring_end_the_watch(bench: Bench):
    bench.must(0x1400, 5, 20, 2)
    bench.map_rpdo(1, 0x205, 255, [0x60650020])
    bench.nmt(0x01)
    bench.put(0x205, "11000000")
    bench.nmt(0x80)
    bench.sent()
    assert bench.run(100 * MS) == []
    bench.nmt(0x01)
    bench.put(0x205, "11000000")
    assert "085#5082110000000000" in bench.run(100 * MS)
    bench.must(0x1400, 5, 0, 2)
    assert bench.aside == ["085#0000000000000000"]
    bench.put(0x205, "11000000")
    assert bench.run(100 * MS) == []


# -- remote requests ---------------------------------------------------------------------------------------------------


def test_type_253_answers_with_the_values_of_the_moment(bench: Bench):
    bench.map_tpdo(1, 0x185, 253, [0x60640020])
    assert 0x185 in bench.drive.cob_ids()
    assert request(bench, 0x185) == []  # not in pre-operational
    bench.nmt(0x01)
    assert bench.sync() == []
    assert bench.run(100 * MS) == []
    bench.drive.axis.latch = lambda now_ns: (now_ns // MS, 0.0, 0)
    bench.now_ns = 0x321 * MS
    assert request(bench, 0x185) == ["185#21030000"]
    bench.now_ns = 0x322 * MS
    assert request(bench, 0x185) == ["185#22030000"]


def test_type_252_answers_with_the_sample_of_the_last_sync(bench: Bench):
    bench.map_tpdo(1, 0x185, 252, [0x60640020])
    bench.nmt(0x01)
    assert request(bench, 0x185) == []
    bench.drive.axis.latch = lambda now_ns: (now_ns // MS, 0.0, 0)
    bench.now_ns = 0x321 * MS
    assert bench.sync() == []
    bench.now_ns = 0x322 * MS
    assert request(bench, 0x185) == ["185#21030000"]
    assert request(bench, 0x185) == ["185#21030000"]


def test_event_driven_pdo_answers_if_its_cob_id_allows_it(bench: Bench):
    bench.nmt(0x01)
    bench.tick()
    assert request(bench, 0x185) == []  # bit 30 is set by default
    bench.must(0x1800, 1, 0x185, 4)
    assert request(bench, 0x185) == ["185#5002"]
    bench.must(0x1800, 1, 0x40000185, 4)
    assert request(bench, 0x185) == []
    assert 0x185 not in bench.drive.cob_ids()


def test_data_frame_of_a_tpdos_cob_id_is_no_request(bench: Bench):
    bench.map_tpdo(1, 0x185, 253, [0x60640020])
    bench.nmt(0x01)
    assert bench.put(0x185, "") == []


def test_synchronous_pdo_waits_for_its_sync(bench: Bench):
    bench.map_tpdo(1, 0x185, 1, [0x60610008])
    bench.nmt(0x01)
    assert request(bench, 0x185) == []
