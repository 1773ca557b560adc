"""Events of the cores in words and as data, for the event log of a run."""

import re
from dataclasses import fields
from enum import Enum
from typing import Final

from drivers.controller import ControllerChanged, ErrorState
from drivers.master import BootUpReceived, EmergencyReceived, HeartbeatLost, NodeStateChanged
from drivers.node import Event
from gateway.cyclic.guard import Condition, GuardTripped
from gateway.cyclic.operation import OrderAnswered
from gateway.running.commissioning import BootUpMissing
from gateway.running.controller_watch import RestartTold
from gateway.running.drive_guards import GuardMissing, GuardsSet
from gateway.running.machine_session import StepReached
from gateway.running.recovery import AxisRecovered

_UNITS: Final = {
    Condition.FOLLOWING_ERROR: "counts",
    Condition.CAM_WINDOW: "counts",
    Condition.FROZEN_ACTUAL: "counts of demand, the actual value stays",
    Condition.UNANSWERED_TORQUE: "per mille of torque, the actual value stays",
    Condition.VELOCITY: "counts a cycle",
    Condition.TORQUE: "per mille of rated torque",
}

EventData = dict[str, str | int | float | bool | None]


def describe(event: Event) -> tuple[str, str, EventData]:
    """Kind, sentence and data of an event; an event that is not the gateway's is told by its name and fields."""
    match event:
        case StepReached(_, step):
            return "step", step, {}
        case GuardTripped(_, condition, axis, value, limit, reaction):
            where = f" on axis {axis}" if axis else ""
            name, answer = condition.value.replace("_", " "), reaction.value.replace("_", " ")
            text = f"{name}{where}: {_guarded_value(condition, value, limit)}, {answer}"
            data: EventData = {"condition": condition.value, "axis": axis, "value": value, "limit": limit}
            return "guard", text, {**data, "reaction": reaction.value}
        case EmergencyReceived(_, node_id, code, register, vendor):
            cleared = " (cleared)" if code == 0 else ""
            text = f"node {node_id} EMCY {code:04X}h{cleared}, error register {register:02X}h"
            return "emergency", text, {"node_id": node_id, "code": code, "vendor": vendor.hex()}
        case HeartbeatLost(_, node_id, timeout_s):
            return "heartbeat_lost", f"node {node_id}: no heartbeat for {timeout_s:g} s", {"node_id": node_id}
        case BootUpReceived(_, node_id):
            return "boot_up", f"node {node_id} has booted up", {"node_id": node_id}
        case GuardsSet() | GuardMissing():
            return _describe_guards(event)
        case ControllerChanged() | RestartTold():
            return _describe_controller(event)
        case AxisRecovered(_, axis, is_ready, is_commissioned_anew, said):
            return (
                "recovery",
                f"axis {axis}: {said}",
                {"axis": axis, "is_ready": is_ready, "anew": is_commissioned_anew},
            )
        case OrderAnswered(_, order, value, refusal):
            name = order.name.lower().replace("_", " ")
            text = f"{name} {value:g} " + (f"refused: {refusal}" if refusal else "taken")
            return "order", text, {"order": name, "value": value, "refusal": refusal}
        case BootUpMissing(_, node_id):
            return "boot_up", f"node {node_id} answers, but sends no boot-up message", {"node_id": node_id}
        case NodeStateChanged(_, node_id, state):
            text = f"node {node_id} is {state.name.lower().replace('_', '-')}"
            return "nmt_state", text, {"node_id": node_id, "state": state.name.lower()}
        case _:
            return _describe_other(event)


def _describe_guards(event: GuardsSet | GuardMissing) -> tuple[str, str, EventData]:
    if isinstance(event, GuardMissing):
        guard = event.guard
        text = f"axis {event.axis}: the drive has no {guard.place} ({guard.name})"
        return "guard_missing", text, {"axis": event.axis, "object": guard.place}
    held = ", ".join(f"{guard.place} {guard.show(guard.value)}" for guard in event.guards)
    return "guards_set", f"axis {event.axis}: the drive holds {held}", {"axis": event.axis}


def _describe_controller(event: ControllerChanged | RestartTold) -> tuple[str, str, EventData]:
    if isinstance(event, RestartTold):
        return "controller", f"the gateway's CAN controller: {event.text}", {}
    text = f"the gateway's CAN controller is {event.state.value}"
    if event.state is not ErrorState.OFF:
        text += f", {event.transmit_errors} transmit errors, {event.receive_errors} receive errors"
    counters = {"transmit_errors": event.transmit_errors, "receive_errors": event.receive_errors}
    return "controller", text, {"state": event.state.value, **counters}


def _guarded_value(condition: Condition, value: int, limit: int) -> str:
    unit = _UNITS.get(condition)
    if unit is not None:
        return f"{value} {unit} (limit {limit})"
    match condition:
        case Condition.END_EFFECTOR_ERROR:
            return f"{value / 1000.0:.1f} mm (limit {limit / 1000.0:g})"
        case Condition.EMERGENCY | Condition.EMERGENCY_WARNING:
            return f"{value:04X}h"
        case Condition.DRIVE_FAULT:
            return f"statusword {value:04X}h"
        case Condition.HEARTBEAT_LOST:
            return f"silent for {limit} ms, or restarted"
        case Condition.BUS_OFF if limit == 0:
            return "the gateway's own controller has left the bus"
        case Condition.OPERATOR_STOP | Condition.SIGINT | Condition.SIGTERM:
            return "on request"
        case _:
            return f"{value} cycles in a row" if value != 1 else "in one cycle"


def _describe_other(event: Event) -> tuple[str, str, EventData]:
    """An event of a room that this one does not know: its name and its fields, in words."""
    name = re.sub(r"(?<!^)(?=[A-Z])", " ", type(event).__name__).lower()
    values = {field.name: getattr(event, field.name) for field in fields(event) if field.name != "at_ns"}
    shown = {key: value.name.lower() if isinstance(value, Enum) else str(value) for key, value in values.items()}
    text = ", ".join(f"{key.replace('_', ' ')} {value.replace('_', ' ')}" for key, value in shown.items())
    return name.replace(" ", "_"), f"{name}: {text}" if text else name, {**shown}
