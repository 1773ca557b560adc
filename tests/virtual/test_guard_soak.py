"""Hours of machine time with random faults: every stop within its bound, no exception, no leak.

``DRIVE_GATEWAY_SOAK_HOURS`` sets the machine hours (default 0.08, some thirty seconds of processor time).
"""

import gc
import math
import os
import random
import time
import tracemalloc

import pytest
from guarded_machine import CV, PAPER, SECOND, SERVO, changed, prepared_run

from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import GuardTripped, StopReason
from gateway.running.assembly import build_core
from gateway.running.recovery import AxisRecovered
from sim_drive.assembly import build_machine
from sim_drive.injection.faults import Direction, Fault, FaultKind
from sim_drive.injection.injector import Injector

HOURS = float(os.environ.get("DRIVE_GATEWAY_SOAK_HOURS", "0.08"))
LASTING = (FaultKind.FROZEN_RESOLVER,)
STOP_BOUND_S = 2.5
"""From the first trip to drives without torque: a controlled stop at 60 rpm takes 1.4 s, settling and disabling 0.7."""
LEAST_SINE = 0.7
NOISY = changed(("brake_torque_Nm: 6.0", "brake_torque_Nm: 6.0\n      resolver_noise_counts: 0.3"))


def random_fault(source):
    node, at_s, span_s = source.choice((CV, SERVO)), source.uniform(0.0, 4.0), source.uniform(0.002, 0.5)
    tpdo = {"cob_id": 0x180 + node, "direction": Direction.SENT}
    return source.choice(
        (
            lambda: Fault(FaultKind.OVER_CURRENT, node, at_s),
            lambda: Fault(FaultKind.OVER_VOLTAGE, node, at_s),
            lambda: Fault(FaultKind.SAFE_TORQUE_OFF, node, at_s, span_s),
            lambda: Fault(FaultKind.FROZEN_RESOLVER, node, source.uniform(1.0, 4.0), span_s),
            lambda: Fault(FaultKind.JUMPING_RESOLVER, node, at_s, span_s, counts=source.choice((-400, 15, 250))),
            lambda: Fault(FaultKind.MUTE_HEARTBEAT, node, at_s, span_s),
            lambda: Fault(FaultKind.NODE_RESET, node, at_s),
            lambda: Fault(FaultKind.POWER_CYCLE, node, at_s, span_s),
            lambda: Fault(FaultKind.BUS_OFF, node, at_s, span_s),
            lambda: Fault(FaultKind.ERROR_PASSIVE, node, at_s, span_s),
            lambda: Fault(FaultKind.LOST_FRAMES, node, at_s, span_s, probability=source.uniform(0.01, 1.0), **tpdo),
            lambda: Fault(FaultKind.LATE_FRAMES, node, at_s, span_s, delay_s=source.uniform(1e-4, 3e-3), **tpdo),
            lambda: Fault(FaultKind.REORDERED_FRAMES, node, at_s, span_s, probability=0.1),
            lambda: Fault(FaultKind.DOUBLED_FRAMES, node, at_s, span_s, probability=0.3),
        )
    )()


class Soak:
    """One session after the other, each with a machine of its own and up to two faults."""

    def __init__(self):
        self.machine_s = 0.0
        self.sessions = 0
        self.reasons = {}
        self.worst_stop_s = 0.0
        self.least_sine = 1.0

    def append(self, *values):
        """No samples are kept."""

    def session(self, seed):
        source = random.Random(seed)
        faults = [random_fault(source) for _ in range(source.choice((1, 1, 2)))]
        prepared = prepared_run(NOISY.text, NOISY.path, 2)
        machine = build_machine(NOISY, seed, record_ticks=8192)
        core = build_core(NOISY, prepared.cam.profile, prepared.plan, self)
        events = []
        bus = VirtualBus(
            [core, Injector(machine, faults, seed)],
            PAPER.bus.bit_rate,
            seed,
            on_event=lambda _, event: events.append(event),
        )
        bus.run_while(lambda: not core.is_done, 40 * SECOND)
        bus.run_until(bus.now_ns + SECOND // 5)
        assert core.is_done, faults
        assert machine.plant.torn_at_s is None, faults
        assert not any(drive.is_powered for drive in machine.drives), faults
        self._judge(machine, events, faults)
        self.machine_s += bus.now_ns / SECOND
        self.sessions += 1
        self.reasons[core.stopped_by] = self.reasons.get(core.stopped_by, 0) + 1

    def _judge(self, machine, events, faults):
        trip = next(
            (event for event in events if isinstance(event, GuardTripped) and event.reaction.value != "warn"), None
        )
        if trip is None:
            return
        records = [record for record in machine.records if record.at_ns >= trip.at_ns]
        powered = [record.at_ns for record in records if any(record.torque_commands_Nm)]
        stop_s = (max(powered, default=trip.at_ns) - trip.at_ns) / SECOND
        self.worst_stop_s = max(self.worst_stop_s, stop_s)
        assert stop_s < STOP_BOUND_S, faults
        five_bar, closure = machine.plant.parameters.dynamics.five_bar, machine.plant.parameters.closure
        for record in records[::8]:
            sine = abs(float(five_bar.transmission_sines(*record.angles_rad, closure)[..., 0]))
            assert not math.isnan(sine)
            self.least_sine = min(self.least_sine, sine)
            # An axis whose resolver froze before its first motion sinks unseen.
            assert sine > LEAST_SINE or any(fault.kind in LASTING for fault in faults), faults
        assert any(isinstance(event, AxisRecovered) for event in events), faults


def kept_by(soak, seed):
    """Bytes that three sessions leave behind; tracing costs so much that the others go without."""
    gc.collect()
    tracemalloc.start()
    try:
        for more in range(3):
            soak.session(seed + more)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_a_soak_with_random_faults():
    soak = Soak()
    for seed in range(3):
        soak.session(seed)
    gc.collect()
    objects, seed, started = len(gc.get_objects()), 3, time.process_time()
    before_s = soak.machine_s
    while soak.machine_s < HOURS * 3600.0:
        soak.session(seed)
        seed += 1
    spent_s = time.process_time() - started
    per_hour_s = spent_s / max(soak.machine_s - before_s, 1.0) * 3600.0
    kept = kept_by(soak, seed)
    counted = ", ".join(
        f"{reason.value} {count}" for reason, count in sorted(soak.reasons.items(), key=lambda r: -r[1])
    )
    print(
        f"\n{soak.machine_s / 3600.0:.3f} machine hours in {soak.sessions} sessions, {spent_s:.0f} s of processor time "
        f"({24.0 * per_hour_s / 3600.0:.1f} h for 24); longest stop {soak.worst_stop_s:.2f} s, "
        f"least sine {soak.least_sine:.2f}, {kept / 1024:.0f} KiB kept; {counted}"
    )
    assert len(gc.get_objects()) - objects < 2000
    assert kept < 500_000
    assert StopReason.COMPLETED in soak.reasons
    assert len(soak.reasons) >= min(5, soak.sessions // 6)
