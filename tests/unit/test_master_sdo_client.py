"""SDO client against responses written out by hand (CiA 301, 7.2.4)."""

import pytest

from drivers.sdo_client import MAX_UPLOAD_BYTES, SdoTransferError, abort_payload, download, upload


def converse(exchange, responses):
    """Run a transfer against a list of responses; returns (requests, result)."""
    requests = [next(exchange)]
    for response in responses:
        try:
            requests.append(exchange.send(bytes.fromhex(response)))
        except StopIteration as end:
            return requests, end.value
    raise AssertionError("the transfer did not end with its last response")


def test_expedited_upload_of_a_statusword():
    requests, value = converse(upload(0x6041, 0), ["4B 41 60 00 37 06 00 00"])
    assert requests == [bytes.fromhex("40 41 60 00 00 00 00 00")]
    assert value == bytes.fromhex("37 06")


@pytest.mark.parametrize(("command", "length"), [("4F", 1), ("4B", 2), ("47", 3), ("43", 4), ("42", 4)])
def test_expedited_upload_takes_as_many_bytes_as_the_command_says(command, length):
    _, value = converse(upload(0x2000, 1), [f"{command} 00 20 01 AA BB CC DD"])
    assert value == bytes.fromhex("AABBCCDD")[:length]


def test_segmented_upload_of_ten_bytes():
    requests, value = converse(
        upload(0x1008, 0),
        ["41 08 10 00 0A 00 00 00", "00 53 69 6D 20 64 72 69", "19 76 65 21 00 00 00 00"],
    )
    assert requests == [
        bytes.fromhex("40 08 10 00 00 00 00 00"),
        bytes.fromhex("60 00 00 00 00 00 00 00"),
        bytes.fromhex("70 00 00 00 00 00 00 00"),
    ]
    assert value == b"Sim drive!"


def test_expedited_download_of_a_byte():
    requests, _ = converse(download(0x6060, 0, b"\x08"), ["60 60 60 00 00 00 00 00"])
    assert requests == [bytes.fromhex("2F 60 60 00 08 00 00 00")]


def test_segmented_download_of_nine_bytes():
    requests, _ = converse(
        download(0x3000, 1, b"ABCDEFGHI"),
        ["60 00 30 01 00 00 00 00", "20 00 00 00 00 00 00 00", "30 00 00 00 00 00 00 00"],
    )
    assert requests == [
        bytes.fromhex("21 00 30 01 09 00 00 00"),
        bytes.fromhex("00 41 42 43 44 45 46 47"),
        bytes.fromhex("1B 48 49 00 00 00 00 00"),
    ]


def test_download_of_nothing_is_one_empty_last_segment():
    requests, _ = converse(download(0x3000, 1, b""), ["60 00 30 01 00 00 00 00", "20 00 00 00 00 00 00 00"])
    assert requests[1] == bytes.fromhex("0F 00 00 00 00 00 00 00")


def fails(exchange, responses):
    with pytest.raises(SdoTransferError) as caught:
        converse(exchange, responses)
    return caught.value.code, caught.value.is_by_server


def test_an_abort_of_the_server_carries_its_code():
    assert fails(upload(0x6099, 1), ["80 99 60 01 00 00 02 06"]) == (0x06020000, True)


def test_a_toggle_bit_that_stays_is_an_error_of_ours_to_tell():
    responses = ["41 08 10 00 0E 00 00 00", "00 53 69 6D 20 64 72 69", "01 76 65 21 00 00 00 00"]
    assert fails(upload(0x1008, 0), responses) == (0x05030000, False)


def test_an_answer_about_another_object_is_refused():
    assert fails(upload(0x6041, 0), ["4B 64 60 00 37 06 00 00"]) == (0x06040043, False)


def test_an_answer_to_another_command_is_refused():
    assert fails(upload(0x6041, 0), ["60 41 60 00 00 00 00 00"]) == (0x05040001, False)


def test_a_length_that_is_not_the_announced_one_is_refused():
    responses = ["41 08 10 00 09 00 00 00", "00 53 69 6D 20 64 72 69", "19 76 65 21 00 00 00 00"]
    assert fails(upload(0x1008, 0), responses) == (0x06070010, False)


def test_an_announced_size_beyond_the_bound_is_refused():
    size = (MAX_UPLOAD_BYTES + 1).to_bytes(4, "little").hex()
    assert fails(upload(0x3000, 1), [f"41 00 30 01 {size}"]) == (0x05040005, False)


def test_abort_payload():
    assert abort_payload(0x6041, 0, 0x05040000) == bytes.fromhex("80 41 60 00 00 00 04 05")
