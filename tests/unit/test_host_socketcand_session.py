"""The socketcand text protocol, against what python-can's client writes and reads, and against nonsense."""

import can
import pytest
from can.interfaces.socketcand import socketcand as client
from hypothesis import given
from hypothesis import strategies as st

from sim_drive.socketcand_session import (
    MAX_COMMAND_BYTES,
    SessionState,
    SocketcandFrame,
    SocketcandSession,
    encode_frame,
)

Frames = st.builds(
    SocketcandFrame,
    identifier=st.integers(0, 0x7FF),
    data=st.binary(max_size=8),
    is_extended=st.just(False),
) | st.builds(
    SocketcandFrame,
    identifier=st.integers(0, 0x1FFFFFFF),
    data=st.binary(max_size=8),
    is_extended=st.just(True),
)


def raw_session() -> SocketcandSession:
    session = SocketcandSession("vcan0")
    session.receive_data(b"< open vcan0 >< rawmode >")
    session.take_output()
    return session


def test_the_greeting_step_by_step() -> None:
    session = SocketcandSession("vcan0")
    assert session.take_output() == b"< hi >"
    assert session.receive_data(b"< open vcan0 >") == []
    assert (session.take_output(), session.state) == (b"< ok >", SessionState.BUS_OPEN)
    assert session.receive_data(b"< rawmode >") == []
    assert (session.take_output(), session.state) == (b"< ok >", SessionState.RAW)
    assert session.receive_data(b"< send 201 2 f 0 >") == [SocketcandFrame(0x201, b"\x0f\x00")]
    assert session.take_output() == b""
    session.receive_data(b"< echo >")
    assert session.take_output() == b"< echo >"


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"< open can7 >", b"< error could not open bus >"),
        (b"< open >", b"< error could not open bus >"),
        (b"< rawmode >", b"< error no bus is open >"),
        (b"< send 1 0 >", b"< error no bus is open >"),
        (b"< statistics 100 >", b"< error unknown command >"),
        (b"<>", b"< error unknown command >"),
        (b"< \xff\xfe >", b"< error unknown command >"),
        (b"< " + b"a" * MAX_COMMAND_BYTES, b"< error command too long >"),
        (b"< " + b"a" * MAX_COMMAND_BYTES + b">", b"< error command too long >"),
    ],
)
def test_without_a_bus(command: bytes, answer: bytes) -> None:
    session = SocketcandSession("vcan0")
    session.take_output()
    assert session.receive_data(command) == []
    assert session.take_output() == answer
    assert session.state is SessionState.NO_BUS
    session.receive_data(b"< open vcan0 >")
    assert session.take_output() == b"< ok >"


@pytest.mark.parametrize(
    "arguments",
    [
        b"",
        b"201",
        b"201 2 f",  # too few bytes
        b"201 1 f 0",  # too many
        b"201 9 1 2 3 4 5 6 7 8 9",
        b"201 2 f 100",  # not a byte
        b"201 1 -1",
        b"201 1 0x1",
        b"201 1 1_0",
        b"0x1 0",
        b"800 0",  # 12 bits
        b"20000000 0",  # 30 bits
        b"123456789 0",
        "２０１ ０".encode(),  # digits, but not ASCII
    ],
)
def test_a_send_that_makes_no_frame(arguments: bytes) -> None:
    session = raw_session()
    assert session.receive_data(b"< send " + arguments + b" >") == []
    assert session.take_output() == b"< error could not parse send command >"


def test_what_is_said_twice_is_refused_and_changes_nothing() -> None:
    session = raw_session()
    session.receive_data(b"< open vcan0 >")
    assert session.take_output() == b"< error open comes too late >"
    session.receive_data(b"< rawmode >")
    assert session.take_output() == b"< error rawmode comes too late >"
    assert session.state is SessionState.RAW


def test_a_frame_as_it_is_told() -> None:
    frame = SocketcandFrame(0x181, bytes.fromhex("2706FFFFFFFF0000"))
    assert encode_frame(frame, 1_700_000_000_000_012_999) == b"< frame 181 1700000000.000012 2706FFFFFFFF0000 >"
    assert encode_frame(SocketcandFrame(0x80, b""), 5) == b"< frame 080 0.000000  >"
    assert encode_frame(SocketcandFrame(0x80, b"", True), 5) == b"< frame 00000080 0.000000  >"


@given(Frames)
def test_what_python_can_sends_is_what_arrives(frame: SocketcandFrame) -> None:
    message = can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=frame.is_extended)
    text = client.convert_can_message_to_ascii_message(message)
    assert raw_session().receive_data(text.encode("ascii")) == [frame]


@given(Frames, st.integers(0, 4_000_000_000_000_000))
def test_what_is_told_is_what_python_can_reads(frame: SocketcandFrame, time_us: int) -> None:
    message = client.convert_ascii_message_to_can_message(encode_frame(frame, time_us * 1000).decode("ascii"))
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == frame
    assert message.timestamp == pytest.approx(time_us * 1e-6, abs=1e-6)


@given(st.lists(st.binary(max_size=64) | st.sampled_from([b"<", b">", b"< send ", b"< open vcan0 >", b"< rawmode >"])))
def test_nonsense_raises_nothing_and_the_session_goes_on(chunks: list[bytes]) -> None:
    session = SocketcandSession("vcan0")
    for chunk in chunks:
        session.receive_data(chunk)
    session.take_output()
    session.receive_data(b">< echo >")
    assert session.take_output().endswith(b"< echo >")


@given(st.lists(Frames, max_size=10), st.data())
def test_frames_do_not_depend_on_how_the_stream_is_cut(frames: list[SocketcandFrame], data: st.DataObject) -> None:
    messages = (
        can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=frame.is_extended)
        for frame in frames
    )
    stream = b"".join(client.convert_can_message_to_ascii_message(message).encode("ascii") for message in messages)
    session = raw_session()
    got: list[SocketcandFrame] = []
    while stream:
        length = data.draw(st.integers(1, len(stream)))
        got += session.receive_data(stream[:length])
        stream = stream[length:]
    assert got == frames
