"""The bus budget as `drive-gateway check` shows it, and the refusal of a run whose budget is not that of its bus."""

from pathlib import Path
from typing import Any, Final

from rich.table import Table

from config.bus_budget import MAX_BUS_LOAD
from config.schema import GatewayConfig
from gateway.errors import GatewayError
from gateway.running.bus_address import BusAddress

_NETWORK_INTERFACES: Final = Path("/sys/class/net")
WITHOUT_WIRE: Final = frozenset({"socketcand", "virtual"})
"""Interfaces of python-can on which a frame takes no time: TCP on loopback, and in process."""


def has_wire(address: BusAddress, root: Path = _NETWORK_INTERFACES) -> bool:
    """Whether frames take their time on this bus; vcan and loopback have no bit rate."""
    if address.interface in WITHOUT_WIRE:
        return False
    if address.interface != "socketcan":
        return True
    try:
        return "virtual" not in (root / address.channel).resolve(strict=True).parts
    except OSError:
        return True


def require_budget(config: GatewayConfig, address: BusAddress) -> None:
    """Raises GatewayError for a configuration that is for virtual channels alone, on a bus that is none."""
    budget = config.budget
    if config.bus.is_virtual and not budget.is_within_bound and has_wire(address):
        raise GatewayError(
            f"bus.is_virtual: {address} is a real bus, on which a cycle of {budget.cycle_us} us is taken to "
            f"{budget.load:.0%} (bound {MAX_BUS_LOAD:.0%}); {budget.shortest_cycle_us} us would fit"
        )


def budget_json(config: GatewayConfig) -> dict[str, Any]:
    """Stable keys."""
    budget = config.budget
    return {
        "cycle_s": config.cycle_s,
        "bit_rate": budget.bit_rate,
        "is_virtual": config.bus.is_virtual,
        "rows": [
            {
                "what": row.what,
                "data_bytes": row.data_bytes,
                "frames_a_cycle": row.frames_a_cycle,
                "wire_us": round(row.wire_us, 3),
            }
            for row in budget.rows
        ],
        "wire_us": round(budget.wire_us, 3),
        "load": round(budget.load, 6),
        "bound": MAX_BUS_LOAD,
        "is_within_bound": budget.is_within_bound,
        "shortest_cycle_us": budget.shortest_cycle_us,
        "tpdo_deadline_us": round(config.tpdo_deadline_us, 3),
    }


def budget_table(config: GatewayConfig) -> Table:
    """The budget for a terminal."""
    budget = config.budget
    title = f"Bus budget: {budget.cycle_us} us a cycle at {budget.bit_rate / 1000:g} kbit/s, worst-case stuffing"
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for name in ("bytes", "frames a cycle", "us a cycle", "share"):
        table.add_column(name, justify="right")
    for row in budget.rows:
        share = f"{row.wire_us / budget.cycle_us:.1%}"
        table.add_row(row.what, str(row.data_bytes), f"{row.frames_a_cycle:g}", f"{row.wire_us:.1f}", share)
    table.add_section()
    table.add_row("all", "", "", f"{budget.wire_us:.1f}", f"{budget.load:.1%}")
    return table


def budget_verdict(config: GatewayConfig) -> str:
    """What follows from it, in a sentence."""
    budget = config.budget
    if budget.is_within_bound:
        return (
            f"bound {MAX_BUS_LOAD:.0%}; the shortest cycle that fits is {budget.shortest_cycle_us} us; "
            f"TPDOs are waited for until {config.tpdo_deadline_us:.0f} us after SYNC"
        )
    return (
        f"too full for a real bus (bound {MAX_BUS_LOAD:.0%}), {budget.shortest_cycle_us} us would fit; "
        "allowed because bus.is_virtual says that frames take no time here"
    )
