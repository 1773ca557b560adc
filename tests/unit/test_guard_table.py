"""The guard's table: what its limits may be, and what every cycle is compared with."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from config.guard_section import Reaction
from config.loading import ConfigError, load_config, parse_config
from drivers.virtual_time import VirtualBus
from gateway.cyclic.axis_channel import NO_LIMITS, RARE_CYCLES, AxisChannel, AxisLimits
from gateway.cyclic.guard import REASON_OF, Condition, Guard, StopReason
from gateway.cyclic.watch import CycleWatch
from gateway.record.sample import Phase
from gateway.running.assembly import build_core, guard_limits, slave_law
from gateway.running.preparation import compile_config, prepare
from gateway.units import AxisUnits
from mechanism.deviation import end_effector_miss, greatest_deviation, harmless_error
from sim_drive.assembly import build_machine

PAPER = load_config("paper")
PROFILE = compile_config(PAPER).profile
UNITS = AxisUnits(4096, 0.0, 1.5)
ENABLED, FAULT = 0x1237, 0x0218
LIMITS = AxisLimits(
    velocity_counts_per_cycle=20.5,
    torque_permille=2500,
    frozen_counts=11,
    unanswered_permille=250,
    pushed_permille=125,
)


@dataclass(frozen=True, slots=True)
class Refusal:
    old: str
    new: str
    sentence: str


@pytest.mark.parametrize(
    "refusal",
    [
        Refusal(
            "limit_percent: 130",
            "limit_percent: 100",
            "would trip in motions that the axis' limits allow (bound: above",
        ),
        Refusal(
            "limit_percent: 130", "limit_percent: 1001", "1001 can never trip, no axis turns at ten times its limit"
        ),
        Refusal(
            "limit_permille: 2500", "limit_permille: 32767", "32767 can never trip, 6077h tells no more than 32767"
        ),
        Refusal("limit_deg: 20", "limit_deg: 180", "guard.cam_window.limit_deg: 180 can never trip"),
        Refusal(
            "limit_deg: 20", "limit_deg: 0.17", "guard.cam_window.limit_deg: 0.17 would always trip, it is less than 2"
        ),
        Refusal("limit_deg: 0.45", "limit_deg: 0.1", "guard.frozen_actual.limit_deg: 0.1 would always trip"),
        Refusal("limit_deg: 0.45", "limit_deg: 18", "18 can never trip, the following error of axis cv does so first"),
        Refusal("limit_mm: 50", "limit_mm: 800", "can never trip, the linkage reaches 400 mm (bound: below 800)"),
        Refusal("limit_mm: 50", "limit_mm: 1", "would always trip, the resolvers tell the end effector to 1.2 mm"),
        Refusal(
            "following_error_counts: 300", "following_error_counts: 2048", "2048 can never trip, half a revolution"
        ),
        Refusal("limit_cycles: 20", "limit_cycles: 200", "can never trip in time, after 200 ms the drives have missed"),
        Refusal(
            "heartbeat_lost: {", "heartbeat_lost: {persistence_cycles: 2, ", "guard.heartbeat_lost.persistence_cycles"
        ),
        Refusal("emergency: {", "emergency: {persistence_cycles: 2, ", "guard.emergency.persistence_cycles"),
        Refusal(
            "missed_tpdo: {persistence_cycles: 20",
            "missed_tpdo: {persistence_cycles: 200",
            "guard.missed_tpdo.persistence_cycles: 200 can never trip in time, after 200 ms the heartbeats are missed",
        ),
        Refusal(
            "limit_percent: 130, persistence_cycles: 5",
            "limit_percent: 130, persistence_cycles: 10001",
            "10001 can never trip in time, they are 10.001 s (bound 10 s)",
        ),
        Refusal(
            "following_error_counts: 200",
            "following_error_counts: 200\n      guarded_error_counts: 1",
            "axes.cv.limits: a following error of 1 counts would always trip",
        ),
        Refusal(
            "sigterm: {reaction: controlled_stop}", "sigterm: {reaction: warn}", "warn would leave the machine running"
        ),
    ],
)
def test_a_limit_that_makes_no_sense_is_refused_in_one_sentence(refusal):
    assert refusal.old in PAPER.text
    with pytest.raises(ConfigError) as caught:
        parse_config(PAPER.text.replace(refusal.old, refusal.new), PAPER.path)
    assert refusal.sentence in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_every_condition_is_a_key_of_the_configuration_and_has_a_reason():
    keys = set(type(PAPER.guard).model_fields)
    assert {condition.value for condition in Condition} == keys
    assert REASON_OF[Condition.SIGTERM] is StopReason.OPERATOR
    assert REASON_OF[Condition.TORQUE] is StopReason.TORQUE


def make(limits=LIMITS, free_motion=None, **replaced):
    section = PAPER.guard.model_copy(update=replaced)
    guard = Guard(section, ("cv", "servo"))
    axes = [AxisChannel("cv", 1, UNITS, 200), AxisChannel("servo", 2, UNITS, 300)]
    for axis in axes:
        axis.statusword = ENABLED
    watch = CycleWatch(guard, axes, [limits, limits], guard_limits(PAPER, slave_law(PAPER, PROFILE))[1], free_motion)
    return guard, axes, watch


def check(watch, cycle, demand=0, awaited=0, phase=Phase.STANDSTILL, offset=0, is_enabled=True, followers=0):
    """One cycle in which the servo axis' target is ``demand``, its torque offset ``offset``."""
    watch.check(awaited, [0, demand], [0, offset], [0.0, 0.0], 0.0, phase, is_enabled, followers, cycle)


def check_late(guard, watch, cycle):
    """One in motion whose demand, 3 counts farther than the last, came too late."""
    guard.hold(Condition.MISSED_DEADLINE, 0, 1, 1, cycle)
    check(watch, cycle, 3 * cycle, phase=Phase.CAM)


def run(watch, axes, guard, track, awaited=0, phase=Phase.STANDSTILL):
    """``track``: (demand, actual) of the servo axis by cycle; returns the cycle of the first trip, None for none."""
    for cycle, (demand, actual) in enumerate(track):
        axes[1].actual = actual
        check(watch, cycle, demand, awaited, phase)
        if guard.tripped:
            return cycle
    return None


def test_a_frozen_actual_value_trips_after_its_travel_and_takes_the_torque_from_its_axis():
    guard, axes, watch = make()
    # From cycle 3 on the actual stays at 9; the demand goes 3 counts a cycle: 12 counts, more than 11, at cycle 7,
    # and that is held for four cycles.
    track = [(3 * n, min(3 * n, 9)) for n in range(20)]
    assert run(watch, axes, guard, track) == 10
    assert guard.tripped[0].condition is Condition.FROZEN_ACTUAL
    assert guard.reaction is Reaction.DISABLE
    assert guard.disabled == 0b10


def test_an_axis_whose_demands_came_too_late_is_not_taken_for_frozen():
    guard, _, watch = make()
    check(watch, 0, phase=Phase.CAM)
    for cycle in range(1, 20):
        check_late(guard, watch, cycle)
    assert all(trip.condition is not Condition.FROZEN_ACTUAL for trip in guard.tripped)
    guard.clear(Condition.MISSED_DEADLINE, 0)
    for cycle in range(20, 30):
        check(watch, cycle, 3 * cycle, phase=Phase.CAM)
    assert guard.tripped[-1].condition is Condition.FROZEN_ACTUAL


def test_demands_that_come_late_for_longer_than_twenty_cycles_are_had_all_the_same():
    """From cycle 21 on the travel counts, 3 a cycle: 12, more than 11, at cycle 24, held for four cycles."""
    guard, _, watch = make()
    check(watch, 0, phase=Phase.CAM)
    for cycle in range(1, 40):
        check_late(guard, watch, cycle)
        if any(trip.condition is Condition.FROZEN_ACTUAL for trip in guard.tripped):
            break
    assert cycle == 27


@pytest.mark.parametrize(("torque", "is_driven"), [(751, True), (750, False), (-751, False)])
def test_late_demands_excuse_an_axis_that_stands_not_one_that_is_driven(torque, is_driven):
    """Three times 250 per mille towards a demand that is farther away than it may stand, for eight cycles."""
    guard, axes, watch = make(AxisLimits(20.5, 2500, 11, 250, 125))
    axes[1].torque = torque
    check(watch, 0, phase=Phase.CAM)
    for cycle in range(1, 19):
        check_late(guard, watch, cycle)
    tripped = [trip.at_ns for trip in guard.tripped if trip.condition is Condition.UNANSWERED_TORQUE]
    # 12 counts away at cycle 4.
    assert tripped == ([11] if is_driven else [])


def test_an_axis_that_stands_as_it_should_is_not_frozen_nor_one_that_flickers():
    guard, axes, watch = make()
    assert run(watch, axes, guard, [(100, 100)] * 1000) is None
    guard, axes, watch = make()
    assert run(watch, axes, guard, [(n, n % 2) for n in range(250)]) is None


def test_too_fast_is_judged_over_its_persistence_and_not_across_a_missed_tpdo():
    guard, axes, watch = make()
    # 21 counts a cycle are above 20.5; five in a row, the first of them in cycle 1.
    assert run(watch, axes, guard, [(21 * n, 21 * n) for n in range(20)]) == 5
    assert guard.tripped[0].value == 21
    guard, axes, watch = make()
    assert run(watch, axes, guard, [(20 * n, 20 * n) for n in range(100)]) is None
    check(watch, 0, awaited=0b10)
    assert run(watch, axes, guard, [(5000 + 20 * n, 5000 + 20 * n) for n in range(100)]) is None


def test_torque_and_fault_and_following_error_are_told_with_their_values():
    guard, axes, watch = make()
    axes[0].torque = -2501
    for cycle in range(99):
        check(watch, cycle)
    assert guard.tripped == []
    check(watch, 99)
    trip = guard.tripped.pop()
    assert (trip.condition, trip.axis, trip.value, trip.limit) == (Condition.TORQUE, "cv", -2501, 2500)
    axes[1].statusword = FAULT
    axes[1].actual = -301
    check(watch, 100)
    assert [(t.condition, t.axis, t.value) for t in guard.tripped] == [
        (Condition.DRIVE_FAULT, "servo", FAULT),
        (Condition.FOLLOWING_ERROR, "servo", 301),
    ]


def test_one_silent_axis_is_told_from_a_silent_bus():
    guard, axes, watch = make()
    for cycle in range(5):
        check(watch, cycle, awaited=0b01, phase=Phase.CAM)
    assert [trip.condition for trip in guard.tripped] == [Condition.AXIS_SILENT]
    assert axes[0].silent_cycles == 5
    guard, axes, watch = make()
    for cycle in range(29):
        check(watch, cycle, awaited=0b11, phase=Phase.CAM)
    # The TPDOs are missed, of each axis; neither is silent alone.
    assert [trip.condition for trip in guard.tripped] == [Condition.MISSED_TPDO] * 2
    check(watch, 30, awaited=0b11, phase=Phase.CAM)
    assert guard.tripped[-1].condition is Condition.BUS_OFF
    assert guard.reaction is Reaction.QUICK_STOP


def test_the_window_around_the_cam_and_the_end_effector():
    guard, axes, watch = make()
    # 20 deg are 227.6 counts: 228 trip it, and 50 mm are reached by no 19 deg of link s.
    axes[1].actual = -227
    check(watch, 0, phase=Phase.CAM)
    assert guard.tripped == []
    axes[1].actual = -228
    check(watch, 0)
    assert guard.tripped == []
    check(watch, 1, awaited=0, phase=Phase.CAM)
    assert [(trip.condition, trip.axis, trip.value, trip.limit) for trip in guard.tripped] == [
        (Condition.CAM_WINDOW, "", 228, 228)
    ]


def test_the_end_effectors_distance_by_hand():
    """A square of p = s = 1, q = r = 2, the pivots 2 apart: C stands symmetrically above the middle."""
    geometry = np.array([1.0, 2.0, 2.0, 1.0, 0.0, 0.0, 2.0, 0.0])
    # theta2 = theta5 = 90 deg: A (0, 1), D (2, 1), C = (1, 1 + sqrt 3). Turned by -90 deg each, C moves by (1, -1).
    quarter = math.pi / 2
    assert end_effector_miss(geometry, 1, quarter, quarter, quarter, quarter) == pytest.approx(math.sqrt(2.0))
    # No closure: far out of reach.
    far = np.array([1.0, 0.1, 0.1, 1.0, 0.0, 0.0, 9.0, 0.0])
    assert math.isnan(end_effector_miss(far, 1, 0.0, 0.0, 0.0, 0.0))


def test_a_torque_limit_below_what_the_cam_needs_would_always_trip():
    """The servo axis needs 0.74 N m of 1.5 N m rated in the return stroke (see the report of a run)."""
    low = parse_config(PAPER.text.replace("limit_permille: 2500", "limit_permille: 300"), PAPER.path)
    violations = [str(violation) for violation in prepare(low, 1, is_strict=False).violations]
    assert any("guard.torque.limit_permille: 300 would always trip, axis" in sentence for sentence in violations)
    assert prepare(PAPER, 1).violations == ()


def test_a_torque_limit_that_the_drive_never_reaches_is_refused_by_commissioning():
    strong = parse_config(PAPER.text.replace("limit_permille: 2500", "limit_permille: 9000"), PAPER.path)
    core = build_core(strong, PROFILE, prepare(PAPER, 1).plan, NoSink())
    bus = VirtualBus([core, build_machine(PAPER)], PAPER.bus.bit_rate)
    bus.run_while(lambda: not core.is_done, 1_000_000_000)
    assert "node 1 gives 3000 per mille of its rated torque at most (6072h)" in str(core.failure)


class NoSink:
    def append(self, *values):
        pass


def test_errors_that_are_passed_over_could_not_have_tripped():
    window = guard_limits(PAPER, slave_law(PAPER, PROFILE))[1]
    least = min(window.harmless_counts)
    # Counts of the resolver: an axis that follows as it should is passed over, one at its limit is not.
    assert 20 < least < 200
    random = np.random.default_rng(7)
    radius = least * window.rad_per_count[0]
    for theta2, share2, share5 in random.uniform((0.0, -1.0, -1.0), (math.tau, 1.0, 1.0), (2000, 3)).tolist():
        error2, error5 = share2 * radius, share5 * radius
        theta5 = PROFILE.at(theta2)[0]
        assert abs(theta5 - error5 - PROFILE.at(theta2 - error2)[0]) < window.window_rad
        miss = end_effector_miss(window.geometry, window.closure, theta2, theta5, error2, error5)
        assert miss < window.end_effector_m


def test_a_linkage_that_cannot_be_off_by_a_count_has_no_harmless_error():
    window = guard_limits(PAPER, slave_law(PAPER, PROFILE))[1]
    arguments = (window.geometry, window.closure, PROFILE.coefficients, PROFILE.net_turns)
    small = harmless_error(*arguments, window.window_rad, 1e-4)
    assert 0.0 < small < math.radians(0.1)
    assert harmless_error(*arguments, window.window_rad, 0.0) == 0.0
    apart = np.array([1.0, 1.0, 1.0, 1.0, 5.0, *window.geometry[5:]])
    assert greatest_deviation(apart, *arguments[1:], 0.01, 90)[1] == math.inf


@pytest.mark.parametrize("limit_mm", [50.0, 12.0])
def test_what_is_passed_over_changes_nothing_that_the_guard_says(limit_mm):
    random = np.random.default_rng(3)
    section = {"end_effector_error": PAPER.guard.end_effector_error.model_copy(update={"limit_mm": limit_mm})}
    config = PAPER.model_copy(update={"guard": PAPER.guard.model_copy(update=section)})
    window = guard_limits(config, slave_law(config, PROFILE))[1]
    limits = [NO_LIMITS, NO_LIMITS]
    outcomes = []
    errors = np.rint(random.laplace(0.0, 60.0, (3000, 2))).astype(int)
    angles = random.uniform(0.0, math.tau, 3000)
    for harmless in (window.harmless_counts, (-1, -1)):
        guard = Guard(config.guard, ("cv", "servo"))
        axes = [AxisChannel("cv", 1, UNITS, 2000), AxisChannel("servo", 2, UNITS, 2000)]
        watch = CycleWatch(guard, axes, limits, replace(window, harmless_counts=harmless))
        counts = []
        for cycle, (angle, (master, slave)) in enumerate(zip(angles.tolist(), errors.tolist(), strict=True)):
            for axis in axes:
                axis.statusword = ENABLED
            axes[0].actual, axes[1].actual = -master, -slave
            watch.check(0, [0, 0], [0, 0], [0.0, 0.0], angle, Phase.CAM, True, 0, cycle)
            counts.append([guard.is_holding(one, 0) for one in (Condition.CAM_WINDOW, Condition.END_EFFECTOR_ERROR)])
        outcomes.append((counts, [(trip.at_ns, trip.condition, trip.value) for trip in guard.tripped]))
    assert outcomes[0] == outcomes[1]
    assert sum(row[1] for row in outcomes[0][0]) > 10


def leap(back_after=None, counts=110):
    """An axis that goes 4 counts a cycle, and leaps in cycle 10."""
    return [(4 * n, 4 * n + (counts if 10 <= n < (back_after or 1000) else 0)) for n in range(40)]


def test_a_leap_that_stays_is_too_fast_and_a_glitch_that_goes_back_is_not():
    # Twice 20.5 counts in a cycle are a leap, and must stay for five cycles.
    for track, tripped, leapt in (
        (leap(), 14, 110),
        (leap(counts=-150), 14, -150),
        (leap(11), None, 0),
        (leap(13), None, 0),
        (leap(counts=42), 14, 42),
        (leap(counts=40), None, 0),
    ):
        guard, axes, watch = make()
        assert run(watch, axes, guard, track) == tripped
        assert not tripped or guard.tripped[0].condition is Condition.VELOCITY
        assert [axis.leapt for axis in axes] == [0, leapt]
        watch.begin()
        assert axes[1].leapt == 0


def test_a_leap_is_too_fast_where_every_other_tpdo_is_missing():
    for counts, is_tripped in ((110, True), (-150, True), (0, False)):
        guard, axes, watch = make()
        for cycle, (demand, actual) in enumerate(leap(counts=counts)):
            if cycle % 2 == 0:
                axes[1].actual = actual
            check(watch, cycle, demand, awaited=cycle % 2 << 1)
        assert [trip.condition for trip in guard.tripped] == [Condition.VELOCITY] * is_tripped
        assert axes[1].leapt == counts


def test_an_axis_whose_tpdo_has_been_missing_is_seen_rarely_for_a_while():
    _, axes, watch = make()
    check(watch, 0, awaited=0b10)
    check(watch, 1, awaited=0b10)
    for cycle in range(RARE_CYCLES):
        assert [bool(axis.rare_cycles) for axis in axes] == [False, True]
        check(watch, 2 + cycle)
    assert axes[1].rare_cycles == 0


def test_a_follower_that_is_driven_towards_a_far_target_and_stands_is_not_seen():
    """Three times 250 per mille, towards a target more than 11 counts away, and not a count for eight cycles."""
    for error, torque, moves, tripped in (
        (12, 751, False, 8),
        (-12, -751, False, 8),
        (12, 750, False, None),
        (11, 3000, False, None),
        (12, -3000, False, None),
        (12, 3000, True, None),
    ):
        guard, axes, watch = make()
        told = None
        for cycle in range(20):
            axes[1].actual = cycle // 7 if moves else 0
            axes[1].torque = torque
            check(watch, cycle, axes[1].actual + error, is_enabled=False, followers=0b10)
            told = cycle if guard.tripped and told is None else told
        assert told == tripped
        assert not tripped or guard.disabled == 0b10


class Driven:
    """A model by which the servo axis is driven in some cycles."""

    slack_permille = (60, 73)

    def __init__(self, acceleration, pauses=()):
        self.value, self.pauses = acceleration, pauses
        self.cycle, self.offsets = 0, []

    def acceleration(self, number, torque, torque_offset, velocities):
        if number == 0:
            return 0.0
        self.cycle += 1
        self.offsets.append(torque_offset)
        return 0.0 if self.cycle in self.pauses else self.value


@pytest.mark.parametrize(
    ("acceleration", "pauses", "moves_in", "tripped"),
    [
        # After four cycles n (n + 1) / 2 times a tenth of a count are more than 11 counts in the 15th; held for eight.
        (0.1, (), None, 26),
        (-0.1, (), None, 26),
        # A cycle in which friction holds it takes the way that it has by then, not how far it has come.
        (0.1, (10,), None, 32),
        # A count of movement takes both.
        (0.1, (), 12, 38),
        (0.0, (), None, None),
    ],
)
def test_an_axis_that_stands_where_it_would_have_gone_by_its_torque_is_not_seen(
    acceleration, pauses, moves_in, tripped
):
    guard, axes, watch = make(free_motion=Driven(acceleration, pauses))
    axes[1].torque = 200
    told = None
    for cycle in range(60):
        axes[1].actual = 1 if moves_in is not None and cycle >= moves_in else 0
        check(watch, cycle, phase=Phase.CAM)
        told = cycle if guard.tripped and told is None else told
    assert told == tripped
    if tripped:
        trip = guard.tripped[0]
        assert (trip.condition, trip.axis, trip.value, trip.limit) == (Condition.UNANSWERED_TORQUE, "servo", 200, 73)
        assert guard.disabled == 0b10


def test_only_at_rest_and_with_open_brakes_the_load_alone_counts():
    model = Driven(0.0)
    _, _, watch = make(free_motion=model)
    for cycle in range(6):
        check(watch, cycle, phase=Phase.STANDSTILL, offset=5)
    watch.trust_loads()
    check(watch, 2, phase=Phase.STANDSTILL, offset=5)
    check(watch, 3, phase=Phase.CAM, offset=5)
    watch.begin()
    check(watch, 4, phase=Phase.STANDSTILL, offset=5)
    assert model.offsets == [5, None, 5, 5]


def test_a_demand_that_comes_back_or_dithers_is_no_dead_resolver():
    """It stands at 0; the demand comes from 10 counts away, and dithers by one for long, but never goes 12 away."""
    guard, axes, watch = make()
    track = [(10 - n, 0) for n in range(10)] + [(n % 2, 0) for n in range(100)] + [(-n, 0) for n in range(12)]
    assert run(watch, axes, guard, track) is None
    assert run(watch, axes, guard, [(-12, 0)] * 4) == 3
    assert guard.tripped[0].condition is Condition.FROZEN_ACTUAL


def test_the_noise_of_a_coarse_resolver_is_no_leap():
    # A count and a half a cycle at most; it shows up to nine more, and comes back by halves, each for two cycles.
    guard, axes, watch = make(replace(LIMITS, velocity_counts_per_cycle=1.5))
    assert run(watch, axes, guard, [(n, n + (0, 9, 5, 0)[n // 2 % 4]) for n in range(100)]) is None
    assert axes[1].leapt == 0


@dataclass(frozen=True, slots=True)
class Push:
    torque_a_cycle: int
    offset_a_cycle: int = 0
    count_at: int = 1000
    blows: tuple[int, ...] = ()
    tripped_at: int | None = None


@pytest.mark.parametrize(
    "push",
    [
        # Standing since cycle 0; the middle one of its torques at 8, 16 and 24 is that at 16: 260 more, above 250, at
        # 42; held for 8 cycles.
        Push(10, tripped_at=42 + 7),
        Push(-10, tripped_at=42 + 7),
        # 7 of 10 are foreseen: 3 a cycle are above 250 from 84 cycles on.
        Push(10, 7, tripped_at=16 + 84 + 7),
        Push(10, 10),
        # The offset takes the load over from the controller.
        Push(0, 10),
        # One count in cycle 40 begins the standing anew.
        Push(10, count_at=40, tripped_at=40 + 16 + 26 + 7),
        # A blow of 800 in cycle 16 hits one of three; in cycles 16 and 24 it would be two.
        Push(0, blows=(16,)),
        Push(0, blows=(8,)),
        Push(0, blows=(16, 24), tripped_at=25 + 7),
        # 1 a cycle is above 125 from cycle 142 on, and half the limit is too much after 80 cycles of that.
        Push(1, tripped_at=142 + 80 + 7),
        Push(-1, tripped_at=142 + 80 + 7),
        # A count in cycle 200 begins the standing anew.
        Push(1, count_at=200),
    ],
)
def test_torque_that_grows_while_not_a_count_comes_of_it(push):
    guard, axes, watch = make()
    for cycle in range(300):
        axes[1].actual = int(cycle >= push.count_at)
        axes[1].torque = push.torque_a_cycle * min(cycle, 200) + 800 * (cycle in push.blows)
        check(watch, cycle, offset=push.offset_a_cycle * min(cycle, 200))
        if guard.tripped:
            assert guard.tripped[0].condition is Condition.UNANSWERED_TORQUE
            assert (cycle, guard.disabled) == (push.tripped_at, 0b10)
            return
    assert push.tripped_at is None


def test_an_axis_apart_from_its_cam_may_be_pushed():
    guard, axes, watch = make()
    watch._cam.law.is_plain = False
    for cycle in range(200):
        axes[1].torque = 10 * cycle
        check(watch, cycle)
    assert not guard.tripped


@pytest.mark.parametrize(("followers", "tripped"), [(0b10, True), (0, False), (0b01, False)])
def test_a_resolver_that_dies_in_a_coupled_stop_takes_the_torque_from_the_follower_alone(followers, tripped):
    guard, _, watch = make()
    for cycle in range(20):
        check(watch, cycle, 3 * cycle, is_enabled=False, followers=followers)
    assert [trip.condition for trip in guard.tripped] == [Condition.FROZEN_ACTUAL] * tripped
    assert guard.disabled == 0b10 * tripped


def test_a_way_gone_while_no_sync_was_sent_is_no_leap():
    guard, axes, watch = make()
    for cycle in range(40):
        axes[1].actual = 4 * cycle + (200 if cycle >= 20 else 0)
        if cycle == 20:
            watch.forget()
        check(watch, cycle, 4 * cycle)
    assert not guard.tripped
