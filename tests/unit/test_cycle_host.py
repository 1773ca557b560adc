"""The gateway's host on buses, a clock and a sleep that are not real."""

from types import SimpleNamespace

import pytest
import yaml

from config.loading import load_config, parse_config
from config.schema import SyncSource, Timestamps
from drivers.bus_off import Restarter, RestartSettings
from drivers.can_link import LinkState
from drivers.controller import BusErrorClass, Controller, ControllerChanged, ErrorState
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.nmt import SYNC_COB_ID
from drivers.real_time import isolated_processors
from drivers.socketcan_port import SocketcanPort
from gateway.cyclic.guard import StopReason
from gateway.errors import GatewayError
from gateway.record.lateness import Cause
from gateway.record.sample import SampleFlag
from gateway.running import cycle_bus
from gateway.running.assembly import build_core
from gateway.running.bus_address import BusAddress
from gateway.running.controller_watch import ControllerWatch
from gateway.running.cycle_bus import open_cycle_bus
from gateway.running.cycle_host import CycleHost
from gateway.running.late_account import LateAccountant
from gateway.running.preparation import prepare

MS = 1_000_000
CONFIG = load_config("paper")


@pytest.fixture(scope="module")
def prepared():
    return prepare(CONFIG, 1)


class Samples:
    def __init__(self):
        self.flags = []
        self.leads = []

    def append(self, *values):
        self.flags.append(values[13])
        self.leads.append(values[10])


class World:
    """Time, a bus on which two drives answer SYNC after 0.2 and 0.3 ms, and a kernel that sends SYNC."""

    def __init__(self, prepared, is_kernel, full_sends=(), echo_cob_id=None):
        self.now_ns = 0
        self.queue = []
        self.sent = []
        self.sleeps = self.waits = self.polls = 0
        self.full_sends = set(full_sends)
        self.cycles = 200
        self.retimed = []
        self.timer_lateness_ns = 0
        self.next_sync_ns = None
        self.samples = Samples()
        self.core = build_core(CONFIG, prepared.cam.profile, prepared.plan, self.samples)
        self.core._procedure = iter(lambda: 1 << 62, None)  # the session waits for ever: the cycle alone is looked at
        self.core.loop.start(0)
        self.echo_cob_id = echo_cob_id
        self.slow_cycles = ()
        self.host = CycleHost(
            self.core,
            self,
            self.poll,
            sync=self if is_kernel else None,
            echo_cob_id=echo_cob_id,
            clock=lambda: self.now_ns,
            sleep=self.sleep,
        )

    # the kernel's SYNC
    def start(self):
        self.next_sync_ns = self.now_ns + 10_000

    def stop(self):
        self.next_sync_ns = None

    def retime(self, period_us):
        self.retimed.append(period_us)

    # the bus
    def send(self, frame):
        self.now_ns += 5_000
        if len(self.sent) in self.full_sends:
            self.full_sends.discard(len(self.sent))
            return False
        self.sent.append((self.now_ns, frame))
        if frame.cob_id == self.echo_cob_id:
            self.queue.append((self.now_ns, frame))
        if frame.cob_id == 0x202 and self.core.loop.cycle in self.slow_cycles:
            # The processor is taken away right after the frame has gone: the clock is read too late.
            self.pass_time(self.now_ns + 900_000)
        if frame.cob_id == SYNC_COB_ID:
            self.answer(self.now_ns)
        return True

    def answer(self, sync_ns):
        for number in (1, 2):
            self.queue.append((sync_ns + 100_000 * (number + 1), Frame(0x180 + number, bytes(8))))

    def receive(self):
        self.pass_time(self.now_ns)
        if self.queue and self.queue[0][0] <= self.now_ns:
            at_ns, frame = self.queue.pop(0)
            return frame, at_ns
        return None

    def pass_time(self, to_ns):
        while self.next_sync_ns is not None and self.next_sync_ns <= to_ns:
            self.queue.append((self.next_sync_ns, Frame(SYNC_COB_ID)))
            self.answer(self.next_sync_ns)
            interval_us = self.retimed[-1] if self.retimed else 1000
            self.next_sync_ns += interval_us * 1000 + self.timer_lateness_ns
        self.queue.sort(key=lambda entry: entry[0])
        self.now_ns = max(self.now_ns, to_ns)

    def wait(self, timeout_s):
        self.waits += 1
        end_ns = self.now_ns + round(timeout_s * 1e9)
        coming = [at_ns for at_ns, _ in self.queue] + ([self.next_sync_ns] if self.next_sync_ns else [])
        self.pass_time(min([end_ns, *coming]))
        return self.now_ns < end_ns

    def sleep(self, span_s):
        self.sleeps += 1
        self.pass_time(self.now_ns + round(span_s * 1e9) + 2_000)

    def poll(self):
        self.polls += 1
        if self.core.loop.cycle >= self.cycles:
            self.core.loop.stop()
            self.core.is_done = True


@pytest.mark.parametrize("is_kernel", [True, False])
def test_the_loop_learns_when_to_wake_and_sleeps_as_little_as_once_a_cycle(prepared, is_kernel):
    world = World(prepared, is_kernel)
    world.host.run()
    assert world.samples.flags == [0] * 200
    # The last TPDO comes after 0.3 ms, and is 2 us late in being read; the margin is 15 us.
    assert 300_000 <= world.host.phase_ns <= 320_000
    sleeps = world.sleeps / 200
    assert sleeps < (1.1 if is_kernel else 2.1), "SYNC itself is a second wake where the loop sends it"
    assert world.waits < 80, "until the phase is known"
    syncs = [at_ns for at_ns, frame in world.sent if frame.cob_id == SYNC_COB_ID]
    assert len(syncs) == (0 if is_kernel else 201)
    assert world.next_sync_ns is None, "the kernel's SYNC ends with the session"
    # RPDOs leave some 15 us after the phase: 0.68 ms are left.
    assert 650_000 < sorted(world.samples.leads)[100] < 690_000


def test_a_timer_that_is_always_late_is_set_to_less(prepared):
    world = World(prepared, True)
    world.cycles, world.timer_lateness_ns = 1000, 30_000
    world.host.run()
    # The loop's own start counts as a short period in the first window.
    assert world.retimed in ([970], [971, 970])
    assert not any(world.samples.flags)
    assert world.core.loop.sync_period_ns == MS


def test_a_full_buffer_is_offered_the_frame_again_and_counted(prepared):
    world = World(prepared, True, full_sends=[21, 40])
    world.host.run()
    full = [n for n, flags in enumerate(world.samples.flags) if flags & SampleFlag.SEND_BUFFER_FULL]
    assert len(full) == 2
    assert not any(flags & SampleFlag.MISSED_RPDO_DEADLINE for flags in world.samples.flags)
    demands = [frame.cob_id for _, frame in world.sent]
    assert demands.count(0x201) == demands.count(0x202)


def test_the_order_on_the_bus_tells_which_sync_takes_a_demand(prepared):
    """The RPDOs of cycles 50 and 120 are on the bus 0.68 ms before SYNC; the loop comes to its clock after it."""
    believed = {}
    for echo_cob_id in (None, 0x202):
        world = World(prepared, True, echo_cob_id=echo_cob_id)
        world.slow_cycles = (50, 120)
        world.host.run()
        flags = world.samples.flags
        believed[echo_cob_id] = [n for n, flag in enumerate(flags) if flag & SampleFlag.MISSED_RPDO_DEADLINE]
        assert sorted(world.samples.leads)[100] > 600_000
    assert believed == {None: [50, 120], 0x202: []}


@pytest.mark.parametrize("is_full", [False, True])
def test_a_heartbeat_after_the_demand_does_not_make_the_demand_late(prepared, is_full):
    """It goes, or is refused, 20 us before SYNC is due, when the demand has long been on the bus."""
    world = World(prepared, False)
    world.cycles = 3
    world.host.run()
    loop = world.core.loop
    loop._is_closed, loop._sent_ns = True, world.now_ns - 700_000
    world.full_sends = {len(world.sent)} if is_full else set()
    world.host._send([Frame(0x77F, b"\x05")])
    assert loop._sent_ns == world.now_ns - 705_000
    world.host._send([Frame(0x201, bytes(8)), Frame(0x202, bytes(8))])
    assert loop._sent_ns == world.now_ns


def test_a_demand_that_never_got_onto_the_bus_has_missed_its_deadline(prepared):
    world = World(prepared, True)
    send, world.send = world.send, lambda frame: (world.now_ns // MS) % 50 != 20 and send(frame)
    world.host.run()
    missed = [n for n, flags in enumerate(world.samples.flags) if flags & SampleFlag.MISSED_RPDO_DEADLINE]
    assert len(missed) == 4


@pytest.mark.parametrize(("text", "expected"), [("", []), ("2", [2]), ("1,4-6\n", [1, 4, 5, 6]), ("x", [])])
def test_isolated_processors_as_the_kernel_lists_them(tmp_path, text, expected):
    (tmp_path / "isolated").write_text(text)
    assert isolated_processors(tmp_path) == expected


STALE = Frame(0x601, b"an answer")


class OffLink:
    """An interface whose controller the kernel restarts."""

    def read(self):
        return LinkState(None, 20)

    def restart(self):
        raise AssertionError("that is the kernel's business")


@pytest.mark.parametrize("is_kernel", [True, False])
def test_a_controller_that_is_bus_off_silences_loop_and_kernel_and_stops_the_machine(prepared, is_kernel):
    """20 ms of bus-off: nothing is offered to the bus, the kernel's SYNC ends at once and is never begun again."""
    world = World(prepared, is_kernel)
    world.core.session.is_interruptible = False
    controller = Controller()
    watch = ControllerWatch(controller, Restarter(controller, OffLink(), RestartSettings()), world.core)
    world.host = CycleHost(
        world.core,
        world,
        world.poll,
        sync=world if is_kernel else None,
        controller=watch,
        clock=lambda: world.now_ns,
        sleep=world.sleep,
    )
    accountant = LateAccountant(MS, lambda *_: None, is_fine=False, clock=lambda: world.now_ns)
    world.core.loop.late_listener = accountant
    ends = {}
    drained = world.receive

    def receive():
        # The error frames are read where all frames are.
        if world.core.loop.cycle >= 50 and "off" not in ends:
            ends["off"] = world.now_ns
            controller.take(BusErrorClass.BUS_OFF, b"")
            world.host._backlog = [STALE]
        elif "off" in ends and "back" not in ends and world.now_ns >= ends["off"] + 20 * MS:
            ends["back"] = world.now_ns
            controller.take(BusErrorClass.RESTARTED, b"")
        if controller.is_off:
            world.queue.clear()
        return drained()

    world.receive = receive
    world.host.run()
    silent = [frame for at_ns, frame in world.sent if ends["off"] + MS // 100 < at_ns <= ends["back"]]
    assert silent == []
    assert world.next_sync_ns is None
    flagged = [n for n, flags in enumerate(world.samples.flags) if flags & SampleFlag.SEND_BUFFER_FULL]
    assert 19 <= len(flagged) <= 21
    assert flagged == list(range(flagged[0], flagged[-1] + 1))
    missed = sum(bool(flags & SampleFlag.MISSED_RPDO_DEADLINE) for flags in world.samples.flags)
    account = accountant.account
    assert (account.missed, account.counts, account.not_explained) == (missed, {Cause.BUS_FULL: missed}, 0)
    assert missed >= 19
    syncs = [at_ns for at_ns, frame in world.sent if frame.cob_id == SYNC_COB_ID and at_ns > ends["back"]]
    assert len(syncs) > 100, "the loop sends SYNC itself, whoever sent it before"
    assert STALE not in [frame for _, frame in world.sent]
    words = {frame.data[0] for at_ns, frame in world.sent if frame.cob_id == 0x201 and at_ns > ends["back"]}
    assert words == {0x02}, "quick stop"
    told = [event for event in world.core.take_events() if isinstance(event, ControllerChanged)]
    assert [event.state for event in told] == [ErrorState.OFF, ErrorState.ACTIVE]
    assert world.core._guard.stopped_by is StopReason.BUS_OFF


def with_source(source):
    document = yaml.safe_load(CONFIG.text)
    document["bus"]["sync_source"] = source.value
    return parse_config(yaml.safe_dump(document), CONFIG.path)


def test_the_kernels_sync_on_a_bus_without_one_is_refused():
    address = BusAddress("socketcand", "vcan0", "127.0.0.1", 29536)
    with pytest.raises(GatewayError, match=r"bus\.sync_source: kernel needs the interface socketcan, this bus is"):
        open_cycle_bus(address, with_source(SyncSource.KERNEL), None)
    bus = open_cycle_bus(address, with_source(SyncSource.AUTO), world := SimpleNamespace())
    assert bus.cyclic is world
    assert world.outlives_bus_off
    assert bus.sync is None
    assert not bus.sync_setting.is_on


def with_timestamps(timestamps):
    document = yaml.safe_load(CONFIG.text)
    document["bus"] |= {"timestamps": timestamps.value, "sync_source": "loop"}
    return parse_config(yaml.safe_dump(document), CONFIG.path)


class StampingPort(SocketcanPort):
    """A port whose interface stamps frames; without any."""

    def __init__(self):
        self.has_hardware_stamps = False

    def use_hardware_stamps(self):
        self.has_hardware_stamps = True


@pytest.mark.parametrize(
    ("wanted", "refusal", "is_on", "reason"),
    [
        (Timestamps.AUTO, "", True, "by the clock of can0's controller"),
        (Timestamps.AUTO, "can0 has none", False, "can0 has none"),
        (Timestamps.KERNEL, "", False, "bus.timestamps is kernel"),
        (Timestamps.HARDWARE, "", True, "by the clock of can0's controller"),
    ],
)
def test_whose_stamps_are_used_is_told_and_why(monkeypatch, wanted, refusal, is_on, reason):
    monkeypatch.setattr(cycle_bus, "why_no_hardware_stamps", lambda channel: refusal)
    monkeypatch.setattr(BusAddress, "open", lambda _self, filters: StampingPort())
    bus = open_cycle_bus(BusAddress("socketcan", "can0", "", 0), with_timestamps(wanted), None)
    assert (bus.stamp_setting.is_on, bus.stamp_setting.reason) == (is_on, reason)
    assert bus.cyclic.has_hardware_stamps is is_on
    assert not bus.service.has_hardware_stamps


@pytest.mark.parametrize(
    ("interface", "why"), [("socketcan", "vcan0 has none"), ("socketcand", "socketcand does not tell")]
)
def test_hardware_stamps_that_are_not_to_be_had_are_one_sentence(monkeypatch, interface, why):
    monkeypatch.setattr(cycle_bus, "why_no_hardware_stamps", lambda channel: f"{channel} has none")
    address = BusAddress(interface, "vcan0", "127.0.0.1", 29536)
    with pytest.raises(GatewayError, match=r"^bus\.timestamps: hardware is not to be had on [^\n]*" + why):
        open_cycle_bus(address, with_timestamps(Timestamps.HARDWARE), None)


@pytest.mark.parametrize("source", list(SyncSource))
def test_without_a_broadcast_manager_auto_falls_back_to_the_loop(monkeypatch, source):
    def refuse(channel, *_):
        raise BusError("socketcan", channel, "this system offers no CAN broadcast manager")

    monkeypatch.setattr(cycle_bus, "PeriodicFrame", refuse)
    opened = []
    monkeypatch.setattr(BusAddress, "open", lambda _self, filters: opened.append(filters) or SimpleNamespace())
    address = BusAddress("socketcan", "can0", "", 0)
    if source is SyncSource.KERNEL:
        with pytest.raises(BusError):
            open_cycle_bus(address, with_source(source), None)
        return
    bus = open_cycle_bus(address, with_source(source), None)
    assert bus.sync is None
    cyclic, service = opened
    assert cyclic == [(0x181, 0x7FF), (0x182, 0x7FF)], "its own SYNC is not for the loop"
    assert {cob_id for cob_id, _ in service} == {0x081, 0x581, 0x701, 0x082, 0x582, 0x702}
