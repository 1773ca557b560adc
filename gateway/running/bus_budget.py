"""The bus budget as `drive-gateway check` shows it, and the refusal of a run whose budget is not that of its bus."""

import ipaddress
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from rich.table import Table

from config.bus_budget import MAX_BUS_LOAD, deadline_without_wire_us
from config.schema import GatewayConfig
from drivers.socketcand_word import says_no_wire
from gateway.errors import GatewayError
from gateway.running.bus_address import BusAddress

_NETWORK_INTERFACES: Final = Path("/sys/class/net")


def has_wire(
    address: BusAddress,
    root: Path = _NETWORK_INTERFACES,
    says_no_wire: Callable[[str, int], bool] = says_no_wire,
) -> bool:
    """Whether frames take their time on this bus; in doubt they do.

    They take none in this process, on an interface that the kernel calls virtual, and behind a socketcand server on
    this machine that says so itself, as ``sim-drive`` does: any other such server may stand before a real bus.
    """
    if address.interface == "virtual":
        return False
    if address.interface == "socketcand":
        return not (_is_loopback(address.host) and says_no_wire(address.host, address.port))
    if address.interface != "socketcan":
        return True
    try:
        return "virtual" not in (root / address.channel).resolve(strict=True).parts
    except OSError:
        return True


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_budget(config: GatewayConfig, address: BusAddress, is_wired: bool) -> None:
    """Raises GatewayError for a configuration that is for virtual channels alone, on a bus that is none."""
    budget = config.budget
    if not (config.bus.is_virtual and is_wired) or budget.is_within_bound:
        return
    what = "may stand before a real bus" if address.interface == "socketcand" else "is a real bus"
    raise GatewayError(
        f"bus.is_virtual: {address} {what}, on which a cycle of {budget.cycle_us} us is taken to "
        f"{budget.load:.0%} (bound {MAX_BUS_LOAD:.0%}); {budget.shortest_cycle_us} us would fit"
    )


def tpdo_deadline_us(config: GatewayConfig, is_wired: bool) -> float:
    """How long after SYNC the TPDOs are waited for on a bus, whatever the configuration takes that for."""
    return config.budget.tpdo_deadline_us if is_wired else deadline_without_wire_us(config.bus.cycle_us)


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
