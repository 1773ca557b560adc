"""Conformance of the emulated drive as a CiA 402 device, rows 18 to 27: every byte written out by hand."""

from itertools import pairwise
from math import inf

import pytest
from conformance_bench import Bus

from sim_drive.assembly import FREE_AXIS_GAINS
from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

RANGE = 0x06090030
CANNOT = {0x08000020, 0x08000021, 0x08000022, 0x05040005}
"""Not now: device state, local control, no memory."""
START, STOP, PRE_OPERATIONAL, RESET_NODE = "000#0105", "000#0205", "000#8005", "000#8105"

# Statusword mask and value of every state, as the standard's table has them.
MASKS = {
    "not ready to switch on": (0x4F, 0x00),
    "switch on disabled": (0x4F, 0x40),
    "ready to switch on": (0x6F, 0x21),
    "switched on": (0x6F, 0x23),
    "operation enabled": (0x6F, 0x27),
    "quick stop active": (0x6F, 0x07),
    "fault reaction active": (0x4F, 0x0F),
    "fault": (0x4F, 0x08),
}
TARGET_REACHED, LIMIT, BIT_12, BIT_13 = 0x0400, 0x0800, 0x1000, 0x2000


@pytest.fixture
def bus() -> Bus:
    return Bus()


def code_of(answer: str) -> int:
    assert answer[:2] == "80", answer
    return int.from_bytes(bytes.fromhex(answer[8:]), "little")


def state_of(statusword: int) -> str:
    names = [name for name, (mask, value) in MASKS.items() if statusword & mask == value]
    assert len(names) == 1, f"{statusword:04X}h is {names}"
    return names[0]


def state(bus: Bus) -> str:
    return state_of(bus.statusword)


def u16(value: int) -> str:
    return (value & 0xFFFF).to_bytes(2, "little").hex().upper()


def i32(value: int) -> str:
    return (value & 0xFFFFFFFF).to_bytes(4, "little").hex().upper()


def control(bus: Bus, word: int) -> None:
    bus.done("2B406000" + u16(word) + "0000")


def position(bus: Bus) -> int:
    return bus.value("646000", signed=True)


def demand(bus: Bus) -> int:
    return bus.value("626000", signed=True)


def velocity(bus: Bus) -> int:
    return bus.value("6C6000", signed=True)


def ramps(bus: Bus, profile: int = 100_000, quick_stop: int = 400_000) -> None:
    """Profile acceleration and deceleration 6083h and 6084h, quick stop deceleration 6085h, in counts/s^2."""
    bus.done("23836000" + i32(profile), "23846000" + i32(profile), "23856000" + i32(quick_stop))


def moving(bus: Bus, speed: int = 20_000) -> None:
    """Operation enabled in profile velocity mode, at its speed."""
    ramps(bus)
    bus.enable("03")
    bus.done("23FF6000" + i32(speed))
    bus.run(300)
    assert velocity(bus) == pytest.approx(speed, rel=0.05)


def time_in(bus: Bus, name: str, limit_ms: int = 1000) -> int:
    """How many milliseconds the drive stays in a state it is in now."""
    for elapsed in range(limit_ms):
        if state(bus) != name:
            return elapsed
        bus.run(1)
    return limit_ms


# -- row 18: power-up and the masks ------------------------------------------------------------------------------------


def test_row_18_not_ready_goes_to_switch_on_disabled_by_itself():
    bus = Bus(is_booted=False)
    assert bus.run(0) == ["705#00"]
    assert state(bus) == "not ready to switch on"
    control(bus, 0x0F)
    bus.run(5)
    assert state(bus) == "switch on disabled"
    bus.run(1000)
    assert state(bus) == "switch on disabled"


def bring(bus: Bus, name: str) -> None:
    """To a state, by frames alone but for the over-current of a fault."""
    if name == "not ready to switch on":
        return
    bus.run(5)
    if name == "switch on disabled":
        return
    bus.done("2B5A600006000000", "2F60600008000000")  # quick stop: ramp, then stay; csp
    bus.run(3)
    words = {"ready to switch on": [6], "switched on": [6, 7]}.get(name, [6, 7, 0x0F])
    for word in words:
        control(bus, word)
    if name == "quick stop active":
        control(bus, 0x02)
    elif name == "fault":
        bus.trip()
        bus.run(5)
    elif name == "fault reaction active":
        # On the way to a target a fifth of a second away, and then with hardly any deceleration.
        control(bus, 0x06)
        bus.done("2FC26001C8000000", "2385600001000000")
        control(bus, 0x07)
        control(bus, 0x0F)
        bus.done("237A600064000000")
        bus.run(50)
        bus.trip()


@pytest.mark.parametrize("name", MASKS)
def test_row_18_statusword_in_every_state(name: str):
    bus = Bus(is_booted=False)
    bus.run(0)
    bring(bus, name)
    statusword = bus.statusword
    assert state_of(statusword) == name
    if name in {"ready to switch on", "switched on", "operation enabled"}:
        assert statusword & 0x20  # low-active: no quick stop
    if name == "quick stop active":
        assert not statusword & 0x20
    assert statusword & 0x10  # voltage
    assert statusword & 0x200  # remote: CAN controls


# -- row 19 and the table of the state machine -------------------------------------------------------------------------

# Transitions 2 to 12 and 16 as the standard numbers them; 0, 1, 13 and 14 have no command, 15 is the fault reset.
TRANSITIONS = {
    ("switch on disabled", "shutdown"): "ready to switch on",  # 2
    ("ready to switch on", "switch on"): "switched on",  # 3
    ("ready to switch on", "enable operation"): "operation enabled",  # 3 and then 4
    ("ready to switch on", "quick stop"): "switch on disabled",  # 7
    ("ready to switch on", "disable voltage"): "switch on disabled",  # 7
    ("switched on", "enable operation"): "operation enabled",  # 4
    ("switched on", "shutdown"): "ready to switch on",  # 6
    ("switched on", "quick stop"): "switch on disabled",  # 10
    ("switched on", "disable voltage"): "switch on disabled",  # 10
    ("operation enabled", "switch on"): "switched on",  # 5: disable operation
    ("operation enabled", "shutdown"): "ready to switch on",  # 8
    ("operation enabled", "disable voltage"): "switch on disabled",  # 9
    ("operation enabled", "quick stop"): "quick stop active",  # 11
    ("quick stop active", "disable voltage"): "switch on disabled",  # 12
    ("quick stop active", "enable operation"): "operation enabled",  # 16
    ("fault", "fault reset"): "switch on disabled",  # 15
}


def command_of(word: int) -> str:
    """By the standard's table of bits 7, 3, 2, 1, 0; the word before it was one without bit 7."""
    if word & 0x80:
        return "fault reset"
    if not word & 0x02:
        return "disable voltage"
    if not word & 0x04:
        return "quick stop"
    if not word & 0x01:
        return "shutdown"
    return "enable operation" if word & 0x08 else "switch on"


@pytest.mark.parametrize("name", MASKS)
@pytest.mark.parametrize("others", [0x0000, 0xF870], ids=["others 0", "others 1"])
def test_row_19_every_command_in_every_state(name: str, others: int):
    """All patterns of the five command bits; bits 4 to 6, 11 to 15 at 0 and at 1; by SDO and by statusword."""
    for pattern in range(32):
        word = (pattern & 0x0F) | (pattern & 0x10) << 3
        bus = Bus(is_booted=False)
        bus.run(0)
        bring(bus, name)
        assert state(bus) == name
        control(bus, word | others)
        expected = TRANSITIONS.get((name, command_of(word)), name)
        assert state(bus) == expected, f"{name}, {word | others:04X}h"


@pytest.mark.parametrize("name", ["ready to switch on", "switched on", "operation enabled", "quick stop active"])
def test_row_19_bit_8_does_not_disturb_transitions(name: str):
    for word in (0x00, 0x02, 0x06, 0x07, 0x0F):
        bus = Bus()
        bring(bus, name)
        control(bus, word | 0x100)
        assert state(bus) == TRANSITIONS.get((name, command_of(word)), name)


def test_row_19_0fh_passes_switched_on_on_its_way(bus: Bus):
    bus.done("2F60600008000000")
    bus.run(3)
    control(bus, 0x06)
    control(bus, 0x0F)
    bus.run(2)
    assert state(bus) == "operation enabled"


def test_row_19_the_last_writer_of_the_controlword_wins(bus: Bus):
    bus.send(START)
    assert not [text for text in bus.send("205#0600") if text.startswith("085")]
    assert state(bus) == "ready to switch on"
    control(bus, 0x00)
    assert state(bus) == "switch on disabled"
    bus.send("205#0600")
    assert state(bus) == "ready to switch on"
    # Synchronous: the SYNC is the later one.
    bus.done("2300140105020080", "2F00140201000000", "2300140105020000")
    bus.send("205#0700")
    control(bus, 0x00)
    assert state(bus) == "switch on disabled"
    control(bus, 0x06)
    bus.send("080#")
    assert state(bus) == "switched on"
    assert bus.value("406000") == 7


# -- row 20: fault and fault reset -------------------------------------------------------------------------------------


def test_row_20_a_fault_passes_its_reaction(bus: Bus):
    moving(bus)
    bus.send(START)
    sent = bus.trip(0x3210, 0x04)
    assert "085#1032050000000000" in sent
    assert state(bus) == "fault reaction active"
    # 605Eh = 2: the quick stop ramp, 20000 / 400000 s = 50 ms.
    assert 35 <= time_in(bus, "fault reaction active") <= 65
    assert state(bus) == "fault"
    assert bus.value("3F6000") == 0x3210
    assert bus.value("011000") == 0x05
    assert abs(velocity(bus)) < 2000


def test_row_20_the_rising_edge_of_bit_7_resets_and_nothing_else(bus: Bus):
    bus.trip()
    bus.run(5)
    for word in (0x00, 0x06, 0x07, 0x0F, 0x02):
        control(bus, word)
        assert state(bus) == "fault"
    sent = bus.send("605#2B40600080000000")
    assert "585#6040600000000000" in sent
    assert "085#0000000000000000" in sent
    assert state(bus) == "switch on disabled"
    assert bus.value("011000") == 0


def test_row_20_a_bit_7_that_stays_set_resets_once(bus: Bus):
    bus.trip()
    bus.run(5)
    control(bus, 0x00)
    control(bus, 0x80)
    assert state(bus) == "switch on disabled"
    bus.trip(0x3210, 0x04)
    bus.run(5)
    assert state(bus) == "fault"
    for word in (0x80, 0x86, 0x8F, 0x80):
        control(bus, word)
        assert state(bus) == "fault"
    control(bus, 0x0F)
    assert state(bus) == "fault"
    control(bus, 0x8F)
    assert state(bus) == "switch on disabled"


def test_row_20_a_bit_7_from_before_the_fault_is_no_edge(bus: Bus):
    control(bus, 0x80)
    bus.trip()
    bus.run(5)
    control(bus, 0x80)
    assert state(bus) == "fault"


def test_row_20_no_reset_while_the_cause_persists(bus: Bus):
    bus.trip(0x3210, 0x04, persists=True)
    bus.run(5)
    control(bus, 0x80)
    assert state(bus) == "fault"
    control(bus, 0x00)
    bus.drive.end_trip(0x3210, bus.now_ns)
    assert state(bus) == "fault"
    control(bus, 0x80)
    assert state(bus) == "switch on disabled"


def test_row_20_no_reset_before_the_reaction_is_over():
    bus = Bus()
    bring(bus, "fault reaction active")
    control(bus, 0x80)
    assert state(bus) == "fault reaction active"
    control(bus, 0x00)
    assert state(bus) == "fault reaction active"


def test_row_20_error_code_is_that_of_the_last_error(bus: Bus):
    bus.trip(0x2310, 0x02)
    bus.trip(0x4310, 0x08)
    assert bus.value("3F6000") == 0x4310
    assert bus.value("011000") == 0x0B
    assert [bus.value(f"03100{n}") & 0xFFFF for n in (1, 2)] == [0x4310, 0x2310]


# -- row 21: quick stop, halt, loss of the connection ------------------------------------------------------------------


def test_row_21_quick_stop_option_0_takes_the_torque_away(bus: Bus):
    bus.done("2B5A600000000000")
    moving(bus)
    control(bus, 0x02)
    assert state(bus) == "switch on disabled"


# The ramp of each option, in ms from 20000 counts/s: 6084h is 100000, 6085h is 400000 counts/s^2.
@pytest.mark.parametrize(("option", "span"), [(1, 200), (2, 50), (3, None), (4, None)])
def test_row_21_quick_stop_options_1_to_4_stop_and_disable(bus: Bus, option: int, span: int | None):
    bus.done(f"2B5A60000{option}000000")
    moving(bus)
    control(bus, 0x02)
    assert state(bus) == "quick stop active"
    elapsed = time_in(bus, "quick stop active")
    assert state(bus) == "switch on disabled"
    assert elapsed <= 250
    assert span is None or span * 0.8 - 2 <= elapsed <= span * 1.2 + 5


@pytest.mark.parametrize(("option", "span"), [(5, 200), (6, 50), (7, None), (8, None)])
def test_row_21_quick_stop_options_5_to_8_stop_and_stay(bus: Bus, option: int, span: int | None):
    bus.done(f"2B5A60000{option}000000")
    moving(bus)
    control(bus, 0x02)
    if span == 200:
        bus.run(120)
        assert 3000 < velocity(bus) < 13_000
    bus.run(400)
    assert state(bus) == "quick stop active"
    assert abs(velocity(bus)) < 500
    held = position(bus)
    bus.run(500)
    assert state(bus) == "quick stop active"
    assert abs(position(bus) - held) <= 2
    control(bus, 0x0F)  # transition 16
    assert state(bus) == "operation enabled"
    control(bus, 0x02)
    control(bus, 0x00)  # transition 12
    assert state(bus) == "switch on disabled"


def test_row_21_an_option_9_is_not_taken(bus: Bus):
    before = bus.value("5A6000")
    assert bus.abort("2B5A600009000000") in {RANGE, 0x06090031}
    assert bus.value("5A6000") == before


@pytest.mark.parametrize(
    ("place", "word", "after"), [("5B6000", 0x06, "ready to switch on"), ("5C6000", 0x07, "switched on")]
)
def test_row_21_shutdown_and_disable_operation_options(place: str, word: int, after: str):
    bus = Bus()
    bus.done(f"2B{place}00000000")
    moving(bus)
    control(bus, word)
    assert state(bus) == after
    bus = Bus()
    bus.done(f"2B{place}01000000")  # slow down, then leave
    moving(bus)
    control(bus, word)
    assert state(bus) == "operation enabled"
    assert 150 <= time_in(bus, "operation enabled") <= 250
    assert state(bus) == after
    assert abs(velocity(bus)) < 500


@pytest.mark.parametrize(("option", "span"), [(1, 200), (2, 50), (3, None), (4, None)])
def test_row_21_halt_stops_and_stays_enabled(bus: Bus, option: int, span: int | None):
    bus.done(f"2B5D60000{option}000000")
    moving(bus)
    control(bus, 0x10F)
    if span == 200:
        bus.run(100)
        assert 6000 < velocity(bus) < 14_000
        assert not bus.statusword & TARGET_REACHED
    bus.run(400)
    assert state(bus) == "operation enabled"
    assert abs(velocity(bus)) < 500
    assert bus.statusword & TARGET_REACHED  # at rest
    control(bus, 0x0F)
    bus.run(400)
    assert velocity(bus) == pytest.approx(20_000, rel=0.05)


CONNECTION = {0: "operation enabled", 1: "fault", 2: "switch on disabled", 3: "quick stop active"}


@pytest.mark.parametrize("option", CONNECTION)
@pytest.mark.parametrize("loss", ["heartbeat", "stop"])
def test_row_21_abort_connection_option(bus: Bus, option: int, loss: str):
    bus.done(f"2B0760000{option}000000", "2B5A600006000000", "2316100164007F00")
    moving(bus)
    bus.send(START)
    if loss == "heartbeat":
        bus.send("77F#05")
        sent = bus.run(400)
        assert next(text for text in sent if text.startswith("085#")) == "085#3081110000000000"
    else:
        bus.send(STOP)
        bus.run(300)
        bus.send(PRE_OPERATIONAL)
    assert state(bus) == CONNECTION[option]
    assert (abs(velocity(bus)) > 15_000) is (option == 0)


# -- row 22: modes -----------------------------------------------------------------------------------------------------


def test_row_22_mode_display_follows_when_the_mode_is_active(bus: Bus):
    assert bus.sdo("4061600000000000") == "4F61600000000000"
    bus.done("2F60600008000000")
    assert bus.sdo("4061600000000000") == "4F61600000000000"  # not at the same instant
    bus.run(5)
    assert bus.sdo("4061600000000000") == "4F61600008000000"
    bus.done("2F60600006000000")
    assert bus.sdo("4061600000000000") == "4F61600008000000"
    bus.run(5)
    assert bus.sdo("4061600000000000") == "4F61600006000000"


def test_row_22_supported_modes_are_those_that_can_be_set(bus: Bus):
    supported = bus.value("026500")
    assert supported & 0x80  # csp
    for mode in range(1, 16):
        answer = bus.sdo(f"2F6060000{mode:X}000000")
        if supported >> (mode - 1) & 1:
            assert answer == "6060600000000000", mode
            bus.run(5)
            assert bus.value("616000") == mode
        else:
            bus.run(5)
            assert bus.value("616000") != mode
            assert answer[:2] == "80" or answer == "6060600000000000"


@pytest.mark.parametrize("mode", ["01", "03", "04", "06", "07", "08", "09", "0A"])
def test_row_22_the_standards_modes_are_supported(bus: Bus, mode: str):
    assert bus.value("026500") >> (int(mode, 16) - 1) & 1
    bus.done(f"2F606000{mode}000000")
    bus.run(5)
    assert bus.sdo("4061600000000000") == f"4F616000{mode}000000"


@pytest.mark.parametrize("mode", ["08", "09", "0A"])
def test_row_22_entering_a_cyclic_mode_holds_until_the_first_target(bus: Bus, mode: str):
    """Stale targets of all kinds lie there; nothing moves."""
    bus.done("237A6000A0860100", "23FF600020A10700", "2B71600096000000")
    bus.enable(mode)
    bus.send(START)
    before = position(bus)
    for _ in range(50):
        bus.send("080#")
        bus.run(1)
    assert abs(position(bus) - before) <= 2
    assert state(bus) == "operation enabled"


@pytest.mark.parametrize("mode", ["08", "09"])
def test_row_22_switching_from_a_motion_into_a_cyclic_mode_does_not_jump(bus: Bus, mode: str):
    moving(bus, 5000)
    bus.done("237A600040420F00")
    bus.done(f"2F606000{mode}000000")
    before = position(bus)
    speeds = []
    for _ in range(200):
        bus.run(1)
        speeds.append(velocity(bus))
    assert state(bus) == "operation enabled"
    assert min(speeds) > -1500
    assert max(speeds) < 8000
    assert position(bus) - before < 2000
    assert abs(velocity(bus)) < 500


# -- row 23: profile position ------------------------------------------------------------------------------------------


def positioning(bus: Bus) -> None:
    """20000 counts/s, 400000 counts/s^2: at speed after 50 ms and 500 counts."""
    ramps(bus, 400_000, 400_000)
    bus.done("23816000204E0000")
    bus.enable("01")


def wait(bus: Bus, bit: int, is_set: bool, limit_ms: int = 3000) -> int:
    for elapsed in range(limit_ms):
        if bool(bus.statusword & bit) is is_set:
            return elapsed
        bus.run(1)
    raise AssertionError(f"bit {bit:04X}h stays {'clear' if is_set else 'set'}")


def test_row_23_the_handshake(bus: Bus):
    positioning(bus)
    assert not bus.statusword & BIT_12
    bus.done("237A6000A00F0000")  # 4000
    bus.run(20)
    assert abs(position(bus)) <= 2  # a target alone moves nothing
    control(bus, 0x1F)
    assert wait(bus, BIT_12, True) <= 5
    assert not bus.statusword & TARGET_REACHED
    bus.run(20)
    assert bus.statusword & BIT_12  # until bit 4 falls
    control(bus, 0x0F)
    assert wait(bus, BIT_12, False) <= 5
    elapsed = wait(bus, TARGET_REACHED, True)
    # 4000 counts: 2 x 50 ms of ramps with 1000 counts, and 3000 at 20000 counts/s; 20 of them have passed.
    assert 220 <= elapsed <= 300
    assert abs(position(bus) - 4000) <= 10
    bus.run(50)
    assert abs(position(bus) - 4000) <= 2


def test_row_23_values_are_latched_at_the_rising_edge(bus: Bus):
    positioning(bus)
    bus.done("237A6000A00F0000")
    control(bus, 0x1F)
    bus.done("237A600000000080", "2381600001000000", "2383600001000000", "2384600001000000")
    control(bus, 0x1F)  # no edge
    control(bus, 0x0F)
    assert wait(bus, TARGET_REACHED, True) <= 400
    assert abs(position(bus) - 4000) <= 10


def test_row_23_one_set_point_waits_and_keeps_bit_12(bus: Bus):
    positioning(bus)
    bus.done("237A6000A00F0000")
    control(bus, 0x1F)
    control(bus, 0x0F)
    assert wait(bus, BIT_12, False) <= 5
    bus.done("237A6000E8030000")  # 1000, waits
    control(bus, 0x1F)
    assert wait(bus, BIT_12, True) <= 5
    control(bus, 0x0F)
    bus.run(100)
    assert bus.statusword & BIT_12  # the buffer is full
    # A third one is not taken.
    bus.done("237A600060EAFFFF")
    control(bus, 0x1F)
    control(bus, 0x0F)
    highest = 0
    for _ in range(1000):
        bus.run(1)
        highest = max(highest, demand(bus))
        if not bus.statusword & BIT_12:
            break
    assert highest == 4000  # the first target came first, and was not passed
    wait(bus, TARGET_REACHED, True)
    assert abs(position(bus) - 1000) <= 10
    bus.run(500)
    assert abs(position(bus) - 1000) <= 2


def test_row_23_change_immediately(bus: Bus):
    positioning(bus)
    bus.done("237A6000409C0000")  # 40000
    control(bus, 0x1F)
    control(bus, 0x0F)
    bus.run(200)
    reached = position(bus)
    assert reached > 2000
    bus.done("237A6000D0070000")  # 2000
    control(bus, 0x3F)
    assert wait(bus, BIT_12, True) <= 5
    control(bus, 0x2F)
    assert wait(bus, BIT_12, False) <= 5
    wait(bus, TARGET_REACHED, True)
    assert abs(position(bus) - 2000) <= 10


@pytest.mark.parametrize("option", ["00", "01", "02"])
def test_row_23_relative(bus: Bus, option: str):
    bus.done(f"2BF26000{option}000000")
    positioning(bus)
    for number in (1, 2, 3):
        bus.done("237A6000E8030000")  # 1000 more
        control(bus, 0x5F)
        control(bus, 0x4F)
        wait(bus, TARGET_REACHED, True)
        bus.run(50)
        assert abs(position(bus) - 1000 * number) <= (2 if option == "00" else 10)


def test_row_23_change_on_set_point_does_not_stop(bus: Bus):
    positioning(bus)
    bus.done("237A6000A00F0000")
    control(bus, 0x1F)
    control(bus, 0x0F)
    bus.done("237A6000401F0000")  # 8000
    control(bus, 0x21F)
    control(bus, 0x20F)
    speeds = []
    for _ in range(1000):
        bus.run(1)
        if 3000 < position(bus) < 5000:
            speeds.append(velocity(bus))
        if bus.statusword & TARGET_REACHED:
            break
    assert abs(position(bus) - 8000) <= 10
    assert min(speeds) > 15_000


def test_row_23_bit_10_at_once_for_a_target_that_is_there(bus: Bus):
    positioning(bus)
    bus.done("237A600000000000")
    control(bus, 0x1F)
    assert wait(bus, BIT_12, True) <= 5
    control(bus, 0x0F)
    assert wait(bus, TARGET_REACHED, True) <= 50


# -- row 24: cyclic modes ----------------------------------------------------------------------------------------------


def cyclic(bus: Bus, mode: str, *entries: str) -> None:
    """RPDO 1: controlword and targets, at every SYNC; operational and enabled."""
    bus.done("2300140105020080", "2F00160000000000", "2300160110004060")
    for number, entry in enumerate(entries, start=2):
        bus.done(f"230016{number:02X}{entry}")
    bus.done(f"2F001600{len(entries) + 1:02X}000000", "2F00140201000000", "2300140105020000")
    bus.enable(mode)
    bus.send(START)


def cycle(bus: Bus, data: str) -> None:
    bus.send("205#0F00" + data)
    bus.send("080#")
    bus.run(1)


def test_row_24_csp_adds_the_position_offset_and_sets_bit_12(bus: Bus):
    cyclic(bus, "08", "20007A60")
    assert bus.statusword & BIT_12
    for number in range(1, 101):
        cycle(bus, i32(20 * number))
    assert bus.statusword & BIT_12
    for _ in range(100):
        cycle(bus, i32(2000))
    assert demand(bus) == 2000
    assert abs(position(bus) - 2000) <= 8
    bus.done("23B0600064000000")  # + 100
    for _ in range(100):
        cycle(bus, i32(2000))
    assert demand(bus) == 2100
    assert abs(position(bus) - 2100) <= 8
    assert state(bus) == "operation enabled"


def test_row_24_csv_adds_the_velocity_offset(bus: Bus):
    cyclic(bus, "09", "2000FF60")
    for number in range(1, 201):
        cycle(bus, i32(min(10_000, 100 * number)))
    # The velocity that is shown is in whole counts a servo period: the way in 100 ms is told apart better.
    assert velocity(bus) == pytest.approx(10_000, abs=1100)
    assert bus.statusword & BIT_12
    for total in (10_000, 12_000):
        for _ in range(50):
            cycle(bus, i32(10_000))
        start, shaft = demand(bus), position(bus)
        for _ in range(100):
            cycle(bus, i32(10_000))
        assert demand(bus) - start == pytest.approx(total * 0.1, abs=2)
        assert position(bus) - shaft == pytest.approx(total * 0.1, abs=30)
        bus.done("23B16000D0070000")  # + 2000


def test_row_24_cst_adds_the_torque_offset(bus: Bus):
    cyclic(bus, "0A", "10007160")
    for _ in range(10):
        cycle(bus, u16(60))
    assert bus.value("776000", signed=True) == pytest.approx(60, abs=3)
    assert bus.statusword & BIT_12
    bus.done("2BB2600028000000")  # + 40
    for _ in range(10):
        cycle(bus, u16(60))
    assert bus.value("776000", signed=True) == pytest.approx(100, abs=3)
    before = position(bus)
    for _ in range(50):
        cycle(bus, u16(60))
    assert position(bus) > before
    # 6072h, max torque, bounds the sum.
    bus.done("2B72600032000000")
    for _ in range(10):
        cycle(bus, u16(60))
    assert bus.value("776000", signed=True) == pytest.approx(50, abs=3)


def test_row_24_csp_goes_in_a_straight_line_over_the_interpolation_time(bus: Bus):
    """60C2h is 20 ms: half of the way after 10 ms; without a successor the line goes on no longer than once more."""
    bus.done("2FC2600114000000", "2FC26002FD000000")
    cyclic(bus, "08", "20007A60")
    for number in range(1, 6):
        bus.send("205#0F00" + i32(200 * number))
        bus.send("080#")
        bus.run(10)
        assert demand(bus) == pytest.approx(200 * number - 100, abs=2)
        bus.run(10)
        assert demand(bus) == pytest.approx(200 * number, abs=2)
    bus.run(20)
    assert 1000 <= demand(bus) <= 1200
    held = demand(bus)
    bus.run(30)
    assert demand(bus) == held


@pytest.mark.parametrize(
    ("mode", "entry", "first"), [("08", "20007A60", ""), ("09", "2000FF60", "E8030000"), ("0A", "10007160", "0A00")]
)
def test_row_24_missing_set_points_end_in_a_fault(bus: Bus, mode: str, entry: str, first: str):
    """Held or extrapolated for a while, and not for ever; no jump."""
    cyclic(bus, mode, entry)
    for number in range(1, 51):
        cycle(bus, i32(10 * number) if mode == "08" else first)
    assert state(bus) == "operation enabled"
    last = position(bus)
    bus.run(3)
    assert state(bus) == "operation enabled"
    sent = bus.run(500)
    assert state(bus) == "fault"
    assert [text for text in sent if text.startswith("085#")]
    assert bus.value("3F6000") != 0
    assert abs(position(bus) - last) < 200


def test_row_24_positions_wrap_in_whole_counts(bus: Bus):
    """Home is 7FFFFF00h; 100 cycles of 10 counts lead across the end of INTEGER32."""
    bus.done("237C600000FFFF7F", "2F98600025000000")
    bus.enable("06")
    control(bus, 0x1F)
    bus.run(20)
    control(bus, 0x0F)
    assert position(bus) == 0x7FFFFF00
    control(bus, 0x06)
    cyclic(bus, "08", "20007A60")
    previous = position(bus)
    for number in range(1, 101):
        target = 0x7FFFFF00 + 10 * number
        cycle(bus, i32(target))
        here = position(bus)
        step = (here - previous + 2**31) % 2**32 - 2**31
        assert -3 <= step <= 40, number
        previous = here
    for _ in range(50):
        cycle(bus, i32(0x7FFFFF00 + 1000))
    assert demand(bus) == 0x7FFFFF00 + 1000 - 2**32
    assert position(bus) == pytest.approx(0x7FFFFF00 + 1000 - 2**32, abs=8)
    assert state(bus) == "operation enabled"


def test_row_24_interpolated_position_by_the_buffer(bus: Bus):
    """Writing 60C1h:01 commits a record; bit 4 enables, bit 12 tells; one record every 60C2h, 10 ms, in order."""
    assert bus.sdo("40C0600000000000") == "4BC0600000000000"  # linear
    bus.done("2FC260010A000000", "2FC26002FD000000", "2FC4600600000000", "2FC4600601000000")
    bus.enable("07")
    assert not bus.statusword & BIT_12
    size = bus.value("C46001")
    assert size >= 4
    for number in range(1, 5):
        bus.done("23C16001" + i32(50 * number))
    bus.run(50)
    assert demand(bus) == 0  # not enabled yet
    control(bus, 0x1F)
    bus.run(3)
    assert bus.statusword & BIT_12
    ways = [demand(bus)]
    for _ in range(80):
        bus.run(1)
        ways.append(demand(bus))
    assert ways[-1] == 200
    assert all(0 <= b - a <= 7 for a, b in pairwise(ways))
    moving_ms = sum(b > a for a, b in pairwise(ways))
    assert 36 <= moving_ms <= 43  # 4 records, 3 of the first 40 ms have passed
    assert state(bus) == "operation enabled"
    control(bus, 0x0F)
    assert not bus.statusword & BIT_12


def test_row_24_the_interpolation_buffer_has_an_end_and_is_cleared(bus: Bus):
    bus.done("2FC260010A000000", "2FC4600600000000")
    # Cleared and disabled: nothing is taken.
    assert code_of(bus.sdo("23C1600164000000")) in CANNOT
    bus.done("2FC4600601000000")
    bus.enable("07")
    size = bus.value("C46001")
    for number in range(size):
        bus.done("23C16001" + i32(number))
    assert code_of(bus.sdo("23C1600164000000")) in CANNOT
    bus.done("2FC4600600000000", "2FC4600601000000", "23C1600164000000")
    assert bus.value("616000") == 7


# -- row 25: following error -------------------------------------------------------------------------------------------


def lagging(bus: Bus, window: str, timeout: str = "1400") -> None:
    """A torque limit of 0 lets the axis stand while its demand goes on: 5 counts a millisecond."""
    bus.done(f"23656000{window}", f"2B666000{timeout}0000", "2B72600000000000")
    cyclic(bus, "08", "20007A60")


def test_row_25_a_following_error_is_a_fault_after_its_time(bus: Bus):
    lagging(bus, "64000000")  # 100 counts, 20 ms
    first_beyond = None
    for number in range(1, 100):
        bus.send("205#0F00" + i32(5 * number))
        sent = bus.send("080#") + bus.run(1)
        error = bus.value("F46000", signed=True)
        if error > 100 and first_beyond is None:
            first_beyond = number
        emergencies = [text for text in sent if text.startswith("085#")]
        if emergencies:
            assert emergencies == ["085#1186210000000000"]  # 8611h, generic and device profile
            break
        assert not bus.statusword & BIT_13
    assert first_beyond is not None
    assert 19 <= first_beyond <= 24
    assert 18 <= number - first_beyond <= 24
    assert bus.statusword & BIT_13
    bus.run(100)
    assert state(bus) == "fault"
    assert bus.value("3F6000") == 0x8611


def test_row_25_a_window_of_ffffffffh_watches_nothing(bus: Bus):
    lagging(bus, "FFFFFFFF")
    for number in range(1, 200):
        cycle(bus, i32(5 * number))
    assert state(bus) == "operation enabled"
    assert bus.value("F46000", signed=True) > 900
    assert not bus.statusword & BIT_13


def test_row_25_a_short_error_is_none(bus: Bus):
    lagging(bus, "64000000", "E803")  # 1 s
    for number in range(1, 50):
        cycle(bus, i32(5 * number))
    for number in range(50, 0, -1):
        cycle(bus, i32(5 * number))
    for _ in range(1200):
        cycle(bus, i32(0))
    assert state(bus) == "operation enabled"


def test_row_25_fault_reaction_option_0_takes_the_torque_away_at_once(bus: Bus):
    bus.done("2B5E600000000000")
    moving(bus)
    bus.trip()
    bus.run(2)
    assert state(bus) == "fault"


# -- row 26: homing ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["23", "25"])  # 35 and 37: the current position
@pytest.mark.parametrize("offset", [0, 1234, -98765])
def test_row_26_homing_on_the_current_position(bus: Bus, method: str, offset: int):
    bus.done(f"2F986000{method}000000", "237C6000" + i32(offset))
    bus.enable("06")
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) in {0, TARGET_REACHED}  # not started
    bus.run(100)
    assert not bus.statusword & BIT_12
    control(bus, 0x1F)
    bus.run(50)
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED | BIT_12
    assert position(bus) == offset
    control(bus, 0x0F)
    bus.run(5)
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED | BIT_12
    assert position(bus) == offset


def test_row_26_a_start_bit_from_before_is_no_edge(bus: Bus):
    bus.done("2F98600025000000", "2F60600006000000")
    bus.run(5)
    for word in (0x16, 0x17, 0x1F):
        control(bus, word)
    bus.run(50)
    status = bus.statusword
    # Either reading of the standard is in use: an edge at bit 4, or its level once operation is enabled.
    assert status & 0x6F == 0x27
    assert not status & BIT_13


def test_row_26_a_method_that_is_not_there_is_refused(bus: Bus):
    for method in ("0F", "10", "1F", "20", "26", "7F"):  # 15, 16, 31, 32, 38, 127
        assert bus.abort(f"2F986000{method}000000") in {RANGE, 0x06090031}
    assert bus.value("986000") in {35, 37}


def test_row_26_changing_the_offset_does_not_move_the_position(bus: Bus):
    bus.done("2F98600025000000")
    bus.enable("06")
    control(bus, 0x1F)
    bus.run(20)
    assert position(bus) == 0
    bus.done("237C6000E8030000")
    bus.run(20)
    assert position(bus) == 0


# Limit switches at -9000 and 9000 counts, index pulses every 4096 counts from 500 on (-7692, -3596, 500, 4596, 8692).
# The home switch is on from 1000 to 1400; for methods 3, 4, 19, 20 from 1000 on, for 5, 6, 21, 22 up to 1400.
# Where home is, in counts of the shaft, by the standard's figures of the methods.
HOMES = {
    1: -7692, 2: 8692,
    3: 500, 4: 4596, 5: 4596, 6: 500,
    7: 500, 8: 4596, 9: 500, 10: 4596, 11: 4596, 12: 500, 13: 4596, 14: 500,
    17: -9000, 18: 9000,
    19: 1000, 20: 1000, 21: 1400, 22: 1400,
    23: 1000, 24: 1000, 25: 1400, 26: 1400, 27: 1400, 28: 1400, 29: 1000, 30: 1000,
    33: -3596, 34: 500,
}  # fmt: skip


def at_switches(method: int) -> Bus:
    home = (1000.0, 1400.0)
    if method in {3, 4, 19, 20}:
        home = (1000.0, inf)
    elif method in {5, 6, 21, 22}:
        home = (-inf, 1400.0)
    bus = Bus(settings=DriveSettings(gains=FREE_AXIS_GAINS, switches=Switches(-9000, 9000, home, 500)))
    # 20000 counts/s towards the switch, 2000 counts/s at it, 400000 counts/s^2.
    bus.done("23996001204E0000", "23996002D0070000", "239A6000801A0600", "2365600000100000")
    bus.done(f"2F986000{method:02X}000000")
    return bus


@pytest.mark.parametrize("method", HOMES)
def test_row_26_homing_on_switches_and_index_pulses(method: int):
    bus = at_switches(method)
    bus.done("237C6000E8030000")  # home is 1000
    bus.enable("06")
    control(bus, 0x1F)
    highest = 0
    for _ in range(20_000):
        statusword = bus.statusword
        assert statusword & 0x6F == 0x27
        assert not statusword & BIT_13
        if statusword & BIT_12 and statusword & TARGET_REACHED:
            break
        # Bit 12 alone: attained, and still on the way to a stop; bit 10 comes last.
        highest = max(highest, abs(velocity(bus)))
        bus.run(1)
    else:
        raise AssertionError("homing does not end")
    assert 1000 < highest < 30_000 or method in {33, 34}
    control(bus, 0x0F)
    bus.run(100)
    # The edge is that of home, not where the axis has come to rest after it.
    assert bus.shaft_counts - (position(bus) - 1000) == pytest.approx(HOMES[method], abs=2)
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED | BIT_12


def test_row_26_homing_comes_to_rest_after_its_edge():
    bus = at_switches(24)
    bus.enable("06")
    control(bus, 0x1F)
    wait(bus, BIT_12, True)
    bus.run(200)
    assert position(bus) > 0  # beyond home, in the direction in which the edge was crossed


def test_row_26_dropping_bit_4_aborts():
    bus = at_switches(18)
    bus.enable("06")
    control(bus, 0x1F)
    bus.run(100)
    assert not bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13)
    assert velocity(bus) > 10_000
    before = position(bus)
    control(bus, 0x0F)
    bus.run(1000)
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED
    assert before < position(bus) < before + 2000
    assert abs(velocity(bus)) < 1100
    # From there again.
    control(bus, 0x1F)
    bus.run(3000)
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED | BIT_12


def test_row_26_a_switch_that_is_never_found_is_a_homing_error():
    bus = Bus(settings=DriveSettings(gains=FREE_AXIS_GAINS, switches=Switches(-2000, 2000, (5000.0, 6000.0), 0)))
    bus.done("23996001204E0000", "23996002D0070000", "239A6000801A0600", "2F98600018000000")
    bus.enable("06")
    control(bus, 0x1F)
    bus.run(3000)
    assert bus.statusword & (BIT_12 | BIT_13) == BIT_13
    assert state(bus) == "operation enabled"
    assert abs(velocity(bus)) < 1100
    # The next start clears it.
    control(bus, 0x0F)
    bus.done("2F98600025000000")
    control(bus, 0x1F)
    bus.run(50)
    assert bus.statusword & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED | BIT_12


# -- row 27: several axes in one node ----------------------------------------------------------------------------------


@pytest.fixture
def pair() -> Bus:
    """Node 5 with two axes: the objects of the second lie 800h above those of the first."""
    axis = DriveSettings(gains=FREE_AXIS_GAINS)
    return Bus(settings=DriveSettings(gains=FREE_AXIS_GAINS, further_axes=(axis,)))


def test_row_27_device_types(pair: Bus):
    # 1000h of a multiple device module, and what each axis is by itself in the last object of its area.
    assert pair.sdo("4000100000000000") == "430010009201FFFF"
    assert pair.sdo("40FF670000000000") == "43FF670092010200"
    assert pair.sdo("40FF6F0000000000") == "43FF6F0092010200"
    # No third axis.
    assert pair.sdo("4041700000000000") == "8041700000000206"
    assert pair.sdo("40FF770000000000") == "80FF770000000206"


def test_row_27_the_second_axis_has_its_objects_at_6800h(pair: Bus):
    assert pair.sdo("4041600000000000") == "4B41600050020000"
    assert pair.sdo("4041680000000000") == "4B41680050020000"
    assert pair.sdo("40026D0000000000") == "43026D00ED030100"
    assert pair.value("026D00") == pair.value("026500")
    # What the first axis has under no profile index, it has once.
    assert pair.sdo("4001180100000000")[:8] != "80011801"
    assert pair.sdo("4000300000000000") == "4F00300006000000"
    assert pair.sdo("4000310000000000") == "4F00310006000000"


def test_row_27_one_node_boots_once():
    axis = DriveSettings(gains=FREE_AXIS_GAINS)
    bus = Bus(settings=DriveSettings(gains=FREE_AXIS_GAINS, further_axes=(axis,)), is_booted=False)
    assert bus.run(0) == ["705#00"]
    assert bus.run(1000) == []


def test_row_27_each_axis_has_a_state_of_its_own(pair: Bus):
    pair.done("2F60680008000000")
    pair.run(5)
    assert pair.value("616800") == 8
    assert pair.value("616000") == 0
    pair.done("2B40680006000000", "2B40680007000000", "2B4068000F000000")
    assert state_of(pair.value("416800")) == "operation enabled"
    assert state(pair) == "switch on disabled"
    control(pair, 0x06)
    assert state(pair) == "ready to switch on"
    pair.done("237A680064000000")
    pair.run(200)
    assert abs(pair.value("646800", signed=True) - 100) <= 8
    assert abs(position(pair)) <= 1


def test_row_27_pdos_of_the_second_axis_begin_at_number_65(pair: Bus):
    # RPDO 65 and TPDO 65 map the second axis' controlword and statusword, and are off until they have a COB-ID.
    assert pair.sdo("4040140100000000") == "4340140100000080"
    assert pair.sdo("4040160100000000") == "4340160110004068"
    assert pair.sdo("4040180100000000") == "4340180100000080"
    assert pair.sdo("40401A0100000000") == "43401A0110004168"
    # No 69th, and none between the axes.
    assert pair.abort("4004140100000000") == 0x06020000
    assert pair.abort("4044140100000000") == 0x06020000
    pair.done("2340140105030000", "2F40140201000000")
    pair.done("2340180185020000", "2F40180201000000")
    pair.send(START)
    pair.run(2)
    # The shutdown acts at the next SYNC, and the TPDO before it shows what was.
    assert pair.send("305#0600") == []
    assert pair.send("080#") == ["285#5002"]
    assert pair.send("080#") == ["285#3102"]
    assert state(pair) == "switch on disabled"


def test_row_27_errors_are_an_axis_own_and_the_node_tells(pair: Bus):
    pair.machine.drives[0].trip(0x2310, 0x02, pair.now_ns, axis=2)
    # The EMCY names the axis in its first vendor-specific byte.
    assert pair.run(5) == ["085#1023030200000000"]
    assert state_of(pair.value("416800")) == "fault"
    assert state(pair) == "switch on disabled"
    assert pair.sdo("403F680000000000") == "4B3F680010230000"
    assert pair.sdo("403F600000000000") == "4B3F600000000000"
    assert pair.sdo("4001100000000000") == "4F01100003000000"
    assert pair.sdo("4003100100000000") == "4303100110230000"
    # The first axis' fault reset is nothing to the second.
    control(pair, 0x80)
    assert state_of(pair.value("416800")) == "fault"
    assert pair.send("605#2B40680080000000") == ["085#0000000000000000", "585#6040680000000000"]
    assert state_of(pair.value("416800")) == "switch on disabled"
    assert pair.sdo("403F680000000000") == "4B3F680000000000"
    assert pair.sdo("4001100000000000") == "4F01100000000000"


def test_row_27_stopping_the_node_stops_both_axes(pair: Bus):
    for shift in ("60", "68"):
        pair.done(f"2F60{shift}0008000000")
    pair.run(3)
    for shift in ("60", "68"):
        pair.done(*(f"2B40{shift}00{word}000000" for word in ("06", "07", "0F")))
    pair.send(STOP)
    pair.run(300)
    pair.send(PRE_OPERATIONAL)
    assert (state(pair), state_of(pair.value("416800"))) == ("fault", "fault")
    assert (pair.value("3F6000"), pair.value("3F6800")) == (0x8100, 0x8100)
