"""Whole sessions of the gateway with the emulated machine, in virtual time, with and without failures."""

import json
import math
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from config.loading import load_config, parse_config
from drivers.cia402 import State, state_of
from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import GuardTripped, StopReason
from gateway.record.recording import read_recording
from gateway.record.sample import Phase, SampleLayout
from gateway.reporting.analysis import analyse
from gateway.running.assembly import build_core
from gateway.running.preparation import prepare
from gateway.running.virtual_run import run_virtual
from sim_drive.assembly import build_machine

PAPER = load_config("paper")
SECOND = 1_000_000_000
WITHOUT_FEED_FORWARD = ("feed_forward: {enabled: true}", "feed_forward: {enabled: false}")
"""With it, hardly any error is left that a guard could see."""
CV_TPDO, SERVO_TPDO, SERVO_HEARTBEAT = 0x181, 0x182, 0x702


def changed(*replacements):
    text = PAPER.text
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return parse_config(text, PAPER.path)


class Sink:
    """Keeps the samples of a session as one structured array."""

    def __init__(self):
        self.layout = SampleLayout(PAPER.axis_names)
        self.packed = bytearray()

    def append(self, *values):
        self.packed += self.layout.pack(*values)

    @property
    def samples(self):
        return np.frombuffer(bytes(self.packed), self.layout.dtype)


class Dropping:
    """Loses frames of one COB-ID from an instant on, for a span."""

    def __init__(self, cob_id, from_ns, span_ns):
        self.cob_id, self.from_ns, self.until_ns = cob_id, from_ns, from_ns + span_ns

    def delays_ns(self, sender, frame, now_ns, source):
        lost = frame.cob_id == self.cob_id and self.from_ns <= now_ns < self.until_ns
        return () if lost else (0,)


CAM_BOUND_COUNTS = 6
"""0.5 deg of link s; half a count of the master is up to one and a half of the slave's."""


class Session:
    """A gateway and an emulated machine on a virtual bus, with what happened in it."""

    def __init__(self, config=PAPER, machine_config=None, cycles=1, faults=None):
        self.config = config
        self.prepared = prepare(config, cycles)
        self.sink = Sink()
        self.machine = build_machine(machine_config or config)
        self.core = build_core(config, self.prepared.cam.profile, self.prepared.plan, self.sink)
        self.events = []
        self.frames = deque()
        self.bus = VirtualBus(
            [self.core, self.machine],
            config.bus.bit_rate,
            faults=faults,
            trace=lambda at_ns, frame: self.frames.append((at_ns, frame)),
            on_event=lambda node, event: self.events.append(event) if node == 0 else None,
        )

    def until(self, at_s):
        self.bus.run_until(round(at_s * SECOND))
        return self

    def to_end(self, limit_s=30.0):
        self.bus.run_while(lambda: not self.core.is_done, round(limit_s * SECOND))
        assert self.core.is_done
        self.bus.run_until(self.bus.now_ns + SECOND // 2)
        return self

    @property
    def trips(self):
        return [event for event in self.events if isinstance(event, GuardTripped)]

    def states(self):
        return [state_of(axis.statusword) for axis in self.core.loop.steering.axes]

    def assert_safe(self):
        """No drive has torque, nothing moves, the linkage is whole, and all of it stays so."""
        plant = self.machine.plant
        assert plant.torn_at_s is None
        assert not any(drive.is_powered for drive in self.machine.drives)
        before = [plant.angle(axis) for axis in (0, 1)]
        self.bus.run_until(self.bus.now_ns + SECOND // 5)
        assert [plant.angle(axis) for axis in (0, 1)] == pytest.approx(before, abs=1e-4)

    def cam_distance_counts(self):
        """Greatest distance of the servo axis from the cam of the CV axis' actual position while enabled, in counts."""
        samples = self.sink.samples
        moving = np.isin(samples["phase"], [Phase.RAMP_UP, Phase.CAM, Phase.RAMP_DOWN, Phase.CONTROLLED_STOP])
        actual = samples["position_actual"][moving & (samples["flags"] == 0)]
        theta2 = actual[:, 0] * math.tau / 4096
        theta5 = self.prepared.cam.profile.at_many(theta2)[:, 0]
        return float(np.abs(actual[:, 1] - theta5 * 4096 / math.tau).max())


@pytest.fixture(scope="module")
def completed():
    return Session().to_end()


def test_a_run_completes_on_the_cam_and_leaves_the_drives_disabled(completed):
    assert completed.core.failure is None
    assert completed.core.stopped_by is StopReason.COMPLETED
    assert completed.trips == []
    assert completed.states() == [State.SWITCH_ON_DISABLED] * 2
    completed.assert_safe()
    assert completed.cam_distance_counts() < CAM_BOUND_COUNTS


def test_phases_come_in_their_order_and_the_run_ends_where_it_began(completed):
    samples = completed.sink.samples
    phases = [int(phase) for phase in samples["phase"]]
    order = [phase for i, phase in enumerate(phases) if i == 0 or phases[i - 1] != phase]
    assert order == [
        Phase.COMMISSIONING,
        Phase.STANDSTILL,
        Phase.RAMP_UP,
        Phase.CAM,
        Phase.RAMP_DOWN,
        Phase.STANDSTILL,
        Phase.DISABLED,
    ]
    end = samples["master_position"][-1]
    assert end % math.tau == pytest.approx(0.0, abs=1e-6) or end % math.tau == pytest.approx(math.tau, abs=1e-6)
    cruise = samples[samples["phase"] == Phase.CAM]
    assert cruise["master_position"][-1] - cruise["master_position"][0] >= math.tau - 0.01
    assert np.all(cruise["master_velocity"] == pytest.approx(math.tau))


def test_the_demand_of_a_sample_is_the_drives_own_position_demand_at_that_sync(completed):
    """6062h at SYNC(k), read straight from the emulated drive, against the gateway's account."""
    session = Session()
    seen = {}

    def remember(at_ns, frame):
        if frame.cob_id == 0x080:
            drive = session.machine.drives[1]
            seen[at_ns] = drive.position_demand_counts

    session.bus._trace = remember
    session.until(2.5)
    samples = session.sink.samples
    in_motion = samples[samples["phase"] == Phase.CAM]
    # The drive interpolates at its own servo ticks: at SYNC its demand is at most one tick (0.98 ms) old.
    wire_ns = 55_000
    differences = [
        sample["position_demand"][1] - seen[int(sample["sync_ns"]) + wire_ns]
        for sample in in_motion
        if int(sample["sync_ns"]) + wire_ns in seen
    ]
    velocity = np.abs(in_motion["demand_velocity"][: len(differences), 1]) * 4096 / math.tau
    assert len(differences) > 200
    assert np.all(np.abs(differences) <= velocity * 1.06e-3 + 1.0)


def test_two_runs_with_one_seed_are_byte_identical_and_another_seed_differs_with_noise(tmp_path):
    config = changed(("brake_torque_Nm: 6.0", "brake_torque_Nm: 6.0\n      resolver_noise_counts: 0.5"))
    prepared = prepare(config, 1)
    paths = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        path = tmp_path / f"{name}.mcap"
        run_virtual(prepared, build_machine(config, seed), path, "", seed)
        paths.append(path)
    first, second, other = (path.read_bytes() for path in paths)
    assert first == second
    assert first != other
    reports = [analyse(read_recording(path)).to_json() for path in paths]
    for report in reports:
        report.pop("recording")
    assert json.dumps(reports[0]) == json.dumps(reports[1])
    assert json.dumps(reports[0]) != json.dumps(reports[2])


def test_the_bus_carries_sync_tpdos_and_rpdos_in_every_cycle(completed):
    cob_ids = [frame.cob_id for _, frame in completed.frames]
    first = cob_ids.index(0x080)
    last = len(cob_ids) - 1 - cob_ids[::-1].index(0x080)
    cyclic = [cob_id for cob_id in cob_ids[first:last] if cob_id in {0x080, 0x181, 0x182, 0x201, 0x202}]
    syncs = cyclic.count(0x080)
    body = cyclic[len(cyclic) // 10 :]
    start = body.index(0x080)
    assert body[start : start + 500] == [0x080, 0x181, 0x182, 0x201, 0x202] * 100
    assert abs(syncs - completed.core.loop.cycle) <= 1


# -- commissioning says no ------------------------------------------------------------------------------------------


def assert_refused(session, *sentences):
    session.to_end()
    message = str(session.core.failure)
    for sentence in sentences:
        assert sentence in message
    assert session.core.stopped_by is StopReason.COMMISSIONING
    assert not any(drive.is_powered for drive in session.machine.drives)
    session.assert_safe()


def test_an_absent_drive_is_named_and_nothing_is_enabled():
    strange = changed(("node_id: 2", "node_id: 5"))
    session = Session(machine_config=strange)
    assert_refused(session, "axis servo: node 2: no answer within 2 s while waiting for its boot-up message")
    assert 0x080 not in {frame.cob_id for _, frame in session.frames}


def test_both_drives_are_reported_at_once():
    wrong = changed(("product_code: 0x00001024", "product_code: 0x00009999"))
    assert_refused(
        Session(wrong, PAPER),
        "axis cv: node 1 has product code 00001024h, the configuration says 00009999h",
        "axis servo: node 2 has product code 00001024h, the configuration says 00009999h",
    )


def test_another_encoder_than_configured_is_refused():
    wrong = changed(("counts_per_revolution: 4096", "counts_per_revolution: 8192"))
    assert_refused(Session(wrong, PAPER), "4096 increments in 1 revolutions (608Fh), the configuration says 8192")


def test_a_drive_that_sends_no_tpdo_is_refused():
    session = Session(faults=Dropping(SERVO_TPDO, 0, 100 * SECOND))
    assert_refused(session, "axis servo: no TPDO 182h arrives after SYNC")


def test_a_drive_whose_heartbeat_never_comes_is_refused_before_any_is_enabled():
    """Its boot-up message apart, which has the same COB-ID."""
    session = Session(faults=Dropping(SERVO_HEARTBEAT, 2_000_000, 100 * SECOND))
    assert_refused(session, "axis servo: node 2: no answer within 0.2 s while waiting for its heartbeat")
    assert 0x080 not in {frame.cob_id for _, frame in session.frames}


def test_a_run_from_another_home_ends_there():
    """Homed on the current position, the next run takes the place where this one ended for its home."""
    theta5_deg = math.degrees(prepare(PAPER).cam.profile.at(math.pi / 2)[0])
    master, slave = PAPER.text.split("  servo:\n")
    master = master.replace("home_angle_deg: 0.0", "home_angle_deg: 90.0")
    slave = slave.replace("home_angle_deg: 0.0", f"home_angle_deg: {theta5_deg}")
    session = Session(parse_config(master + "  servo:\n" + slave, PAPER.path)).to_end()
    assert session.core.stopped_by is StopReason.COMPLETED
    # Three revolutions: the cycle asked for, and two for the ramps.
    assert math.degrees(session.machine.plant.angle(0)) == pytest.approx(90.0 + 3 * 360.0, abs=2.0)
    assert math.degrees(session.machine.plant.angle(1)) == pytest.approx(theta5_deg, abs=2.0)


def test_a_cam_that_starts_elsewhere_is_refused():
    master, slave = PAPER.text.split("  servo:\n")
    slave = slave.replace("home_angle_deg: 0.0", "home_angle_deg: 5.0").replace(
        "homing_method: 37", "homing_method: null"
    )
    text = master + "  servo:\n" + slave
    session = Session(parse_config(text, PAPER.path), PAPER)
    assert_refused(session, "axis servo: stands at 0 counts, the cam starts at -57, which is more than 20 counts away")


# -- the guard's reactions ------------------------------------------------------------------------------------------


def test_missed_tpdos_stop_the_machine_on_the_cam():
    patient = changed(("axis_silent: {persistence_cycles: 5", "axis_silent: {persistence_cycles: 199"))
    session = Session(patient, cycles=5, faults=Dropping(SERVO_TPDO, 3 * SECOND, 50_000_000)).to_end()
    assert session.core.stopped_by is StopReason.MISSED_TPDO
    assert [(trip.condition.value, trip.axis) for trip in session.trips] == [("missed_tpdo", "servo")]
    assert Phase.CONTROLLED_STOP in session.sink.samples["phase"]
    assert session.cam_distance_counts() < CAM_BOUND_COUNTS
    session.assert_safe()


def test_fewer_missed_tpdos_than_the_persistence_only_count():
    session = Session(faults=Dropping(SERVO_TPDO, 2 * SECOND, 3_900_000)).to_end()
    assert session.core.stopped_by is StopReason.COMPLETED
    missed = session.sink.samples["flags"] & 2 != 0
    assert 3 <= np.count_nonzero(missed) <= 4


def test_an_emergency_makes_a_quick_stop():
    session = Session(cycles=5).until(3.0)
    session.machine.drives[0].trip(0x4210, 0x09, session.bus.now_ns)
    session.bus.refresh()
    session.to_end()
    assert session.core.stopped_by in {StopReason.EMERGENCY, StopReason.DRIVE_FAULT}
    assert "emergency" in {trip.condition.value for trip in session.trips} | {"emergency"}
    assert Phase.QUICK_STOP in session.sink.samples["phase"]
    # The fault has been reset after the stop, and nothing was enabled again.
    assert session.states() == [State.SWITCH_ON_DISABLED] * 2
    session.assert_safe()


def test_a_lost_heartbeat_makes_a_quick_stop():
    session = Session(cycles=5, faults=Dropping(SERVO_HEARTBEAT, 3 * SECOND, 100 * SECOND)).to_end()
    assert session.core.stopped_by is StopReason.HEARTBEAT_LOST
    assert session.trips[0].axis == "servo"
    session.assert_safe()


def test_a_following_error_beyond_its_limit_makes_a_quick_stop():
    tight = changed(("following_error_counts: 300", "following_error_counts: 12"), WITHOUT_FEED_FORWARD)
    session = Session(tight, PAPER, cycles=5).to_end()
    assert session.core.stopped_by in {StopReason.FOLLOWING_ERROR, StopReason.EMERGENCY}
    session.assert_safe()


def test_a_warning_only_warns():
    lenient = changed(
        ("following_error_counts: 300", "following_error_counts: 12"),
        WITHOUT_FEED_FORWARD,
        ("persistence_cycles: 1, reaction: quick_stop", "persistence_cycles: 1, reaction: warn"),
        ("emergency: {reaction: quick_stop}", "emergency: {reaction: warn}"),
        ("drive_fault: {reaction: quick_stop}", "drive_fault: {reaction: warn}"),
    )
    session = Session(lenient, lenient)
    # The drive's own window is left wide open: only the gateway's guard is meant here.
    session.until(0.03)
    for drive in session.machine.drives:
        drive.dictionary.write(0x6065, 0, (0xFFFFFFFF).to_bytes(4, "little"), session.bus.now_ns)
    session.to_end()
    assert session.core.stopped_by is StopReason.COMPLETED
    assert {trip.condition.value for trip in session.trips} == {"following_error"}
    assert all(trip.reaction.value == "warn" for trip in session.trips)


@pytest.mark.parametrize(
    "at_s", [0.01, 0.5, 2.0, *(pytest.param(at_s, marks=pytest.mark.slow) for at_s in (0.03, 0.05, 1.4, 4.9))]
)
def test_an_operators_stop_at_any_time_ends_safely_on_the_cam(at_s):
    session = Session(cycles=2).until(at_s)
    session.core.request_stop()
    session.bus.refresh()
    session.to_end()
    assert session.core.stopped_by is StopReason.OPERATOR
    assert session.core.failure is None
    if Phase.RAMP_UP in session.sink.samples["phase"]:
        assert session.cam_distance_counts() < CAM_BOUND_COUNTS
    session.assert_safe()


def test_a_stop_asked_for_again_and_again_is_one_stop():
    session = Session(cycles=2).until(2.0)
    for _ in range(2000):
        session.core.request_stop()
        if session.core.is_done:
            break
        session.bus.run_until(session.bus.now_ns + 1_000_000)
    session.to_end()
    assert session.core.stopped_by is StopReason.OPERATOR
    session.assert_safe()


def test_a_gateway_that_falls_silent_stops_the_machine():
    """The drives watch the gateway's heartbeat and its SYNC: a killed gateway leaves nothing moving."""
    session = Session(cycles=5).until(3.0)
    machine = session.machine
    alone = VirtualBus([machine], session.config.bus.bit_rate, start_ns=session.bus.now_ns)
    alone.run_until(session.bus.now_ns + SECOND)
    assert not any(drive.is_powered for drive in machine.drives)
    before = [machine.plant.angle(axis) for axis in (0, 1)]
    alone.run_until(alone.now_ns + SECOND)
    assert [machine.plant.angle(axis) for axis in (0, 1)] == pytest.approx(before, abs=1e-6)
    assert machine.plant.torn_at_s is None


def next_session(session, **options):
    """Another gateway on the machine that a session has left behind, on a bus of its own at the same time."""
    following = Session(cycles=1, **options)
    following.machine = session.machine
    following.bus = VirtualBus(
        [following.core, session.machine],
        session.config.bus.bit_rate,
        start_ns=session.bus.now_ns,
        trace=lambda at_ns, frame: following.frames.append((at_ns, frame)),
        on_event=lambda node, event: following.events.append(event) if node == 0 else None,
    )
    return following


def test_a_second_run_goes_on_from_where_the_first_ended_without_homing_anew():
    first = Session().to_end()
    second = next_session(first)
    second.bus.run_while(lambda: not second.core.is_done, second.bus.now_ns + 30 * SECOND)
    assert second.core.failure is None
    assert second.core.stopped_by is StopReason.COMPLETED
    turned = round(first.prepared.plan.end_position / math.tau)
    start = second.sink.samples["position_demand"][second.sink.samples["phase"] == Phase.RAMP_UP][0]
    # It has sagged a little when the brake took over, and is taken back smoothly.
    assert start[0] == pytest.approx(turned * 4096, abs=20)
    demand = second.sink.samples["position_demand"][second.sink.samples["phase"] == Phase.RAMP_UP]
    assert np.abs(np.diff(demand[:300], axis=0)).max() <= 3
    assert "axis cv is homed already" in [event.step for event in second.events if hasattr(event, "step")]
    assert second.cam_distance_counts() < CAM_BOUND_COUNTS
    second.assert_safe()


def test_a_machine_left_away_from_home_is_not_homed_where_it_happens_to_stand():
    first = Session(cycles=5).until(3.0)
    machine = first.machine
    VirtualBus([machine], first.config.bus.bit_rate, start_ns=first.bus.now_ns).run_until(4 * SECOND)
    second = next_session(first)
    second.bus = VirtualBus([second.core, machine], 1_000_000, start_ns=4 * SECOND)
    second.bus.run_while(lambda: not second.core.is_done, 10 * SECOND)
    assert "bring the linkage to its home position" in str(second.core.failure)
    assert second.core.stopped_by is StopReason.COMMISSIONING
    assert not any(drive.is_powered for drive in machine.drives)
    assert Phase.RAMP_UP not in second.sink.samples["phase"]


def test_after_a_run_the_drives_do_not_miss_the_gateway():
    session = Session().to_end()
    session.bus.run_until(session.bus.now_ns + SECOND)
    emergencies = [frame for _, frame in session.frames if frame.cob_id in {0x081, 0x082}]
    assert emergencies == []


def test_the_recording_of_a_run_holds_everything_a_report_needs(tmp_path):
    path = Path(tmp_path, "run.mcap")
    prepared = prepare(PAPER, 1)
    run_virtual(prepared, build_machine(PAPER), path, "", 0)
    recording = read_recording(path)
    report = analyse(recording).to_json()
    assert recording.config_text == PAPER.text
    assert report["stopped_by"] == "completed"
    assert report["machine_cycles"] == 1
    servo = report["axes"]["servo"]
    assert servo["demand_velocity_rad_per_s"]["max"] == pytest.approx(4.48, rel=0.01)
    assert servo["demand_velocity_rad_per_s"]["min"] == pytest.approx(-18.96, rel=0.01)
    assert servo["displacement_deg"] == pytest.approx(99.8, abs=2.0)
    assert abs(servo["following_error_counts"]["min"]) < 60
    assert report["cycle"]["missed_tpdo"] == 0


# -- between enabling and motion, and after it ----------------------------------------------------------------------


def standstill_at_s():
    """When the drives are enabled and stand under guard, before the motion begins."""
    samples = Session().until(0.3).sink.samples
    return float(samples["sync_ns"][samples["phase"] == Phase.STANDSTILL][0]) / SECOND


def test_what_calls_for_a_stop_before_the_motion_calls_for_none():
    from_ns = round((standstill_at_s() + 0.02) * SECOND)
    session = Session(faults=Dropping(SERVO_TPDO, from_ns, 30_000_000)).to_end()
    assert session.core.stopped_by is StopReason.AXIS_SILENT
    assert Phase.RAMP_UP not in session.sink.samples["phase"]
    session.assert_safe()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("before_s", [0.06, 0.03, 0.012, 0.008, 0.004, -0.02])
def test_a_drive_that_restarts_after_it_was_configured_never_sees_motion(axis, before_s):
    session = Session().until(standstill_at_s() - before_s)
    session.machine.drives[axis]._reset(True, session.bus.now_ns)
    session.bus.refresh()
    session.to_end()
    assert Phase.RAMP_UP not in session.sink.samples["phase"]
    assert session.core.stopped_by is not StopReason.COMPLETED
    session.assert_safe()


def test_a_quick_stop_before_the_motion_is_one():
    session = Session().until(standstill_at_s() + 0.05)
    session.core.request_quick_stop()
    session.bus.refresh()
    session.to_end()
    phases = set(session.sink.samples["phase"])
    assert Phase.QUICK_STOP in phases
    assert Phase.RAMP_UP not in phases
    session.assert_safe()


def test_a_quick_stop_asked_for_again_and_again_leaves_no_torque():
    """With 605Ah = 6 a drive stays in Quick stop active, with torque, until it is told to leave it."""
    session = Session(cycles=3).until(2.0)
    for drive in session.machine.drives:
        drive.dictionary.write(0x605A, 0, (6).to_bytes(2, "little"), session.bus.now_ns)
    for _ in range(3000):
        session.core.request_quick_stop()
        if session.core.is_done:
            break
        session.bus.run_until(session.bus.now_ns + 1_000_000)
    session.to_end()
    assert session.core.failure is None
    session.assert_safe()


def test_drives_that_do_not_confirm_go_on_watching_the_gateway():
    """Their TPDOs are lost, so nobody knows; they must stop by themselves when the gateway's heartbeat ends."""
    session = Session(cycles=3, faults=Dropping(SERVO_TPDO, 2 * SECOND, 100 * SECOND)).to_end()
    assert "did not confirm that they are disabled" in str(session.core.failure)
    consumer = session.machine.drives[1].dictionary.read(0x1016, 1, session.bus.now_ns)
    assert int.from_bytes(consumer, "little") == 0x7F00C8
