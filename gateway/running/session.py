"""A run in real time, as its parent sees it: the ring, the cyclic process, the recorder, and what comes of them."""

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final

from drivers.errors import BusError
from gateway.errors import GatewayError
from gateway.record.ring import RingReader, RingWriter, RunState, StopRequest
from gateway.record.run_constants import RunConstants
from gateway.running.bus_address import BusAddress
from gateway.running.bus_budget import has_wire, require_budget
from gateway.running.cyclic_process import CyclicJob
from gateway.running.preparation import PreparedRun

POLL_S: Final = 0.1
RECORDER_TIMEOUT_S: Final = 30.0
PROCESS_TIMEOUT_S: Final = 15.0
"""How long the cyclic process may take to end when it is not watched any more, before it is terminated."""
HUNG_S: Final = 3.0
"""A running cyclic process that has given no sign of life for so long is killed: the drives then stop by themselves."""


@dataclass(frozen=True, slots=True)
class Progress:
    """What the parent shows while a run goes on."""

    at_s: float
    """Time since the processes were started."""
    step: str
    """The session's last step, in words."""
    machine_cycles: float
    """Whole and broken machine cycles that the master has turned so far."""
    total_machine_cycles: float
    """Machine cycles of the whole plan, ramps included."""


REQUEST_OF_SIGNAL: Final[Mapping[int, StopRequest]] = {
    signal.SIGINT: StopRequest.SIGINT,
    signal.SIGTERM: StopRequest.SIGTERM,
}


class StopSwitch:
    """Signals as stop requests: the first SIGINT or SIGTERM asks for what the guard's table says, the second for a
    quick stop.

    SIGHUP, a terminal that was closed, asks for an operator's stop however often it comes.
    """

    def __init__(self) -> None:
        self.request: StopRequest = StopRequest.NONE

    def press(self, _number: int = 0, _frame: FrameType | None = None) -> None:
        """Ask for a stop, or for a stronger one."""
        if self.request is StopRequest.NONE:
            self.request = REQUEST_OF_SIGNAL.get(_number, StopRequest.CONTROLLED_STOP)
        elif _number != signal.SIGHUP:
            self.request = StopRequest.QUICK_STOP

    @contextmanager
    def installed(self) -> Generator[None]:
        """While this lasts the signals press the switch."""
        numbers = [signal.SIGINT, signal.SIGTERM]
        # Who was started under nohup has been promised to outlive the terminal.
        numbers += [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
        before = {number: signal.signal(number, self.press) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _python_environment() -> dict[str, str]:
    """The environment of the children: they import the same rooms as this process, wherever it was started."""
    root = str(Path(__file__).resolve().parent.parent.parent)
    known = os.environ.get("PYTHONPATH", "")
    return {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in (root, known) if part)}


def run_realtime(
    prepared: PreparedRun,
    address: BusAddress,
    recording: Path,
    cam_text: str,
    switch: StopSwitch,
    *,
    machine_cycles: int,
    is_overwriting: bool = False,
    with_frames: bool = False,
    is_homing_again: bool = False,
    is_starting_anywhere: bool = False,
    learn: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_event: Callable[[dict[str, Any]], None] | None = None,
) -> None:
    """Carry out a prepared run on a bus and record it; ``with_frames`` also records every frame on the bus,
    ``is_starting_anywhere`` brings a machine that does not stand at home slowly onto its cam first.

    ``learn``: file or folder of what has been learned, see ``gateway.running.learning_store``; None leaves it to the
    configuration.

    Raises BusError for a bus that is not there, GatewayError with what else went wrong: drives that are not what they
    should be, a process that died. A stop that the guard called for is no error here: the recording tells it.
    """
    config = prepared.config
    constants = RunConstants.from_config(config, prepared.cam.closure)
    failures: list[str] = []
    # A bus that is not there is told before a recording is begun.
    address.open().close()
    is_wired = has_wire(address)
    require_budget(config, address, is_wired)
    start_ns = time.monotonic_ns()
    start_wall_ns = time.time_ns()
    with RingWriter.create(config.name, constants) as ring, tempfile.TemporaryDirectory() as folder:
        config_file, cam_file = Path(folder, "config.yaml"), Path(folder, "cam.json")
        config_file.write_text(config.text, encoding="utf-8")
        cam_file.write_text(cam_text, encoding="utf-8")
        command = [sys.executable, "-m", "gateway.running.recorder", str(ring.path), str(recording)]
        command += ["--config", str(config_file), "--cam", str(cam_file)]
        command += ["--start-ns", str(start_ns), "--start-wall-ns", str(start_wall_ns)]
        command += ["--overwrite"] if is_overwriting else []
        command += ["--bus", address.interface, address.channel, address.host, str(address.port)] if with_frames else []
        environment = _python_environment()
        recorder = subprocess.Popen(  # noqa: S603 -- our own module
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            text=True,
            # Signals of the terminal are for this process, who stops the run in order.
            start_new_session=True,
        )
        job = CyclicJob(
            ring=str(ring.path),
            config_path=str(config.path),
            config_text=config.text,
            cam_text=cam_text,
            machine_cycles=machine_cycles,
            interface=address.interface,
            channel=address.channel,
            host=address.host,
            port=address.port,
            bit_rate=address.bit_rate,
            parent_pid=os.getpid(),
            is_wired=is_wired,
            is_homing_again=is_homing_again,
            is_starting_anywhere=is_starting_anywhere,
            learn=None if learn is None else str(learn.absolute()),
        )
        loop = subprocess.Popen(
            [sys.executable, "-m", "gateway.running.cyclic_process"],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            text=True,
            start_new_session=True,
        )
        try:
            if loop.stdin is not None:
                # A process that has died already is told of below.
                with suppress(BrokenPipeError):
                    loop.stdin.write(job.to_json())
                with suppress(BrokenPipeError):
                    loop.stdin.close()
                # Else communicate() would flush it once more.
                loop.stdin = None
            with RingReader(ring.path) as reader:
                _follow(loop, recorder, reader, prepared, start_ns, switch, failures, on_progress, on_event)
        finally:
            if loop.poll() is None:
                ring.request_stop(StopRequest.CONTROLLED_STOP)
            loop_errors = _end(loop, PROCESS_TIMEOUT_S)
        if loop.returncode not in (0, 1):
            # Nobody else will say so to the recorder, which otherwise waits for the writer that this process is.
            ring.set_state(RunState.FAILED, 1)
        if loop.returncode != 0 and not failures:
            failures.append(f"the cyclic process {_ending(loop.returncode, loop_errors)}")
        recorder_errors = _end(recorder, RECORDER_TIMEOUT_S)
        if recorder.returncode != 0:
            last = recorder_errors.strip().splitlines()[-1:] or ["nothing on stderr"]
            ending = _ending(recorder.returncode, recorder_errors)
            failures.append(last[0] if recorder.returncode == 2 else f"the recorder {ending}")
    if failures:
        raise GatewayError("\n".join(failures))


def _follow(
    loop: "subprocess.Popen[str]",
    recorder: "subprocess.Popen[str]",
    reader: RingReader,
    prepared: PreparedRun,
    start_ns: int,
    switch: StopSwitch,
    failures: list[str],
    on_progress: Callable[[Progress], None] | None,
    on_event: Callable[[dict[str, Any]], None] | None,
) -> None:
    """Watch the run until the cyclic process ends; hand on stops, events and progress."""
    step = "starting"
    turns = 0.0
    total = (prepared.plan.end_position - prepared.plan.at(0.0)[0]) / math.tau
    first: float | None = None
    is_recorder_lost = False
    tell = on_event or _tell_nobody
    while True:
        with suppress(subprocess.TimeoutExpired):
            loop.wait(POLL_S)
        is_over = loop.poll() is not None
        if switch.request is not StopRequest.NONE:
            reader.request_stop(switch.request)
        if recorder.poll() is not None and not is_over and not is_recorder_lost:
            is_recorder_lost = True
            # A run that nobody records goes on: the machine is as safe as before, and the cycle never waits for a disk.
            ending = _ending(recorder.returncode, "").partition(" (")[0]
            tell({"kind": "recorder_lost", "text": f"the recorder {ending}: the run goes on, unrecorded"})
        samples, _ = reader.read_new()
        if len(samples):
            position = float(samples["master_position"][-1])
            first = position if first is None else first
            turns = abs(position - first) / math.tau
        for event in reader.read_new_events()[0]:
            kind, text = str(event.data.get("kind")), str(event.data.get("text"))
            if kind == "step":
                step = text
            elif kind == "failure":
                failures.append(text)
            tell(dict(event.data))
        if not is_over and _is_hung(reader):
            failures.append(f"the cyclic process gave no sign of life for {HUNG_S:g} s and was killed")
            loop.kill()
            loop.wait()
        if on_progress is not None:
            on_progress(Progress((time.monotonic_ns() - start_ns) * 1e-9, step, turns, total))
        if is_over:
            return


def _tell_nobody(_event: dict[str, Any]) -> None:
    pass


def _is_hung(reader: RingReader) -> bool:
    """Whether the loop runs, has shown signs of life, and shows them no more."""
    heartbeat_ns = reader.heartbeat_ns
    silent_s = (time.monotonic_ns() - heartbeat_ns) * 1e-9
    return reader.state is RunState.RUNNING and heartbeat_ns > 0 and silent_s > HUNG_S


def _ending(status: int, errors: str) -> str:
    """How a child ended: by which signal, or with which status and what it said last."""
    if status < 0:
        return f"was ended by {signal.Signals(-status).name}"
    last = errors.strip().splitlines()[-1:] or ["nothing on stderr"]
    return f"ended with status {status} ({last[0]})"


def _end(process: "subprocess.Popen[str]", timeout_s: float) -> str:
    """Wait for a child, end it if it does not; returns what it wrote to stderr."""
    try:
        _, errors = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            _, errors = process.communicate(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            _, errors = process.communicate()
    return errors or ""


@contextmanager
def emulator_process(
    config_path: Path,
    *,
    interface: str | None,
    channel: str | None,
    timeout_s: float = 90.0,
    on_wait: Callable[[float], None] | None = None,
    seed: int = 0,
) -> Generator[BusAddress]:
    """Start ``sim-drive`` as a process of its own, wait until it serves its bus, and end it afterwards.

    Raises GatewayError if it does not come up; what it says on stderr is in the error.
    """
    with tempfile.TemporaryDirectory() as folder:
        ready = Path(folder, "ready.json")
        command = [sys.executable, "-m", "gateway.running.child_process", str(os.getpid())]
        command += ["sim_drive", str(config_path), "--port", "0"]
        command += ["--ready-file", str(ready), "--seed", str(seed), "--realtime"]
        command += ["--interface", interface] if interface else []
        command += ["--channel", channel] if channel else []
        process = subprocess.Popen(  # noqa: S603 -- our own module
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=_python_environment(),
            text=True,
            start_new_session=True,
        )
        try:
            started = time.monotonic()
            while not ready.exists() or not ready.read_text().endswith("\n"):
                waited = time.monotonic() - started
                if process.poll() is not None or waited > timeout_s:
                    errors = _end(process, 0.1).strip()
                    raise GatewayError(errors.splitlines()[-1] if errors else "the emulator did not come up")
                if on_wait is not None:
                    on_wait(waited)
                time.sleep(0.05)
            place = json.loads(ready.read_text())
            try:
                yield BusAddress(
                    place["interface"], place["channel"], place.get("host") or "", int(place.get("port") or 0)
                )
            except (GatewayError, BusError) as error:
                if process.poll() is None:
                    raise
                ending = _ending(process.returncode, _end(process, 0.1))
                raise GatewayError(f"{error}\nthe emulated machine {ending}") from None
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            _end(process, 10.0)
