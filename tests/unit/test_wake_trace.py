"""What is said of late cycles, with a kernel that is made up."""

from pathlib import Path

import pytest

from gateway.running.wake_trace import ThreadFigures, WakeTrace, read_steal_ns, read_thread, read_waited_ns

MS = 1_000_000


class Kernel:
    def __init__(self):
        self.switches = self.minor = self.major = self.now_ns = self.stat_reads = 0
        self.steal = self.waited = 0
        self.told = []
        self.watch = WakeTrace(
            MS,
            lambda text, figures: self.told.append((text, figures)),
            thread=lambda: ThreadFigures(self.switches, self.minor, self.major),
            steal_ns=self.read,
            waited_ns=lambda: self.waited,
            clock=lambda: self.now_ns,
        )
        self.stat_reads = 0

    def read(self):
        self.stat_reads += 1
        return self.steal


def test_a_loop_in_time_reads_no_file_and_says_nothing():
    kernel = Kernel()
    for cycle in range(1000):
        kernel.now_ns += MS
        kernel.switches += 1
        kernel.watch.woke(cycle, 99_999)
        kernel.watch.tell()
    kernel.watch.flush()
    assert kernel.told == []
    assert kernel.stat_reads == 0


def test_each_late_wake_is_given_what_changed_in_its_own_cycle():
    kernel = Kernel()
    kernel.switches += 5  # in a cycle that was in time
    kernel.watch.woke(1, 0)
    kernel.switches += 2
    kernel.watch.woke(2, 400_000)
    kernel.watch.tell()
    text, figures = kernel.told.pop()
    assert text == "1 late wakes, the worst 400 us at cycle 2: the processor taken away 2 times"
    assert figures["involuntary_switches"] == 2
    kernel.steal += 20 * MS
    kernel.watch.woke(3, 150_000)
    kernel.minor += 3
    kernel.watch.woke(4, 900_000)
    kernel.watch.woke(5, 120_000)
    kernel.watch.tell()
    assert kernel.told == [], "a second has not passed"
    kernel.now_ns += 1000 * MS
    kernel.watch.woke(6, 0)
    assert kernel.told == [], "not in the cycle itself"
    kernel.watch.tell()
    text, figures = kernel.told.pop()
    assert text.startswith(
        "3 late wakes, the worst 900 us at cycle 4: 20 ms stolen by the host, 3 page faults, no cause"
    )
    assert figures == {
        "late": 3, "unexplained": 1, "involuntary_switches": 0, "page_faults": 3, "waited_us": 0, "stolen_us": 20_000,
        "worst_us": 900,
    }  # fmt: skip


def test_waiting_for_a_processor_explains_a_late_wake():
    kernel = Kernel()
    kernel.waited = 350_000
    kernel.watch.woke(9, 360_000)
    kernel.watch.tell()
    text, figures = kernel.told.pop()
    assert text == "1 late wakes, the worst 360 us at cycle 9: 350 us of waiting for a processor"
    assert (figures["waited_us"], figures["unexplained"]) == (350, 0)


def test_this_kernel_tells_how_long_a_thread_waited():
    waited_ns = read_waited_ns()
    assert waited_ns is None or 0 <= waited_ns <= read_waited_ns()
    assert read_waited_ns(Path("/nowhere")) is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [("cpu  1 2 3 4 5 6 7 8 9 10\ncpu0 1 2\n", 80 * MS), ("cpu 1 2 3\n", None), ("nonsense", None), (None, None)],
)
def test_stolen_time_as_the_kernel_writes_it(tmp_path, monkeypatch, text, expected):
    monkeypatch.setattr("os.sysconf", lambda _: 100)
    if text is not None:
        (tmp_path / "stat").write_text(text)
    assert read_steal_ns(tmp_path / "stat") == expected


def test_this_kernel_tells_of_this_thread():
    before = read_thread()
    assert before.minor_faults > 0
    assert read_thread().minor_faults >= before.minor_faults
