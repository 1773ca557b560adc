"""The command line of the emulated machine, as the process that it is."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from config.loading import load_config
from drivers.eds import load_eds
from drivers.frame import Frame
from drivers.ports import open_port

COMMAND = [sys.executable, "-m", "sim_drive"]
PATIENCE_S = 60.0
NMT_RESET_NODE = 0x81


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def test_help_has_examples() -> None:
    done = run("--help")
    assert done.returncode == 0
    assert "sim-drive paper --port 0 --json" in done.stdout
    assert "Usage: sim-drive [OPTIONS]" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "status", "sentence"),
    [
        (("no_such_machine",), 2, "sim-drive: no_such_machine: no such file, nor a shipped configuration"),
        (("paper", "--interface", "nosuch"), 1, "sim-drive: bus nosuch:vcan0: cannot be opened"),
        (("paper", "--interface", "socketcan", "--channel", "vcan99"), 1, "sim-drive: bus socketcan:vcan99: "),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(arguments: tuple[str, ...], status: int, sentence: str) -> None:
    done = run(*arguments)
    assert done.returncode == status
    assert done.stderr.startswith(sentence)
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""


def test_wrong_use_has_status_2() -> None:
    done = run("paper", "--port", "70000")
    assert done.returncode == 2
    assert "'--port'" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_machine_is_served_until_it_is_told_to_stop(tmp_path: Path) -> None:
    """Every drive answers a reset with its boot-up frame; SIGTERM is a clean end."""
    reading, writing = os.pipe()
    ready_file = tmp_path / "ready.json"
    arguments = ["paper", "--interface", "socketcand", "--port", "0", "--json"]
    arguments += ["--ready-fd", str(writing), "--ready-file", str(ready_file)]
    with subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, pass_fds=[writing]
    ) as process:
        try:
            os.close(writing)  # so that reading ends if the process does
            with os.fdopen(reading, encoding="utf-8") as pipe:
                place = json.loads(pipe.readline())
            assert (place["interface"], place["host"]) == ("socketcand", "127.0.0.1")
            assert json.loads(ready_file.read_text()) == place
            bus = open_port("socketcand", place["channel"], port=place["port"])
            try:
                bus.send(Frame(0x000, bytes((NMT_RESET_NODE, 0))))
                missing = {0x700 + axis.node_id for axis in load_config("paper").axes.values()}
                for _ in range(1000):
                    received = bus.receive()
                    if received is None:
                        assert bus.wait(PATIENCE_S)
                    elif received[0].data == b"\x00":
                        missing.discard(received[0].cob_id)
                    if not missing:
                        break
                assert not missing
            finally:
                bus.close()
        finally:
            process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    lines = [json.loads(line) for line in out.splitlines()]
    assert [line["event"] for line in lines] == ["ready", "stopped"]
    assert lines[0] == {"event": "ready", **place}
    assert lines[1]["frames_received"] == 1
    assert "Traceback" not in err


def test_the_eds_of_a_two_axis_drive_is_written(tmp_path: Path) -> None:
    file = tmp_path / "two.eds"
    done = run("--nodes", "5", "--axes-per-node", "2", "--write-eds", str(file))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    described = load_eds(file, 5)
    assert described.get(0x6840, 0) is not None
    assert described.get(0x7040, 0) is None


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("paper", "--axes-per-node", "3"), "--axes-per-node 3: a machine of 2 axes takes 1 or 2"),
        (("paper", "--axes-per-node", "2", "--fault", "servo over_current axis=3"), "axis 3: node 1 has 2 axes"),
    ],
)
def test_axes_that_there_are_not_are_refused(arguments: tuple[str, ...], sentence: str) -> None:
    done = run(*arguments, "--interface", "socketcand", "--port", "0", "--duration", "0")
    assert done.returncode == 2
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1
