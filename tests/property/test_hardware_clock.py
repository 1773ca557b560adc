"""Hardware stamps on the host's clock: drift, jitter, steps, gaps and counters that begin anew."""

import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.hardware_clock import MAX_DRIFT, STEP_NS, WINDOW_NS, WRAP_NS, HardwareClock
from drivers.hardware_stamps import offers_both, why_no_hardware_stamps

EPOCH_NS = 10**15
LEAST_LATENESS_NS = 5_000
"""What no frame's way through the kernel is shorter than: it cannot be seen, and is in every result."""
EVERY_NS = 333_333
SECOND = 1_000_000_000
MS = 1_000_000


class Bus:
    """Frames at true instants, stamped by a controller of a given drift and by a kernel that is late at random."""

    def __init__(self, drift=0.0, seed=0, mean_lateness_ns=60_000, hardware_epoch_ns=123_456_789_012):
        self.clock = HardwareClock()
        self.drift = drift
        self.random = random.Random(seed)
        self.mean_ns = mean_lateness_ns
        self.hardware_ns = hardware_epoch_ns
        self.true_ns = 0
        self.software_ns = 0
        self.errors = []
        self.modulus = None

    def pass_time(self, span_ns):
        self.true_ns += span_ns
        self.hardware_ns += round(span_ns * (1.0 - self.drift))

    def frame(self, more_ns=0):
        lateness_ns = LEAST_LATENESS_NS + int(self.random.expovariate(1.0 / self.mean_ns)) + more_ns
        # The kernel's stamps are in order, as the frames are.
        self.software_ns = max(self.software_ns, EPOCH_NS + self.true_ns + lateness_ns)
        stamp_ns = self.hardware_ns if self.modulus is None else self.hardware_ns % self.modulus
        arrival_ns = self.clock.arrival_ns(stamp_ns // 1000 * 1000, self.software_ns)
        assert arrival_ns <= self.software_ns
        self.errors.append(arrival_ns - EPOCH_NS - self.true_ns - LEAST_LATENESS_NS)

    def run(self, span_s, every_ns=EVERY_NS):
        for _ in range(round(span_s * SECOND / every_ns)):
            self.pass_time(every_ns)
            self.frame()
        return self

    def worst_of_last(self, span_s, every_ns=EVERY_NS):
        return max(map(abs, self.errors[-round(span_s * SECOND / every_ns) :]))


@pytest.mark.parametrize("drift", [0.0, 100e-6, -100e-6, 400e-6, -400e-6])
def test_after_a_few_seconds_the_bus_is_known_to_microseconds_whatever_the_quartz(drift):
    bus = Bus(drift).run(6.0)
    # A stamp of whole microseconds, and the best of 750 frames of a mean lateness of 60 us.
    assert bus.worst_of_last(1.0) < 3_000
    assert bus.clock.drift == pytest.approx(drift, abs=3e-6)
    assert bus.clock.step_count == 0


def test_while_nothing_is_known_of_the_drift_an_error_is_what_it_makes_in_two_windows():
    for drift in (100e-6, -100e-6):
        errors = Bus(drift).run(2.0).errors
        assert max(map(abs, errors[100:])) < 100e-6 * 2 * WINDOW_NS + 10_000
        # The kernel's own stamps are that late with every other frame.
        assert max(map(abs, errors[100:])) < 60_000


def test_a_host_that_was_away_makes_its_frames_late_but_not_their_arrivals():
    bus = Bus(50e-6).run(4.0)
    for _ in range(30):
        bus.pass_time(EVERY_NS)
        bus.frame(more_ns=12 * MS)
    assert max(map(abs, bus.errors[-30:])) < 5_000
    assert bus.clock.step_count == 0


def test_a_longer_absence_is_told_by_the_kernels_stamps_and_forgets_nothing():
    bus = Bus(50e-6).run(4.0)
    for _ in range(30):
        bus.pass_time(EVERY_NS)
        bus.frame(more_ns=STEP_NS + 30 * MS)
    bus.pass_time(100 * MS)
    bus.run(0.1)
    assert bus.worst_of_last(0.1) < 5_000
    assert bus.clock.step_count == 0


@pytest.mark.parametrize("step_ns", [3600 * SECOND, -3600 * SECOND, 30 * MS, -30 * MS])
def test_a_controllers_clock_that_is_set_anew_is_followed(step_ns):
    bus = Bus(100e-6).run(3.0)
    bus.hardware_ns += step_ns
    bus.run(5.0)
    assert bus.clock.step_count == 1
    assert bus.worst_of_last(0.5) < 3_000


def test_a_stamp_from_the_future_is_believed_at_once_to_be_of_a_clock_set_anew():
    bus = Bus(0.0).run(1.0)
    bus.hardware_ns += 30 * MS
    bus.run(0.05)
    assert bus.clock.step_count == 1
    # Late by as little as the best of these frames, no more by what the kernel took for each.
    assert bus.worst_of_last(0.02) < 5_000


def test_a_counter_of_32_bits_of_microseconds_begins_anew_without_a_step():
    bus = Bus(-80e-6, hardware_epoch_ns=WRAP_NS - 5 * SECOND)
    bus.modulus = WRAP_NS
    bus.run(4.5)
    before = len(bus.errors)
    bus.run(2.0)
    assert max(map(abs, bus.errors[before:])) < 3_000
    assert bus.clock.step_count == 0


def test_a_pause_of_a_minute_does_no_harm():
    bus = Bus(100e-6).run(4.0)
    bus.pass_time(60 * SECOND)
    before = len(bus.errors)
    bus.run(2.0)
    # The first frames are told by the kernel's stamps until one comes that is hardly late.
    assert max(map(abs, bus.errors[before + 200 :])) < 5_000
    assert bus.worst_of_last(0.5) < 3_000


@settings(max_examples=40)
@given(
    st.integers(0, 1 << 30),
    st.floats(-MAX_DRIFT, MAX_DRIFT),
    st.lists(
        st.tuples(st.integers(1, 50 * MS), st.integers(0, 60 * MS), st.sampled_from((0, 0, 0, 30 * MS, -5 * SECOND))),
        min_size=1,
        max_size=300,
    ),
)
def test_no_arrival_runs_backwards_or_is_later_than_the_kernel_saw_it_or_much_earlier(seed, drift, frames):
    bus = Bus(drift, seed)
    before_ns = 0
    for span_ns, more_ns, step_ns in frames:
        bus.pass_time(span_ns)
        bus.hardware_ns += step_ns
        bus.frame(more_ns)
        arrival_ns = bus.errors[-1] + EPOCH_NS + bus.true_ns + LEAST_LATENESS_NS
        assert before_ns <= arrival_ns <= bus.software_ns
        assert arrival_ns >= bus.software_ns - STEP_NS
        before_ns = arrival_ns


@settings(max_examples=200)
@given(st.lists(st.tuples(st.integers(0, 1 << 63), st.integers(0, 1 << 63)), max_size=30))
def test_any_stamps_at_all_are_answered(stamps):
    clock = HardwareClock()
    for hardware_ns, software_ns in stamps:
        assert clock.arrival_ns(hardware_ns, software_ns) <= software_ns


def test_the_interfaces_offer_is_read_as_the_header_has_it():
    both = struct.pack("=IIiI3II3I", 0x41, 0x5F, 0, 3, 0, 0, 0, 3, 0, 0, 0)
    software = struct.pack("=IIiI3II3I", 0x41, 0x1A, -1, 0, 0, 0, 0, 0, 0, 0, 0)
    assert len(both) == 44
    assert offers_both(both)
    assert not offers_both(software)
    assert not offers_both(struct.pack("=IIiI3II3I", 0x41, 0x04, 0, 0, 0, 0, 0, 0, 0, 0, 0)), "not raw"


@pytest.mark.parametrize("name", ["nosuchcan9", "a-name-that-is-too-long-for-any-interface", ""])
def test_an_interface_that_is_not_there_has_none_and_why(name):
    assert why_no_hardware_stamps(name)
