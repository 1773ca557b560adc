"""What `check` tells of the guard: every condition, its limit in the machine's units."""

import json

import yaml

from config.loading import load_config, parse_config
from gateway.cyclic.guard import Condition
from gateway.running.guard_listing import drive_guards_text, guard_json, guard_rows

PAPER = load_config("paper")


def test_every_condition_is_listed_in_the_machines_own_units():
    rows = {row.condition: row for row in guard_rows(PAPER)}
    assert set(rows) == set(Condition)
    limits = {condition.value: row.limit for condition, row in rows.items() if row.limit}
    assert limits == {
        # 200 and 300 of 4096 counts; 1.3 times 14 and 25 rad/s; rated 1.5 N m; 0.45 of 360 deg are 5.1 counts.
        "following_error": "cv 17.6 deg (200 counts), servo 26.4 deg (300 counts)",
        "cam_window": "20 deg",
        "velocity": "130 %: cv 18.2, servo 32.5 rad/s",
        "torque": "2500 per mille: cv 3.75, servo 3.75 N m",
        "end_effector_error": "50 mm",
        "frozen_actual": "0.45 deg: cv 5, servo 5 counts",
        # Friction of 0.04 and 0.05 N m, 27 and 33 per mille: 2.2 times that is less than half the limit.
        "unanswered_torque": "250 per mille: cv 0.375, servo 0.375 N m; for 80 cycles cv 125, servo 125 per mille; "
        "or frozen_actual's way by the model",
        "emergency_warning": "EMCY 8110h, 8120h",
        "sync_lost": "20 cycles in a row",
    }
    assert rows[Condition.MISSED_TPDO].cycles == 20
    assert rows[Condition.HEARTBEAT_LOST].cycles == 1


def test_without_a_model_nothing_is_told_of_it():
    for section in ("enabled: false", "enabled: true, load_check_ms: 0"):
        text = PAPER.text.replace("feed_forward: {enabled: true}", f"feed_forward: {{{section}}}")
        rows = {row.condition: row for row in guard_rows(parse_config(text, PAPER.path))}
        assert rows[Condition.UNANSWERED_TORQUE].limit.endswith("for 80 cycles cv 125, servo 125 per mille")


def test_what_the_drives_do_without_the_gateway_is_told():
    assert drive_guards_text(PAPER) == (
        "without the gateway the drives stop by themselves after 200 ms without the gateway's heartbeat, "
        "cv after 40 cycles without SYNC and servo after 40 cycles without SYNC"
    )
    document = yaml.safe_load(PAPER.text)
    for axis in document["axes"].values():
        del axis["sync_watchdog"]
    without = parse_config(yaml.safe_dump(document), PAPER.path)
    assert "none has a SYNC watchdog" in drive_guards_text(without)
    assert guard_json(without)["sync_watchdog_cycles"] == {"cv": None, "servo": None}


def test_the_guard_as_json_is_the_configurations_own():
    document = json.loads(json.dumps(guard_json(PAPER)))
    assert document["conditions"]["velocity"] == {
        "persistence_cycles": 5,
        "reaction": "quick_stop",
        "limit_percent": 130.0,
    }
    assert document["conditions"]["emergency_warning"]["codes"] == [0x8110, 0x8120]
    assert set(document["conditions"]) == {condition.value for condition in Condition}
    assert document["following_error_counts"] == {"cv": 200, "servo": 300}
