"""LSS slave (CiA 305): node id and bit timing set over the bus, by the identity object and without a node id."""

import struct
from collections.abc import Callable
from enum import IntEnum, unique
from typing import Final, NamedTuple

from drivers.frame import Frame
from drivers.nmt import MAX_NODE_ID
from drivers.objects import IDENTITY
from sim_drive.communication.dictionary import LiveDictionary

LSS_REQUEST_COB_ID: Final = 0x7E5
LSS_RESPONSE_COB_ID: Final = 0x7E4
LSS_LENGTH: Final = 8
UNCONFIGURED_NODE_ID: Final = 0xFF
"""Node id of a node that has none: it takes part in LSS alone."""
BIT_TIMINGS: Final = frozenset({0, 1, 2, 3, 4, 6, 7, 8})
"""Indices into the standard bit timing table: 1000, 800, 500, 250, 125, 50, 20, 10 kbit/s; 5 is reserved."""

_IDENTITY_PARTS: Final = 4
_FAST_SCAN_RESET: Final = 128
_LAST_BIT: Final = 31
_FAST_SCAN: Final = struct.Struct("<xIBBB")


@unique
class LssState(IntEnum):
    """Modes, as the service "switch state global" names them."""

    WAITING = 0
    CONFIGURATION = 1


@unique
class LssCommand(IntEnum):
    """Command specifiers of CiA 305."""

    SWITCH_STATE_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE_CONFIGURATION = 0x17
    SELECT_VENDOR_ID = 0x40
    """The first of four, in the order of the identity object."""
    SELECTED = 0x44
    IDENTIFY_VENDOR_ID = 0x46
    """The first of six: vendor id, product code, range of the revision number, range of the serial number."""
    IDENTIFY_UNCONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    IDENTIFIED_UNCONFIGURED = 0x50
    FAST_SCAN = 0x51
    INQUIRE_VENDOR_ID = 0x5A
    """The first of four, in the order of the identity object."""
    INQUIRE_NODE_ID = 0x5E


@unique
class LssError(IntEnum):
    """Error codes of the configuration services."""

    NONE = 0
    REFUSED = 1
    """Node id or bit timing out of range."""
    NOT_STORED = 2
    """The storage medium cannot be accessed."""


class LssHooks(NamedTuple):
    """What the slave has its node do; the last argument of each is the time in ns."""

    store: Callable[[int, int | None, int], bool]
    """``(node_id, bit_timing, now_ns)``: keep them for the next power-on; whether it has worked."""
    leave_configuration: Callable[[int], None]
    """The master has sent the slave back to waiting: a node without a node id takes the one it was given."""
    activate_bit_timing: Callable[[int, int, int], None]
    """``(bit_timing, delay_ms, now_ns)``: change the bit rate after the delay, and be silent for as long again."""


class LssSlave:
    """One node's LSS slave. A node id that it is given is pending until the node takes it at its next reset."""

    __slots__ = (
        "_can_change",
        "_dictionary",
        "_hooks",
        "_identified",
        "_outbox",
        "_scanned",
        "_selected",
        "_services",
        "active_node_id",
        "pending_bit_timing",
        "pending_node_id",
        "state",
    )

    def __init__(
        self, node_id: int, dictionary: LiveDictionary, outbox: list[Frame], hooks: LssHooks, can_change: bool
    ) -> None:
        """``can_change``: whether the node can live under another node id than ``node_id``."""
        self._dictionary = dictionary
        self._outbox = outbox
        self._hooks = hooks
        self._can_change = can_change
        self.active_node_id = node_id
        self.pending_node_id = node_id
        self.pending_bit_timing: int | None = None
        self.state = LssState.WAITING
        self._selected = 0
        self._identified = 0
        self._scanned = 0
        self._services: dict[int, Callable[[bytes, int], None]] = {
            LssCommand.SWITCH_STATE_GLOBAL: self._switch_state,
            LssCommand.CONFIGURE_NODE_ID: self._configure_node_id,
            LssCommand.CONFIGURE_BIT_TIMING: self._configure_bit_timing,
            LssCommand.ACTIVATE_BIT_TIMING: self._activate_bit_timing,
            LssCommand.STORE_CONFIGURATION: self._store_configuration,
            LssCommand.IDENTIFY_UNCONFIGURED: self._identify_unconfigured,
            LssCommand.FAST_SCAN: self._fast_scan,
            LssCommand.INQUIRE_NODE_ID: self._inquire_node_id,
        }
        self._services |= {LssCommand.SELECT_VENDOR_ID + n: self._select for n in range(_IDENTITY_PARTS)}
        self._services |= {LssCommand.IDENTIFY_VENDOR_ID + n: self._identify for n in range(len(_IDENTIFY_CHECKS))}
        self._services |= {LssCommand.INQUIRE_VENDOR_ID + n: self._inquire_identity for n in range(_IDENTITY_PARTS)}

    @property
    def is_unconfigured(self) -> bool:
        """Whether the node has no node id, and has not been given one either."""
        return self.active_node_id == self.pending_node_id == UNCONFIGURED_NODE_ID

    def restart(self, node_id: int) -> None:
        """The node goes through its initialisation, and is ``node_id`` from now on."""
        self.active_node_id = node_id
        self.pending_node_id = node_id
        self.state = LssState.WAITING
        self._selected = self._identified = self._scanned = 0

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take a request of the LSS master; what is no service, or not one for this state, is ignored."""
        service = self._services.get(data[0]) if len(data) == LSS_LENGTH else None
        if service is not None and (self.state is LssState.CONFIGURATION or data[0] not in _CONFIGURATION_ALONE):
            service(data, now_ns)

    # -- states ------------------------------------------------------------------------------------------------------

    def _switch_state(self, data: bytes, now_ns: int) -> None:
        if data[1] == LssState.CONFIGURATION:
            self.state = LssState.CONFIGURATION
        elif data[1] == LssState.WAITING:
            was_configured = self.state is LssState.CONFIGURATION
            self.state = LssState.WAITING
            if was_configured:
                self._hooks.leave_configuration(now_ns)

    def _identity(self, part: int) -> int:
        return self._dictionary.entry(IDENTITY, part + 1).value

    def _select(self, data: bytes, now_ns: int) -> None:
        part = data[0] - LssCommand.SELECT_VENDOR_ID
        if (
            self.state is not LssState.WAITING
            or part not in (0, self._selected)
            or _number(data) != self._identity(part)
        ):
            self._selected = 0
            return
        self._selected = part + 1
        if self._selected == _IDENTITY_PARTS:
            self._selected = 0
            self.state = LssState.CONFIGURATION
            self._answer(LssCommand.SELECTED)

    # -- configuration -----------------------------------------------------------------------------------------------

    def _configure_node_id(self, data: bytes, now_ns: int) -> None:
        node_id = data[1]
        is_node_id = 1 <= node_id <= MAX_NODE_ID or node_id == UNCONFIGURED_NODE_ID
        if is_node_id and (self._can_change or node_id == self.active_node_id):
            self.pending_node_id = node_id
            self._answer(LssCommand.CONFIGURE_NODE_ID, LssError.NONE)
        else:
            self._answer(LssCommand.CONFIGURE_NODE_ID, LssError.REFUSED)

    def _configure_bit_timing(self, data: bytes, now_ns: int) -> None:
        table, bit_timing = data[1], data[2]
        if table or bit_timing not in BIT_TIMINGS:
            self._answer(LssCommand.CONFIGURE_BIT_TIMING, LssError.REFUSED)
            return
        self.pending_bit_timing = bit_timing
        self._answer(LssCommand.CONFIGURE_BIT_TIMING, LssError.NONE)

    def _activate_bit_timing(self, data: bytes, now_ns: int) -> None:
        if self.pending_bit_timing is not None:
            self._hooks.activate_bit_timing(self.pending_bit_timing, int.from_bytes(data[1:3], "little"), now_ns)

    def _store_configuration(self, data: bytes, now_ns: int) -> None:
        is_stored = self._hooks.store(self.pending_node_id, self.pending_bit_timing, now_ns)
        self._answer(LssCommand.STORE_CONFIGURATION, LssError.NONE if is_stored else LssError.NOT_STORED)

    def _inquire_identity(self, data: bytes, now_ns: int) -> None:
        identity = self._identity(data[0] - LssCommand.INQUIRE_VENDOR_ID)
        self._answer(data[0], *identity.to_bytes(4, "little"))

    def _inquire_node_id(self, data: bytes, now_ns: int) -> None:
        self._answer(LssCommand.INQUIRE_NODE_ID, self.active_node_id)

    # -- identification ----------------------------------------------------------------------------------------------

    def _identify(self, data: bytes, now_ns: int) -> None:
        step = data[0] - LssCommand.IDENTIFY_VENDOR_ID
        part, fits = _IDENTIFY_CHECKS[step]
        if step not in (0, self._identified) or not fits(self._identity(part), _number(data)):
            self._identified = 0
            return
        self._identified = step + 1
        if self._identified == len(_IDENTIFY_CHECKS):
            self._identified = 0
            self._answer(LssCommand.IDENTIFIED)

    def _identify_unconfigured(self, data: bytes, now_ns: int) -> None:
        if self.is_unconfigured:
            self._answer(LssCommand.IDENTIFIED_UNCONFIGURED)

    def _fast_scan(self, data: bytes, now_ns: int) -> None:
        """Answer if the identity agrees in its higher bits; the last part found, the master has found this node."""
        if not self.is_unconfigured or self.state is not LssState.WAITING:
            return
        number, bit, part, next_part = _FAST_SCAN.unpack(data)
        if bit == _FAST_SCAN_RESET:
            self._scanned = 0
        elif not self._agrees(number, bit, part):
            return
        elif bit == 0 and next_part < _IDENTITY_PARTS:
            self._scanned = next_part
            if next_part < part:
                self.state = LssState.CONFIGURATION
        self._answer(LssCommand.IDENTIFIED)

    def _agrees(self, number: int, bit: int, part: int) -> bool:
        """Whether the part of the identity that is being scanned is ``number`` from ``bit`` upwards."""
        return bit <= _LAST_BIT and part == self._scanned and not (number ^ self._identity(part)) >> bit

    def _answer(self, command: int, *data: int) -> None:
        self._outbox.append(Frame(LSS_RESPONSE_COB_ID, bytes((command, *data)).ljust(LSS_LENGTH, b"\0")))


def _number(data: bytes) -> int:
    return int.from_bytes(data[1:5], "little")


def _is(own: int, given: int) -> bool:
    return own == given


def _is_at_least(own: int, given: int) -> bool:
    return own >= given


def _is_at_most(own: int, given: int) -> bool:
    return own <= given


_IDENTIFY_CHECKS: Final = (
    (0, _is),
    (1, _is),
    (2, _is_at_least),
    (2, _is_at_most),
    (3, _is_at_least),
    (3, _is_at_most),
)
"""For each of the six requests of "identify remote slave": part of the identity, and what it has to be."""

_CONFIGURATION_ALONE: Final = frozenset(
    {
        LssCommand.CONFIGURE_NODE_ID,
        LssCommand.CONFIGURE_BIT_TIMING,
        LssCommand.ACTIVATE_BIT_TIMING,
        LssCommand.STORE_CONFIGURATION,
        *range(LssCommand.INQUIRE_VENDOR_ID, LssCommand.INQUIRE_NODE_ID + 1),
    }
)
"""Services that only a slave in configuration state has."""
