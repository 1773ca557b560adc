"""The master's view of CiA 402: every statusword pattern of the standard, over all values of the other bits."""

import itertools

import pytest

from drivers.cia402 import NEXT_COMMAND_TO_ENABLE, State, state_of

# CiA 402-2, statusword: x is any value. Written bit 6 ... bit 0 (bit 4, voltage enabled, is x in every row).
ROWS = {
    State.NOT_READY_TO_SWITCH_ON: "0xx0000",
    State.SWITCH_ON_DISABLED: "1xx0000",
    State.READY_TO_SWITCH_ON: "01x0001",
    State.SWITCHED_ON: "01x0011",
    State.OPERATION_ENABLED: "01x0111",
    State.QUICK_STOP_ACTIVE: "00x0111",
    State.FAULT_REACTION_ACTIVE: "0xx1111",
    State.FAULT: "0xx1000",
}


def words(pattern):
    choices = ["01" if bit == "x" else bit for bit in pattern]
    return [int("".join(bits), 2) for bits in itertools.product(*choices)]


@pytest.mark.parametrize("state", ROWS)
def test_every_pattern_of_the_standard(state):
    for low in words(ROWS[state]):
        for high in (0x0000, 0x0600, 0x1280, 0xFF80):
            assert state_of(low | high) is state


def test_every_other_pattern_is_no_state():
    known = {word for pattern in ROWS.values() for word in words(pattern)}
    for low in range(128):
        if low not in known:
            assert state_of(low) is State.UNKNOWN


def test_the_way_to_operation_enabled():
    assert NEXT_COMMAND_TO_ENABLE[State.SWITCH_ON_DISABLED] == 0x06
    assert NEXT_COMMAND_TO_ENABLE[State.READY_TO_SWITCH_ON] == 0x07
    assert NEXT_COMMAND_TO_ENABLE[State.SWITCHED_ON] == 0x0F
    assert NEXT_COMMAND_TO_ENABLE[State.OPERATION_ENABLED] == 0x0F
    assert NEXT_COMMAND_TO_ENABLE[State.FAULT] is None
    assert set(NEXT_COMMAND_TO_ENABLE) == set(State)
