"""python-can's command-line tools on the emulated machine's socketcand server: ``can.logger`` and ``can.viewer``."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

PATIENCE_S = 60.0
HEARTBEAT_EVERY_20_MS = bytes.fromhex("2b17100014000000")


@pytest.fixture(scope="module")
def place(start_sim_drive: Callable[..., dict[str, Any]]) -> dict[str, Any]:
    return start_sim_drive("--interface", "socketcand", "--port", "0")


@pytest.fixture(scope="module")
def bus(place: dict[str, Any]) -> Iterator[can.BusABC]:
    """A client of the test's own; both drives send their heartbeats by then."""
    with can.Bus(
        interface="socketcand", host=place["host"], port=place["port"], channel=place["channel"], tcp_tune=True
    ) as bus:
        for node in (1, 2):
            bus.send(can.Message(arbitration_id=0x600 + node, data=HEARTBEAT_EVERY_20_MS, is_extended_id=False))
        for _ in range(10_000):
            message = bus.recv(PATIENCE_S)
            assert message is not None
            if message.arbitration_id == 0x702:
                break
        yield bus


def tool(name: str, place: dict[str, Any], *options: str) -> list[str]:
    # The tools hand on what they take for a number as one.
    where = [f"host={place['host']}", f"port={place['port']}", "tcp_tune=True"]
    return [
        sys.executable, "-m", name, "-i", "socketcand", "-c", place["channel"], *options, "--bus-kwargs", *where
    ]  # fmt: skip


def test_can_logger_writes_what_the_bus_carries(place: dict[str, Any], bus: can.BusABC, tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    # Ends by itself once the file is this large, and begins the next one: the first is whole then.
    process = subprocess.Popen(
        tool("can.logger", place, "-f", str(log), "-s", "1500"),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        for _ in range(100_000):
            assert bus.recv(PATIENCE_S) is not None
            whole = [path for path in tmp_path.iterdir() if path != log]
            if len(whole) >= 2 or process.poll() is not None:
                break
    finally:
        process.send_signal(signal.SIGINT)
        _, complaints = process.communicate(timeout=PATIENCE_S)
    files = sorted(tmp_path.iterdir())
    assert files, complaints
    messages = [message for path in files for message in can.LogReader(path)]
    assert len(messages) > 20
    assert {(m.arbitration_id, bytes(m.data)) for m in messages} == {(0x701, b"\x7f"), (0x702, b"\x7f")}


def test_can_viewer_shows_the_bus(place: dict[str, Any], bus: can.BusABC) -> None:
    """On a terminal of its own; the viewer wants one, and draws each identifier with its bytes."""
    screen, terminal = pty.openpty()
    process = subprocess.Popen(
        tool("can.viewer", place, "-d", "701:<B", "702:<B"),
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        env={**os.environ, "TERM": "xterm", "LINES": "40", "COLUMNS": "130"},
        start_new_session=True,
    )
    os.close(terminal)
    drawn = b""
    try:
        for _ in range(10_000):
            assert select.select([screen], [], [], PATIENCE_S)[0], "the viewer draws nothing"
            drawn += os.read(screen, 65536)
            if re.search(rb"0x701.*7F.*127", drawn, re.DOTALL) and re.search(rb"0x702.*7F", drawn, re.DOTALL):
                break
        else:
            raise AssertionError(drawn[-2000:])
        os.write(screen, b"q")
        for _ in range(10_000):
            if not select.select([screen], [], [], PATIENCE_S)[0]:
                break
            try:
                if not os.read(screen, 65536):
                    break
            except OSError:
                break
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        os.close(screen)
    assert b"Traceback" not in drawn
