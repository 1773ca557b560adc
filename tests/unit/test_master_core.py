"""The master's core: NMT, heartbeats, EMCY and procedures, in simulation time."""

import pytest

from drivers.errors import NoAnswerError, SdoAbortedError
from drivers.frame import Frame
from drivers.master import BootUpReceived, EmergencyReceived, HeartbeatLost, Master, NodeStateChanged
from drivers.nmt import NmtCommand, NmtState
from drivers.object_dictionary import DataType

MS = 1_000_000


def make_master(period_ns=50 * MS):
    return Master([1, 2], 127, period_ns)


def finish(procedure):
    with pytest.raises(StopIteration) as end:
        next(procedure)
    return end.value.value


def test_nmt_commands_as_bytes():
    master = make_master()
    master.command(NmtCommand.START, 2)
    master.command(NmtCommand.RESET_COMMUNICATION, 0)
    assert master.outbox == [Frame(0x000, b"\x01\x02"), Frame(0x000, b"\x82\x00")]


def test_its_own_heartbeat_keeps_its_grid_and_is_not_made_up_for():
    master = make_master()
    master.wake(0)
    assert master.outbox == [Frame(0x77F, b"\x05")]
    assert master.next_wake_ns() == 50 * MS
    master.wake(51 * MS)
    assert master.next_wake_ns() == 100 * MS
    master.wake(1000 * MS)
    assert len(master.outbox) == 3
    assert master.next_wake_ns() == 1050 * MS


def test_boot_up_and_state_changes_are_events_once():
    master = make_master()
    master.receive(Frame(0x701, b"\x00"), 5)
    master.receive(Frame(0x701, b"\x7f"), 6)
    master.receive(Frame(0x701, b"\x05"), 7)
    master.receive(Frame(0x701, b"\x05"), 8)
    assert master.events == [BootUpReceived(5, 1), NodeStateChanged(7, 1, NmtState.OPERATIONAL)]


def test_a_boot_up_message_without_its_byte_is_one():
    master = make_master()
    master.receive(Frame(0x701), 5)
    assert master.events == [BootUpReceived(5, 1)]


@pytest.mark.parametrize("data", ["0500", "63"])
def test_a_heartbeat_that_is_none_is_passed_over(data):
    master = make_master()
    master.receive(Frame(0x701, bytes.fromhex(data)), 5)
    assert master.events == []
    assert master.nodes[1].state is None


def test_heartbeat_loss_is_told_once_and_ends_with_the_next_heartbeat():
    master = make_master(0)
    master.now_ns = 10 * MS
    master.watch_heartbeat(1, 0.2)
    master.receive(Frame(0x701, b"\x05"), 100 * MS)
    master.events.clear()
    assert master.next_wake_ns() == 300 * MS
    master.wake(299 * MS)
    assert master.events == []
    master.wake(300 * MS)
    master.wake(301 * MS)
    assert master.events == [HeartbeatLost(300 * MS, 1, 0.2)]
    assert master.next_wake_ns() is None
    master.receive(Frame(0x701, b"\x05"), 400 * MS)
    assert master.next_wake_ns() == 600 * MS


def test_emergency_is_decoded():
    master = make_master()
    master.receive(Frame(0x082, bytes.fromhex("11 86 21 01 02 03 04 05")), 9)
    assert master.events == [EmergencyReceived(9, 2, 0x8611, 0x21, bytes.fromhex("0102030405"))]


def test_sync_is_not_taken_for_an_emergency():
    master = make_master()
    master.receive(Frame(0x080, b""), 9)
    assert master.events == []


def test_frames_of_strangers_pass_by():
    master = make_master()
    master.receive(Frame(0x703, b"\x00"), 1)
    master.receive(Frame(0x583, bytes(8)), 1)
    master.receive(Frame(0x701, b"", is_remote=True), 1)
    assert master.events == []


def test_read_over_sdo():
    master = make_master()
    reading = master.read_int(1, 0x6064, 0, DataType.INTEGER32)
    assert next(reading) == 500 * MS
    assert master.outbox == [Frame(0x601, bytes.fromhex("40 64 60 00 00 00 00 00"))]
    master.receive(Frame(0x581, bytes.fromhex("43 64 60 00 FE FF FF FF")), 3 * MS)
    assert finish(reading) == -2


def test_no_answer_is_aborted_and_says_what_was_waited_for():
    master = make_master()
    reading = master.read_int(1, 0x6064, 0, DataType.INTEGER32)
    next(reading)
    master.now_ns = 500 * MS
    with pytest.raises(NoAnswerError, match=r"node 1: no answer within 0\.5 s while waiting for SDO 6064h:00"):
        next(reading)
    assert master.outbox[-1] == Frame(0x601, bytes.fromhex("80 64 60 00 00 00 04 05"))


def test_an_answer_of_another_node_does_not_count():
    master = make_master()
    reading = master.read_int(1, 0x6064, 0, DataType.INTEGER32)
    next(reading)
    master.receive(Frame(0x582, bytes.fromhex("43 64 60 00 FE FF FF FF")), 3 * MS)
    assert next(reading) == 500 * MS


def test_an_abort_names_node_object_code_and_text():
    master = make_master()
    writing = master.write(2, 0x6060, 0, DataType.INTEGER8, 77)
    next(writing)
    master.receive(Frame(0x582, bytes.fromhex("80 60 60 00 30 00 09 06")), 1)
    with pytest.raises(SdoAbortedError, match=r"node 2: SDO 6060h:00 aborted with 06090030h \(value range exceeded\)"):
        next(writing)


def test_a_value_of_the_wrong_length_is_refused():
    master = make_master()
    reading = master.read_int(1, 0x6064, 0, DataType.INTEGER32)
    next(reading)
    master.receive(Frame(0x581, bytes.fromhex("4B 64 60 00 FE FF 00 00")), 1)
    with pytest.raises(SdoAbortedError, match="2 bytes are no INTEGER32"):
        next(reading)


def test_reset_communication_waits_for_the_boot_up():
    master = make_master()
    resetting = master.reset_communication(1, 2.0)
    assert next(resetting) == 2000 * MS
    assert master.outbox == [Frame(0x000, b"\x82\x01")]
    master.receive(Frame(0x701, b"\x7f"), 1 * MS)
    assert next(resetting) == 2000 * MS
    master.receive(Frame(0x701, b"\x00"), 2 * MS)
    finish(resetting)
