"""The drive's CiA 402 state machine against the standard's own wording, over all states and controlwords."""

import pytest
from drive_bench import MS, Bench

from sim_drive.device.cia402 import STATE_BITS, PowerState, PowerStateChanged

NOT_READY, DISABLED, READY, ON, ENABLED, QUICK, REACTION, FAULT = PowerState

# Statusword mask and value of each state (CiA 402-2, table of the statusword's state coding).
MASKS = {
    NOT_READY: (0x4F, 0x00),
    DISABLED: (0x4F, 0x40),
    READY: (0x6F, 0x21),
    ON: (0x6F, 0x23),
    ENABLED: (0x6F, 0x27),
    QUICK: (0x6F, 0x07),
    REACTION: (0x4F, 0x0F),
    FAULT: (0x4F, 0x08),
}

# Commands as the standard's table writes them: bits 7, 3, 2, 1, 0; x is any.
CODING = {
    "shutdown": "0x110",
    "switch on": "00111",
    "enable operation": "01111",
    "disable voltage": "0xx0x",
    "quick stop": "0x01x",
}
BITS = (7, 3, 2, 1, 0)

# Transitions by the standard's numbers: state, command, state.
NUMBERED = {
    2: (DISABLED, "shutdown", READY),
    3: (READY, "switch on", ON),
    4: (ON, "enable operation", ENABLED),
    5: (ENABLED, "switch on", ON),
    6: (ON, "shutdown", READY),
    7: (READY, "quick stop", DISABLED),
    70: (READY, "disable voltage", DISABLED),
    8: (ENABLED, "shutdown", READY),
    9: (ENABLED, "disable voltage", DISABLED),
    10: (ON, "quick stop", DISABLED),
    100: (ON, "disable voltage", DISABLED),
    11: (ENABLED, "quick stop", QUICK),
    12: (QUICK, "disable voltage", DISABLED),
    16: (QUICK, "enable operation", ENABLED),
    34: (READY, "enable operation", ENABLED),  # 3, then 4 by itself
}


def commands_of(low_byte: int) -> set[str]:
    return {
        name
        for name, pattern in CODING.items()
        if all(wanted in {"x", str(low_byte >> bit & 1)} for bit, wanted in zip(BITS, pattern, strict=True))
    }


def bench_in(state: PowerState) -> Bench:
    bench = Bench(boot=False)
    bench.drive.wake(0)
    bench.sent()
    if state is NOT_READY:
        return bench
    bench.tick()
    words = {READY: (0x06,), ON: (0x06, 0x07)}.get(state, (0x06, 0x07, 0x0F))
    if state not in {DISABLED, FAULT}:
        bench.must(0x605A, 0, 6, 2)
        bench.must(0x6060, 0, 8, 1)
        bench.must(0x60C2, 1, 100, 1)
        bench.tick()
        for word in words:
            bench.control(word)
    if state is QUICK:
        bench.control(0x02)
    elif state is REACTION:
        bench.must(0x6085, 0, 1, 4)
        bench.must(0x607A, 0, 100, 4)  # in motion, so that the ramp lasts
        bench.drive.trip(0x2310, 0x02, bench.now_ns)
    elif state is FAULT:
        bench.drive.trip(0x2310, 0x02, bench.now_ns)
        bench.tick()
    assert bench.drive.power_state is state
    return bench


@pytest.mark.parametrize("state", list(PowerState))
def test_statusword_of_each_state(state: PowerState):
    bench = bench_in(state)
    mask, value = MASKS[state]
    statusword = bench.statusword
    assert statusword & mask == value
    assert statusword & 0x0210 == 0x0210  # remote, voltage
    for other, (other_mask, other_value) in MASKS.items():
        assert other is state or statusword & other_mask != other_value


@pytest.mark.parametrize("state", list(PowerState))
def test_every_controlword_in_every_state(state: PowerState):
    for low_byte in range(256):
        commands = commands_of(low_byte)
        assert len(commands) <= 1
        expected = state
        for before, command, after in NUMBERED.values():
            if before is state and command in commands:
                expected = after
        if state is FAULT and low_byte & 0x80:
            expected = DISABLED
        bench = bench_in(state)
        # The other bits carry what modes use: they must not matter.
        bench.control(low_byte | (low_byte * 0x35 << 8 & 0xFF00))
        assert bench.drive.power_state is expected, f"{state.name} {low_byte:02X}h"


def test_state_bits_are_the_standards():
    for state, (mask, value) in MASKS.items():
        assert STATE_BITS[state] & mask == value


def test_zero_fh_from_ready_passes_switched_on():
    bench = bench_in(READY)
    bench.drive.take_events()
    bench.control(0x0F)
    changes = [event for event in bench.drive.take_events() if isinstance(event, PowerStateChanged)]
    assert [(change.before, change.after) for change in changes] == [(READY, ON), (ON, ENABLED)]


def test_not_ready_goes_on_by_itself():
    bench = bench_in(NOT_READY)
    bench.tick()
    assert bench.drive.power_state is DISABLED


@pytest.mark.parametrize("state", list(PowerState))
def test_power_and_brake_in_each_state(state: PowerState):
    bench = bench_in(state)
    assert bench.drive.is_powered is (state in {ENABLED, QUICK, REACTION})
    assert bench.drive.axis.is_brake_released is bench.drive.is_powered


def test_last_writer_of_the_controlword_wins():
    bench = Bench()
    bench.map_cyclic()
    bench.set_point(0x06, 0)
    bench.sync()
    assert bench.drive.power_state is READY
    bench.set_point(0x07, 0)
    bench.control(0x00)
    assert bench.drive.power_state is DISABLED
    bench.sync()  # 07h comes into effect now, and means nothing here
    assert bench.drive.power_state is DISABLED
    assert bench.read(0x6040) == 0x07


# -- fault reset -------------------------------------------------------------------------------------------------------


def test_fault_reset_acts_on_the_rising_edge_once():
    bench = bench_in(FAULT)
    bench.control(0x80)
    assert bench.drive.power_state is DISABLED
    assert bench.read(0x603F) == 0
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    bench.tick()
    bench.control(0x80)  # still high: no edge
    assert bench.drive.power_state is FAULT
    bench.control(0x00)
    bench.control(0x8F)  # an edge, whatever the other bits are
    assert bench.drive.power_state is DISABLED


def test_edge_before_the_fault_is_no_reset():
    bench = bench_in(ENABLED)
    bench.control(0x8F)  # no command at all: bit 7 is set
    assert bench.drive.power_state is ENABLED
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    bench.tick()
    bench.tick()
    bench.control(0x8F)
    assert bench.drive.power_state is FAULT


# -- modes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [6, 8, 0, -2])
def test_display_follows_at_the_next_servo_tick(mode: int):
    bench = Bench()
    bench.must(0x6060, 0, 8 if mode != 8 else 6, 1)
    bench.tick()
    bench.must(0x6060, 0, mode, 1)
    assert bench.read(0x6061, signed=True) != mode
    bench.tick()
    assert bench.read(0x6061, signed=True) == mode


def test_supported_modes_are_those_that_6060h_takes():
    bench = Bench()
    bits = {1: 0, 3: 2, 4: 3, 6: 5, 7: 6, 8: 7, 9: 8, 10: 9, -2: 16}
    takes = {mode for mode in range(-128, 128) if bench.write(0x6060, 0, mode, 1) == 0}
    assert takes - {0} == {mode for mode, bit in bits.items() if bench.read(0x6502) >> bit & 1}
    assert bench.read(0x6502) & ~sum(1 << bit for bit in bits.values()) == 0


def test_mode_written_by_rpdo_is_checked_too():
    bench = Bench()
    bench.map_rpdo(2, 0x305, 255, [0x60400010, 0x60600008])
    bench.nmt(0x01)
    bench.put(0x305, "060008")
    bench.put(0x305, "060002")
    bench.tick()
    assert bench.read(0x6060) == 8
    assert bench.read(0x6061) == 8
    assert bench.drive.power_state is READY


# -- quick stop and fault reaction ---------------------------------------------------------------------------------


RAMPS = {code: {index} for code, index in zip((1, 2, 3, 4), (0x6084, 0x6085, 0x60C6, 0x60C6), strict=True)}
"""Where the deceleration of an option code stands: slow down, quick stop, limits."""
RAMPS |= {code + 4: index for code, index in RAMPS.items()} | {0: set()}


def moving_bench(quick_stop: int = 0, reaction: int = 0) -> Bench:
    """Enabled in csp at 10000 counts/s, with 100000 counts/s^2 of deceleration: 100 ms and 500 counts to rest."""
    bench = Bench()
    bench.must(0x605A, 0, quick_stop, 2)
    bench.must(0x605E, 0, reaction, 2)
    for index in (0x6084, 0x6085, 0x60C6):  # the ramp that is not asked for is ten times as steep
        bench.must(index, 0, 100_000 if index in RAMPS[quick_stop] | RAMPS[reaction] else 1_000_000, 4)
    bench.map_cyclic()
    bench.enable()
    bench.follows = True
    for k in range(1, 21):
        bench.cycle(10 * k)
    assert bench.shaft == 200
    return bench


@pytest.mark.parametrize("option", [1, 2, 3, 4])
def test_quick_stop_ramp_then_disabled(option: int):
    bench = moving_bench(quick_stop=option)
    bench.control(0x02)
    bench.run(99 * MS)
    assert bench.drive.power_state is QUICK
    assert bench.drive.is_powered
    bench.run(2 * MS)
    assert bench.drive.power_state is DISABLED
    assert not bench.drive.is_powered
    assert bench.shaft == 200 + 500


@pytest.mark.parametrize("option", [5, 6, 7, 8])
def test_quick_stop_ramp_then_stays(option: int):
    bench = moving_bench(quick_stop=option)
    bench.control(0x02)
    bench.run(500 * MS)
    assert bench.drive.power_state is QUICK
    assert bench.shaft == 700
    bench.control(0x0F)  # transition 16
    assert bench.drive.power_state is ENABLED
    bench.run(10 * MS)
    assert bench.shaft == 700
    bench.control(0x02)
    bench.control(0x00)
    assert bench.drive.power_state is DISABLED


def test_enable_is_no_way_out_of_a_quick_stop_that_ends_disabled():
    bench = moving_bench(quick_stop=2)
    bench.control(0x02)
    bench.tick()
    bench.control(0x0F)
    assert bench.drive.power_state is QUICK


def test_quick_stop_option_zero_disables_at_once():
    bench = moving_bench(quick_stop=0)
    bench.control(0x02)
    assert bench.drive.power_state is DISABLED
    assert not bench.drive.is_powered


def test_quick_stop_is_parabolic():
    bench = moving_bench(quick_stop=2, reaction=2)
    bench.control(0x02)
    for _ in range(50):
        bench.tick()
    # 10000 * 0.05 - 100000 * 0.05^2 / 2
    assert bench.drive.position_demand_counts == pytest.approx(200 + 375, abs=1e-6)


@pytest.mark.parametrize("option", [1, 2, 3, 4])
def test_fault_reaction_ramps_then_faults(option: int):
    bench = moving_bench(reaction=option)
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    bench.run(99 * MS)
    assert bench.drive.power_state is REACTION
    bench.run(2 * MS)
    assert bench.drive.power_state is FAULT
    assert bench.shaft == 700


def test_fault_reaction_zero_takes_the_torque_away_at_once():
    bench = moving_bench(reaction=0)
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    assert not bench.drive.is_powered
    bench.tick()
    assert bench.drive.power_state is FAULT


def test_fault_during_a_quick_stop_keeps_to_the_ramp():
    bench = moving_bench(quick_stop=2, reaction=2)
    bench.control(0x02)
    bench.run(50 * MS)
    bench.drive.trip(0x2310, 0x02, bench.now_ns)
    bench.run(52 * MS)
    assert bench.drive.power_state is FAULT
    assert bench.shaft == 700


@pytest.mark.parametrize(("word", "index", "state"), [(0x07, 0x605C, ON), (0x06, 0x605B, READY)])
def test_leaving_the_operation_by_ramp_or_at_once(word: int, index: int, state: PowerState):
    bench = moving_bench()
    bench.must(index, 0, 0, 2)
    bench.control(word)
    assert bench.drive.power_state is state
    bench = moving_bench(quick_stop=1)  # 6084h is 100000
    bench.must(index, 0, 1, 2)
    bench.control(word)
    bench.run(99 * MS)
    assert bench.drive.power_state is ENABLED
    bench.cycle(0, word)  # targets count no more
    bench.run(MS)
    assert bench.drive.power_state is state
    assert bench.shaft == 700


def test_enabling_again_calls_the_ramp_off():
    bench = moving_bench(quick_stop=1)
    bench.must(0x605C, 0, 1, 2)
    bench.control(0x07)
    bench.run(10 * MS)
    bench.control(0x0F)
    bench.run(200 * MS)
    assert bench.drive.power_state is ENABLED
    assert bench.shaft == 700  # there was no new target, so the ramp ran out
    bench.cycle(710)
    assert bench.shaft == 710


@pytest.mark.parametrize(("word", "state"), [(0x00, DISABLED), (0x06, READY), (0x02, QUICK)])
def test_stronger_commands_go_ahead_of_the_ramp(word: int, state: PowerState):
    bench = moving_bench(quick_stop=2)
    bench.must(0x605C, 0, 1, 2)
    bench.must(0x605B, 0, 0, 2)
    bench.control(0x07)
    bench.tick()
    bench.control(word)
    assert bench.drive.power_state is state


# -- halt ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", [1, 2, 3, 4])
def test_halt_stops_csp_and_the_next_target_after_it_counts(option: int):
    bench = moving_bench(quick_stop=option)
    bench.must(0x605D, 0, option, 2)
    bench.set_point(0x10F, 210)
    bench.sync()
    bench.run(101 * MS)
    assert bench.drive.power_state is ENABLED
    assert bench.shaft == 700
    bench.cycle(900, 0x10F)
    assert bench.shaft == 700
    bench.cycle(710)
    assert bench.shaft == 710


# -- abort connection ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("option", "state"), [(0, ENABLED), (1, REACTION), (2, DISABLED), (3, QUICK)])
def test_abort_connection_option_on_nmt_stop(option: int, state: PowerState):
    bench = moving_bench(quick_stop=6, reaction=2)
    bench.must(0x6007, 0, option, 2)
    bench.nmt(0x02)
    assert bench.drive.power_state is state


def test_option_codes_that_are_not_there_are_refused():
    bench = Bench()
    for index, good, bad in (
        (0x6007, 3, 4),
        (0x605A, 8, 9),
        (0x605B, 1, 2),
        (0x605C, 1, 2),
        (0x605D, 4, 5),
        (0x605E, 4, 5),
    ):
        assert bench.write(index, 0, good, 2) == 0
        assert bench.write(index, 0, bad, 2) == 0x06090031
        assert bench.write(index, 0, -1, 2) == 0x06090032
