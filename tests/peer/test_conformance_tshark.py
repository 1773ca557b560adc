"""One session with every service and every mode of the emulated drive, before tshark's CANopen dissector."""

import binascii
from collections.abc import Callable
from pathlib import Path

import pytest
from conformance_bench import Bus

from sim_drive.assembly import FREE_AXIS_GAINS
from sim_drive.settings import DriveSettings
from sim_drive.switches import Switches

Dissect = Callable[..., list[list[str]]]
MODES = ["01", "03", "04", "06", "07", "08", "09", "0A", "FE"]


def transfers(bus: Bus) -> None:
    """SDO: expedited, segmented and block, both ways, with a lost segment, and aborts of both sides."""
    bus.done("2B17100064000000")
    assert bus.sdo("4008100000000000") == "4108100009000000"
    assert bus.sdo("6000000000000000")[:2] == "00"
    assert bus.sdo("7000000000000000")[:2] == "1B"
    data = bytes(range(200))
    crc = binascii.crc_hqx(data, 0)
    assert bus.sdo("C6003001C8000000")[:2] == "A4"
    for number in range(1, 29):
        if number != 20:  # lost
            assert bus.sdo(f"{number:02X}" + data[7 * number - 7 : 7 * number].hex()) == ""
    assert bus.sdo("9D" + data[196:].hex() + "000000") == "A2137F0000000000"
    for number in range(1, 10):
        assert bus.sdo(f"{number:02X}" + data[133 + 7 * number - 7 : 133 + 7 * number].hex()) == ""
    assert bus.sdo("8A" + data[196:].hex() + "000000") == "A20A7F0000000000"
    assert bus.sdo(f"CD{crc & 0xFF:02X}{crc >> 8:02X}0000000000") == "A100000000000000"
    assert bus.sdo("A400300114000000") == "C6003001C8000000"
    assert len(bus.send("605#A300000000000000")) == 20
    assert len(bus.send("605#A214140000000000")) == 9
    assert bus.sdo("A209140000000000") == f"CD{crc & 0xFF:02X}{crc >> 8:02X}0000000000"
    assert bus.sdo("A100000000000000") == ""
    assert bus.sdo("2100300120000000") == "6000300100000000"
    assert bus.sdo("8000300100000008") == ""
    assert bus.sdo("4000200000000000") == "8000200000000206"


def communication(bus: Bus) -> None:
    """NMT, SYNC with and without counter, TIME, EMCY, PDOs of all kinds, heartbeats, node guarding."""
    bus.send("100#785634120F30")
    bus.done("2B15100005000000", "2316100164007F00")
    bus.done("2300180185010080", "2F00180201000000", "2300180185010000")
    bus.done("23011801850200C0", "2F011802FF000000", "2B01180514000000", "2301180185020040")
    bus.send("000#0105")
    bus.run(100)
    bus.send("77F#05")
    for data in ("0600", "0700", "0600", "06", "060000", "0600"):
        bus.send("205#" + data)
        bus.send("080#")
        bus.run(10)
    bus.send("080#00")
    bus.run(200)  # the heartbeat of node 127 is lost
    bus.send("77F#05")
    bus.send("000#8005")
    bus.done("2316100100000000", "2F1910000A000000")
    bus.send("000#0105")
    for number in range(1, 11):
        bus.send(f"080#{number:02X}")
        bus.run(2)
    bus.send("000#0205")
    bus.run(150)
    bus.send("000#8005")
    bus.done("2B17100000000000", "2B0C1000C8000000", "2F0D100003000000")
    for _ in range(3):
        bus.send("705#R")
        bus.run(100)
    bus.send("000#8105")
    bus.run(10)


def lss(bus: Bus) -> None:
    """Selection, inquiry, configuration and fastscan."""
    for text in (
        "0401000000000000", "5A00000000000000", "5B00000000000000", "5C00000000000000", "5D00000000000000",
        "5E00000000000000", "1300060000000000", "11FF000000000000", "0400000000000000", "5100000000800000",
    ):  # fmt: skip
        bus.send("7E5#" + text)
    bus.send("000#8205")
    bus.run(10)
    assert bus.send("7E5#5100000000800000") == ["7E4#4F00000000000000"]
    for part in range(4):
        known = 0
        for bit in range(31, -1, -1):
            if not bus.send(f"7E5#51{known.to_bytes(4, 'little').hex()}{bit:02x}{part:02x}{part:02x}"):
                known |= 1 << bit
        bus.send(f"7E5#51{known.to_bytes(4, 'little').hex()}00{part:02x}{(part + 1) % 4:02x}")
    for text in ("1105000000000000", "1700000000000000", "0400000000000000"):
        bus.send("7E5#" + text)
    bus.run(10)
    for text in ("40D2040000000000", "4124100000000000", "4200000100000000", "4305000000000000", "0400000000000000"):
        bus.send("7E5#" + text)
    for text in (
        "46D2040000000000", "4724100000000000", "4800000000000000", "49FFFFFFFF000000", "4A00000000000000",
        "4BFFFFFFFF000000", "4C00000000000000",
    ):  # fmt: skip
        bus.send("7E5#" + text)


def motion(bus: Bus, mode: str) -> None:
    """A mode from Operation enabled to a quick stop, a fault and its reset, with PDOs at every SYNC."""
    bus.send("000#8005")
    bus.done("2300140105020080", "2F00160000000000", "2300160110004060", "2300160220007A60", "2F00160002000000")
    bus.done("2F00140201000000", "2300140105020000")
    bus.done("2303180185040080", "2303180185040000")
    bus.send("605#2F606000" + mode + "000000")
    bus.done("23FF6000E8030000", "2B7160000A000000", "2B5A600006000000")
    bus.run(3)
    bus.send("000#0105")
    for word in ("0600", "0700", "0F00", "1F00", "0F00"):
        for number in range(10):
            bus.send(f"205#{word}{number:02X}000000")
            bus.send("080#")
            bus.run(1)
    for word in ("0F01", "0F00", "0200", "0000"):
        bus.send(f"205#{word}0A000000")
        bus.send("080#")
        bus.run(1)
    bus.trip()
    bus.run(50)
    for word in ("0000", "8000"):
        bus.send(f"205#{word}0A000000")
        bus.send("080#")
        bus.run(1)


@pytest.fixture(scope="module")
def bus() -> Bus:
    switches = Switches(-9000, 9000, (1000.0, 1400.0), 500)
    bus = Bus(settings=DriveSettings(gains=FREE_AXIS_GAINS, switches=switches), is_booted=False)
    bus.run(5)
    transfers(bus)
    communication(bus)
    for mode in MODES:
        motion(bus, mode)
    bus.send("000#8105")
    bus.run(5)
    lss(bus)
    return bus


@pytest.fixture(scope="module")
def log(bus: Bus, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tshark") / "everything.log"
    lines = [f"({1_700_000_000 + at_ns / 1e9:.6f}) vcan0 {text}\n" for at_ns, text in bus.trace]
    path.write_text("".join(lines), encoding="ascii")
    return path


def test_every_frame_of_every_service_is_sound(bus: Bus, log: Path, dissect: Dissect) -> None:
    rows = dissect(log, "can.id", "frame.protocols", "_ws.col.Info", "_ws.expert.message", "_ws.malformed")
    assert [int(row[0], 0) for row in rows] == [int(text[:3], 16) for _, text in bus.trace]
    assert len(rows) > 1500
    assert {row[4] for row in rows} == {""}
    assert [row for row in rows if "malformed" in row[1]] == []
    assert {row[3] for row in rows} == {""}
    # A SYNC and a remote frame have nothing that the dissector could show beneath the frame.
    bare = [row for row in rows if not row[1].endswith(":can:canopen")]
    assert {int(row[0], 0) for row in bare} <= {0x080, 0x705, 0x205}


def test_the_dissector_sees_what_was_meant(log: Path, dissect: Dissect) -> None:
    said = {row[0] for row in dissect(log, "_ws.col.Info")}
    sentences = {
        "NMT: Start remote node",
        "NMT: Stop remote node",
        "NMT: Enter pre-operational state",
        "NMT: Reset node",
        "NMT: Reset communication",
        "NMT Error Control: Boot-up",
        "NMT Error Control: Pre-operational",
        "NMT Error Control: Operational",
        "NMT Error Control: Stopped",
        "SYNC",
        "TIME STAMP",
        "EMCY",
        "PDO1 (tx)",
        "PDO1 (rx)",
        "PDO2 (tx)",
        "PDO4 (tx)",
        "Default-SDO (rx): Initiate upload request",
        "Default-SDO (rx): Initiate download request",
        "Default-SDO (rx): Download segment request",
        "Default-SDO (rx): Upload segment request",
        "Default-SDO (rx): Block download",
        "Default-SDO (rx): Block upload",
        "Default-SDO (rx): Abort transfer",
        "Default-SDO (tx): Initiate upload response",
        "Default-SDO (tx): Initiate download response",
        "Default-SDO (tx): Upload segment response",
        "Default-SDO (tx): Block download",
        "Default-SDO (tx): Block upload",
        "Default-SDO (tx): Abort transfer",
        "LSS (Slave): Switch state selective protocol",
        "LSS (Slave): Identify slave protocol",
        "LSS (Slave): Configure node-ID protocol",
        "LSS (Slave): Configure bit timing protocol",
        "LSS (Slave): Store configuration protocol",
        "LSS (Slave): Inquire node-ID protocol",
        "LSS (Master): LSS Fastscan protocol",
        "LSS (Master): Identify non-configured remote slave protocol",
    }
    assert [sentence for sentence in sentences if not any(row.startswith(sentence) for row in said)] == []
