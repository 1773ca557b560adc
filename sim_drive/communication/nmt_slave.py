"""NMT slave: the node's state and the commands that move it (CiA 301, 7.3.2.2)."""

from collections.abc import Mapping
from typing import Final

from drivers.nmt import ALL_NODES, NmtCommand, NmtState

_NEXT_STATE: Final[Mapping[NmtCommand, NmtState]] = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    # Both resets pass through initialisation, whose end the boot-up message tells.
    NmtCommand.RESET_NODE: NmtState.BOOT_UP,
    NmtCommand.RESET_COMMUNICATION: NmtState.BOOT_UP,
}
_COMMANDS: Final = {int(command): command for command in NmtCommand}
_COMMAND_LENGTH: Final = 2


def next_state(command: NmtCommand) -> NmtState:
    """The state that a command leads to; it is the same from every state but initialisation, which takes none."""
    return _NEXT_STATE[command]


def parse_command(data: bytes, node_id: int) -> NmtCommand | None:
    """The command in an NMT frame's data; None if it is for others, of a wrong length, or unknown."""
    if len(data) != _COMMAND_LENGTH or data[1] not in {ALL_NODES, node_id}:
        return None
    return _COMMANDS.get(data[0])
