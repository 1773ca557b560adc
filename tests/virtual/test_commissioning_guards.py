"""What guards the gateway from within the drives: commissioning writes it, reads it back, and tells what is lacking."""

import pytest
from guarded_machine import CV, PAPER, SERVO, Guarded, changed

from config.quirks import Quirk
from config.schema import GatewayConfig
from drivers.sdo import AbortCode
from gateway.cyclic.guard import StopReason
from gateway.running.drive_guards import GuardMissing, GuardsSet
from gateway.running.event_text import describe
from sim_drive.device.drive import Drive

HOMING_S = 0.25
"""All drives are commissioned by then."""
# 127 after 200 ms; 40 cycles; 1 ms; 300 rad/s^2 and 2000 rad/s^2 over 4096 counts.
GUARDS = {
    (0x1016, 1): (0x007F00C8, 0x007F00C8),
    (0x3050, 0): (40, 40),
    (0x1006, 0): (1000, 1000),
    (0x60C2, 1): (1, 1),
    (0x60C2, 2): (-3, -3),
    (0x6007, 0): (1, 1),
    (0x605A, 0): (2, 2),
    (0x605E, 0): (2, 2),
    (0x6065, 0): (200, 300),
    (0x6085, 0): (195570, 1303797),
}


def with_quirk(quirk: Quirk, axis_name: str) -> GatewayConfig:
    before, marker, after = PAPER.text.partition(f"  {axis_name}:\n")
    quirky = after.replace("    emulation:\n", f"    emulation:\n      quirks: [{quirk.value}]\n", 1)
    return changed((PAPER.text, before + marker + quirky))


def drive_of(run: Guarded, node: int) -> Drive:
    return next(drive for drive in run.machine.drives if drive.node_id == node)


def keep(run: Guarded, node: int, place: tuple[int, int], value: int) -> None:
    """Let a drive take any value there without a word, and go on with its own."""
    drive_of(run, node).dictionary.entry(*place).on_read = lambda now_ns: value


def lack(run: Guarded, node: int, index: int) -> None:
    drive_of(run, node).dictionary.refusals[index, None] = AbortCode.OBJECT_DOES_NOT_EXIST


def sentences(run: Guarded) -> list[str]:
    assert run.core.stopped_by is StopReason.COMMISSIONING
    return str(run.core.failure).splitlines()


def test_every_guard_is_set_whatever_the_drive_had_before_and_that_is_told() -> None:
    run = Guarded()
    for drive in run.machine.drives:
        for place in GUARDS:
            entry = drive.dictionary.entry(*place)
            # None of them is what it has to be; a reset of communication restores the defaults of its area.
            entry.default = entry.value = {(0x605A, 0): 6, (0x605E, 0): 1, (0x60C2, 1): 20}.get(place, 0)
    run.until(HOMING_S)
    for place, expected in GUARDS.items():
        assert tuple(drive_of(run, node).dictionary.entry(*place).value for node in (CV, SERVO)) == expected
    told = [event for event in run.events if isinstance(event, GuardsSet)]
    assert [event.axis for event in told] == ["cv", "servo"]
    assert {(guard.index, guard.subindex) for guard in told[0].guards} == GUARDS.keys()
    kind, text, _ = describe(told[1])
    assert kind == "guards_set"
    assert text.startswith("axis servo: the drive holds 60C2h:01 1, 60C2h:02 -3, 1006h:00 1000, 6065h:00 300, ")
    assert text.endswith("3050h:00 40, 1016h:01 007F00C8h")
    assert not any(isinstance(event, GuardMissing) for event in run.events)


KEPT = {
    (0x60C2, 1): (20, "holds 20 in 60C2h:01 (interpolation time period value), although 1 was written to it"),
    (0x60C2, 2): (-4, "holds -4 in 60C2h:02 (interpolation time index), although -3 was written to it"),
    (0x1006, 0): (0, "holds 0 in 1006h:00 (communication cycle period), although 1000 was written to it"),
    (0x6065, 0): (5000, "holds 5000 in 6065h:00 (following error window), although 300 was written to it"),
    (0x6007, 0): (0, "holds 0 in 6007h:00 (abort connection option code), although 1 was written to it"),
    (0x605A, 0): (6, "holds 6 in 605Ah:00 (quick stop option code), although 2 was written to it"),
    (0x605E, 0): (0, "holds 0 in 605Eh:00 (fault reaction option code), although 2 was written to it"),
    (0x6085, 0): (
        1276000, "holds 1276000 in 6085h:00 (quick stop deceleration), although 1303797 was written to it"
    ),
    (0x3050, 0): (0, "holds 0 in 3050h:00 (SYNC watchdog), although 40 was written to it"),
    (0x1016, 1): (
        0, "holds 00000000h in 1016h:01 (consumer heartbeat time), although 007F00C8h was written to it"
    ),
}  # fmt: skip
"""What a drive may keep for itself, and what is said of it, in the order of commissioning."""


def test_a_drive_that_keeps_other_values_is_refused_and_all_are_told_at_once() -> None:
    run = Guarded()
    for place, (value, _) in KEPT.items():
        keep(run, SERVO, place, value)
    run.to_end()
    assert sentences(run) == [f"axis servo: node 2 {sentence}" for _, sentence in KEPT.values()]
    assert run.is_without_torque


def test_one_value_is_enough_and_both_axes_are_told() -> None:
    run = Guarded()
    keep(run, CV, (0x3050, 0), 39)
    keep(run, SERVO, (0x1016, 1), 0x7F00C9)
    run.to_end()
    assert [sentence.partition(" (")[0] for sentence in sentences(run)] == [
        "axis cv: node 1 holds 39 in 3050h:00",
        "axis servo: node 2 holds 007F00C9h in 1016h:01",
    ]


def test_a_ramp_may_be_kept_in_units_of_the_drives_own() -> None:
    run = Guarded()
    keep(run, SERVO, (0x6085, 0), 1300000)  # 0.3 % less
    assert run.until(HOMING_S).core.failure is None


def test_a_drive_whose_abort_option_stays_is_refused() -> None:
    run = Guarded(config=with_quirk(Quirk.ABORT_OPTION_STAYS, "cv")).to_end()
    assert sentences(run) == [
        "axis cv: node 1 holds 0 in 6007h:00 (abort connection option code), although 1 was written to it"
    ]


@pytest.mark.parametrize("is_missing_all", [False, True])
def test_a_guard_that_a_drive_lacks_is_told_and_no_failure(is_missing_all: bool) -> None:
    run = Guarded(config=with_quirk(Quirk.NO_ABORT_OPTION, "servo"))
    for index in (0x1006, 0x605A, 0x605E) if is_missing_all else ():
        lack(run, SERVO, index)
    run.until(HOMING_S)
    assert run.core.failure is None
    told = [describe(event)[:2] for event in run.events if isinstance(event, GuardMissing)]
    expected = [
        ("guard_missing", "axis servo: the drive has no 1006h:00 (communication cycle period)"),
        ("guard_missing", "axis servo: the drive has no 6007h:00 (abort connection option code)"),
        ("guard_missing", "axis servo: the drive has no 605Ah:00 (quick stop option code)"),
        ("guard_missing", "axis servo: the drive has no 605Eh:00 (fault reaction option code)"),
    ]
    assert told == (expected if is_missing_all else expected[1:2])


@pytest.mark.parametrize(
    ("index", "sentence"),
    [
        (0x3050, "axis servo: node 2: SDO 3050h:00 aborted with 06020000h"),
        (0x1016, "axis servo: node 2: SDO 1016h:01 aborted with 06020000h"),
        (0x6065, "axis servo: node 2: SDO 6065h:00 aborted with 06020000h"),
    ],
)
def test_a_drive_without_what_the_configuration_or_the_machine_relies_on_is_refused(index: int, sentence: str) -> None:
    run = Guarded()
    lack(run, SERVO, index)
    run.to_end()
    assert [told[: len(sentence)] for told in sentences(run)] == [sentence]


def test_without_a_watchdog_in_the_configuration_the_drives_own_is_left_as_it_is() -> None:
    line = "    sync_watchdog: {index: 0x3050, bits: 16, unit: cycles, cycles: 40}\n"
    run = Guarded(config=changed((line, "")))
    drive_of(run, SERVO).dictionary.entry(0x3050).value = 77
    run.until(HOMING_S)
    assert [drive_of(run, node).dictionary.entry(0x3050).value for node in (CV, SERVO)] == [0, 77]
