"""Which bus a run uses, and where it is."""

from dataclasses import dataclass

from config.schema import BusSection
from drivers.ports import Port, interface_is_up, open_port


@dataclass(frozen=True, slots=True)
class BusAddress:
    """An interface of python-can by its name, its channel, and, for socketcand, the server."""

    interface: str
    channel: str
    host: str
    port: int
    bit_rate: int | None = None
    """For interfaces that set it themselves; None leaves it to python-can. A SocketCAN interface has its own."""

    def __str__(self) -> str:
        if self.interface == "socketcand":
            return f"socketcand {self.host}:{self.port}"
        return f"{self.interface} {self.channel}"

    def open(self, filters: list[tuple[int, int]] | None = None) -> Port:
        """Open the bus. Raises drivers.errors.BusError."""
        options = {} if self.bit_rate is None else {"bitrate": self.bit_rate}
        return open_port(self.interface, self.channel, host=self.host, port=self.port, filters=filters, **options)


def resolve_bus(
    bus: BusSection, interface: str | None = None, channel: str | None = None, port: int | None = None
) -> BusAddress:
    """The bus that the configuration names, or the one named instead.

    ``auto`` is socketcan where the channel is an interface that is up, else socketcand on the configured host.
    """
    chosen_channel = channel or bus.channel
    chosen = interface or bus.interface
    if chosen == "auto":
        chosen = "socketcan" if interface_is_up(chosen_channel) else "socketcand"
    return BusAddress(chosen, chosen_channel, bus.host, bus.port if port is None else port, bus.bit_rate)
