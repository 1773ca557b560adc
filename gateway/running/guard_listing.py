"""The guard of a configuration, for people: every condition in the machine's own units, and how the drives guard us."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from config.guard_section import (
    AngleCondition,
    CodesCondition,
    CyclesCondition,
    LengthCondition,
    PercentCondition,
    PushCondition,
    Reaction,
    TorqueCondition,
)
from config.schema import AxisSection, GatewayConfig
from gateway.cyclic.answer import PUSHED_CYCLES
from gateway.cyclic.guard import Condition, persistence_cycles
from gateway.running.drive_settings import lasting_pushes


@dataclass(frozen=True, slots=True)
class GuardRow:
    """One condition; ``cycles``: for how many in a row it holds before something is done."""

    condition: Condition
    limit: str
    cycles: int
    reaction: Reaction


def guard_rows(config: GatewayConfig) -> list[GuardRow]:
    """All conditions, in the order of the configuration's guard section."""
    rows: list[GuardRow] = []
    for condition in Condition:
        rule = getattr(config.guard, condition.value)
        limit = _limit(config, condition, rule)
        rows.append(GuardRow(condition, limit, persistence_cycles(rule), rule.reaction))
    return rows


def drive_guards_text(config: GatewayConfig) -> str:
    """What stops the drives without the gateway, in a sentence."""
    watchdogs = [
        f"{name} after {axis.sync_watchdog.cycles} cycles without SYNC"
        for name, axis in zip(config.axis_names, config.ordered_axes, strict=True)
        if axis.sync_watchdog is not None
    ]
    heartbeat = f"after {config.bus.heartbeat_timeout_ms} ms without the gateway's heartbeat"
    return f"without the gateway the drives stop by themselves {heartbeat}" + (
        f", {' and '.join(watchdogs)}" if watchdogs else "; none has a SYNC watchdog (axes.*.sync_watchdog)"
    )


def guard_json(config: GatewayConfig) -> dict[str, Any]:
    """Stable keys."""
    conditions = config.guard.model_dump(mode="json")
    conditions[Condition.EMERGENCY_WARNING.value]["codes"].sort()
    return {
        "conditions": conditions,
        "following_error_counts": {
            name: axis.limits.gateway_error_counts
            for name, axis in zip(config.axis_names, config.ordered_axes, strict=True)
        },
        "heartbeat_timeout_ms": config.bus.heartbeat_timeout_ms,
        "sync_watchdog_cycles": {
            name: None if axis.sync_watchdog is None else axis.sync_watchdog.cycles
            for name, axis in zip(config.axis_names, config.ordered_axes, strict=True)
        },
    }


def guard_table(config: GatewayConfig) -> Table:
    """The guard for a terminal."""
    table = Table(title="Guard: what stops the machine", title_justify="left")
    for name, justify in (("", "left"), ("limit", "left"), ("for", "right"), ("reaction", "left")):
        table.add_column(name, justify=justify)  # pyright: ignore[reportArgumentType]
    for row in guard_rows(config):
        held = f"{row.cycles} cycles" if row.cycles > 1 else "at once"
        table.add_row(row.condition.value, row.limit, held, row.reaction.value)
    return table


def _limit(config: GatewayConfig, condition: Condition, rule: object) -> str:
    def by_axis(text: Callable[[AxisSection], str]) -> str:
        axes = zip(config.axis_names, config.ordered_axes, strict=True)
        return ", ".join(f"{name} {text(axis)}" for name, axis in axes)

    def counts(axis: AxisSection, degrees: float) -> str:
        return f"{degrees / 360.0 * axis.counts_per_revolution:.0f}"

    match rule:
        case AngleCondition(limit_deg=degrees) if condition is Condition.FROZEN_ACTUAL:
            return f"{degrees:g} deg: {by_axis(lambda axis: counts(axis, degrees))} counts"
        case AngleCondition(limit_deg=degrees):
            return f"{degrees:g} deg"
        case PercentCondition(limit_percent=percent):
            speeds = by_axis(lambda axis: f"{percent / 100.0 * axis.limits.velocity_rad_per_s:.3g}")
            return f"{percent:g} %: {speeds} rad/s"
        case TorqueCondition(limit_permille=permille):
            torques = by_axis(lambda axis: f"{permille / 1000.0 * axis.rated_torque_Nm:.3g}")
            return f"{permille} per mille: {torques} N m{_lasting(config, rule)}"
        case LengthCondition(limit_mm=length):
            return f"{length:g} mm"
        case CyclesCondition(limit_cycles=cycles):
            return f"{cycles} cycles in a row"
        case CodesCondition(codes=codes):
            return "EMCY " + ", ".join(f"{code:04X}h" for code in sorted(codes))
        case _ if condition is Condition.FOLLOWING_ERROR:
            return by_axis(
                lambda axis: (
                    f"{axis.limits.gateway_error_counts / axis.counts_per_revolution * 360.0:.3g} deg"
                    f" ({axis.limits.gateway_error_counts} counts)"
                )
            )
        case _:
            return ""


def _lasting(config: GatewayConfig, rule: TorqueCondition) -> str:
    if not isinstance(rule, PushCondition):
        return ""
    lasting = [f"{name} {permille}" for name, permille in zip(config.axis_names, lasting_pushes(config), strict=True)]
    text = f"; for {PUSHED_CYCLES} cycles {', '.join(lasting)} per mille"
    return f"{text}; or frozen_actual's way by the model" if config.feed_forward.tells_loads else text
