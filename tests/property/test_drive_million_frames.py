"""Twenty thousand frames, or a million, at the emulated drives in virtual time: nothing breaks, nothing falls silent.

The frames are those of a recorded run of the gateway, such frames with bits, lengths and identifiers changed, services
of all kinds with random contents, and noise. What is seen is held against the standard alone: the masks of the
statusword, the transitions of the state machine, and that nothing but an enabled axis has torque.
"""

import random
from collections import deque

import pytest

from config.loading import load_config
from drivers.eds import load_eds
from drivers.frame import Frame
from drivers.nmt import NmtState
from gateway.record.recording import read_recording
from gateway.running.preparation import prepare
from gateway.running.virtual_run import run_virtual
from sim_drive.assembly import SHIPPED_EDS, build_machine, free_machine
from sim_drive.device.cia402 import PowerStateChanged

NODES = (1, 2)
ROUND = 500
"""Frames after which the drives are looked after, so that none stays stopped or without a node id for long."""

MASKS = {
    "not ready": (0x4F, 0x00),
    "disabled": (0x4F, 0x40),
    "ready": (0x6F, 0x21),
    "on": (0x6F, 0x23),
    "enabled": (0x6F, 0x27),
    "quick stop": (0x6F, 0x07),
    "reaction": (0x4F, 0x0F),
    "fault": (0x4F, 0x08),
}
MAY_HAVE_TORQUE = {"enabled", "quick stop", "reaction"}

# Transitions 1 to 12 and 14 to 16 of the standard; 13 leads from every state to the fault reaction, and a reset of the
# node, through 0, to the first.
ALLOWED = {
    ("not ready", "disabled"), ("disabled", "ready"), ("ready", "on"), ("on", "enabled"), ("enabled", "on"),
    ("on", "ready"), ("ready", "disabled"), ("enabled", "ready"), ("enabled", "disabled"), ("on", "disabled"),
    ("enabled", "quick stop"), ("quick stop", "disabled"), ("reaction", "fault"), ("fault", "disabled"),
    ("quick stop", "enabled"),
}  # fmt: skip
NAMES = dict(enumerate(MASKS))
"""The drive's own numbers of the states in its events are in the order of the standard's table."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    """The frames of a run of the gateway with both drives, from commissioning to the end."""
    path = tmp_path_factory.mktemp("fuzz") / "run.mcap"
    config = load_config("paper")
    core = run_virtual(prepare(config, 1), build_machine(config, 0), path, "{}", 0)
    assert core.failure is None
    frames = read_recording(path).frames()
    return [
        Frame(int(row["cob_id"]), bytes(row["data"][: row["length"]]), bool(row["is_remote"])) for row in frames[:4000]
    ]


SCRIPTS = [
    # Requests that belong together: block download and upload, segmented download and upload, a cam slot's commands.
    ("C600300109000000", "0131323334353637", "8238390000000000", "D5C3310000000000"),
    ("A40030017F000000", "A300000000000000", "A2027F0000000000", "A100000000000000"),
    ("A400300101000000", "A300000000000000", "A201010000000000", "A201010000000000", "A100000000000000"),
    ("2100300109000000", "0031323334353637", "1B38390000000000", "2F00300201000000"),
    ("4000300100000000", "6000000000000000", "7000000000000000"),
    ("4008100000000000", "6000000000000000", "7000000000000000"),
    # Profile position, homing, profile velocity, halt and on again, quick stop and on again.
    ("2F60600001000000", "237A6000E8030000", "2B4060000F000000", "2B4060001F000000", "2B4060000F000000"),
    ("2F60600006000000", "2B4060000F000000", "2B4060001F000000"),
    ("2F60600003000000", "23FF600010270000", "2B4060000F010000", "2B4060000F000000"),
    ("2B5A600006000000", "2B40600002000000", "2B4060000F000000"),
    ("2F60600007000000", "23C1600164000000", "23C16001C8000000", "2B4060001F000000", "23C160012C010000"),
    # Heartbeats, and an event-driven TPDO with inhibit and event timers.
    ("2316100132007F00", "2B17100032000000"),
    ("2300180181010080", "2F001802FF000000", "2B00180332000000", "2B0018050A000000", "2300180181010000"),
]
"""Each with the requests of a service in their order, which chance alone would hardly find."""


class Source:
    """Frames without end."""

    def __init__(self, seed: int, recorded: list[Frame]) -> None:
        self.random = random.Random(seed)
        self.recorded = recorded
        self.place = 0
        self.queue: deque[Frame] = deque()
        self.is_calm = False
        """Mostly what a master and its drives say to one another at every SYNC, so that its state lasts."""
        first_sync = next(place for place, frame in enumerate(recorded) if frame.cob_id == 0x080)
        self.commissioning = [
            frame for frame in recorded[: first_sync + 40] if frame.cob_id == 0 or 0x580 < frame.cob_id <= 0x67F
        ]
        objects = [variable for variable in load_eds(SHIPPED_EDS, 1) if variable.index >= 0x1000]
        self.places = [(variable.index, variable.subindex) for variable in objects]
        self.writable = [
            (variable.index, variable.subindex, variable.size)
            for variable in objects
            if variable.access.is_writable and variable.size and variable.size <= 4
        ]
        self.kinds = (
            [self.play] * 20
            + [self.script] * 10
            + [self.mutant] * 16
            + [self.write] * 16
            + [self.read] * 8
            + [self.sdo] * 10
            + [self.block] * 8
            + [self.controlword] * 14
            + [self.mode] * 4
            + [self.pdo] * 14
            + [self.sync] * 14
            + [self.nmt] * 5
            + [self.lss] * 4
            + [self.error_control] * 4
            + [self.time] * 2
            + [self.noise] * 8
        )

    def __next__(self) -> Frame:
        if self.is_calm and self.random.random() < 0.95:
            return self.random.choice([self.play, self.play, self.play, self.sync, self.pdo])()
        if self.queue and self.random.random() < 0.8:
            return self.queue.popleft()
        return self.random.choice(self.kinds)()

    def script(self) -> Frame:
        """Begin with requests that belong together; others come in between."""
        cob_id = 0x600 + self.node()
        requests = [Frame(cob_id, bytes.fromhex(text)) for text in self.random.choice(SCRIPTS)]
        self.queue.extend(requests[1:])
        return requests[0]

    def node(self) -> int:
        return self.random.choice(NODES)

    def data(self, length: int = 8) -> bytes:
        return self.random.randbytes(length)

    def number(self, size: int) -> bytes:
        pick = self.random.random()
        if pick < 0.4:
            return self.random.randrange(min(1 << 8 * size, 50)).to_bytes(size, "little")
        if pick < 0.6:
            edge = self.random.choice(
                [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 2**32 - 1]
            )
            return (edge & ((1 << 8 * size) - 1)).to_bytes(size, "little")
        return self.data(size)

    def play(self) -> Frame:
        """The recording, piece by piece in its own order."""
        if self.random.random() < 0.01:
            self.place = self.random.randrange(len(self.recorded))
        self.place = (self.place + 1) % len(self.recorded)
        return self.recorded[self.place]

    def mutant(self) -> Frame:
        """A frame of the recording or of any other kind, with one to three changes."""
        frame = self.random.choice((self.play, self.write, self.read, self.sdo, self.block, self.lss, self.time))()
        cob_id, data, is_remote = frame.cob_id, bytearray(frame.data), frame.is_remote
        for _ in range(self.random.randrange(1, 4)):
            change = self.random.randrange(5)
            if change <= 1 and data:
                data[self.random.randrange(len(data))] ^= 1 << self.random.randrange(8)
            elif change == 2:
                data = data[: self.random.randrange(9)]
            elif change == 3:
                data = (data + self.data())[: self.random.randrange(9)]
            elif change == 4:
                cob_id = (cob_id ^ 1 << self.random.randrange(11)) & 0x7FF
        if self.random.random() < 0.02:
            return Frame(cob_id, b"", True)
        return Frame(cob_id, bytes(data), is_remote and not data)

    def request(self, command: int, index: int, subindex: int, payload: bytes) -> Frame:
        multiplexer = bytes((command, index & 0xFF, index >> 8, subindex))
        return Frame(0x600 + self.node(), multiplexer + payload)

    def write(self) -> Frame:
        index, subindex, size = self.random.choice(self.writable)
        command = 0x23 | (4 - size) << 2
        payload = self.number(size).ljust(4, b"\0")
        return Frame(
            0x600 + self.node(), bytes((command,)) + index.to_bytes(2, "little") + bytes((subindex,)) + payload
        )

    def read(self) -> Frame:
        index, subindex = self.random.choice(self.places)
        command = self.random.choice([0x40, 0x40, 0xA0, 0xA4])
        payload = bytes((self.random.choice([1, 4, 127, self.random.randrange(256)]), self.random.randrange(8), 0, 0))
        return Frame(
            0x600 + self.node(), bytes((command,)) + index.to_bytes(2, "little") + bytes((subindex,)) + payload
        )

    def sdo(self) -> Frame:
        """Segments, initiates and aborts with anything in them."""
        command = self.random.choice(
            [0x00, 0x10, 0x01, 0x11, 0x60, 0x70, 0x20, 0x21, 0x22, 0x80, 0xA1, 0xA2, 0xA3, 0xC1]
        )
        if self.random.random() < 0.2:
            command = self.random.randrange(256)
        index, subindex = self.random.choice(self.places)
        rest = index.to_bytes(2, "little") + bytes((subindex,)) + self.number(4)
        return Frame(0x600 + self.node(), bytes((command,)) + (rest if self.random.random() < 0.5 else self.data(7)))

    def block(self) -> Frame:
        """Block transfers that often find one another: the cam slots, short sequence numbers, ends."""
        pick = self.random.randrange(6)
        place = self.random.choice([b"\x00\x30\x01", b"\x01\x30\x01", b"\x7a\x60\x00"])
        if pick == 0:
            data = b"\xc2" + place + bytes((self.random.randrange(40), 0, 0, 0))
        elif pick == 1:
            data = b"\xa0" + place + bytes((self.random.randrange(1, 128), 0, 0, 0))
        elif pick == 2:
            data = b"\xa3" + bytes(7)
        elif pick == 3:
            data = bytes((0xA2, self.random.randrange(8), self.random.randrange(1, 128), 0, 0, 0, 0, 0))
        else:
            data = bytes((self.random.randrange(1, 5) | self.random.choice([0, 0x80]),)) + self.data(7)
        return Frame(0x600 + self.node(), data)

    def controlword(self) -> Frame:
        word = self.random.choice([0x06, 0x06, 0x07, 0x0F, 0x0F, 0x1F, 0x3F, 0x5F, 0x02, 0x00, 0x80, 0x8F, 0x10F])
        return Frame(0x600 + self.node(), b"\x2b\x40\x60\x00" + word.to_bytes(4, "little"))

    def mode(self) -> Frame:
        mode = self.random.choice([1, 3, 4, 6, 7, 8, 9, 10, 0xFE, 0, self.random.randrange(256)])
        return Frame(0x600 + self.node(), b"\x2f\x60\x60\x00" + bytes((mode, 0, 0, 0)))

    def pdo(self) -> Frame:
        word = self.random.choice([0x06, 0x0F, 0x0F, 0x0F, 0x1F, self.random.randrange(65536)])
        data = word.to_bytes(2, "little") + self.number(4) + self.number(2)
        length = self.random.choice([2, 6, 8, 8, 8, self.random.randrange(9)])
        return Frame(self.random.choice([0x200, 0x300, 0x400, 0x500]) + self.node(), data[:length])

    def sync(self) -> Frame:
        if self.random.random() < 0.1:
            return Frame(0x080, self.data(self.random.choice([1, 1, 1, 2, 8])))
        return Frame(0x080, b"")

    def nmt(self) -> Frame:
        command = self.random.choice([0x01] * 8 + [0x02, 0x80, 0x80, 0x81, 0x82, self.random.randrange(256)])
        return Frame(0x000, bytes((command, self.random.choice([0, 1, 1, 2, 2, self.random.randrange(256)]))))

    def lss(self) -> Frame:
        specifier = self.random.choice(bytes.fromhex("04041113151740414243464748494A4B4C515A5E"))
        if self.random.random() < 0.05:
            specifier = self.random.randrange(256)
        rest = self.random.choice(
            [b"\x01", b"\x00", b"\xff", b"\xd2\x04", b"\x24\x10", b"\0\0\1", b"\0\0\0\0\x80", self.data(7)]
        )
        return Frame(0x7E5, bytes((specifier,)) + rest.ljust(7, b"\0"))

    def error_control(self) -> Frame:
        node = self.random.choice([1, 2, 127, 126, self.random.randrange(128)])
        if self.random.random() < 0.3:
            return Frame(0x700 + node, b"", True)
        return Frame(0x700 + node, self.random.choice([b"\x05", b"\x7f", b"\x00", b"\x04", self.data(2)]))

    def time(self) -> Frame:
        return Frame(0x100, self.data(self.random.choice([6, 6, 6, 8, 0])))

    def noise(self) -> Frame:
        return Frame(self.random.randrange(0x800), self.data(self.random.randrange(9)))


class Watch:
    """Feeds the machine, and holds what it does against the standard."""

    def __init__(self, seed: int, recorded: list[Frame]) -> None:
        self.machine = free_machine(NODES, record_ticks=1)
        self.source = Source(seed, recorded)
        self.random = random.Random(seed + 1)
        self.now_ns = 0
        self.sent = 0
        self.seen: set[str] = set()
        self.transitions: set[tuple[str, str]] = set()
        self.last: deque[tuple[int, str]] = deque(maxlen=40)
        self.statuswords = [drive.dictionary.entry(0x6041) for drive in self.machine.drives]
        self.states = ["not ready"] * len(NODES)
        self.is_resetting = False

    def pass_time(self, span_ns: int) -> None:
        end_ns = self.now_ns + span_ns
        machine = self.machine
        for _ in range(100_000):
            due_ns = machine.next_wake_ns()
            if due_ns is None or due_ns > end_ns:
                break
            self.now_ns = max(self.now_ns, due_ns)
            before = list(self.states)
            machine.wake(self.now_ns)
            self.look()
            if machine.records and machine.records[-1].at_ns == self.now_ns:
                torques = machine.records[-1].torque_commands_Nm
                for name, was, torque in zip(self.states, before, torques, strict=True):
                    assert torque == 0.0 or {name, was} & MAY_HAVE_TORQUE, f"{torque} N m while {name}"
        else:
            raise AssertionError("the drives do not let the time go on")
        self.now_ns = end_ns

    def put(self, frame: Frame) -> list[Frame]:
        self.last.append((self.now_ns, f"{frame.cob_id:03X}#{'R' if frame.is_remote else frame.data.hex()}"))
        self.sent += 1
        self.is_resetting = frame.cob_id == 0 and frame.data[:1] == b"\x81"
        self.machine.receive(frame, self.now_ns)
        frames = self.look()
        self.is_resetting = False
        return frames

    def look(self) -> list[Frame]:
        frames = self.machine.take_frames()
        for frame in frames:
            assert 0 < frame.cob_id < 0x800
            assert len(frame.data) <= 8
        has_told = False
        for event in self.machine.take_events():
            if isinstance(event, PowerStateChanged):
                change = NAMES[event.before], NAMES[event.after]
                assert change in ALLOWED or change[1] == "reaction", change
                self.transitions.add(change)
                has_told = True
        for place, entry in enumerate(self.statuswords):
            word = entry.value
            names = [name for name, (mask, value) in MASKS.items() if word & mask == value]
            assert len(names) == 1, f"{word:04X}h is {names}"
            name = names[0]
            drive = self.machine.drives[place]
            assert NAMES[drive.power_state] == name
            assert not drive.is_powered or name in MAY_HAVE_TORQUE, f"powered while {name}"
            if name != self.states[place] and not has_told:
                assert name == "not ready", f"{self.states[place]} to {name} without a word"
                assert self.is_resetting
            self.seen.add(name)
            self.states[place] = name
        return frames

    def look_after(self) -> None:
        """Whatever has happened, every drive answers; one that was stopped or renamed is called back first."""
        self.put(Frame(0x7E5, bytes.fromhex("0400000000000000")))
        for node in NODES:
            self.put(Frame(0x600 + node, bytes.fromhex("8000000000000008")))
        # Whoever shall answer does so before the reset, too.
        for node, drive in zip(NODES, self.machine.drives, strict=True):
            if drive.node_id == node and drive.nmt_state in {NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL}:
                self.ask(node)
        booted = {frame.cob_id for frame in self.put(Frame(0x000, b"\x82\x00")) if frame.data == b"\0"}
        for node in NODES:
            if 0x700 + node in booted:
                continue
            # By its identity: the serial number is the node id.
            for text in ("40D2040000000000", "4124100000000000", "4200000100000000", f"43{node:02X}000000000000"):
                answers = self.put(Frame(0x7E5, bytes.fromhex(text)))
            assert Frame(0x7E4, bytes.fromhex("4400000000000000")) in answers
            answers = self.put(Frame(0x7E5, bytes((0x11, node, 0, 0, 0, 0, 0, 0))))
            assert Frame(0x7E4, bytes.fromhex("1100000000000000")) in answers
            self.put(Frame(0x7E5, bytes.fromhex("1700000000000000")))
            self.put(Frame(0x7E5, bytes.fromhex("0400000000000000")))
            self.put(Frame(0x000, b"\x82\x00"))
        for node in NODES:
            self.ask(node)

    def ask(self, node: int) -> None:
        answers = self.put(Frame(0x600 + node, bytes.fromhex("4000100000000000")))
        assert Frame(0x580 + node, bytes.fromhex("4300100092010200")) in answers, f"node {node} is silent"

    def begin(self) -> None:
        """What lets a round do more than be refused: operational, now and then with the defaults, and enabled."""
        pick = self.random.random()
        if pick < 0.3:
            for node in NODES:
                self.put(Frame(0x600 + node, bytes.fromhex("231110016C6F6164")))  # restore defaults
            self.put(Frame(0x000, b"\x81\x00"))
            self.pass_time(3_000_000)
        self.source.is_calm = pick < 0.15
        if pick < 0.15:
            for frame in self.source.commissioning:
                self.put(frame)
                self.pass_time(300_000)
        if pick < 0.8:
            self.put(Frame(0x000, b"\x01\x00"))
            for node in NODES:
                mode = self.random.choice(["01", "03", "04", "06", "07", "08", "09", "0A"])
                option = f"2B5A60000{self.random.randrange(9)}000000"
                for text in ("2B40600000000000", "2B40600080000000", f"2F606000{mode}000000", option):
                    self.put(Frame(0x600 + node, bytes.fromhex(text)))
                self.pass_time(2_000_000)
                for text in ("2B40600006000000", "2B40600007000000", "2B4060000F000000"):
                    self.put(Frame(0x600 + node, bytes.fromhex(text)))

    def run(self, count: int) -> None:
        self.pass_time(3_000_000)
        try:
            while self.sent < count:
                self.begin()
                for _ in range(ROUND):
                    self.put(next(self.source))
                    pick = self.random.random()
                    if pick < 0.5:
                        self.pass_time(self.random.randrange(600_000))
                    elif pick < 0.501:
                        self.pass_time(self.random.randrange(1_500_000_000))
                self.look_after()
        except Exception as error:
            story = "\n".join(f"({at_ns / 1e9:.6f}) {text}" for at_ns, text in self.last)
            raise AssertionError(f"frame {self.sent}: {type(error).__name__}: {error}\n{story}") from error
        assert self.seen == set(MASKS)
        assert {(a, b) for a, b in self.transitions if b != "reaction"} == ALLOWED


@pytest.mark.parametrize("seed", [20261122])
def test_twenty_thousand_frames(seed: int, recorded: list[Frame]):
    Watch(seed, recorded).run(20_000)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(4))
def test_a_million_frames(seed: int, recorded: list[Frame]):
    Watch(seed, recorded).run(250_000)
