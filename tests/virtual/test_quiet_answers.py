"""A core that answers False has nothing to send, nothing to tell, and wants to be woken when it said last."""

from guarded_machine import CV, PAPER, SERVO, prepared_run

from drivers.frame import Frame
from drivers.node import Event, Node
from drivers.virtual_time import VirtualBus
from gateway.running.assembly import build_core
from sim_drive.assembly import build_machine, free_machine

SECOND = 1_000_000_000


class Doubted:
    """Asks a core all the same, whatever it answers."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.next_wake_ns, self.take_frames, self.take_events = node.next_wake_ns, node.take_frames, node.take_events
        self.quiet: set[int] = set()
        """COB-IDs of which nothing has come at least once."""
        self.loud: set[int] = set()
        self.quiet_wakes = 0

    def receive(self, frame: Frame, now_ns: int) -> None:
        due_ns = self.node.next_wake_ns()
        answer = self.node.receive(frame, now_ns)
        (self.quiet if answer is False else self.loud).add(frame.cob_id)
        if answer is False:
            assert (self.take_frames(), self.take_events(), self.next_wake_ns()) == ([], [], due_ns)

    def wake(self, now_ns: int) -> None:
        if self.node.wake(now_ns) is False:
            self.quiet_wakes += 1
            assert (self.take_frames(), self.take_events()) == ([], [])


class NoSink:
    def append(self, *values: float) -> None:
        pass


def ignore(node: int, event: Event) -> None:
    pass


def test_gateway_and_machine_are_quiet_only_when_nothing_has_come_of_a_call() -> None:
    prepared = prepared_run(PAPER.text, PAPER.path, 1)
    gateway = Doubted(build_core(PAPER, prepared.cam.profile, prepared.plan, NoSink()))
    machine = build_machine(PAPER)
    doubted = Doubted(machine)
    bus = VirtualBus([gateway, doubted], PAPER.bus.bit_rate, on_event=ignore)
    bus.run_until(2 * SECOND)
    assert gateway.quiet <= {0x180 + CV, 0x180 + SERVO}
    assert {0x200 + CV, 0x200 + SERVO} <= doubted.quiet
    assert 0x080 in doubted.loud
    assert doubted.quiet_wakes > 1000
    machine.drives[SERVO - 1].trip(0x2310, 0x03, bus.now_ns)
    bus.run_until(3 * SECOND)
    assert 0x080 + SERVO in gateway.loud


def test_free_drives_that_hear_each_other_are_not_taken_for_quiet() -> None:
    machine = free_machine([1, 2, 3])
    doubted = Doubted(machine)

    class Master:
        """NMT start for all, then SDO reads and remote requests of heartbeats."""

        def __init__(self) -> None:
            sdo = [Frame(0x600 + n, bytes.fromhex("4041600000000000")) for n in (1, 2, 3)]
            self.frames = [Frame(0, b"\x01\x00"), *sdo, Frame(0x701, b"", True), Frame(0x123, b"\x01")]

        def receive(self, frame: Frame, now_ns: int) -> None:
            pass

        def next_wake_ns(self) -> int | None:
            return SECOND if self.frames else None

        def wake(self, now_ns: int) -> None:
            self.frames, self.out = [], self.frames

        def take_frames(self) -> list[Frame]:
            frames, self.out = getattr(self, "out", []), []
            return frames

        def take_events(self) -> list[Event]:
            return []

    VirtualBus([Master(), doubted], 1_000_000, on_event=ignore).run_until(2 * SECOND)
    assert {0x601, 0x602, 0x603} <= doubted.loud
    assert 0x123 in doubted.quiet
