"""What reaches the terminal while a run goes on: everything that matters, and no flood."""

import pytest

from drivers.master import BootUpReceived, EmergencyReceived
from gateway.cli.event_lines import HOLD_NS, MOST_LINES, SPAN_NS, EventLines
from gateway.cyclic.guard import Condition, GuardTripped, Reaction
from gateway.running.controller_watch import RestartTold
from gateway.running.event_text import describe
from gateway.running.recovery import AxisRecovered

MS = 1_000_000
REFERENCE_LOST = "commissioned anew, its reference is lost: bring the linkage to its home position"


class Terminal:
    def __init__(self, **options):
        self.lines = []
        self.styles = {}
        self.events = EventLines(self.put, **options)

    def put(self, text, style):
        self.lines.append(text.strip())
        self.styles[text.strip()] = style

    def tell(self, event):
        kind, text, data = describe(event)
        self.events.tell({"at_ns": event.at_ns, "kind": kind, "text": text, **data})

    def say(self, kind, text, at_ns=0, **data):
        self.events.tell({"at_ns": at_ns, "kind": kind, "text": text, **data})


def trip(at_ns, reaction=Reaction.WARN, value=120, condition=Condition.FOLLOWING_ERROR, axis="servo"):
    return GuardTripped(at_ns, condition, axis, value, 100, reaction)


def test_recovery_boot_up_emergency_and_bus_off_are_told():
    terminal = Terminal()
    terminal.say("step", "moving")
    terminal.tell(BootUpReceived(1 * MS, 2))
    terminal.tell(EmergencyReceived(2 * MS, 2, 0x8130, 0x11, bytes(5)))
    terminal.tell(RestartTold(3 * MS, "restarted after 100 ms"))
    terminal.tell(AxisRecovered(4 * MS, "servo", False, True, REFERENCE_LOST))
    terminal.tell(AxisRecovered(5 * MS, "cv", True, False, "ready for a new run"))
    terminal.say("nmt_state", "node 2 is pre-operational", 6 * MS, node_id=2)
    terminal.events.close()
    assert terminal.lines == [
        "node 2 has booted up",
        "node 2 EMCY 8130h, error register 11h",
        "the gateway's CAN controller: restarted after 100 ms",
        f"axis servo: {REFERENCE_LOST}",
        "axis cv: ready for a new run",
        "node 2 is pre-operational",
    ]
    assert terminal.styles[f"axis servo: {REFERENCE_LOST}"] == "bold red"
    assert terminal.styles["axis cv: ready for a new run"] == "bold"
    assert terminal.styles["node 2 has booted up"] == "yellow"


def test_what_every_commissioning_and_every_end_has_is_told_quietly():
    terminal = Terminal()
    styles = []
    for step in ("homing axis cv", "moving", "recovering the axes", "done"):
        terminal.say("step", step)
        terminal.tell(BootUpReceived(0, 2))
        styles.append(terminal.styles.pop("node 2 has booted up"))
        terminal.events.tick(terminal.events.now_ns + SPAN_NS)
    assert styles == ["dim", "yellow", "yellow", "dim"]


def test_a_thousand_warnings_are_a_few_lines_and_a_count_and_hide_no_other():
    terminal = Terminal()
    for number in range(1000):
        terminal.tell(trip(number * MS, value=200 + number))
    terminal.tell(trip(1000 * MS, Reaction.QUICK_STOP))
    terminal.tell(trip(1001 * MS, axis="cv"))
    assert len(terminal.lines) == MOST_LINES + 2
    assert terminal.lines[-2].endswith("quick stop")
    terminal.events.tick(SPAN_NS - 1)
    assert len(terminal.lines) == MOST_LINES + 2
    terminal.events.tick(SPAN_NS)
    counted = "following error on axis servo: 1199 counts (limit 100), warn"
    assert terminal.lines[-1] == f"and 997 more like this, the last: {counted}"
    terminal.tell(trip(SPAN_NS + 1, value=7777))
    assert "7777 counts" in terminal.lines[-1], "a new span begins"
    terminal.events.close()
    assert len(terminal.lines) == MOST_LINES + 4


def test_what_is_held_back_is_counted_at_the_end():
    terminal = Terminal()
    for number in range(10):
        terminal.tell(EmergencyReceived(number * MS, 2, 0x8110 + number, 0x11, bytes(5)))
    terminal.events.close()
    last = "node 2 EMCY 8119h, error register 11h"
    assert terminal.lines[MOST_LINES:] == [f"and {10 - MOST_LINES} more like this, the last: {last}"]


def test_a_failure_is_told_while_the_run_goes_on_and_not_twice_at_its_end():
    terminal = Terminal()
    terminal.say("failure", "axis cv: no TPDO 181h arrives after SYNC", 5)
    assert terminal.lines == []
    terminal.events.tick(5 + HOLD_NS)
    assert terminal.lines == ["axis cv: no TPDO 181h arrives after SYNC"]
    terminal.say("failure", "the end", 6 + HOLD_NS)
    terminal.events.close()
    assert terminal.lines == ["axis cv: no TPDO 181h arrives after SYNC"]


def test_an_event_of_the_parents_own_has_no_time_and_is_told():
    terminal = Terminal()
    terminal.events.tell({"kind": "recorder_lost", "text": "the recorder was ended by SIGKILL"})
    assert terminal.lines == ["the recorder was ended by SIGKILL"]


@pytest.mark.parametrize("kind", ["late", "late_demand", "late_account", "end", "bus"])
def test_what_the_report_tells_is_not_told_twice(kind):
    terminal = Terminal()
    terminal.say(kind, "something")
    assert terminal.lines == []


def test_steps_are_told_where_no_progress_bar_shows_them():
    for with_steps in (True, False):
        terminal = Terminal(with_steps=with_steps)
        terminal.say("step", "homing axis cv")
        terminal.say("step", "quick stop")
        assert terminal.lines == [*["homing axis cv"] * with_steps, "quick stop"]
