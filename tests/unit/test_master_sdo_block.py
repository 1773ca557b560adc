"""SDO client's block transfers against responses written out by hand (CiA 301, 7.2.4.3.9 to 7.2.4.3.16)."""

from collections.abc import Generator

import pytest

from drivers.errors import NoAnswerError, SdoAbortedError
from drivers.frame import Frame
from drivers.master import Master
from drivers.sdo_client import (
    MAX_RESUMES,
    Request,
    SdoTimeoutError,
    SdoTransferError,
    Wait,
    download_block,
    upload_block,
)

SILENCE = None
NODE = 5


def hexadecimal(*texts: str) -> tuple[bytes, ...]:
    return tuple(bytes.fromhex(text) for text in texts)


def converse(exchange: Generator, responses: list[str | None]) -> tuple[list[tuple[bytes, ...]], object]:
    """Run a transfer against a list of responses; gives the payloads of each request, and the result."""
    requests: list[tuple[bytes, ...]] = []

    def note(request: bytes | Request) -> None:
        while not isinstance(request, bytes) and request.wait is Wait.NOTHING:
            requests.append(request.payloads)
            request = next(exchange)
        requests.append((request,) if isinstance(request, bytes) else request.payloads)

    try:
        note(next(exchange))
        for response in responses:
            note(exchange.throw(SdoTimeoutError()) if response is None else exchange.send(bytes.fromhex(response)))
    except StopIteration as end:
        return requests, end.value
    raise AssertionError("the transfer did not end with its last response")


def fails(exchange: Generator, responses: list[str | None]) -> tuple[int, bool]:
    with pytest.raises(SdoTransferError) as caught:
        converse(exchange, responses)
    return caught.value.code, caught.value.is_by_server


OPENED = "A4 00 30 01 7F 00 00 00"
CONFIRMED = "A1 00 00 00 00 00 00 00"
FIRST, LAST = "01 31 32 33 34 35 36 37", "82 38 39 00 00 00 00 00"
ANNOUNCED = "C6 00 30 01 09 00 00 00"
END = "D5 C3 31 00 00 00 00 00"


# -- download ----------------------------------------------------------------------------------------------------------


def test_download_of_nine_bytes():
    requests, _ = converse(download_block(0x3000, 1, b"123456789"), [OPENED, "A2 02 7F 00 00 00 00 00", CONFIRMED])
    assert requests == [hexadecimal("C6 00 30 01 09 00 00 00"), hexadecimal(FIRST, LAST), hexadecimal(END)]


def test_download_to_a_server_without_crc_sends_none():
    requests, _ = converse(
        download_block(0x3000, 1, b"123456789"), ["A0 00 30 01 7F 00 00 00", "A2 02 7F 00 00 00 00 00", CONFIRMED]
    )
    assert requests[-1] == hexadecimal("D5 00 00 00 00 00 00 00")


def test_download_keeps_to_the_servers_block_sizes_and_sends_again_what_was_lost():
    data = bytes(range(42))
    segments = [data[start : start + 7].hex() for start in range(0, 42, 7)]
    requests, _ = converse(
        download_block(0x3000, 1, data),
        [
            "A4 00 30 01 03 00 00 00",
            "A2 03 02 00 00 00 00 00",
            "A2 01 04 00 00 00 00 00",  # the second one was lost
            "A2 00 04 00 00 00 00 00",  # both were lost
            "A2 02 04 00 00 00 00 00",
            CONFIRMED,
        ],
    )
    assert requests[1:5] == [
        hexadecimal("01" + segments[0], "02" + segments[1], "03" + segments[2]),
        hexadecimal("01" + segments[3], "02" + segments[4]),
        hexadecimal("01" + segments[4], "82" + segments[5]),
        hexadecimal("01" + segments[4], "82" + segments[5]),
    ]
    assert requests[5][0][0] == 0xC1  # no byte of the last segment is unused


def test_download_of_nothing_is_one_segment_without_a_byte():
    requests, _ = converse(download_block(0x3000, 1, b""), [OPENED, "A2 01 7F 00 00 00 00 00", CONFIRMED])
    assert requests[1:] == [hexadecimal("81 00 00 00 00 00 00 00"), hexadecimal("DD 00 00 00 00 00 00 00")]


def test_download_falls_back_on_segments():
    requests, _ = converse(
        download_block(0x3000, 1, b"123456789"),
        [
            "80 00 30 01 01 00 04 05",
            "60 00 30 01 00 00 00 00",
            "20 00 00 00 00 00 00 00",
            "30 00 00 00 00 00 00 00",
        ],
    )
    assert [request[0][0] for request in requests] == [0xC6, 0x21, 0x00, 0x1B]


@pytest.mark.parametrize(
    ("responses", "code", "is_by_server"),
    [
        (["80 00 30 01 02 00 01 06"], 0x06010002, True),
        (["A4 00 30 01 00 00 00 00"], 0x05040002, False),
        (["A4 00 30 01 80 00 00 00"], 0x05040002, False),
        (["A4 00 30 02 7F 00 00 00"], 0x06040043, False),
        (["A6 00 30 01 7F 00 00 00"], 0x05040001, False),
        (["60 00 30 01 00 00 00 00"], 0x05040001, False),
        ([OPENED, "A2 03 7F 00 00 00 00 00"], 0x05040003, False),
        ([OPENED, "A2 02 00 00 00 00 00 00"], 0x05040002, False),
        ([OPENED, "A1 00 00 00 00 00 00 00"], 0x05040001, False),
        ([OPENED, "80 00 30 01 03 00 04 05"], 0x05040003, True),
        ([OPENED, "A2 02 7F 00 00 00 00 00", "80 00 30 01 04 00 04 05"], 0x05040004, True),
        ([OPENED, "A2 02 7F 00 00 00 00 00", "A2 02 7F 00 00 00 00 00"], 0x05040001, False),
        ([OPENED] + ["A2 00 7F 00 00 00 00 00"] * (MAX_RESUMES + 1), 0x05040000, False),
    ],
)
def test_download_that_goes_wrong(responses: list[str | None], code: int, is_by_server: bool):
    assert fails(download_block(0x3000, 1, b"123456789"), responses) == (code, is_by_server)


def test_download_does_not_outlive_a_silence():
    with pytest.raises(SdoTimeoutError):
        converse(download_block(0x3000, 1, b"123456789"), [OPENED, SILENCE])


# -- upload ------------------------------------------------------------------------------------------------------------


def test_upload_of_nine_bytes():
    requests, data = converse(upload_block(0x3000, 1), [ANNOUNCED, FIRST, LAST, END])
    assert data == b"123456789"
    assert requests == [
        hexadecimal("A4 00 30 01 7F 00 00 00"),
        hexadecimal("A3 00 00 00 00 00 00 00"),
        (),
        hexadecimal("A2 02 7F 00 00 00 00 00"),
        hexadecimal("A1 00 00 00 00 00 00 00"),
    ]


def test_upload_asks_again_from_the_gap():
    requests, data = converse(
        upload_block(0x3000, 1, block_size=3),
        [
            "C4 00 30 01 00 00 00 00",  # the size is not told
            "01 11 11 11 11 11 11 11",
            "03 33 33 33 33 33 33 33",
            "01 22 22 22 22 22 22 22",
            "01 22 22 22 22 22 22 22",  # twice
            "02 33 33 33 33 33 33 33",
            "83 44 00 00 00 00 00 00",
            "83 44 00 00 00 00 00 00",  # twice
            f"D9 {crc_of('11' * 7 + '22' * 7 + '33' * 7 + '44')} 00 00 00 00 00",
        ],
    )
    assert data == bytes.fromhex("11" * 7 + "22" * 7 + "33" * 7 + "44")
    assert [request for request in requests if request][:4] == [
        hexadecimal("A4 00 30 01 03 00 00 00"),
        hexadecimal("A3 00 00 00 00 00 00 00"),
        hexadecimal("A2 01 03 00 00 00 00 00"),
        hexadecimal("A2 03 03 00 00 00 00 00"),
    ]


def crc_of(text: str) -> str:
    """CRC-16-CCITT bit by bit, low byte first."""
    crc = 0
    for byte in bytes.fromhex(text):
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc.to_bytes(2, "little").hex()


def test_upload_asks_again_after_a_silence():
    requests, data = converse(upload_block(0x3000, 1), [ANNOUNCED, FIRST, SILENCE, "81 38 39 00 00 00 00 00", END])
    assert data == b"123456789"
    assert requests[3] == hexadecimal("A2 01 7F 00 00 00 00 00")


def test_upload_gives_up_after_too_many_silences():
    with pytest.raises(SdoTimeoutError):
        converse(upload_block(0x3000, 1), [ANNOUNCED] + [SILENCE] * (MAX_RESUMES + 1))


def test_upload_falls_back_on_segments():
    _, data = converse(
        upload_block(0x3000, 1),
        ["80 00 30 01 01 00 04 05", "41 00 30 01 09 00 00 00", "00 31 32 33 34 35 36 37", "1B 38 39 00 00 00 00 00"],
    )
    assert data == b"123456789"


def test_upload_takes_a_switch_of_protocol_only_when_it_has_offered_one():
    requests, data = converse(upload_block(0x1000, 0, protocol_switch_threshold=4), ["43 00 10 00 92 01 02 00"])
    assert requests == [hexadecimal("A4 00 10 00 7F 04 00 00")]
    assert data == bytes.fromhex("92 01 02 00")
    assert fails(upload_block(0x1000, 0), ["43 00 10 00 92 01 02 00"]) == (0x05040001, False)


@pytest.mark.parametrize(
    ("responses", "code", "is_by_server"),
    [
        (["80 00 30 01 11 00 09 06"], 0x06090011, True),
        (["C6 00 30 02 09 00 00 00"], 0x06040043, False),
        (["C7 00 30 01 09 00 00 00"], 0x05040001, False),
        (["C6 00 30 01 01 00 10 00"], 0x05040005, False),  # 1 MiB and a byte
        ([ANNOUNCED, "00 31 32 33 34 35 36 37"], 0x05040003, False),
        ([ANNOUNCED, "80 00 30 01 00 00 04 05"], 0x05040000, True),
        ([ANNOUNCED, FIRST, LAST, "D5 C4 31 00 00 00 00 00"], 0x05040004, False),
        ([ANNOUNCED, FIRST, LAST, "C2 C3 31 00 00 00 00 00"], 0x05040001, False),
        (["C6 00 30 01 0A 00 00 00", FIRST, LAST, END], 0x06070010, False),
    ],
)
def test_upload_that_goes_wrong(responses: list[str | None], code: int, is_by_server: bool):
    assert fails(upload_block(0x3000, 1), responses) == (code, is_by_server)


def test_upload_from_a_server_without_crc_checks_none():
    _, data = converse(upload_block(0x3000, 1), ["C2 00 30 01 09 00 00 00", FIRST, LAST, "D5 FF FF 00 00 00 00 00"])
    assert data == b"123456789"


# -- by the master -----------------------------------------------------------------------------------------------------


class Script:
    """A master's procedure, its frames, and the time."""

    def __init__(self) -> None:
        self.master = Master([NODE], 127, 0)

    def run(self, procedure: Generator, steps: list[str | int]) -> object:
        """Frames of the node in hexadecimal, and spans of silence in ms; gives the result, or raises what it raises."""
        next(procedure)
        for step in steps:
            if isinstance(step, int):
                self.master.wake(self.master.now_ns + step * 1_000_000)
            else:
                self.master.receive(Frame(0x580 + NODE, bytes.fromhex(step)), self.master.now_ns)
            try:
                next(procedure)
            except StopIteration as end:
                return end.value
        raise AssertionError("the procedure did not end")

    def sent(self) -> list[str]:
        frames, self.master.outbox = self.master.outbox, []
        assert all(frame.cob_id == 0x600 + NODE for frame in frames)
        return [frame.data.hex().upper() for frame in frames]


def test_master_sends_a_sub_block_at_once_and_confirms_an_upload():
    script = Script()
    script.run(
        script.master.download_block(NODE, 0x3000, 1, b"123456789"), [OPENED, "A2 02 7F 00 00 00 00 00", CONFIRMED]
    )
    assert script.sent() == ["C600300109000000", "0131323334353637", "8238390000000000", "D5C3310000000000"]
    assert script.run(script.master.upload_block(NODE, 0x3000, 1), [ANNOUNCED, FIRST, LAST, END]) == b"123456789"
    assert script.sent() == ["A40030017F000000", "A300000000000000", "A2027F0000000000", "A100000000000000"]


def test_master_helps_an_upload_on_after_half_of_its_time_out():
    script = Script()
    procedure = script.master.upload_block(NODE, 0x3000, 1, timeout_s=0.2)
    assert script.run(procedure, [ANNOUNCED, FIRST, 99, 1, "81 38 39 00 00 00 00 00", END]) == b"123456789"
    assert script.sent()[2:] == ["A2017F0000000000", "A2017F0000000000", "A100000000000000"]


def test_master_aborts_when_nothing_comes():
    script = Script()
    with pytest.raises(NoAnswerError, match="3000h:01"):
        script.run(script.master.download_block(NODE, 0x3000, 1, b"123456789", timeout_s=0.2), [OPENED, 199, 1])
    assert script.sent()[-1] == "8000300100000405"


def test_master_lets_an_unwanted_sub_block_pass_before_it_goes_on():
    script = Script()
    with pytest.raises(SdoAbortedError) as caught:
        script.run(
            script.master.upload_block(NODE, 0x3000, 1),
            [ANNOUNCED, "00 31 32 33 34 35 36 37", "02 31 32 33 34 35 36 37", 19, "03 31 32 33 34 35 36 37", 19, 1],
        )
    assert caught.value.code == 0x05040003
    assert script.sent()[-1] == "8000300103000405"
    assert script.run(script.master.upload(NODE, 0x1000, 0), ["43 00 10 00 92 01 02 00"]) == b"\x92\x01\x02\x00"
