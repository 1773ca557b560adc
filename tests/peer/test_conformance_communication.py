"""Conformance of the emulated drive as a CiA 301 node, rows 1 to 3, 11 to 17 and 28: every byte written out by hand.

SDO aborts by row: ``06040041h`` object cannot be mapped, ``06040042h`` PDO too long, ``06090030h`` value range,
``06010000h`` unsupported access, ``08000020h`` to ``08000022h`` cannot be stored (now, locally, in this state).
"""

import configparser
from itertools import pairwise
from pathlib import Path

import pytest
from conformance_bench import Bus

NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
UNSUPPORTED_ACCESS = 0x06010000
RANGE = 0x06090030
DEVICE_STATE = 0x08000022
REFUSED_NOW = {UNSUPPORTED_ACCESS, RANGE, DEVICE_STATE}
CANNOT_STORE = {0x08000020, 0x08000021, 0x08000022}

SAVE, LOAD = "73617665", "6C6F6164"
START, STOP, PRE_OPERATIONAL = "000#0105", "000#0205", "000#8005"
RESET_NODE, RESET_COMMUNICATION = "000#8105", "000#8205"
DEVICE_TYPE = ("4000100000000000", "4300100092010200")


@pytest.fixture
def bus() -> Bus:
    return Bus()


# -- row 1: boot-up ----------------------------------------------------------------------------------------------------


def test_row_01_power_on_gives_one_boot_up_frame():
    bus = Bus(is_booted=False)
    assert bus.run(2000) == ["705#00"]
    assert bus.sdo(DEVICE_TYPE[0]) == DEVICE_TYPE[1]
    bus.done("2B17100064000000")
    assert bus.run(100) == ["705#7F"]


@pytest.mark.parametrize("reset", ["000#8105", "000#8205", "000#8100", "000#8200"])
@pytest.mark.parametrize("before", [None, START, STOP])
def test_row_01_resets_give_one_boot_up_frame_and_pre_operational(bus: Bus, reset: str, before: str | None):
    if before:
        assert "705#00" not in bus.send(before) + bus.run(10)
    assert bus.send(reset) + bus.run(2000) == ["705#00"]
    # Pre-operational: SDOs, no PDOs.
    assert bus.send("080#") == []
    bus.done("2B17100064000000")
    assert bus.run(100) == ["705#7F"]


# -- row 2: what each NMT state lets pass ------------------------------------------------------------------------------


def with_cyclic_pdos(bus: Bus) -> None:
    """RPDO 1 with the controlword at once, TPDO 1 with the statusword at every SYNC."""
    bus.done("2300180185010080", "2F00180201000000", "2300180185010000")


def test_row_02_pre_operational_has_sdos_and_no_pdos(bus: Bus):
    with_cyclic_pdos(bus)
    assert bus.send("080#") == []
    assert bus.send("205#0600") == []
    assert bus.run(10) == []
    assert bus.statusword & 0x6F == 0x40
    assert bus.send(START) == []
    assert bus.send("205#0600") == []
    sent = bus.send("080#")
    assert len(sent) == 1
    assert sent[0][:5] == "185#3"  # xx31h: Ready to switch on
    assert bus.sdo(DEVICE_TYPE[0]) == DEVICE_TYPE[1]
    assert bus.send(PRE_OPERATIONAL) == []
    assert bus.send("080#") == []


def test_row_02_stopped_has_nmt_and_error_control_alone(bus: Bus):
    with_cyclic_pdos(bus)
    bus.done("2B17100064000000")
    bus.send(START)
    bus.send(STOP)
    assert bus.sdo(DEVICE_TYPE[0]) == ""
    assert bus.sdo("E000000000000000") == ""
    assert bus.send("080#") == []
    assert bus.send("080#01") == []
    assert bus.send("205#0600") == []
    assert bus.send("205#06") == []
    assert bus.trip() == []  # no EMCY
    assert bus.run(300) == ["705#04"] * 3
    assert bus.send(PRE_OPERATIONAL) == []
    assert bus.sdo(DEVICE_TYPE[0]) == DEVICE_TYPE[1]
    assert bus.run(100) == ["705#7F"]
    # The error has been noticed nevertheless, and the controlword of the RPDO has not.
    assert bus.value("3F6000") == 0x2310
    assert bus.value("406000") == 0


@pytest.mark.parametrize("state", ["stopped", "pre-operational"])
def test_row_02_no_tpdo_slips_out_after_the_state_has_changed(bus: Bus, state: str):
    # An event waits for the inhibit time of 100 ms, and the event timer of 50 ms runs.
    bus.done("2300180185010080", "2F001802FF000000", "2B001803E8030000", "2B00180532000000", "2300180185010000")
    assert bus.send(START) + bus.run(1) != []
    bus.done("2B40600006000000")
    assert bus.run(2) == []
    assert bus.send(STOP if state == "stopped" else PRE_OPERATIONAL) == []
    assert bus.run(1000) == []


def test_row_02_no_emergency_slips_out_after_the_state_has_changed(bus: Bus):
    bus.done("2B151000E8030000")  # inhibit time 100 ms
    assert bus.trip() == ["085#1023030000000000"]
    assert bus.trip(0x3210, 0x04) == []  # waits
    bus.send(STOP)
    assert bus.run(1000) == []
    assert bus.trip(0x4310, 0x08) == []
    bus.send(PRE_OPERATIONAL)
    assert bus.run(1000) == []
    assert bus.value("031000") == 3


def test_row_02_a_transfer_does_not_outlive_stopped(bus: Bus):
    assert bus.sdo("4008100000000000") == "4108100009000000"
    bus.send(STOP)
    assert bus.run(5000) == []
    bus.send(PRE_OPERATIONAL)
    assert bus.sdo("6000000000000000")[8:] == "01000405"


# -- row 3: NMT addressing ---------------------------------------------------------------------------------------------


def state_shown(bus: Bus) -> str:
    """The state in the next heartbeat; 1017h must be 100 ms."""
    sent = [text for text in bus.run(100) if text.startswith("705#")]
    assert len(sent) == 1
    return sent[0].removeprefix("705#")


@pytest.mark.parametrize(
    "frame",
    [
        "000#0106",  # another node
        "000#017F",
        "000#0185",
        "000#01",  # too short
        "000#010500",  # too long
        "000#0105000000000000",
        "000#",
        "000#0005",  # unknown commands
        "000#0305",
        "000#7F05",
        "000#8305",
        "000#FF05",
        "000#0300",
        "000#R",
    ],
)
def test_row_03_what_is_not_for_this_node_is_ignored(bus: Bus, frame: str):
    bus.done("2B17100064000000")
    assert bus.send(frame) == []
    assert state_shown(bus) == "7F"
    bus.send(START)
    assert bus.send(frame.replace("#01", "#02")) == []
    assert state_shown(bus) == "05"


@pytest.mark.parametrize("node", ["05", "00"])
def test_row_03_own_and_broadcast_commands_act(bus: Bus, node: str):
    bus.done("2B17100064000000")
    for command, state in (("01", "05"), ("02", "04"), ("80", "7F"), ("02", "04"), ("01", "05"), ("80", "7F")):
        bus.send("000#" + command + node)
        assert state_shown(bus) == state


# -- row 11: the order of remapping ------------------------------------------------------------------------------------

# RPDO 2 of node 5: COB-ID 1401h:01, mapping 1601h; TPDO 2: 1801h and 1A01h.
PDOS = [
    pytest.param("0114", "0116", "05030000", "05030080", "10004060", "20007A60", id="RPDO"),
    pytest.param("0118", "011A", "85020040", "850200C0", "10004160", "20006460", id="TPDO"),
]
pdos = pytest.mark.parametrize(("parameter", "mapping", "valid", "invalid", "word", "long"), PDOS)


@pdos
def test_row_11_the_proper_order_is_taken(
    bus: Bus, parameter: str, mapping: str, valid: str, invalid: str, word: str, long: str
):
    for _ in range(2):
        bus.done(
            f"23{parameter}01{invalid}",
            f"2F{mapping}0000000000",
            f"23{mapping}01{word}",
            f"23{mapping}02{long}",
            f"2F{mapping}0002000000",
            f"2F{parameter}0201000000",
            f"23{parameter}01{valid}",
        )
        assert bus.sdo(f"40{mapping}0200000000") == f"43{mapping}02{long}"
        assert bus.sdo(f"40{parameter}0100000000") == f"43{parameter}01{valid}"
    bus.send(START)
    if parameter == "0118":
        sent = bus.send("080#")
        assert [text[:4] for text in sent] == ["285#"]
        assert len(sent[0]) == 4 + 12
    else:
        assert bus.send("305#060078563412") == []
        bus.send("080#")
        assert bus.sdo("407A600000000000") == "437A600078563412"


@pdos
def test_row_11_any_other_order_is_refused(
    bus: Bus, parameter: str, mapping: str, valid: str, invalid: str, word: str, long: str
):
    bus.done(f"23{parameter}01{valid}")
    # Valid: neither the count nor an entry changes.
    assert bus.abort(f"2F{mapping}0000000000") in REFUSED_NOW
    assert bus.abort(f"2F{mapping}0001000000") in REFUSED_NOW
    assert bus.abort(f"23{mapping}01{long}") in REFUSED_NOW
    bus.done(f"23{parameter}01{invalid}")
    # Invalid with a count: no entry changes.
    assert bus.abort(f"23{mapping}01{long}") in REFUSED_NOW
    assert bus.sdo(f"40{mapping}0100000000") == f"43{mapping}01{word}"
    bus.done(f"2F{mapping}0000000000", f"23{mapping}01{long}", f"2F{mapping}0001000000", f"23{parameter}01{valid}")


@pdos
def test_row_11_cob_id_does_not_change_while_valid(
    bus: Bus, parameter: str, mapping: str, valid: str, invalid: str, word: str, long: str
):
    bus.done(f"23{parameter}01{valid}")
    assert bus.abort(f"23{parameter}01{'86' if valid[0] == '8' else '06'}{valid[2:]}") in REFUSED_NOW
    assert bus.sdo(f"40{parameter}0100000000") == f"43{parameter}01{valid}"
    bus.done(f"23{parameter}01{invalid}", f"23{parameter}01{'86' if valid[0] == '8' else '06'}{valid[2:]}")


@pdos
def test_row_11_what_cannot_be_mapped(
    bus: Bus, parameter: str, mapping: str, valid: str, invalid: str, word: str, long: str
):
    bus.done(f"23{parameter}01{invalid}", f"2F{mapping}0000000000")
    for entry, codes in {
        "20000010": {NOT_MAPPABLE},  # 1000h, device type
        "20011810": {NOT_MAPPABLE},
        "08004060": {NOT_MAPPABLE},  # 6040h or 6041h with 8 bits
        "20004160": {NOT_MAPPABLE},
        "10000920": {0x06020000, NOT_MAPPABLE},  # 2009h is not there
        "10014060": {0x06090011, NOT_MAPPABLE},  # 6040h:01
    }.items():
        assert bus.abort(f"23{mapping}01{entry}") in codes, entry
    # The wrong direction: RPDOs take what is written, TPDOs what is read.
    if parameter == "0114":
        assert bus.abort(f"23{mapping}0110004160") == NOT_MAPPABLE
    # 64 bits, and not one more.
    for number in range(1, 4):
        bus.done(f"23{mapping}0{number}{long}")
    assert bus.abort(f"2F{mapping}0003000000") == PDO_TOO_LONG
    bus.done(f"2F{mapping}0002000000", f"2F{mapping}0000000000")
    # More entries than there are.
    assert bus.abort(f"2F{mapping}0009000000") in {PDO_TOO_LONG, RANGE, 0x06090031}


def test_row_11_bit_30_is_kept(bus: Bus):
    """No remote requests: 4000 0185h, as the device has it by default; a master that drops the bit is answered too."""
    assert bus.sdo("4000180100000000") == "4300180185010040"
    bus.done("23001801850100C0")
    assert bus.sdo("4000180100000000") == "43001801850100C0"
    bus.done("2300180185010040")
    assert bus.sdo("4000180100000000") == "4300180185010040"
    answer = bus.sdo("2300180185010080")
    assert answer == "6000180100000000" or int.from_bytes(bytes.fromhex(answer[8:]), "little") in REFUSED_NOW


# -- row 12: lengths of RPDO and SYNC ----------------------------------------------------------------------------------


@pytest.mark.parametrize("data", ["", "06"])
def test_row_12_too_short_an_rpdo_is_not_applied(bus: Bus, data: str):
    bus.send(START)
    bus.run(5)
    assert bus.send("205#" + data) == ["085#1082110000000000"]  # 8210h, register generic and communication
    assert bus.value("011000") == 0x11
    assert bus.value("406000") == 0
    assert bus.statusword & 0x6F == 0x40


@pytest.mark.parametrize("data", ["060000", "06000102030405FF"])
def test_row_12_too_long_an_rpdo_is_applied_as_far_as_mapped(bus: Bus, data: str):
    bus.send(START)
    bus.run(5)
    assert bus.send("205#" + data) == ["085#2082110000000000"]  # 8220h
    assert bus.value("011000") == 0x11
    assert bus.value("406000") == 6
    assert bus.statusword & 0x6F == 0x21


@pytest.mark.parametrize("kind", ["01", "00"])
def test_row_12_holds_for_synchronous_rpdos_too(bus: Bus, kind: str):
    bus.done("2300140105020080", f"2F001402{kind}000000", "2300140105020000")
    bus.send(START)
    bus.run(5)
    assert bus.send("205#06") == ["085#1082110000000000"]
    bus.send("080#")
    assert bus.statusword & 0x6F == 0x40
    assert bus.send("205#060000")[0][:13] == "085#208211000"
    bus.send("080#")
    assert bus.statusword & 0x6F == 0x21


def test_row_12_a_sync_of_the_wrong_length(bus: Bus):
    with_cyclic_pdos(bus)
    bus.send(START)
    bus.run(5)
    assert bus.send("080#01") == ["085#4082110000000000"]  # 8240h, and no TPDO
    bus.send(PRE_OPERATIONAL)
    bus.done("2F1910000A000000")  # with counter
    bus.send(START)
    bus.run(5)
    bus.send("080#01")
    assert [text[:8] for text in bus.send("080#")] == ["085#4082"]
    assert [text[:4] for text in bus.send("080#0102")] == []  # the same error, told once
    assert "185#" in [text[:4] for text in bus.send("080#02")]


# -- row 13: synchronous types -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["00", "01", "02", "F0"])
def test_row_13_a_synchronous_rpdo_acts_at_the_next_sync(bus: Bus, kind: str):
    bus.done("2300140105020080", f"2F001402{kind}000000", "2300140105020000")
    bus.send(START)
    bus.send("080#")
    assert bus.send("205#0600") == []
    bus.run(50)
    assert bus.value("406000") == 0
    assert bus.statusword & 0x6F == 0x40
    bus.send("205#0700")
    bus.send("205#0600")  # the last one counts
    bus.send("080#")
    assert bus.value("406000") == 6
    assert bus.statusword & 0x6F == 0x21


@pytest.mark.parametrize("kind", ["FE", "FF"])
def test_row_13_an_event_driven_rpdo_acts_at_once(bus: Bus, kind: str):
    bus.done("2300140105020080", f"2F001402{kind}000000", "2300140105020000")
    bus.send(START)
    bus.run(5)
    bus.send("205#0600")
    assert bus.value("406000") == 6
    assert bus.statusword & 0x6F == 0x21


@pytest.mark.parametrize(("kind", "every"), [("01", 1), ("02", 2), ("03", 3), ("F0", 240)])
def test_row_13_a_synchronous_tpdo_comes_every_nth_sync(bus: Bus, kind: str, every: int):
    bus.done("2300180185010080", f"2F001802{kind}000000", "2300180185010000")
    bus.send(START)
    assert bus.run(10) == []
    counts = [len(bus.send("080#")) for _ in range(2 * every)]
    assert sum(counts) == 2
    places = [place for place, count in enumerate(counts) if count]
    assert places[1] - places[0] == every


def test_row_13_type_0_comes_at_the_sync_after_a_change(bus: Bus):
    bus.done("2300180185010080", "2F00180200000000", "2300180185010000")
    bus.send(START)
    bus.send("080#")
    assert [bus.send("080#") for _ in range(3)] == [[], [], []]
    bus.done("2B40600006000000")
    assert bus.run(20) == []
    assert len(bus.send("080#")) == 1
    assert bus.send("080#") == []


def test_row_13_start_value_of_the_sync_counter(bus: Bus):
    bus.done("2F19100004000000")
    bus.done("2300180185010080", "2F00180202000000", "2F00180603000000", "2300180185010000")
    bus.send(START)
    counts = [len(bus.send(f"080#0{n}")) for n in (1, 2, 3, 4, 1, 2, 3, 4, 1, 2)]
    assert counts[:2] == [0, 0]
    assert sum(counts) in {4, 5}  # counted from the third SYNC on: 3 itself, or the second after it
    places = [place for place, count in enumerate(counts) if count]
    assert {b - a for a, b in pairwise(places)} == {2}


def test_row_13_what_comes_after_the_synchronous_window_is_not_used(bus: Bus):
    bus.done("23071000E8030000")  # 1000 us
    bus.done("2300140105020080", "2F00140201000000", "2300140105020000")
    bus.send(START)
    bus.send("080#")
    bus.run(1.5)
    bus.send("205#0600")
    bus.run(1)
    bus.send("080#")
    assert bus.statusword & 0x6F == 0x40
    bus.run(0.5)
    bus.send("205#0600")
    bus.run(1)
    bus.send("080#")
    assert bus.statusword & 0x6F == 0x21


def test_row_13_samples_are_taken_at_the_sync_before_the_new_targets_act(bus: Bus):
    with_cyclic_pdos(bus)
    bus.done("2300140105020080", "2F00140201000000", "2300140105020000")
    bus.send(START)
    bus.send("205#0600")
    sent = bus.send("080#")
    assert int.from_bytes(bytes.fromhex(sent[0][4:]), "little") & 0x6F == 0x40
    sent = bus.send("080#")
    assert int.from_bytes(bytes.fromhex(sent[0][4:]), "little") & 0x6F == 0x21


def test_row_13_position_is_that_of_the_instant_of_the_sync(bus: Bus):
    """A moving axis, two TPDOs with 6064h at one SYNC agree, and with SDO at the same instant."""
    bus.done("23021801850300C0", "2F02180201000000", "2302180185030040")
    bus.enable()
    bus.send(START)
    for number in range(1, 40):
        target = (25 * number).to_bytes(4, "little").hex()
        bus.done("237A6000" + target)
        sent = bus.send("080#")
        assert [text[:4] for text in sent] == ["385#"]
        position = sent[0][8:16]
        assert bus.sdo("4064600000000000") == "43646000" + position
        bus.run(1)
    assert int.from_bytes(bytes.fromhex(position), "little", signed=True) > 500


# -- row 14: inhibit time and event timer ------------------------------------------------------------------------------


def event_driven(bus: Bus, inhibit: str = "0000", event: str = "0000", cob_id: str = "8501") -> None:
    bus.done(
        f"23001801{cob_id}0080", "2F001802FF000000", f"2B001803{inhibit}0000", f"2B001805{event}0000",
        f"23001801{cob_id}0000",
    )  # fmt: skip


def test_row_14_inhibit_time_in_units_of_100_us(bus: Bus):
    event_driven(bus, inhibit="6400")  # 10.0 ms
    bus.send(START)
    bus.run(50)
    bus.done("2B40600006000000")
    times = [at for at, text in bus.run_timed(2) if text.startswith("185#")]
    assert len(times) == 1
    bus.done("2B40600007000000")
    later = [at + 2 for at, text in bus.run_timed(30) if text.startswith("185#")]
    assert len(later) == 1
    assert later[0] - times[0] == pytest.approx(10.0, abs=1e-6)


def test_row_14_event_timer_in_ms_restarts_when_the_pdo_is_sent(bus: Bus):
    event_driven(bus, event="1400")  # 20 ms
    bus.send(START)
    times = [at for at, text in bus.run_timed(101) if text.startswith("185#")]
    assert [round(b - a, 6) for a, b in pairwise(times)] == [20.0] * (len(times) - 1)
    assert len(times) >= 5
    # An event 9 ms after the last one: the next is 20 ms after that.
    bus.run(20 - (101 - times[-1]) + 9)
    bus.done("2B40600006000000")
    times = [at for at, text in bus.run_timed(45) if text.startswith("185#")]
    assert len(times) == 3
    assert times[0] < 2
    assert [round(b - a, 6) for a, b in pairwise(times)] == [20.0, 20.0]


def test_row_14_inhibit_time_holds_for_the_event_timer_too(bus: Bus):
    event_driven(bus, inhibit="F401", event="1400")  # 50 ms and 20 ms
    bus.send(START)
    times = [at for at, text in bus.run_timed(1000) if text.startswith("185#")]
    assert min(b - a for a, b in pairwise(times)) >= 50.0


def test_row_14_a_jittering_encoder_does_not_flood_the_bus():
    bus = Bus(noise_counts=2.0)
    bus.done("23001801850100C0", "2F001A0000000000", "23001A0110004160", "23001A0220006460", "2F001A0002000000")
    bus.done("2F001802FF000000", "2300180185010040")
    bus.send(START)
    bus.run(10)
    positions = set()
    frames = []
    for _ in range(200):
        frames += bus.run(1)
        positions.add(bus.value("646000", signed=True))
    assert len(positions) > 2  # it does jitter
    assert len(frames) <= 20


# -- row 15: heartbeats ------------------------------------------------------------------------------------------------


def test_row_15_writing_the_period_restarts_it_at_once(bus: Bus):
    bus.done("2B17100064000000")
    assert [at for at, _ in bus.run_timed(350)] == pytest.approx([100, 200, 300])
    bus.done("2B1710001E000000")  # 30 ms, 50 ms after the last one
    assert [at for at, _ in bus.run_timed(100)] == pytest.approx([30, 60, 90])
    bus.done("2B17100000000000")
    assert bus.run(1000) == []


def watch(bus: Bus, behaviour: str | None = None) -> None:
    """Node 127 is watched with 100 ms."""
    bus.done("2316100164007F00")
    if behaviour is not None:
        bus.done("2F291001" + behaviour + "000000")


def test_row_15_the_consumer_starts_with_the_first_heartbeat(bus: Bus):
    watch(bus)
    assert bus.run(1000) == []
    assert bus.send("77F#05") == []
    sent = bus.run_timed(99)
    assert sent == []
    sent = bus.run_timed(10)
    assert sent == [(pytest.approx(1.0), "085#3081110000000000")]  # 8130h
    assert bus.run(1000) == []  # once


@pytest.mark.parametrize("state", ["05", "7F", "04"])
def test_row_15_heartbeats_in_time_are_no_loss(bus: Bus, state: str):
    watch(bus)
    for _ in range(20):
        assert bus.send("77F#" + state) == []
        assert bus.run(99) == []


def test_row_15_other_nodes_and_lengths_are_no_heartbeat(bus: Bus):
    watch(bus)
    bus.send("77F#05")
    bus.run(60)
    bus.send("77E#05")
    bus.send("77F#")
    bus.send("77F#0505")
    assert bus.run(60) == ["085#3081110000000000"]


@pytest.mark.parametrize(("behaviour", "state"), [("00", "7F"), ("01", "05"), ("02", "04"), (None, "7F")])
def test_row_15_error_behaviour_after_a_loss(bus: Bus, behaviour: str | None, state: str):
    watch(bus, behaviour)
    bus.send(START)
    bus.run(5)
    bus.send("77F#05")
    assert "085#3081110000000000" in bus.run(120)
    if state == "04":
        assert bus.sdo(DEVICE_TYPE[0]) == ""
        bus.send("000#0105")
    bus.done("2B17100064000000")
    assert state_shown(bus) == ("05" if state == "04" else state)
    # Back again: no error any more, and the NMT state is the master's business.
    sent = bus.send("77F#05")
    assert sent == ["085#0000000000000000"]
    assert bus.value("011000") == 0
    bus.done("2316100100000000")  # watched no longer
    assert state_shown(bus) in ({"05"} if state == "04" else {state})


def test_row_15_behaviour_0_leaves_pre_operational_as_it_is(bus: Bus):
    watch(bus)
    bus.send("77F#05")
    assert bus.run(120) == ["085#3081110000000000"]
    assert bus.sdo(DEVICE_TYPE[0]) == DEVICE_TYPE[1]


def test_row_15_several_nodes_are_watched_each_for_itself(bus: Bus):
    bus.done("2316100164007F00", "2316100232007E00")
    bus.send("77F#05")
    bus.send("77E#05")
    sent = bus.run_timed(60)
    assert sent == [(pytest.approx(50.0), "085#3081110000000000")]
    bus.send("77F#05")
    assert bus.send("77E#05") == ["085#0000000000000000"]


def test_row_15_after_its_own_reset_the_consumer_waits_for_the_first_heartbeat_again(bus: Bus):
    watch(bus)
    bus.done("23101001" + SAVE)
    bus.send("77F#05")
    bus.run(50)
    for reset in (RESET_NODE, RESET_COMMUNICATION):
        assert bus.send(reset) == ["705#00"]
        assert bus.run(1000) == []
        assert bus.sdo("4016100100000000") == "4316100164007F00"
        bus.send("77F#05")
        assert bus.run(101) == ["085#3081110000000000"]
        bus.send("77F#05")


def test_row_15_one_node_is_not_watched_twice(bus: Bus):
    watch(bus)
    assert bus.abort("2316100232007F00") == 0x06040043
    # A node id or a time of 0 watches nobody, and 128 and more are no nodes.
    bus.done("2316100264000000", "2316100300007E00")
    assert bus.abort("2316100464008000") in {RANGE, 0x06090031, 0x06040043}
    bus.send("77E#05")
    bus.send("700#05")
    assert bus.run(1000) == []


def test_row_15_node_guarding_toggles_and_life_guarding_is_a_loss(bus: Bus):
    assert [bus.send("705#R") for _ in range(3)] == [["705#7F"], ["705#FF"], ["705#7F"]]
    bus.send(START)
    assert bus.send("705#R") == ["705#85"]
    # The boot-up starts the toggle anew.
    bus.send(RESET_COMMUNICATION)
    assert bus.send("705#R") == ["705#7F"]
    # 100 ms times 3: no loss before the first request, and one after 300 ms without any.
    bus.done("2B0C100064000000", "2F0D100003000000")
    assert bus.run(1000) == []
    assert bus.send("705#R") == ["705#FF"]
    assert bus.run(299) == []
    assert bus.run(2) == ["085#3081110000000000"]
    # With a heartbeat of its own the node is not guarded.
    bus.send(RESET_COMMUNICATION)
    bus.done("2B171000E8030000")
    assert bus.send("705#R") == []


# -- row 16: EMCY ------------------------------------------------------------------------------------------------------


def test_row_16_emergency_register_and_history(bus: Bus):
    assert bus.sdo("4003100000000000") == "4F03100000000000"
    bus.send(START)
    bus.run(5)
    assert bus.send("205#06") == ["085#1082110000000000"]
    assert bus.send("080#00") == ["085#4082110000000000"]
    assert bus.trip() == ["085#1023130000000000"]  # 2310h: generic, current, communication
    assert bus.value("011000") == 0x13
    assert bus.value("3F6000") == 0x2310
    assert bus.sdo("4003100000000000") == "4F03100003000000"
    # Newest first.
    assert [bus.value(f"03100{n}") & 0xFFFF for n in (1, 2, 3)] == [0x2310, 0x8240, 0x8210]
    # 0000h when all have gone, and not before.
    assert not [text for text in bus.send("080#") if text.startswith("085#0000")]
    assert not [text for text in bus.send("205#0000") if text.startswith("085#0000")]
    assert bus.value("011000") & 0x10 == 0
    bus.run(20)
    bus.done("2B40600000000000")
    assert "085#0000000000000000" in bus.send("205#8000")
    assert bus.value("011000") == 0
    # The history stays.
    assert bus.value("031000") == 3
    assert bus.abort("2F03100001000000") == RANGE
    assert bus.value("031000") == 3
    bus.done("2F03100000000000")
    assert bus.value("031000") == 0
    assert bus.abort("4003100100000000") in {0x08000024, 0x06090011}


def test_row_16_the_history_has_an_end(bus: Bus):
    for number in range(12):
        bus.trip(0x2310 if number % 2 else 0x3210)
        bus.run(20)
        bus.done("2B40600000000000", "2B40600080000000")
    count = bus.value("031000")
    assert 1 <= count <= 254
    assert bus.value(f"0310{count:02X}") & 0xFFFF in {0x2310, 0x3210}
    assert bus.value("031001") & 0xFFFF == 0x2310
    assert bus.value("031002") & 0xFFFF == 0x3210


def test_row_16_inhibit_time_of_emergencies(bus: Bus):
    bus.done("2B15100064000000")  # 10.0 ms
    bus.send(START)
    bus.run(5)
    assert bus.send("205#06") == ["085#1082110000000000"]
    bus.run(2)
    assert bus.send("080#00") == []
    sent = [(at, text) for at, text in bus.run_timed(30) if text.startswith("085#")]
    assert sent == [(pytest.approx(8.0), "085#4082110000000000")]


def test_row_16_cob_id_of_emergencies(bus: Bus):
    assert bus.sdo("4014100000000000") == "4314100085000000"
    bus.done("2314100085000080")  # does not exist
    assert bus.trip() == []
    bus.run(20)
    bus.done("2314100085000000")
    bus.done("2B40600000000000")
    assert "085#0000000000000000" in bus.send("605#2B40600080000000")


# -- row 17: store and restore -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["101001", "101002", "111001", "111002"])
def test_row_17_a_wrong_signature_is_refused(bus: Bus, place: str):
    right = SAVE if place.startswith("1010") else LOAD
    others = [SAVE, LOAD, "00000000", "01000000", "65766173", "64616F6C", "53415645"]
    for signature in others:
        if signature != right:
            assert bus.abort("23" + place + signature) in CANNOT_STORE


def test_row_17_capabilities_are_read_back(bus: Bus):
    for place in ("101001", "111001"):
        assert bus.value(place) & 1 == 1  # on command
        assert bus.value(place) >> 2 == 0
    bus.done("23101001" + SAVE)
    assert bus.value("101001") & 1 == 1


@pytest.mark.parametrize("reset", [RESET_NODE, RESET_COMMUNICATION])
def test_row_17_what_is_stored_outlives_a_reset(bus: Bus, reset: str):
    bus.done("2B17100064000000", "23101001" + SAVE)
    bus.done("2B171000C8000000")  # not stored
    assert bus.send(reset)[:1] == ["705#00"]
    assert bus.sdo("4017100000000000") == "4B17100064000000"


def test_row_17_restore_acts_after_the_reset(bus: Bus):
    bus.done("2B17100064000000", "2365600000010000", "23101001" + SAVE, "23111001" + LOAD)
    assert bus.sdo("4017100000000000") == "4B17100064000000"
    assert bus.sdo("4065600000000000") == "4365600000010000"
    assert bus.send(RESET_NODE) == ["705#00"]
    assert bus.sdo("4017100000000000") == "4B17100000000000"
    assert bus.sdo("4065600000000000") != "4365600000010000"
    # Once: what is stored after it stays.
    bus.done("2B17100032000000", "23101001" + SAVE)
    bus.send(RESET_NODE)
    assert bus.sdo("4017100000000000") == "4B17100032000000"


def test_row_17_nothing_stored_is_nothing_kept(bus: Bus):
    bus.done("2B17100064000000", "2365600000010000")
    bus.send(RESET_NODE)
    assert bus.sdo("4017100000000000") == "4B17100000000000"


# -- row 28: identity, EDS, LSS ----------------------------------------------------------------------------------------

EDS = Path(__file__).parents[2] / "config" / "eds" / "sim_drive.eds"


def eds_sections() -> list[tuple[str, configparser.SectionProxy]]:
    parser = configparser.ConfigParser(interpolation=None, strict=True)
    parser.read_string(EDS.read_text(encoding="ascii"))
    names = [name for name in parser.sections() if name[:4].isalnum() and len(name) >= 4]
    found = []
    for name in names:
        index, _, subindex = name.lower().partition("sub")
        try:
            int(index, 16)
        except ValueError:
            continue
        if len(index) == 4 and "DataType" in parser[name]:
            place = index[2:] + index[:2] + f"{int(subindex or '0', 16):02x}"
            found.append((place.upper(), parser[name]))
    return found


def upload(bus: Bus, place: str) -> bytes | int:
    """Everything the standard offers to a client without block transfer; an abort code instead of the data."""
    answer = bytes.fromhex(bus.sdo("40" + place + "00000000"))
    if answer[0] == 0x80:
        return int.from_bytes(answer[4:], "little")
    if answer[0] & 2:
        return answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & 1 else 0)]
    data = b""
    for number in range(10_000):
        segment = bytes.fromhex(bus.sdo("7000000000000000" if number % 2 else "6000000000000000"))
        assert segment[0] >> 5 == 0
        data += segment[1 : 8 - (segment[0] >> 1 & 7)]
        if segment[0] & 1:
            return data
    raise AssertionError("a segmented upload without an end")


def test_row_28_every_default_of_the_eds_is_what_the_drive_answers(bus: Bus):
    # State, not defaults: what a drive at standstill shows differs from the 0 of a file.
    live = {"416000", "646000", "626000", "6C6000", "776000", "F46000", "FD6000", "781000"}
    instance = {"181004"} | {f"2030{n:02X}" for n in range(1, 6)}  # serial number; gains of the bench's axis
    differing = []
    count = 0
    for place, section in eds_sections():
        access = section["AccessType"].lower()
        if access == "wo" or place in live or place in instance or section.get("ObjectType", "0x7") == "0x2":
            continue
        default = section.get("DefaultValue", "")
        answer = upload(bus, place)
        if isinstance(answer, int):
            # A history that is empty has no data, whatever the file says.
            if not (place.startswith("0310") and answer in {0x08000024, 0x06090011}):
                differing.append((place, default, hex(answer)))
            continue
        count += 1
        if int(section["DataType"], 16) in {0x09, 0x0A, 0x0B}:
            same = answer == default.encode("ascii")
        else:
            total = (
                sum(5 if part.upper() == "$NODEID" else int(part, 0) for part in default.split("+")) if default else 0
            )
            same = answer == (total % (1 << 8 * len(answer))).to_bytes(len(answer), "little")
        if not same:
            differing.append((place, default, answer.hex()))
    assert differing == []
    assert count > 200


def test_row_28_restored_defaults_are_those_of_the_eds_again(bus: Bus):
    before = {place: upload(bus, place) for place, section in eds_sections() if section["AccessType"].lower() != "wo"}
    bus.done("2B17100064000000", "2365600000010000", "2F00140201000000", "2B5A600006000000")
    bus.send("605#23101001" + SAVE)
    bus.done("23111001" + LOAD)
    bus.send(RESET_NODE)
    bus.run(10)
    after = {place: upload(bus, place) for place in before}
    assert {place: (before[place], after[place]) for place in before if before[place] != after[place]} == {}


def test_row_28_device_type_and_identity(bus: Bus):
    assert bus.value("001000") & 0xFFFF == 0x0192  # 402
    assert bus.value("001000") >> 16 & 0xFF == 0x02  # a servo drive
    assert bus.value("181000") == 4
    assert [bus.value(f"18100{n}") for n in (1, 2, 3, 4)] == [0x4D2, 0x1024, 0x10000, 5]


def test_row_28_lss_inquires_the_identity_of_1018h(bus: Bus):
    assert bus.send("7E5#0401000000000000") == []  # all into configuration
    assert bus.send("7E5#5A00000000000000") == ["7E4#5AD2040000000000"]
    assert bus.send("7E5#5B00000000000000") == ["7E4#5B24100000000000"]
    assert bus.send("7E5#5C00000000000000") == ["7E4#5C00000100000000"]
    assert bus.send("7E5#5D00000000000000") == ["7E4#5D05000000000000"]
    assert bus.send("7E5#5E00000000000000") == ["7E4#5E05000000000000"]
    assert bus.send("7E5#0400000000000000") == []  # all into waiting: not a word from there
    assert bus.send("7E5#5E00000000000000") == []


def test_row_28_lss_selects_by_identity(bus: Bus):
    for serial, answers in (("06", []), ("05", ["7E4#4400000000000000"])):
        assert bus.send("7E5#40D2040000000000") == []
        assert bus.send("7E5#4124100000000000") == []
        assert bus.send("7E5#4200000100000000") == []
        assert bus.send(f"7E5#43{serial}000000000000") == answers
    # Node id 6, after the next reset of communication.
    assert bus.send("7E5#1106000000000000") == ["7E4#1100000000000000"]
    assert bus.send("7E5#1180000000000000") == ["7E4#1101000000000000"]  # 128 is none
    assert bus.send("7E5#1100000000000000") == ["7E4#1101000000000000"]
    assert bus.send("7E5#5E00000000000000") in (["7E4#5E05000000000000"], ["7E4#5E06000000000000"])
    bus.send("7E5#0400000000000000")
    assert bus.sdo(DEVICE_TYPE[0]) == DEVICE_TYPE[1]  # still 5
    assert bus.send(RESET_COMMUNICATION) + bus.run(100) == ["706#00"]
    assert bus.send("606#" + DEVICE_TYPE[0]) == ["586#" + DEVICE_TYPE[1]]
    assert bus.sdo(DEVICE_TYPE[0]) == ""


def test_row_28_lss_identify(bus: Bus):
    for low, high, answers in (
        ("04000000", "06000000", ["7E4#4F00000000000000"]),
        ("05000000", "05000000", ["7E4#4F00000000000000"]),
        ("06000000", "FFFFFFFF", []),
        ("00000000", "04000000", []),
    ):
        sent = bus.send("7E5#46D2040000000000") + bus.send("7E5#4724100000000000")
        sent += bus.send("7E5#4800000000000000") + bus.send("7E5#49FFFFFFFF000000")
        sent += bus.send(f"7E5#4A{low}000000") + bus.send(f"7E5#4B{high}000000")
        assert sent == answers


def test_row_28_lss_fastscan_finds_the_identity_of_1018h(bus: Bus):
    # A configured node takes no part.
    assert bus.send("7E5#5100000000800000") == []
    bus.send("7E5#0401000000000000")
    assert bus.send("7E5#11FF000000000000") == ["7E4#1100000000000000"]  # node id 255: none
    bus.send("7E5#0400000000000000")
    assert bus.send(RESET_COMMUNICATION) + bus.run(100) == []  # no boot-up without a node id
    assert bus.sdo(DEVICE_TYPE[0]) == ""
    assert bus.send("7E5#5100000000800000") == ["7E4#4F00000000000000"]
    found = []
    for part in range(4):
        known = 0
        for bit in range(31, -1, -1):
            guess = known.to_bytes(4, "little").hex()
            answers = bus.send(f"7E5#51{guess}{bit:02x}{part:02x}{part:02x}")
            assert answers in ([], ["7E4#4F00000000000000"])
            if not answers:
                known |= 1 << bit
        confirmed = known.to_bytes(4, "little").hex()
        following = (part + 1) % 4
        assert bus.send(f"7E5#51{confirmed}00{part:02x}{following:02x}") == ["7E4#4F00000000000000"]
        found.append(known)
    assert found == [0x4D2, 0x1024, 0x10000, 5]
    # It is in configuration now: give it a node id again.
    assert bus.send("7E5#1107000000000000") == ["7E4#1100000000000000"]
    assert bus.send("7E5#0400000000000000") + bus.run(100) == ["707#00"]
    assert bus.send("607#" + DEVICE_TYPE[0]) == ["587#" + DEVICE_TYPE[1]]
