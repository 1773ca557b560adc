"""Scenario files and faults in words: what they mean, and what is said of wrong ones."""

from pathlib import Path

import pytest

from config.loading import ConfigError
from sim_drive.injection.faults import Direction, Fault, FaultKind
from sim_drive.injection.scenario import Scenario, load_scenario, parse_fault, parse_scenario

NODES = {"cv": 1, "servo": 2}
IDS = (1, 2)
PATH = Path("trouble.yaml")


def parse(text: str) -> Scenario:
    return parse_scenario(text, PATH, NODES, IDS)


def test_a_scenario_is_its_faults_seed_and_name(tmp_path: Path) -> None:
    file = tmp_path / "trouble.yaml"
    file.write_text("""
name: trouble
description: everything at once
seed: 7
faults:
  - {kind: over_current, node: servo, at_s: 3, for_s: 1}
  - kind: lost_frames
    node: 1
    cob_id: 0x181
    direction: sent
    probability: 0.25
  - {kind: bus_off, node: all, at_s: 5.5, for_s: 0.2}
""")
    assert load_scenario(file, NODES, IDS) == Scenario(
        (
            Fault(FaultKind.OVER_CURRENT, 2, at_s=3.0, for_s=1.0),
            Fault(FaultKind.LOST_FRAMES, 1, cob_id=0x181, direction=Direction.SENT, probability=0.25),
            Fault(FaultKind.BUS_OFF, 1, at_s=5.5, for_s=0.2),
            Fault(FaultKind.BUS_OFF, 2, at_s=5.5, for_s=0.2),
        ),
        7,
        "trouble",
    )


def test_a_fault_in_words_has_the_keys_of_the_file() -> None:
    assert parse_fault("servo over_current at_s=3 for_s=1", NODES, IDS) == [
        Fault(FaultKind.OVER_CURRENT, 2, at_s=3.0, for_s=1.0)
    ]
    assert parse_fault("1 sdo_abort index=0x6098 subindex=0 abort_code=0x06060000", NODES, IDS) == [
        Fault(FaultKind.SDO_ABORT, 1, index=0x6098, subindex=0, abort_code=0x06060000)
    ]
    assert [fault.node_id for fault in parse_fault("all mute_heartbeat", NODES, IDS)] == [1, 2]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("faults: [{kind: smoke, node: 1}]", "trouble.yaml: faults.0.kind: 'smoke' should be 'over_current', 'over_"),
        ("faults: [{kind: bus_off, node: 9}]", "faults.0.node: there is no 9 (there are: cv, servo, 1, 2, all)"),
        ("faults: [{kind: bus_off, node: crank}]", "faults.0.node: there is no crank (there are: cv, servo"),
        ("faults: [{kind: bus_off}]", "trouble.yaml: faults.0.node: required key is missing"),
        ("faults: [{kind: bus_off, node: 1, form_s: 3}]", "faults.0.form_s: unknown key, did you mean for_s?"),
        ("faults: [{kind: bus_off, node: 1, at_s: -1}]", "faults.0.bus_off: at_s -1.0 is not 0 to 1e+06"),
        ("faults: [{kind: bus_off, node: 1, at_s: soon}]", "faults.0.at_s: 'soon' should be a valid number"),
        ("faults: [{kind: bus_off, node: 1, at_s: .nan}]", "faults.0.at_s: nan should be a finite number"),
        ("faults: [{kind: late_frames, node: 1}]", "faults.0.late_frames: needs delay_s"),
        ("faults: [{kind: late_frames, node: 1, delay_s: 1, direction: up}]", "'up' should be 'sent', 'received' or"),
        ("fault: []", "trouble.yaml: fault: unknown key, did you mean faults?"),
        ("faults: bus_off", "trouble.yaml: faults: 'bus_off' should be a valid list"),
        ("[1]", "trouble.yaml: holds no mapping at its top level"),
        ("faults: [", "trouble.yaml: not valid YAML in line"),
        ("faults: [&a {kind: bus_off, node: 1}, *a]", "aliases are not accepted"),
        ("faults: []\nfaults: []", "key 'faults' is given twice"),
    ],
)
def test_a_wrong_scenario_is_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert any(sentence in problem for problem in caught.value.problems)
    assert not any("\n" in problem for problem in caught.value.problems)


def test_all_that_is_wrong_is_said_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        parse("faults: [{kind: late_frames, node: 1}, {kind: bus_off, node: 1}, {kind: wrong_identity, node: 2}]")
    assert len(caught.value.problems) == 2


def test_an_unknown_kind_is_told_every_known_one() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_fault("1 smoke", NODES, IDS)
    assert all(kind.value in caught.value.problems[0] for kind in FaultKind)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("over_current", "fault 'over_current': is not NODE KIND [KEY=VALUE]..."),
        ("", "fault '': is not NODE KIND [KEY=VALUE]..."),
        ("1 over_current at", "at is not KEY=VALUE"),
        ("1 over_current at_s=1 at_s=2", "at_s is given twice"),
        ("1 over_current at_s=soon", "at_s: 'soon' should be a valid number"),
        ("1 over_current at=3", "at: unknown key, did you mean at_s?"),
        ("3 over_current", "node: there is no 3 (there are: cv, servo, 1, 2, all)"),
        ("1 jumping_resolver", "jumping_resolver: needs counts"),
        ("1 over_current at_s=[", "at_s: '[' should be a valid number"),
    ],
)
def test_a_wrong_fault_in_words_is_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_fault(text, NODES, IDS)
    assert sentence in caught.value.problems[0]


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read \(No such file or directory\)"):
        load_scenario(tmp_path / "none.yaml", NODES, IDS)


def test_axes_that_share_a_node_are_told_apart_by_their_names() -> None:
    names, numbers = {"cv": 1, "servo": 1}, {"cv": 1, "servo": 2}
    (fault,) = parse_fault("servo over_current at_s=1", names, [1], numbers)
    assert (fault.node_id, fault.axis) == (1, 2)
    (fault,) = parse_fault("servo over_current axis=1", names, [1], numbers)
    assert fault.axis == 1
    (fault,) = parse_fault("1 over_current", names, [1], numbers)
    assert fault.axis is None
    (fault,) = parse_fault("servo mute_heartbeat", names, [1], numbers)
    assert fault.axis is None


EXTRAS = {
    FaultKind.OVER_CURRENT: "for_s=1 error_code=0x2320 axis=1",
    FaultKind.JUMPING_RESOLVER: "for_s=2 counts=-40 axis=1",
    FaultKind.NODE_RESET: "",
    FaultKind.WRONG_IDENTITY: "for_s=1 vendor_id=7 serial_number=9",
    FaultKind.SLOW_SDO: "for_s=1 delay_s=0.25",
    FaultKind.SDO_ABORT: "index=0x6040 subindex=0 abort_code=0x08000022",
    FaultKind.LATE_FRAMES: "delay_s=0.002 cob_id=0x185 cob_id_mask=0x7FF direction=sent probability=0.5 count=3",
}
"""What is given with a kind beside ``at_s``; a second's duration for the others."""


@pytest.mark.parametrize("kind", FaultKind)
def test_every_fault_is_the_same_in_a_file_on_the_command_line_and_in_python(kind: FaultKind) -> None:
    words = f"at_s=1.5 {EXTRAS.get(kind, 'for_s=1')}".split()
    items = dict(word.split("=") for word in words)
    (told,) = parse_fault(f"servo {kind.value} {' '.join(words)}", {"servo": 5}, [5])
    entry = ", ".join(f"{key}: {value}" for key, value in {"node": "servo", "kind": kind.value, **items}.items())
    scenario = parse_scenario(f"faults: [{{{entry}}}]", Path("trouble.yaml"), {"servo": 5}, [5])
    numbers = {
        key: Direction(text) if key == "direction" else float(text) if key.endswith("_s") or key == "probability"
        else int(text, 0)
        for key, text in items.items()
    }  # fmt: skip
    made = Fault(kind, 5, **numbers)  # type: ignore[arg-type]
    assert (told,) == scenario.faults == (made,)
