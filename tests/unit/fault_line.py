"""Emulated drives with their faults on a virtual bus, and a tester that speaks to them in bytes."""

import struct
from collections.abc import Iterable

from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from sim_drive.assembly import free_machine
from sim_drive.device.drive import Drive
from sim_drive.injection.faults import Fault
from sim_drive.injection.injector import Injector
from sim_drive.settings import DriveSettings

MS = 1_000_000
SECOND = 1_000_000_000


class Tester:
    """Sends what it is told to, and keeps what it hears as (time in ns, text)."""

    def __init__(self) -> None:
        self.out: list[Frame] = []
        self.heard: list[tuple[int, str]] = []

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.heard.append((now_ns, str(frame)))

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        raise AssertionError("nobody asked for it")

    def take_frames(self) -> list[Frame]:
        frames, self.out = self.out, []
        return frames

    def take_events(self) -> list[Event]:
        return []


class Line:
    """Drives of ``free_machine``, and the tester, on a bus of 1 Mbit/s."""

    def __init__(
        self,
        faults: Iterable[Fault] = (),
        node_ids: tuple[int, ...] = (5,),
        settings: DriveSettings | None = None,
        seed: int = 0,
    ) -> None:
        self.machine = free_machine(node_ids, settings=settings)
        self.injector = Injector(self.machine, faults, seed)
        self.tester = Tester()
        self.bus = VirtualBus([self.tester, self.injector], 1_000_000)

    @property
    def now_ns(self) -> int:
        return self.bus.now_ns

    def drive(self, place: int = 0) -> Drive:
        drive = self.machine.drives[place]
        assert isinstance(drive, Drive)
        return drive

    def until(self, at_s: float) -> list[str]:
        """Let time pass up to an instant; gives what has been heard meanwhile."""
        self.tester.heard.clear()
        self.bus.run_until(round(at_s * SECOND))
        return self.heard()

    def run(self, span_s: float) -> list[str]:
        return self.until((self.now_ns + round(span_s * SECOND)) / SECOND)

    def heard(self) -> list[str]:
        return [text for _, text in self.tester.heard]

    def put(self, cob_id: int, data: str = "", span_s: float = 0.002) -> list[str]:
        """Send a frame; gives what was heard in the span after it."""
        self.tester.out.append(Frame(cob_id, bytes.fromhex(data)))
        return self.run(span_s)

    def sdo(self, request: str, node_id: int = 5) -> list[str]:
        """The SDO responses' data."""
        own = f"{0x580 + node_id:03X}#"
        return [text.removeprefix(own) for text in self.put(0x600 + node_id, request) if text.startswith(own)]

    def write(self, index: int, subindex: int, value: int, size: int, node_id: int = 5) -> int:
        """Expedited download; gives the abort code, 0 if there was none."""
        payload = (value & ((1 << 8 * size) - 1)).to_bytes(4, "little")
        request = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, subindex) + payload
        (answer,) = self.sdo(request.hex(), node_id)
        return 0 if answer.startswith("60") else int.from_bytes(bytes.fromhex(answer[8:]), "little")

    def read(self, index: int, subindex: int = 0, node_id: int = 5) -> int:
        """Expedited upload of an unsigned value."""
        (answer,) = self.sdo((b"\x40" + struct.pack("<HB", index, subindex) + bytes(4)).hex(), node_id)
        raw = bytes.fromhex(answer)
        assert raw[0] & 0xE3 == 0x43, answer
        return int.from_bytes(raw[4 : 8 - (raw[0] >> 2 & 3)], "little")

    def enable(self, node_id: int = 5) -> None:
        """Start the node, and bring it to operation enabled in csp."""
        self.put(0x000, f"01{node_id:02X}")
        assert self.write(0x6060, 0, 8, 1, node_id) == 0
        for controlword in (0x06, 0x07, 0x0F):
            assert self.write(0x6040, 0, controlword, 2, node_id) == 0
        assert self.read(0x6041, 0, node_id) & 0x6F == 0x27
