"""A real run of the product's own processes over loopback, for tests that kill one of them, or send it a signal."""

import os
import subprocess
import sys
import time
from pathlib import Path

import yaml
from slow_host import slow_host_paper

from gateway.record.ring import RingReader, find_rings
from gateway.record.sample import Phase

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 120.0


def unhurried_machine(folder: Path) -> tuple[str, Path]:
    """``paper`` at 4 ms, its guards warning of what a busy computer is late with, under a name of its own."""
    config = slow_host_paper()
    config["name"] = f"{folder.name}-{os.getpid()}"
    config["bus"] |= {"cycle_us": 4000, "heartbeat_timeout_ms": 2000}
    config["guard"]["sync_lost"] = {"limit_cycles": 100, "reaction": "warn"}
    path = folder / "machine.yaml"
    path.write_text(yaml.safe_dump(config))
    return config["name"], path


def start(command, *arguments, folder, stdout=subprocess.DEVNULL):
    """``drive-gateway COMMAND ...`` as a process that leads a group of its own, as one that a terminal starts."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (folder / f"{command}.stderr").open("w") as stderr:
        return subprocess.Popen(
            [sys.executable, "-m", "gateway.cli", command, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            env=environment,
            cwd=folder,
            text=True,
            start_new_session=True,
        )


def until(condition, what):
    """What ``condition`` answers, as soon as it is something."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        answer = condition()
        if answer:
            return answer
        time.sleep(0.02)
    raise AssertionError(what)


def child_of(process, module):
    """Process id of the child that runs ``module``."""
    for folder in Path("/proc").iterdir():
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes().decode().split("\0")
        except (OSError, IndexError, ValueError):
            continue
        if parent == process.pid and module in command:
            return int(folder.name)
    raise AssertionError(f"no child of {process.pid} runs {module}")


class LoopbackRun:
    """``drive-gateway run`` with its ring read along; ``samples`` holds what has been read."""

    def __init__(self, config: tuple[str, Path], port: int, folder: Path, cycles: int) -> None:
        """Start it, and return when it is on the cam."""
        name, path = config
        self.folder = folder
        options = ("-i", "socketcand", "--port", port, "--cycles", cycles, "--record", "run.mcap")
        self.process = start("run", path, *options, folder=folder)
        self.reader = RingReader(until(lambda: find_rings(name) or self._assert_alive(), "no ring")[0])
        self.samples = []
        self.wait_for(Phase.CAM)

    def _assert_alive(self):
        assert self.process.poll() is None, self.complaints

    def read(self):
        """Take what is new; returns the phases of it."""
        samples, lost = self.reader.read_new()
        assert lost == 0, "the test has not kept up with the ring"
        self.samples.extend(samples)
        return {Phase(int(phase)) for phase in samples["phase"]}

    def wait_for(self, phase):
        """Read until the cycle is in this phase."""

        def is_there():
            phases = self.read()
            if phase not in phases:
                self._assert_alive()
            return phase in phases

        until(is_there, f"never in phase {phase.name}: {self.complaints}")

    def go_on(self, cycles):
        """Read on for so many cycles; the run must not end meanwhile."""
        end = len(self.samples) + cycles

        def is_read():
            self.read()
            self._assert_alive()
            return len(self.samples) >= end

        until(is_read, f"no {cycles} cycles more")

    def to_end(self):
        """Read until the process has ended; returns its exit status."""
        until(lambda: self.read() is None or self.process.poll() is not None, "the run never ended")
        self.read()
        return self.process.returncode

    @property
    def phases(self):
        """Every phase that was read, in order, each run of one phase once."""
        phases = [Phase(int(sample["phase"])) for sample in self.samples]
        return [phase for before, phase in zip([None, *phases], phases, strict=False) if phase is not before]

    @property
    def complaints(self):
        """Whatever the run has said on stderr."""
        return (self.folder / "run.stderr").read_text()
