"""A drive on the bench: frames in as hexadecimal, frames out as text, and a clock that the test turns."""

import functools
import struct
from pathlib import Path

from drivers.eds import load_eds
from drivers.frame import Frame
from drivers.object_dictionary import ObjectDictionary
from mechanism.errors import CamFileError
from sim_drive.device.cam_slots import CamDecoder, CamTable
from sim_drive.device.drive import Drive, DriveSettings

EDS = Path(__file__).parents[2] / "config" / "eds" / "sim_drive.eds"
TICK_NS = 1_000_000
MS = 1_000_000


@functools.cache
def described(node_id: int) -> ObjectDictionary:
    return load_eds(EDS, node_id)


class RefusedImageError(CamFileError):
    """What the bench's decoder raises."""

    def __init__(self, reason: int) -> None:
        super().__init__("image", "refused by the bench")
        self.reason = reason


class Gear:
    """A cam that is a straight line: ``start`` plus ``ratio`` times the master."""

    points = 7

    def __init__(self, start: int, ratio: float) -> None:
        self.start = start
        self.ratio = ratio

    def slave_position(self, master_counts: int) -> float:
        return self.start + self.ratio * master_counts


def decode_bench_image(image: bytes) -> CamTable:
    """``b"OK"``, INTEGER64 start and REAL64 ratio make a Gear; anything else is refused with its first byte."""
    if image[:2] != b"OK":
        raise RefusedImageError(image[0])
    return Gear(*struct.unpack_from("<qd", image, 2))


class Bench:
    """Node 5 by default, booted and ticked once, with nothing in its outbox."""

    def __init__(
        self,
        settings: DriveSettings | None = None,
        node_id: int = 5,
        boot: bool = True,
        decode: CamDecoder = decode_bench_image,
    ) -> None:
        self.node_id = node_id
        self.drive = Drive(node_id, described(node_id), settings or DriveSettings(), decode)
        self.now_ns = 0
        self.shaft = 0
        self.aside: list[str] = []
        """What the drive sent besides SDO responses while SDO requests were put to it."""
        self.follows = False
        """The shaft is where the demand is, as that of an ideal servo."""
        if boot:
            self.drive.wake(0)
            self.tick()
            self.drive.take_frames()
            self.drive.take_events()

    # -- time ----------------------------------------------------------------------------------------------------

    def run(self, span_ns: int) -> list[str]:
        """Let time pass with servo ticks every millisecond and the drive's own wakes; gives what it sent."""
        end_ns = self.now_ns + span_ns
        while self.now_ns < end_ns:
            self.now_ns += TICK_NS
            self.drive.on_servo_tick(self.now_ns, self.shaft)
            if self.follows and self.drive.is_powered:
                self.shaft = round(self.drive.position_demand_counts)
            self.wake()
        return self.sent()

    def tick(self) -> list[str]:
        return self.run(TICK_NS)

    def wake(self) -> None:
        due_ns = self.drive.next_wake_ns()
        if due_ns is not None and due_ns <= self.now_ns:
            self.drive.wake(self.now_ns)

    # -- frames --------------------------------------------------------------------------------------------------

    def sent(self) -> list[str]:
        return [str(frame) for frame in self.drive.take_frames()]

    def put(self, cob_id: int, data: str = "") -> list[str]:
        self.drive.receive(Frame(cob_id, bytes.fromhex(data)), self.now_ns)
        return self.sent()

    def sdo(self, request: str) -> str:
        """Send an SDO request; gives the only response's data, "" if there was none."""
        own = f"{0x580 + self.node_id:03X}#"
        frames = self.put(0x600 + self.node_id, request)
        answers = [frame.removeprefix(own) for frame in frames if frame.startswith(own)]
        self.aside += [frame for frame in frames if not frame.startswith(own)]
        assert len(answers) <= 1, answers
        return answers[0] if answers else ""

    def write(self, index: int, subindex: int, value: int, size: int) -> int:
        """Expedited download; gives the abort code, 0 if there was none."""
        payload = (value & ((1 << 8 * size) - 1)).to_bytes(4, "little")
        request = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, subindex) + payload
        return self._outcome(self.sdo(request.hex()))[1]

    def must(self, index: int, subindex: int, value: int, size: int) -> None:
        assert self.write(index, subindex, value, size) == 0, f"{index:04X}h:{subindex:02X}"

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Expedited upload of an integer."""
        answer = bytes.fromhex(self.sdo((b"\x40" + struct.pack("<HBI", index, subindex, 0)).hex()))
        assert answer[0] & 0xE3 == 0x43, answer.hex()
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=signed)

    def read_abort(self, index: int, subindex: int = 0) -> int:
        return self._outcome(self.sdo((b"\x40" + struct.pack("<HBI", index, subindex, 0)).hex()))[1]

    @staticmethod
    def _outcome(answer: str) -> tuple[int, int]:
        data = bytes.fromhex(answer)
        return data[0], int.from_bytes(data[4:8], "little") if data[0] == 0x80 else 0

    def download(self, index: int, subindex: int, data: bytes) -> int:
        """Segmented download; gives the abort code, 0 if there was none."""
        opening = b"\x21" + struct.pack("<HBI", index, subindex, len(data))
        command, code = self._outcome(self.sdo(opening.hex()))
        toggle = 0
        for start in range(0, max(len(data), 1), 7):
            if command == 0x80:
                return code
            part = data[start : start + 7]
            first = toggle | (7 - len(part)) << 1 | (start + 7 >= len(data))
            command, code = self._outcome(self.sdo((bytes((first,)) + part.ljust(7, b"\0")).hex()))
            toggle ^= 0x10
        return code

    def nmt(self, command: int, node_id: int | None = None) -> list[str]:
        return self.put(0x000, bytes((command, self.node_id if node_id is None else node_id)).hex())

    # -- CiA 402 -------------------------------------------------------------------------------------------------

    @property
    def statusword(self) -> int:
        return self.read(0x6041)

    def control(self, word: int) -> None:
        self.must(0x6040, 0, word, 2)

    def enable(self, mode: int = 8) -> None:
        self.must(0x6060, 0, mode, 1)
        self.tick()
        for word in (0x06, 0x07, 0x0F):
            self.control(word)
        assert self.statusword & 0x6F == 0x27

    def map_rpdo(self, number: int, cob_id: int, kind: int, words: list[int]) -> None:
        self._map(0x1400 + number - 1, 0x1600 + number - 1, cob_id, kind, words)

    def map_tpdo(self, number: int, cob_id: int, kind: int, words: list[int]) -> None:
        self._map(0x1800 + number - 1, 0x1A00 + number - 1, cob_id, kind, words)

    def _map(self, communication: int, mapping: int, cob_id: int, kind: int, words: list[int]) -> None:
        self.must(communication, 1, 0x80000000 | cob_id, 4)
        self.must(mapping, 0, 0, 1)
        for number, word in enumerate(words, start=1):
            self.must(mapping, number, word, 4)
        self.must(mapping, 0, len(words), 1)
        self.must(communication, 2, kind, 1)
        self.must(communication, 1, cob_id, 4)

    def map_cyclic(self) -> None:
        """The reference mapping of 8 bytes each way, in step with the SYNC, and NMT operational."""
        self.map_rpdo(1, 0x200 + self.node_id, 1, [0x60400010, 0x607A0020, 0x60B20010])
        self.map_tpdo(1, 0x180 + self.node_id, 1, [0x60410010, 0x60640020, 0x60770010])
        self.nmt(0x01)

    def set_point(self, controlword: int, target: int, torque: int = 0) -> None:
        assert self.put(0x200 + self.node_id, struct.pack("<Hih", controlword, target, torque).hex()) == []

    def sync(self) -> list[str]:
        return self.put(0x080)

    def cycle(self, target: int, controlword: int = 0x0F) -> list[str]:
        """Set-point, SYNC, and a millisecond with its servo tick at the end; gives what the SYNC sent."""
        self.set_point(controlword, target)
        answers = self.sync()
        answers += self.tick()
        return answers
