"""Faults, scenarios and many nodes on the command line of the emulated machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from config.loading import ConfigError, load_config, parse_config
from config.quirks import Quirk
from drivers.frame import Frame
from drivers.ports import open_port
from sim_drive.cli import parse_node_ids
from sim_drive.injection.faults import FaultKind

COMMAND = [sys.executable, "-m", "sim_drive"]
PATIENCE_S = 60.0
NOWHERE = ("--interface", "socketcand", "--port", "0", "--duration", "0.3", "--json")


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.mark.parametrize(
    ("text", "node_ids"),
    [
        ("7", (7,)),
        ("1-3", (1, 2, 3)),
        ("5-5", (5,)),
        ("9,1-2, 127", (9, 1, 2, 127)),
        ("1-127", tuple(range(1, 128))),
    ],
)
def test_node_ids_in_words(text: str, node_ids: tuple[int, ...]) -> None:
    assert parse_node_ids(text) == node_ids


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("0", "--nodes 0: node id 0 is not 1 to 127"),
        ("1-128", "--nodes 1-128: node id 128 is not 1 to 127"),
        ("1-5,3", "--nodes 1-5,3: node id 3 is given twice, every node id must be unique"),
        ("9-7", "--nodes 9-7: 9-7 runs backwards"),
        ("1-", "'1-' is neither a node id nor a range such as 1-20"),
        ("", "'' is neither a node id nor a range"),
        ("1,,2", "'' is neither a node id nor a range"),
        ("-3", "'-3' is neither a node id nor a range"),
        ("1-2-3", "'1-2-3' is neither a node id nor a range"),
        ("²", "'²' is neither a node id nor a range"),
        ("1-99999999999999999999", "is neither a node id nor a range"),
    ],
)
def test_wrong_node_ids_are_refused_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_node_ids(text)
    assert sentence in caught.value.problems[0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--nodes", "0-5"), "sim-drive: --nodes 0-5: node id 0 is not 1 to 127"),
        (("paper", "--nodes", "1"), "sim-drive: give either CONFIG or --nodes, not both"),
        ((), "sim-drive: give either CONFIG or --nodes"),
        (("paper", "--fault", "servo smoke"), "sim-drive: fault 'servo smoke': kind: 'smoke' should be 'over_current'"),
        (("paper", "--fault", "3 bus_off"), "sim-drive: fault '3 bus_off': node: there is no 3 (there are: cv, servo,"),
        (
            ("paper", "--scenario", "nowhere.yaml"),
            "sim-drive: nowhere.yaml: cannot be read (No such file or directory)",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence_with_status_2(arguments: tuple[str, ...], sentence: str) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert done.stderr.startswith(sentence)
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""


def test_every_fault_is_listed() -> None:
    done = run("--list-faults")
    assert done.returncode == 0
    names = [line.split()[0] for line in done.stdout.splitlines() if line[0] != " "]
    assert names == [kind.value for kind in FaultKind]
    assert "delay_s" in done.stdout


def test_every_quirk_is_listed() -> None:
    done = run("--list-quirks")
    assert done.returncode == 0
    assert done.stdout.split() == [quirk.value for quirk in Quirk]


def test_faults_of_a_file_and_of_the_command_line_happen_and_are_told(tmp_path: Path) -> None:
    scenario = tmp_path / "trouble.yaml"
    scenario.write_text("faults: [{kind: power_cycle, node: 3, at_s: 0.1, for_s: 0.05}]")
    done = run("--nodes", "3,9", "--scenario", str(scenario), "--fault", "9 over_current at_s=0.02", *NOWHERE)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    told = [(line["event"], line["node_id"], line["kind"]) for line in lines if "kind" in line]
    assert told == [
        ("fault_started", 9, "over_current"),
        ("fault_ended", 9, "over_current"),
        ("fault_started", 3, "power_cycle"),
        ("fault_ended", 3, "power_cycle"),
    ]
    starts = [line["at_ns"] for line in lines if line["event"] == "fault_started"]
    assert starts[1] - starts[0] == 80_000_000
    assert (lines[0]["event"], lines[-1]["event"]) == ("ready", "stopped")
    assert "sim-drive: node 9: over_current begins" in done.stderr
    assert "sim-drive: a row of 2 free axes is on socketcand" in done.stderr


def test_an_unknown_quirk_in_a_configuration_is_refused_with_the_known_ones() -> None:
    config = load_config("paper")
    text = config.text.replace("    emulation:\n", "    emulation:\n      quirks: [slow_mode_switch, moody]\n", 1)
    with pytest.raises(ConfigError) as caught:
        parse_config(text, config.path)
    (problem,) = caught.value.problems
    assert "emulation.quirks" in problem
    assert "'moody' should be 'no_boot_up'" in problem


def test_an_unknown_quirk_on_the_command_line_is_wrong_use() -> None:
    done = run("paper", "--quirk", "moody")
    assert done.returncode == 2
    assert "'moody'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("fleet", [("--nodes", "1-2"), ("paper",)])
def test_a_quirk_of_the_command_line_is_on_the_bus(fleet: tuple[str, ...]) -> None:
    """Reset node: with a short boot-up, 701h and 702h have no data."""
    options = ("--quirk", Quirk.SHORT_BOOT_UP.value, "--interface", "socketcand", "--port", "0", "--json")
    command = [*COMMAND, *fleet, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            place = json.loads(process.stdout.readline())
            bus = open_port("socketcand", place["channel"], port=place["port"])
            try:
                bus.send(Frame(0x000, b"\x81\x00"))
                seen: dict[int, bytes] = {}
                for _ in range(1000):
                    received = bus.receive()
                    if received is not None:
                        seen[received[0].cob_id] = received[0].data
                    elif seen.keys() >= {0x701, 0x702} or not bus.wait(PATIENCE_S):
                        break
                assert (seen.get(0x701), seen.get(0x702)) == (b"", b"")
            finally:
                bus.close()
        finally:
            process.terminate()
