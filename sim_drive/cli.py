"""Command line of the emulated machine: ``sim-drive``."""

import contextlib
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NoReturn

import typer

from config.loading import SHIPPED, ConfigError, load_config
from config.quirks import Quirk
from config.schema import BusSection, GatewayConfig
from drivers.bus_off import Restarter, RestartSettings
from drivers.eds import read_eds_text
from drivers.errors import BusError, DriveError
from drivers.nmt import MAX_NODE_ID
from drivers.node import Event, Node
from drivers.node_runner import RunStatistics
from drivers.ports import interface_is_up, open_port
from drivers.real_time import freeze_garbage, run_node, tighten_timers, try_realtime
from mechanism.errors import MechanismError
from sim_drive.device.quirks import describe_quirks
from sim_drive.injection.faults import Fault, describe_faults
from sim_drive.injection.scenario import Scenario, load_scenario, parse_fault
from sim_drive.logical_axes import MAX_AXES, eds_of_axes
from sim_drive.settings import DriveSettings
from sim_drive.socketcand_server import SocketcandServer

if TYPE_CHECKING:
    from sim_drive.injection.injector import Injector
    from sim_drive.machine import EmulatedMachine

_EXIT_BUS: Final = 1
_EXIT_USE: Final = 2
_MAX_DIGITS: Final = 9

_EPILOG: Final = """Examples:

\b
  sim-drive paper                            vcan0 where it is up, else socketcand on 127.0.0.1
  sim-drive paper --port 0 --json            any free port; a JSON line says which
  sim-drive paper --interface socketcan --channel vcan1
  sim-drive paper --duration 60 --ready-file /tmp/ready.json
  sim-drive --nodes 1-20,30                  no machine: drives on free axes, at most 127
  sim-drive --nodes 5 --axes-per-node 2      a two-axis drive: its second axis has its objects at 6800h, PDOs from 65 on
  sim-drive paper --axes-per-node 2          the machine's two axes in one node, that of the first
  sim-drive --nodes 5 --axes-per-node 2 --write-eds two.eds    the EDS file of such a node, and exit
  sim-drive paper --fault "servo over_current at_s=3" --fault "1 lost_frames cob_id=0x181 probability=0.01"
  sim-drive paper --scenario trouble.yaml    the same in a file, faults: [{node: servo, kind: over_current, at_s: 3}]
  sim-drive --list-faults                    every kind of fault, and what it takes
  sim-drive paper --quirk slow_mode_switch   a habit of real drives; in CONFIG: emulation.quirks of an axis

Connect to it, over socketcand, with python-can:

\b
  can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=29536, tcp_tune=True)

at_s counts from when the machine is switched on, in its own time; for_s says how long a fault lasts, else to the end.

Exit status: 0 after --duration, SIGINT or SIGTERM; 1 if the bus cannot be opened or is lost; 2 for wrong use, a bad
configuration or a bad scenario.
"""

app: Final = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the emulated bus is to be found; ``host`` and ``port`` with socketcand alone."""

    interface: str
    channel: str
    host: str | None = None
    port: int | None = None

    def __str__(self) -> str:
        at = "" if self.host is None else f" at {self.host}:{self.port}"
        return f"{self.interface} {self.channel}{at}"


@dataclass(frozen=True, slots=True)
class _Announcement:
    """Whom to tell once the bus is served."""

    as_json: bool
    file: Path | None
    descriptor: int | None

    def make(self, name: str, place: _Place) -> None:
        line = json.dumps(asdict(place))
        if self.as_json:
            print(json.dumps({"event": "ready", **asdict(place)}), flush=True)
        print(f"sim-drive: {name} is on {place}", file=sys.stderr, flush=True)
        if self.file is not None:
            # Renamed into place, so that whoever waits for the file never reads half of it.
            temporary = self.file.with_name(f".{self.file.name}.{os.getpid()}")
            temporary.write_text(line + "\n", encoding="utf-8")
            temporary.replace(self.file)
        if self.descriptor is not None:
            with open(self.descriptor, "w", encoding="utf-8") as pipe:  # noqa: PTH123 - a descriptor, not a path
                pipe.write(line + "\n")


@dataclass(frozen=True, slots=True)
class _Fleet:
    """Which drives there are."""

    name: str
    node_ids: tuple[int, ...]
    config: GatewayConfig | None = None
    """None: drives on free axes."""
    names: dict[str, int] = field(default_factory=dict[str, int])
    """Node ids by the names of their axes."""
    axes_per_node: int = 1

    @property
    def axes(self) -> dict[str, int] | None:
        """Numbers of the axes by their names, where they share a node."""
        return {name: place for place, name in enumerate(self.names, start=1)} if self.axes_per_node > 1 else None

    @property
    def eds(self) -> Path:
        """The EDS file of drives of one axis."""
        if self.config is None:
            return SHIPPED / "eds" / "sim_drive.eds"
        return self.config.relative(self.config.emulator.eds)


def _print_quirks(wanted: bool) -> None:
    if wanted:
        print(describe_quirks())
        raise typer.Exit


def _print_faults(wanted: bool) -> None:
    if wanted:
        print(describe_faults())
        raise typer.Exit


@app.command(epilog=_EPILOG)
def sim_drive(
    config: Annotated[
        str | None, typer.Argument(help="Configuration file, or the name of a shipped one: paper.")
    ] = None,
    nodes: Annotated[
        str | None, typer.Option(help="In place of CONFIG: node ids of drives on free axes, such as 1-20,30.")
    ] = None,
    axes_per_node: Annotated[
        int, typer.Option(min=1, max=MAX_AXES, help="Logical axes in each node; with CONFIG 1, or all in one.")
    ] = 1,
    write_eds: Annotated[
        Path | None, typer.Option(help="Write the EDS file of the drives to this file, and exit.")
    ] = None,
    scenario: Annotated[Path | None, typer.Option(help="File that says which faults there are, and when.")] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help='One fault: "NODE KIND [KEY=VALUE]..."; may be given several times.')
    ] = None,
    list_faults: Annotated[
        bool,
        typer.Option("--list-faults", help="List all faults and exit.", callback=_print_faults, is_eager=True),
    ] = False,
    quirk: Annotated[
        list[Quirk] | None,
        typer.Option(metavar="NAME", help="A habit of real drives that all have; may be given several times."),
    ] = None,
    list_quirks: Annotated[
        bool, typer.Option("--list-quirks", help="List all habits and exit.", callback=_print_quirks, is_eager=True)
    ] = False,
    interface: Annotated[
        str | None, typer.Option(help="auto, socketcan, socketcand or a python-can interface  [default: from CONFIG]")
    ] = None,
    channel: Annotated[str | None, typer.Option(help="Name of the bus  [default: from CONFIG]")] = None,
    host: Annotated[str | None, typer.Option(help="socketcand: address to listen at  [default: from CONFIG]")] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="socketcand: TCP port, 0 for any free one  [default: from CONFIG]"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random in the machine.")] = 0,
    duration: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after so many seconds  [default: run until told to stop]")
    ] = None,
    ready_file: Annotated[
        Path | None, typer.Option(help="Write where the bus is, as one JSON line, to this file once it is served.")
    ] = None,
    ready_fd: Annotated[int | None, typer.Option(min=0, help="The same, to this open file descriptor.")] = None,
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Let --host be an address that other machines can reach.")
    ] = False,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Ask for SCHED_FIFO and locked memory, and say what was granted.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Report on standard output, one JSON object a line: ready, faults, stopped.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log clients coming and going.")] = False,
) -> None:
    """Emulate the drives of a machine, and the machine that they move, on a CAN bus."""
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="sim-drive: %(message)s")
    stop = _stop_on_signals()
    fleet = _fleet(config, nodes, axes_per_node)
    if write_eds is not None:
        write_eds.write_text(eds_of_axes(read_eds_text(fleet.eds), axes_per_node), encoding="utf-8")
        return
    trouble = _scenario(scenario, fault or [], fleet)
    bus_section = BusSection() if fleet.config is None else fleet.config.bus
    place = _place(bus_section, interface, channel, host, port)
    announcement = _Announcement(as_json, ready_file, ready_fd)

    def build() -> Node:
        machine = _build(fleet, frozenset(quirk or ()), trouble, seed)
        _prepare_process(realtime)
        return machine

    def until() -> Callable[[], bool]:
        if duration is None:
            return stop
        end_s = time.monotonic() + duration
        return lambda: stop() or time.monotonic() >= end_s

    on_event = _fault_reporter(as_json) if trouble.faults else None
    if place.host is None or place.port is None:
        bus = open_port(place.interface, place.channel)
        try:
            machine = build()
            announcement.make(fleet.name, place)
            restarter = Restarter(bus.controller, bus.link, RestartSettings())
            statistics = run_node(machine, bus, until(), on_event, restarter=restarter)
        finally:
            bus.close()
    else:
        server = SocketcandServer(
            build(), place.host, place.port, place.channel, on_event=on_event, allow_remote=allow_remote
        )
        with server:
            real_host, real_port = server.address
            announcement.make(fleet.name, _Place(place.interface, place.channel, real_host, real_port))
            statistics = server.run(until())
    _report(statistics, as_json)


def main() -> NoReturn:
    """Run the command line; every foreseen error becomes one sentence on standard error and an exit status."""
    try:
        app(prog_name="sim-drive")
    except ConfigError as error:
        status, sentences = _EXIT_USE, error.problems
    except (DriveError, MechanismError) as error:
        status, sentences = (_EXIT_BUS if isinstance(error, BusError) else _EXIT_USE), [str(error)]
    except OSError as error:
        status, sentences = _EXIT_USE, [f"{error.filename or 'input/output'}: {error.strerror or error}"]
    else:
        sys.exit(0)
    for sentence in sentences:
        print(f"sim-drive: {sentence}", file=sys.stderr)
    sys.exit(status)


def _fleet(config: str | None, nodes: str | None, axes_per_node: int) -> _Fleet:
    """The drives that the command line asks for. Raises ConfigError."""
    if (config is None) == (nodes is None):
        raise ConfigError(["give either CONFIG or --nodes" + (", not both" if config is not None else "")])
    if nodes is not None:
        node_ids = parse_node_ids(nodes)
        name = f"a row of {len(node_ids) * axes_per_node} free axes"
        return _Fleet(name, node_ids, axes_per_node=axes_per_node)
    settings = load_config(config or "")
    names = {name: settings.axes[name].node_id for name in settings.axis_names}
    if axes_per_node == 1:
        return _Fleet(settings.name, tuple(names.values()), settings, names)
    if axes_per_node != len(names):
        raise ConfigError([f"--axes-per-node {axes_per_node}: a machine of {len(names)} axes takes 1 or {len(names)}"])
    first = next(iter(names.values()))
    return _Fleet(settings.name, (first,), settings, dict.fromkeys(names, first), axes_per_node)


def parse_node_ids(text: str) -> tuple[int, ...]:
    """Node ids such as ``1-20,30``, in the order in which they are given. Raises ConfigError."""
    node_ids: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = (first, last if dash else first)
        if not all(end.isascii() and end.isdigit() and len(end) <= _MAX_DIGITS for end in ends):
            raise ConfigError([f"--nodes {text}: '{part}' is neither a node id nor a range such as 1-20"])
        low, high = map(int, ends)
        for node_id in (low, high):
            if not 1 <= node_id <= MAX_NODE_ID:
                raise ConfigError([f"--nodes {text}: node id {node_id} is not 1 to {MAX_NODE_ID}"])
        if low > high:
            raise ConfigError([f"--nodes {text}: {part} runs backwards"])
        for node_id in range(low, high + 1):
            if node_id in node_ids:
                raise ConfigError([f"--nodes {text}: node id {node_id} is given twice, every node id must be unique"])
            node_ids.append(node_id)
    return tuple(node_ids)


def _scenario(file: Path | None, words: Sequence[str], fleet: _Fleet) -> Scenario:
    """All faults that the command line asks for. Raises ConfigError."""
    scenario = Scenario() if file is None else load_scenario(file, fleet.names, fleet.node_ids, fleet.axes)
    further: list[Fault] = []
    for text in words:
        further += parse_fault(text, fleet.names, fleet.node_ids, fleet.axes)
    return Scenario((*scenario.faults, *further), scenario.seed, scenario.name)


def _build(fleet: _Fleet, quirks: frozenset[Quirk], scenario: Scenario, seed: int) -> "EmulatedMachine | Injector":
    # Here, not above: the maths behind it takes a second to import, for which --help and errors need not wait.
    from sim_drive.assembly import FREE_AXIS_GAINS, build_machine, free_machine, settings_of_axes
    from sim_drive.injection.injector import Injector

    if fleet.config is None:
        settings = settings_of_axes(DriveSettings(gains=FREE_AXIS_GAINS, quirks=quirks), fleet.axes_per_node)
        machine = free_machine(fleet.node_ids, settings=settings, seed=seed)
    else:
        machine = build_machine(_with_quirks(fleet.config, quirks), seed, in_one_node=fleet.axes_per_node > 1)
    if not scenario.faults:
        return machine
    try:
        return Injector(machine, scenario.faults, scenario.seed ^ seed)
    except ValueError as error:
        raise ConfigError([str(error)]) from None


def _with_quirks(config: GatewayConfig, quirks: frozenset[Quirk]) -> GatewayConfig:
    """The configuration with further quirks for every axis."""
    axes = {
        name: axis.model_copy(
            update={"emulation": axis.emulation.model_copy(update={"quirks": axis.emulation.quirks | quirks})}
        )
        for name, axis in config.axes.items()
    }
    return config.model_copy(update={"axes": axes})


def _fault_reporter(as_json: bool) -> Callable[[Event], None]:
    """Tells of faults that begin and end, at_ns on the host's clock."""
    from sim_drive.injection.injector import FaultEnded, FaultStarted

    def report(event: Event) -> None:
        if not isinstance(event, FaultStarted | FaultEnded):
            return
        fault = event.fault
        is_start = isinstance(event, FaultStarted)
        if as_json:
            line = {
                "event": "fault_started" if is_start else "fault_ended",
                "at_ns": event.at_ns,
                "node_id": fault.node_id,
                "kind": fault.kind.value,
            }
            print(json.dumps(line), flush=True)
        verb = "begins" if is_start else "is over"
        print(f"sim-drive: node {fault.node_id}: {fault.kind.value} {verb}", file=sys.stderr, flush=True)

    return report


def _place(bus: BusSection, interface: str | None, channel: str | None, host: str | None, port: int | None) -> _Place:
    chosen_interface = interface or bus.interface
    chosen_channel = channel or bus.channel
    if chosen_interface == "auto":
        chosen_interface = "socketcan" if interface_is_up(chosen_channel) else "socketcand"
    if chosen_interface != "socketcand":
        return _Place(chosen_interface, chosen_channel)
    return _Place(chosen_interface, chosen_channel, host or bus.host, bus.port if port is None else port)


def _prepare_process(realtime: bool) -> None:
    if not realtime:
        tighten_timers()
        freeze_garbage()
        return
    for setting in try_realtime():
        state = "on" if setting.is_on else "off"
        print(f"sim-drive: {setting.feature.value}: {state} ({setting.reason})", file=sys.stderr)


def _stop_on_signals() -> Callable[[], bool]:
    """Make SIGINT and SIGTERM end the run in good order; the answer says whether one has come."""
    received: list[int] = []

    def note(number: int, _: object) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        # Only the main thread of a process may set handlers; elsewhere the caller has other means to stop.
        with contextlib.suppress(ValueError):
            signal.signal(number, note)
    return lambda: bool(received)


def _report(statistics: RunStatistics, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"event": "stopped", **asdict(statistics)}), flush=True)
    print(
        f"sim-drive: stopped after {statistics.wakes} wakes, {statistics.frames_received} frames received, "
        f"{statistics.frames_sent} sent; latest wake {statistics.max_wake_lateness_ns * 1e-6:.1f} ms late",
        file=sys.stderr,
    )
