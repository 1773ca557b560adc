"""The emulated machine with drives that are only what the machine needs of them."""

from collections.abc import Callable
from itertools import pairwise
from math import pi

import pytest

from drivers.frame import Frame
from drivers.node import Event
from mechanism.dynamics import STANDARD_GRAVITY, DynamicsParameters, LinkParameters
from mechanism.five_bar import Closure, FiveBar
from sim_drive.machine import EmulatedMachine, LinkageTorn, TickRecord, TimeSkipped
from sim_drive.machine_axis import LINKAGE_TORN_ERROR_CODE, MachineAxis
from sim_drive.machine_seam import Latch
from sim_drive.physics.driveline import AxisDriveline
from sim_drive.physics.free_axis import FreeAxisParameters, FreeAxisPlant
from sim_drive.physics.plant import CoupledPlant, PlantParameters

MS = 1_000_000
SECOND = 1_000_000_000
SYNC = Frame(0x080)
COUNTS_PER_RAD = 4096 / (2 * pi)


def no_latch(now_ns: int) -> tuple[int, float, int]:
    raise AssertionError(f"latched at {now_ns} before the machine gave a latch")


class FakeDrive:
    """A drive without a bus: its demand is a function of time, and it logs what it is told."""

    def __init__(self, name: str, log: list[tuple[object, ...]], listens: set[int] | None = None) -> None:
        self.name = name
        self.log = log
        self.listens = {0x080} if listens is None else listens
        self.outbox: list[Frame] = []
        self.events: list[Event] = []
        self.subscriptions_changed = False
        self.latch: Latch = no_latch
        self.position_demand_counts = 0.0
        self.torque_offset_Nm = 0.0
        self.velocity_offset = 0.0
        self.is_wake_stale = True
        self.torque_demand_Nm: float | None = None
        self.torque_limit_Nm = 4.5
        self.negative_torque_limit_Nm = 4.5
        self.is_powered = False
        self.is_brake_released = False
        self.axes = (self,)
        self.gains: tuple[int, ...] = (4000, 0, 0, 45_000, 45_000)
        self.demand: Callable[[int], float] = lambda now_ns: 0.0
        self.answers: dict[int, list[Frame]] = {}
        self.wakes_ns: list[int] = []
        self.trips: list[int] = []
        self.keeps_waking = False
        self.watches_events = True

    def power(self, on: bool = True) -> None:
        self.is_powered = on
        self.is_brake_released = on

    def measure_by(self, latch: Latch) -> None:
        self.latch = latch

    @property
    def torque_demand(self) -> float | None:
        return self.torque_demand_Nm

    def handler_of(self, cob_id: int) -> None:
        return None

    def cob_ids(self) -> set[int]:
        return self.listens

    def receive(self, frame: Frame, now_ns: int) -> None:
        self.log.append(("frame", self.name, frame.cob_id, now_ns))
        self.outbox.extend(self.answers.get(frame.cob_id, []))

    def next_wake_ns(self) -> int | None:
        return self.wakes_ns[0] if self.wakes_ns else None

    def wake(self, now_ns: int) -> None:
        self.log.append(("wake", self.name, now_ns))
        if not self.keeps_waking:
            self.wakes_ns = [at_ns for at_ns in self.wakes_ns if at_ns > now_ns]

    def after_servo_tick(self, now_ns: int) -> None:
        pass

    def on_tick(self, now_ns: int, shaft_counts: int) -> None:
        self.log.append(("tick", self.name, now_ns, shaft_counts, self.latch(now_ns)[1]))
        self.position_demand_counts = self.demand(now_ns)

    def trip(self, error_code: int, error_register_bits: int, now_ns: int, *, persists: bool = False) -> None:
        assert persists
        self.trips.append(error_code)
        self.power(False)


class Bench:
    """A machine of fake drives on free axes or on the five-bar."""

    def __init__(
        self,
        count: int = 2,
        start_ns: int = 0,
        axes: list[FreeAxisParameters] | None = None,
        axis: MachineAxis | None = None,
        five_bar: bool = False,
        seed: int = 0,
        record_ticks: int = 0,
    ) -> None:
        self.log: list[tuple[object, ...]] = []
        self.drives = [FakeDrive("abc"[index], self.log) for index in range(count)]
        machine_axis = axis if axis is not None else MachineAxis()
        plant = (
            paper_plant()
            if five_bar
            else FreeAxisPlant(axes if axes is not None else [FreeAxisParameters(0.002)] * count, [0.0] * count)
        )
        self.plant = plant
        self.machine = EmulatedMachine(
            self.drives, plant, [machine_axis] * count, start_ns=start_ns, seed=seed, record_ticks=record_ticks
        )

    def run_until(self, limit_ns: int) -> None:
        for _ in range(1_000_000):
            due_ns = self.machine.next_wake_ns()
            assert due_ns is not None
            if due_ns > limit_ns:
                return
            self.machine.wake(due_ns)
        raise AssertionError("the machine does not come to the end")

    def ticks(self, name: str = "a") -> list[int]:
        return [int(str(entry[2])) for entry in self.log if entry[:2] == ("tick", name)]


def paper_plant() -> CoupledPlant:
    dynamics = DynamicsParameters(
        five_bar=FiveBar(0.15, 0.25, 0.3, 0.15, (0.0, 0.0), (0.25, 0.0)),
        p=LinkParameters(0.596, 0.09072986577181207, 0.0, 0.001501582508389262),
        q=LinkParameters(0.0405, 0.125, 0.0, 0.00021169687500000001),
        r=LinkParameters(0.0486, 0.15, 0.0, 0.00036541125),
        s=LinkParameters(0.0363, 0.09979338842975206, 0.0, 9.120407541322314e-05),
        end_effector_mass_kg=0.012,
        rotor_inertia_kg_m2=(0.00012, 0.00012),
        gravity_m_s2=STANDARD_GRAVITY,
        viscous_N_m_s=(0.005, 0.005),
        coulomb_N_m=(0.04, 0.05),
    )
    return CoupledPlant(PlantParameters(dynamics, Closure.LEFT), 0.0, 0.0)


def test_servo_ticks_stand_at_exact_nanoseconds() -> None:
    start_ns = 123_456_789_000
    bench = Bench(start_ns=start_ns)
    bench.run_until(start_ns + 2 * SECOND)
    ticks = bench.ticks()
    assert ticks[:4] == [start_ns + 976_562, start_ns + 1_953_125, start_ns + 2_929_687, start_ns + 3_906_250]
    assert ticks == [start_ns + n * 1_953_125 // 2 for n in range(1, 2049)]
    assert ticks[1023] == start_ns + SECOND
    assert bench.machine.servo_ticks == 2048


def test_a_late_wake_runs_every_tick_at_its_own_time() -> None:
    prompt, late = Bench(), Bench()
    for bench in (prompt, late):
        for drive in bench.drives:
            drive.power()
            drive.demand = lambda now_ns: now_ns / 1e7
    prompt.run_until(100 * MS)
    late.machine.wake(40 * MS)
    late.machine.wake(40 * MS)
    late.machine.wake(100 * MS)
    assert late.log == prompt.log
    assert late.plant.angle(0) == prompt.plant.angle(0) != 0.0


def test_a_frame_after_a_missed_wake_finds_the_machine_up_to_date() -> None:
    bench = Bench()
    bench.machine.receive(SYNC, 2 * MS)
    assert [entry[0] for entry in bench.log] == ["tick", "tick", "tick", "tick", "frame", "frame"]


def test_very_late_ticks_are_left_out_and_said() -> None:
    bench = Bench()
    bench.run_until(10 * MS)
    bench.drives[1].wakes_ns = [20 * MS, 30 * MS, 40 * MS]
    bench.machine.receive(SYNC, 10 * MS)
    bench.log.clear()
    late_ns = 1_000_000 * SECOND + 5
    bench.machine.wake(late_ns)
    assert bench.ticks() == [1_000_000 * SECOND]
    # The drive's missed wakes are one, after the tick.
    assert [entry[:3] for entry in bench.log[2:]] == [("wake", "b", 1_000_000 * SECOND)]
    assert bench.machine.take_events() == [TimeSkipped(late_ns, 1_000_000 * 1024 - 10 - 1)]
    assert bench.machine.next_wake_ns() == 1_000_000 * SECOND + 976_562
    bench.machine.wake(1_000_000 * SECOND + 976_562)
    assert bench.machine.take_events() == []


def test_one_second_late_is_caught_up_with() -> None:
    bench = Bench()
    bench.machine.wake(SECOND)
    assert len(bench.ticks()) == 1024
    assert bench.machine.take_events() == []


def test_wakes_of_drives_come_at_their_own_time_and_in_order() -> None:
    bench = Bench()
    a, b = bench.drives
    a.wakes_ns = [500_000, 1_953_125]
    b.wakes_ns = [400_000, 1_953_125]
    bench.machine.receive(SYNC, 0)
    bench.log.clear()
    assert bench.machine.next_wake_ns() == 400_000
    bench.machine.wake(2 * MS)
    assert [entry[:3] for entry in bench.log] == [
        ("wake", "b", 400_000),
        ("wake", "a", 500_000),
        ("tick", "a", 976_562),
        ("tick", "b", 976_562),
        ("tick", "a", 1_953_125),
        ("tick", "b", 1_953_125),
        ("wake", "a", 1_953_125),
        ("wake", "b", 1_953_125),
    ]


def test_a_drive_that_always_wants_to_wake_does_not_stop_the_machine() -> None:
    bench = Bench()
    bench.drives[0].wakes_ns = [100]
    bench.drives[0].keeps_waking = True
    bench.machine.receive(SYNC, 0)
    bench.machine.wake(5 * MS)
    assert len(bench.ticks("b")) == 5
    assert sum(entry[0] == "wake" for entry in bench.log) <= 16 * 6
    instants = [int(str(entry[2])) for entry in bench.log if entry[0] in ("wake", "tick")]
    assert instants == sorted(instants)


def test_frames_go_to_the_drives_that_listen() -> None:
    bench = Bench()
    a, b = bench.drives
    a.listens = {0x080, 0x201}
    a.subscriptions_changed = True
    bench.run_until(1 * MS)
    assert not a.subscriptions_changed
    bench.log.clear()
    for cob_id in (0x080, 0x201, 0x202):
        bench.machine.receive(Frame(cob_id), MS)
    assert [entry[1:3] for entry in bench.log] == [("a", 0x080), ("b", 0x080), ("a", 0x201)]
    b.listens = {0x202}
    b.subscriptions_changed = True
    bench.machine.receive(SYNC, MS)
    bench.log.clear()
    bench.machine.receive(Frame(0x202), MS)
    bench.machine.receive(SYNC, MS)
    assert [entry[1:3] for entry in bench.log] == [("b", 0x202), ("a", 0x080)]


def test_drives_hear_each_other_after_the_frame_that_caused_it() -> None:
    bench = Bench()
    a, b = bench.drives
    tpdo_a, tpdo_b = Frame(0x181, b"\x01"), Frame(0x182, b"\x02")
    a.answers = {0x080: [tpdo_a]}
    b.answers = {0x080: [tpdo_b]}
    a.listens = b.listens = {0x080, 0x181}
    b.subscriptions_changed = True
    bench.run_until(MS)
    bench.log.clear()
    bench.machine.receive(SYNC, MS)
    # The cross-linked TPDO comes after both have had the SYNC, and not back to its sender.
    assert [entry[1:3] for entry in bench.log] == [("a", 0x080), ("b", 0x080), ("b", 0x181)]
    assert bench.machine.take_frames() == [tpdo_a, tpdo_b]
    assert bench.machine.take_frames() == []


def test_drives_that_answer_each_other_for_ever_are_held_back() -> None:
    bench = Bench()
    a, b = bench.drives
    a.listens, b.listens = {0x080, 0x182}, {0x181}
    a.answers = {0x080: [Frame(0x181)], 0x182: [Frame(0x181)]}
    b.answers = {0x181: [Frame(0x182)]}
    a.subscriptions_changed = True
    bench.run_until(MS)
    bench.machine.receive(SYNC, MS)
    sent = bench.machine.take_frames()
    assert 2 <= len(sent) <= 32
    bench.run_until(2 * MS)
    assert bench.machine.take_frames()


def test_events_of_drives_are_collected() -> None:
    bench = Bench()
    bench.drives[1].events.append(Event(7))
    bench.run_until(MS)
    assert bench.machine.take_events() == [Event(7)]
    assert bench.machine.take_events() == []


def test_resolver_is_quantised_and_its_velocity_is_the_middle_one_of_three_differences() -> None:
    bench = Bench(1, axes=[FreeAxisParameters(0.001, load_torque_Nm=-1.0)])
    bench.drives[0].is_brake_released = True
    bench.run_until(20 * MS)
    seen = [entry[3:] for entry in bench.log if entry[0] == "tick"]
    # The brake is released at the first tick; from there 1000 rad/s2: theta = 500 t^2, t = n / 1024 s.
    expected = [int(500.0 * (n / 1024) ** 2 * COUNTS_PER_RAD + 0.5) for n in range(20)]
    assert [counts for counts, _ in seen] == expected
    differences = [0, *(after - before for before, after in pairwise(expected))]
    middle = [sorted(([0, 0, *differences])[n : n + 3])[1] for n in range(20)]
    assert [velocity for _, velocity in seen] == [difference * 1024.0 for difference in middle]


def test_latch_extrapolates_between_ticks() -> None:
    bench = Bench(1, axes=[FreeAxisParameters(0.001, load_torque_Nm=-1.0)])
    drive = bench.drives[0]
    drive.is_brake_released = True
    bench.run_until(101 * 1_953_125 // 2)
    tick_ns = 101 * 1_953_125 // 2

    def counts_at(periods: int) -> int:
        return int(500.0 * (periods / 1024) ** 2 * COUNTS_PER_RAD + 0.5)

    # 100 periods after the release: theta = 500 t^2.
    for offset_ns in (0, 250_000, 900_000):
        t = 100 / 1024 + offset_ns * 1e-9
        counts, velocity, torque = drive.latch(tick_ns + offset_ns)
        assert counts == int(500.0 * t * t * COUNTS_PER_RAD + 0.5)
        assert velocity == (counts_at(100) - counts_at(99)) * 1024.0
        assert torque == 0
    # Past the next tick nothing is known: no further than one period.
    assert drive.latch(tick_ns + SECOND) == drive.latch(tick_ns + 976_563)


def test_latch_gives_torque_in_per_mille_of_rated_torque() -> None:
    bench = Bench(1, axis=MachineAxis(rated_torque_Nm=0.5))
    drive = bench.drives[0]
    drive.power()
    drive.gains = (0, 0, 0, 0, 0)
    drive.torque_offset_Nm = -0.2
    bench.run_until(50 * MS)
    # -0.2 N m is -91 units of 2.197 mN m, -0.19995 N m.
    assert drive.latch(50 * MS)[2] == -400


def test_the_drives_torque_limit_holds() -> None:
    bench = Bench(1)
    drive = bench.drives[0]
    drive.power()
    drive.gains = (0, 0, 0, 0, 0)
    drive.torque_offset_Nm = 3.0
    drive.torque_limit_Nm = drive.negative_torque_limit_Nm = 0.5
    bench.run_until(50 * MS)
    # 227 whole units of 2.197 mN m are within 0.5 N m.
    assert bench.plant.torque(0) == pytest.approx(227 * 10 / 2048 * 0.45, rel=1e-9)


def test_an_axis_without_power_gets_no_torque_and_starts_anew() -> None:
    bench = Bench(1)
    drive = bench.drives[0]
    drive.demand = lambda now_ns: 1000.0
    drive.is_brake_released = True
    bench.run_until(10 * MS)
    assert bench.plant.angle(0) == 0.0
    drive.power()
    drive.gains = (0, 0, 0, 0, 25_600)
    bench.run_until(20 * MS)
    # A demand that stands gives no difference, also in the first sample after power-on.
    assert bench.plant.angle(0) == 0.0
    drive.gains = (256, 256, 0, 0, 0)
    bench.run_until(200 * MS)
    assert bench.machine.servo_loop(0).output_units != 0
    drive.power(on=False)
    bench.run_until(202 * MS)
    drive.demand = lambda now_ns: bench.plant.angle(0) * COUNTS_PER_RAD
    drive.gains = (0, 256, 0, 0, 0)
    drive.power()
    bench.run_until(203 * MS)
    assert abs(bench.machine.servo_loop(0).output_units) <= 1


def test_brakes_hold_the_five_bar_until_they_are_released() -> None:
    bench = Bench(five_bar=True)
    bench.run_until(3 * SECOND)
    assert (bench.plant.angle(0), bench.plant.angle(1)) == (0.0, 0.0)
    bench.drives[0].is_brake_released = True
    bench.run_until(3 * SECOND + 30 * MS)
    assert bench.plant.angle(0) < -0.01
    assert bench.plant.angle(1) == 0.0


def test_a_torn_linkage_trips_every_drive_and_stays_torn() -> None:
    bench = Bench(five_bar=True)
    for drive in bench.drives:
        drive.power()
        drive.gains = (0, 0, 0, 0, 0)
    bench.drives[0].torque_offset_Nm = 4.0
    bench.drives[1].torque_offset_Nm = -4.0
    bench.run_until(SECOND)
    events = bench.machine.take_events()
    assert len(events) == 1
    torn = events[0]
    assert isinstance(torn, LinkageTorn)
    assert 0.0 < torn.plant_time_s <= torn.at_ns * 1e-9 < torn.plant_time_s + 0.002
    assert torn.angles_rad == (bench.plant.angle(0), bench.plant.angle(1))
    assert [drive.trips for drive in bench.drives] == [[LINKAGE_TORN_ERROR_CODE]] * 2
    bench.drives[0].power()
    bench.run_until(SECOND + 5 * MS)
    assert [drive.trips for drive in bench.drives] == [[LINKAGE_TORN_ERROR_CODE] * 2, [LINKAGE_TORN_ERROR_CODE]]
    assert torn.angles_rad == (bench.plant.angle(0), bench.plant.angle(1))


def test_resolver_noise_comes_from_the_seed() -> None:
    def counts(seed: int) -> list[object]:
        bench = Bench(axis=MachineAxis(resolver_noise_counts=2.0), seed=seed)
        bench.run_until(500 * MS)
        return [entry[3] for entry in bench.log if entry[0] == "tick"]

    first = counts(1)
    assert first == counts(1) != counts(2)
    values = [int(str(value)) for value in first]
    assert 1.5 < (sum(value * value for value in values) / len(values)) ** 0.5 < 2.5


def test_records_keep_the_last_ticks() -> None:
    bench = Bench(record_ticks=3)
    bench.drives[0].demand = lambda now_ns: now_ns / 1e6
    bench.run_until(5 * 1_953_125 // 2)
    records = list(bench.machine.records)
    assert [record.at_ns for record in records] == [n * 1_953_125 // 2 for n in (3, 4, 5)]
    assert records[-1] == TickRecord(4_882_812, (0.0, 0.0), (0, 0), (4.882812, 0.0), *((0.0, 0.0),) * 3)
    assert not Bench().machine.records


def test_numbers_of_drives_and_axes_must_agree() -> None:
    plant = FreeAxisPlant([FreeAxisParameters(1.0)], [0.0])
    with pytest.raises(ValueError, match="drives of 0 axes and 1 scalings of axes for a plant of 1 axes"):
        EmulatedMachine([], plant, [MachineAxis()])
    with pytest.raises(ValueError, match="rated_torque_Nm"):
        MachineAxis(rated_torque_Nm=0.0)


def test_a_driveline_brake_may_be_too_weak_for_its_load() -> None:
    weak = FreeAxisParameters(0.01, load_torque_Nm=1.5, driveline=AxisDriveline(brake_torque_Nm=1.0))
    bench = Bench(1, axes=[weak])
    bench.run_until(125 * MS)
    assert bench.plant.velocity(0) == pytest.approx(-50.0 * 0.125)
