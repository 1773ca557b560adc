"""The cyclic loop's own process: ``python -m gateway.running.cyclic_process``, its job as JSON on stdin.

It writes samples and events into the ring that the parent has made, takes stop requests from it, and ends with the
session. It outlives nobody: a parent that dies is a request for a controlled stop.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Final

from config.loading import parse_config
from config.schema import GatewayConfig
from drivers.bus_off import Restarter, RestartSettings
from drivers.cia402 import COMMAND_QUICK_STOP
from drivers.errors import BusError, DriveError
from drivers.frame import Frame
from drivers.nmt import HEARTBEAT_BASE, SYNC_COB_ID
from drivers.ports import Port
from drivers.real_time import RealTimeSetting, try_realtime
from gateway.cyclic.cycle import RPDO_LAYOUT, SYNC_FRAME
from gateway.cyclic.guard import Condition, StopReason
from gateway.cyclic.operation import Order
from gateway.errors import GatewayError
from gateway.record.order_word import unpack_order
from gateway.record.ring import RingWriter, RunState, StopRequest
from gateway.running.assembly import build_core
from gateway.running.bus_address import BusAddress
from gateway.running.bus_budget import tpdo_deadline_us
from gateway.running.child_process import end_with
from gateway.running.controller_watch import ControllerWatch
from gateway.running.core import GatewayCore
from gateway.running.cycle_bus import CycleBus, open_cycle_bus
from gateway.running.cycle_host import CycleHost
from gateway.running.event_text import describe
from gateway.running.late_account import LateAccountant, is_processor_clock_fine, open_counters
from gateway.running.learning_store import LearningStore, open_store
from gateway.running.preparation import plan
from gateway.running.wake_trace import WakeTrace
from mechanism.cam_file import parse_cam_file

LISTENING_S: Final = 0.5
"""How long the bus is listened to at least before anything is sent on it; a socketcand server may keep frames from a
client for some tenths of a second after the greeting."""


@dataclass(frozen=True, slots=True)
class CyclicJob:
    """What the process is to do; travels as JSON."""

    ring: str
    config_path: str
    config_text: str
    cam_text: str
    machine_cycles: int
    interface: str
    channel: str
    host: str
    port: int
    bit_rate: int | None
    parent_pid: int
    is_wired: bool = True
    """Frames take their time on the bus, see `gateway.running.bus_budget.has_wire`."""
    is_homing_again: bool = False
    is_starting_anywhere: bool = False
    learn: str | None = None
    """File or folder with what has been learned; None leaves it to the configuration."""

    def to_json(self) -> str:
        """The job as it is sent to the process."""
        return json.dumps(asdict(self))


def refuse_other_master(port: Port, gateway_node_id: int, span_s: float) -> None:
    """Listen for ``span_s``, and refuse a bus that somebody else commands: two masters reset each other's drives.

    Raises GatewayError, and BusError when the bus goes away.
    """
    telltales = {SYNC_COB_ID: "SYNC", HEARTBEAT_BASE + gateway_node_id: f"the heartbeat of node {gateway_node_id}"}
    end_s = time.monotonic() + span_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        received = port.receive()
        if received is None:
            port.wait(left_s)
            continue
        sign = telltales.get(received[0].cob_id)
        if sign is not None:
            raise GatewayError(f"somebody else commands this bus: {sign} is on it, is another run going on?")


ORDERS: Final = frozenset(int(order) for order in Order)
WISH_OF_REQUEST: Final = {
    StopRequest.CONTROLLED_STOP: Condition.OPERATOR_STOP,
    StopRequest.SIGINT: Condition.SIGINT,
    StopRequest.SIGTERM: Condition.SIGTERM,
}


def pass_on_stop(core: GatewayCore, request: int, answered: int) -> int:
    """Hand a stop request to the core, once: a quick stop asked for again would undo the disabling that follows it.

    ``answered`` is what was handed on before; returns what has been handed on now.
    """
    if request <= answered:
        return answered
    if request >= StopRequest.QUICK_STOP:
        core.request_quick_stop()
    else:
        core.request_stop(WISH_OF_REQUEST[StopRequest(request)])
    return request


def pass_on_order(core: GatewayCore, word: int) -> int:
    """Hand an operator's order to the core; a word that is none passes. Returns the word."""
    _, order, value = unpack_order(word)
    if order in ORDERS:
        core.order(Order(order), value)
    return word


def stop_drives(core: GatewayCore, port: Port) -> None:
    """Last resort after a failure of our own: quick stop to every drive, taken over by one more SYNC.

    If even this does not reach them, they miss our heartbeat and their set-points, and stop by themselves.
    """
    for axis in core.loop.steering.axes:
        port.send(Frame(axis.rpdo_cob_id, RPDO_LAYOUT.pack(COMMAND_QUICK_STOP, axis.target, 0)))
    port.send(SYNC_FRAME)


def run_guarded(
    core: GatewayCore,
    bus: CycleBus,
    poll: Callable[[], None],
    late: LateAccountant | None = None,
    restart: RestartSettings | None = None,
) -> None:
    """Run the core by the real clock; a failure of our own, once the cycle runs, stops the drives before it is told.

    ``restart``: how the own controller is brought back after bus-off.
    """
    controller = bus.cyclic.controller
    restarter = Restarter(controller, bus.cyclic.link, restart or RestartSettings())
    try:
        CycleHost(
            core,
            bus.cyclic,
            poll,
            service=bus.service,
            sync=bus.sync,
            late=late,
            controller=ControllerWatch(controller, restarter, core),
            echo_cob_id=bus.echo_cob_id,
        ).run()
    except BusError:
        raise
    except Exception:
        if core.loop.is_running:
            stop_drives(core, bus.cyclic)
        raise
    finally:
        if late is not None:
            late.flush()


def tell_setting(ring: RingWriter, setting: RealTimeSetting) -> None:
    """What keeps the loop on time is an event of the run: on or off, and why."""
    state = "on" if setting.is_on else "off"
    text = f"{setting.feature.value} {state}: {setting.reason}"
    ring.append_event(time.monotonic_ns(), "realtime", text, is_on=setting.is_on)


def tell_bus(ring: RingWriter, config: GatewayConfig, address: BusAddress, is_wired: bool) -> None:
    """What the bus was taken for, which sets the TPDOs' deadline, is an event of the run."""
    taken = "taken for a bus with a wire" if is_wired else "frames take no time there"
    text = f"{address}: {taken}, TPDOs are waited for until {tpdo_deadline_us(config, is_wired):.0f} us after SYNC"
    ring.append_event(time.monotonic_ns(), "bus", text, is_wired=is_wired)


def join_bus(address: BusAddress, config: GatewayConfig, ring: RingWriter) -> CycleBus:
    """Listen whether the bus is free, and open what the cycle needs. Raises BusError and GatewayError."""
    listener = address.open()
    try:
        for setting in try_realtime(processor=config.bus.processor):
            tell_setting(ring, setting)
        refuse_other_master(listener, config.bus.gateway_node_id, max(LISTENING_S, 2.5 * config.cycle_s))
        bus = open_cycle_bus(address, config, listener)
    except BaseException:
        listener.close()
        raise
    if bus.cyclic is not listener:
        listener.close()
    tell_setting(ring, bus.sync_setting)
    tell_setting(ring, bus.stamp_setting)
    return bus


def keep_memory(store: LearningStore, core: GatewayCore, ring: RingWriter) -> GatewayError | None:
    """Write what has been learned; returns why it could not be written."""
    try:
        if store.keep(core):
            ring.append_event(time.monotonic_ns(), "learning", f"what was learned is in {store.path}")
    except GatewayError as error:
        return error
    return None


def late_accountant(config: GatewayConfig, bus: CycleBus, ring: RingWriter) -> LateAccountant:
    """Who tells, as events of the run, why demands were late, and of late wakes where the configuration asks for it."""
    period_ns = config.bus.cycle_us * 1000

    def tell(at_ns: int, kind: str, text: str, data: dict[str, str | int | bool]) -> None:
        ring.append_event(at_ns, kind, text, **data)

    def trace(text: str, figures: dict[str, int]) -> None:
        ring.append_event(time.monotonic_ns(), "late", text, source="gateway", **figures)

    is_fine, counters = is_processor_clock_fine(), open_counters()
    if counters is None or not is_fine:
        why = "goes in steps too large" if not is_fine else "leaves out waiting for a processor"
        text = f"account of processor time off: this kernel's {why}; of lateness only what passed asleep is explained"
        ring.append_event(time.monotonic_ns(), "realtime", text, is_on=False)
    return LateAccountant(
        period_ns,
        tell,
        is_echoed=bus.echo_cob_id is not None,
        is_fine=is_fine,
        counters=counters,
        trace=WakeTrace(period_ns, trace) if config.bus.trace_lateness else None,
    )


class Poll:
    """What passes between core and ring: events and a sign of life out, stops and orders in; to be called often."""

    def __init__(self, core: GatewayCore, ring: RingWriter) -> None:
        self._core = core
        self._ring = ring
        self._answered = int(StopRequest.NONE)
        self._ordered = 0
        self._told: set[str] = set()

    def __call__(self) -> None:
        core, ring = self._core, self._ring
        for event in core.take_events():
            kind, text, data = describe(event)
            ring.append_event(event.at_ns, kind, text, source="gateway", **data)
            if core.failure is not None:
                # The way back to standstill begins with an event and may take long; the user is to know at once.
                self.tell_failure(core.failure)
        ring.beat(time.monotonic_ns())
        self._answered = pass_on_stop(core, ring.stop_request(), self._answered)
        if ring.order_word() != self._ordered:
            self._ordered = pass_on_order(core, ring.order_word())

    def tell_failure(self, failure: Exception) -> None:
        """Tell why the run has failed, each sentence once."""
        for sentence in str(failure).splitlines():
            if sentence not in self._told:
                self._told.add(sentence)
                self._ring.append_event(time.monotonic_ns(), "failure", sentence)


def run_job(job: CyclicJob, ring: RingWriter) -> int:
    """Carry out the job; returns the process' exit status (0 done, 1 the machine said no)."""
    config = parse_config(job.config_text, Path(job.config_path))
    profile = parse_cam_file(job.cam_text, "cam of the job").cam.profile
    store = open_store(config, profile, None if job.learn is None else Path(job.learn))
    address = BusAddress(job.interface, job.channel, job.host, job.port, job.bit_rate)
    core = build_core(
        config,
        profile,
        plan(config, job.machine_cycles),
        ring,
        time.thread_time_ns,
        job.is_homing_again,
        None if store is None else store.learning(),
        tpdo_deadline_us(config, job.is_wired),
        job.machine_cycles if job.is_starting_anywhere else None,
    )
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def on_terminate(number: int, _frame: FrameType | None) -> None:
        ring.request_stop(StopRequest.SIGTERM if number == signal.SIGTERM else StopRequest.CONTROLLED_STOP)

    signal.signal(signal.SIGTERM, on_terminate)
    signal.signal(signal.SIGHUP, on_terminate)
    end_with(job.parent_pid)
    poll = Poll(core, ring)
    bus: CycleBus | None = None
    stopped_by = StopReason.BUS_LOST
    try:
        bus = join_bus(address, config, ring)
        tell_bus(ring, config, address, job.is_wired)
        ring.set_state(RunState.RUNNING)
        recovery = config.recovery
        restart = RestartSettings(recovery.restart_delay_ms * 1e-3, recovery.max_restarts)
        run_guarded(core, bus, poll, late_accountant(config, bus, ring), restart)
        stopped_by = core.stopped_by
        failure: Exception | None = core.failure
    except BusError as error:
        failure = error
    except GatewayError as error:
        failure, stopped_by = error, StopReason.COMMISSIONING
    finally:
        if bus is not None:
            bus.close()
    poll()
    if store is not None and failure is None:
        failure = keep_memory(store, core, ring)
    if failure is not None:
        poll.tell_failure(failure)
    ring.append_event(time.monotonic_ns(), "end", f"stopped by {stopped_by.value}", stopped_by=stopped_by.value)
    is_failed = failure is not None
    ring.set_state(RunState.FAILED if is_failed else RunState.FINISHED, int(is_failed))
    return int(is_failed)


def main() -> int:
    """Read the job from stdin and carry it out."""
    job = CyclicJob(**json.loads(sys.stdin.read()))
    ring = RingWriter.take_over(Path(job.ring))
    try:
        return run_job(job, ring)
    except DriveError as error:
        ring.append_event(time.monotonic_ns(), "failure", str(error))
        ring.set_state(RunState.FAILED, 1)
        return 1
    except BaseException as error:
        ring.append_event(time.monotonic_ns(), "failure", f"internal error: {type(error).__name__}: {error}")
        ring.set_state(RunState.FAILED, 1)
        raise
    finally:
        # The ring is the parent's to remove, unless it is dead; who reads it keeps it.
        ring.close(unlink=os.getppid() != job.parent_pid)


if __name__ == "__main__":
    sys.exit(main())
