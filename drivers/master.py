"""The CANopen master: NMT, heartbeats, EMCY and SDO towards any number of nodes; a core without I/O.

Sequences are *procedures*: generators that yield the time at which they want to be resumed at the latest. They are
resumed after every frame and at that time, look at the master's state, and go on. So a commissioning of fifty steps
reads from top to bottom, and runs in virtual time and in real time alike.
"""

import struct
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Final, TypeVar

from drivers.errors import NoAnswerError, SdoAbortedError
from drivers.frame import Frame
from drivers.nmt import EMCY_BASE, HEARTBEAT_BASE, NMT_COB_ID, NmtCommand, NmtState
from drivers.node import Event
from drivers.object_dictionary import DataType, Value, decode, encode
from drivers.sdo import SDO_REQUEST_BASE, SDO_RESPONSE_BASE, AbortCode, abort_text
from drivers.sdo_block import MAX_BLOCK_SIZE
from drivers.sdo_client import (
    SdoTimeoutError,
    SdoTransferError,
    Transfer,
    Wait,
    abort_payload,
    download,
    download_block,
    upload,
    upload_block,
)

T = TypeVar("T")
Procedure = Generator[int, None, T]
"""A sequence in progress: yields the time (ns) by which it wants to be resumed, returns its result."""

DEFAULT_SDO_TIMEOUT_S: Final = 0.5
NS_PER_S: Final = 1_000_000_000
_RESPONSES_KEPT: Final = 2 * MAX_BLOCK_SIZE
_QUIET_S: Final = 0.02
"""After a client's abort: how long a server must have been silent for the rest of its sub-block to be over."""


@dataclass(frozen=True, slots=True)
class BootUpReceived(Event):
    """A node has sent its boot-up message."""

    node_id: int


@dataclass(frozen=True, slots=True)
class HeartbeatLost(Event):
    """A node whose heartbeat was being watched has fallen silent for ``timeout_s``."""

    node_id: int
    timeout_s: float


@dataclass(frozen=True, slots=True)
class NodeStateChanged(Event):
    """A heartbeat carries another NMT state than the one before."""

    node_id: int
    state: NmtState


@dataclass(frozen=True, slots=True)
class EmergencyReceived(Event):
    """An EMCY frame: emergency error code, error register, and the manufacturer's five bytes."""

    node_id: int
    code: int
    register: int
    vendor: bytes


class RemoteNode:
    """What the master knows of one node."""

    __slots__ = (
        "boot_ups",
        "emergencies",
        "heartbeat_at_ns",
        "heartbeat_timeout_ns",
        "is_lost",
        "last_emergency",
        "node_id",
        "responses",
        "state",
    )

    def __init__(self, node_id: int) -> None:
        self.node_id = node_id
        self.state: NmtState | None = None
        self.boot_ups = 0
        self.heartbeat_at_ns = 0
        self.heartbeat_timeout_ns = 0
        """0: its heartbeat is not watched."""
        self.is_lost = False
        self.emergencies = 0
        self.last_emergency: EmergencyReceived | None = None
        self.responses: deque[bytes] = deque(maxlen=_RESPONSES_KEPT)
        """SDO responses that no transfer has taken yet."""


class Master:
    """The master's side of CiA 301 for a set of nodes."""

    def __init__(self, node_ids: list[int], own_node_id: int, heartbeat_period_ns: int) -> None:
        """``own_node_id`` and ``heartbeat_period_ns``: the master's own heartbeat; a period of 0 sends none."""
        self.nodes: dict[int, RemoteNode] = {node_id: RemoteNode(node_id) for node_id in node_ids}
        self.now_ns = 0
        self.outbox: list[Frame] = []
        self.events: list[Event] = []
        self._heartbeat = Frame(HEARTBEAT_BASE + own_node_id, bytes((NmtState.OPERATIONAL,)))
        self._heartbeat_period_ns = heartbeat_period_ns
        self._heartbeat_due_ns = 0
        self._due_ns: int | None = None
        self._find_due()

    # -- the seam ------------------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Take a frame; frames of nodes that are not the master's own, and of services it does not use, pass by."""
        self.now_ns = now_ns
        if frame.is_remote:
            return
        node = self.nodes.get(frame.cob_id & 0x7F)
        if node is None:
            return
        service = frame.cob_id & 0x780
        if service == SDO_RESPONSE_BASE:
            node.responses.append(frame.data)
        elif service == HEARTBEAT_BASE:
            self._take_heartbeat(node, frame.data)
        elif service == EMCY_BASE and len(frame.data) == 8:
            code, register = struct.unpack_from("<HB", frame.data)
            node.emergencies += 1
            node.last_emergency = EmergencyReceived(now_ns, node.node_id, code, register, frame.data[3:])
            self.events.append(node.last_emergency)

    def _take_heartbeat(self, node: RemoteNode, data: bytes) -> None:
        if len(data) > 1:
            return
        try:
            # Some drives send their boot-up message, and that one alone, without its byte.
            state = NmtState(data[0] & 0x7F) if data else NmtState.BOOT_UP
        except ValueError:
            return
        node.heartbeat_at_ns = self.now_ns
        node.is_lost = False
        self._find_due()
        if state is NmtState.BOOT_UP:
            node.boot_ups += 1
            node.state = NmtState.PRE_OPERATIONAL
            self.events.append(BootUpReceived(self.now_ns, node.node_id))
        elif state is not node.state:
            node.state = state
            self.events.append(NodeStateChanged(self.now_ns, node.node_id, state))

    def next_wake_ns(self) -> int | None:
        """The next heartbeat of our own, or the next one to be missed of a node's."""
        return self._due_ns

    def _find_due(self) -> None:
        due = self._heartbeat_due_ns if self._heartbeat_period_ns else None
        for node in self.nodes.values():
            if node.heartbeat_timeout_ns and not node.is_lost:
                missed_at = node.heartbeat_at_ns + node.heartbeat_timeout_ns
                if due is None or missed_at < due:
                    due = missed_at
        self._due_ns = due

    def wake(self, now_ns: int) -> None:
        """Send our heartbeat and look for lost ones where due."""
        self.now_ns = now_ns
        if self._heartbeat_period_ns and now_ns >= self._heartbeat_due_ns:
            self.outbox.append(self._heartbeat)
            periods = (now_ns - self._heartbeat_due_ns) // self._heartbeat_period_ns + 1
            self._heartbeat_due_ns += periods * self._heartbeat_period_ns
        for node in self.nodes.values():
            if (
                node.heartbeat_timeout_ns
                and not node.is_lost
                and now_ns >= node.heartbeat_at_ns + node.heartbeat_timeout_ns
            ):
                node.is_lost = True
                self.events.append(HeartbeatLost(now_ns, node.node_id, node.heartbeat_timeout_ns / NS_PER_S))
        self._find_due()

    # -- commands ------------------------------------------------------------------------------------------------

    def command(self, command: NmtCommand, node_id: int) -> None:
        """Send an NMT command to one node (or to all, node id 0)."""
        self.outbox.append(Frame(NMT_COB_ID, bytes((command, node_id))))

    def watch_heartbeat(self, node_id: int, timeout_s: float) -> None:
        """Watch a node's heartbeat from now on; 0 stops watching."""
        node = self.nodes[node_id]
        node.heartbeat_timeout_ns = round(timeout_s * NS_PER_S)
        node.heartbeat_at_ns = self.now_ns
        node.is_lost = False
        self._find_due()

    # -- procedures ----------------------------------------------------------------------------------------------

    def wait_for(self, condition: Callable[[], bool], timeout_s: float) -> Procedure[bool]:
        """Wait until ``condition`` holds; returns False when ``timeout_s`` has passed first."""
        deadline_ns = self.now_ns + round(timeout_s * NS_PER_S)
        while not condition():
            if self.now_ns >= deadline_ns:
                return False
            yield deadline_ns
        return True

    def pause(self, span_s: float) -> Procedure[None]:
        """Let ``span_s`` pass."""
        yield from self.wait_for(lambda: False, span_s)

    def _transfer(
        self, node_id: int, index: int, subindex: int, exchange: Transfer[T], timeout_s: float
    ) -> Procedure[T]:
        cob_id = SDO_REQUEST_BASE + node_id
        responses = self.nodes[node_id].responses
        is_block_transfer = False
        try:
            request = next(exchange)
            while True:
                payloads, wait = ((request,), Wait.RESPONSE) if isinstance(request, bytes) else request
                if payloads:
                    responses.clear()
                    self.outbox += [Frame(cob_id, payload) for payload in payloads]
                if wait is Wait.NOTHING:
                    request = next(exchange)
                    continue
                is_block_transfer = is_block_transfer or not isinstance(request, bytes)
                # A pause between responses is a lost one long before the server gives up waiting for us.
                patience_s = timeout_s / 2 if wait is Wait.MORE else timeout_s
                yield from self.wait_for(lambda: bool(responses), patience_s)
                request = exchange.send(responses.popleft()) if responses else exchange.throw(SdoTimeoutError())
        except StopIteration as done:
            return done.value
        except SdoTimeoutError:
            self.outbox.append(Frame(cob_id, abort_payload(index, subindex, AbortCode.PROTOCOL_TIMED_OUT)))
            raise NoAnswerError(node_id, f"SDO {index:04X}h:{subindex:02X}", timeout_s) from None
        except SdoTransferError as failure:
            if not failure.is_by_server:
                self.outbox.append(Frame(cob_id, abort_payload(index, subindex, failure.code)))
                if is_block_transfer:
                    yield from self._let_pass(responses)
            raise SdoAbortedError(node_id, index, subindex, failure.code, abort_text(failure.code)) from None

    def _let_pass(self, responses: deque[bytes]) -> Procedure[None]:
        """Wait for the end of a sub-block that nobody wants any more, so that it is no answer to what comes next."""
        for _ in range(_RESPONSES_KEPT):
            responses.clear()
            if not (yield from self.wait_for(lambda: bool(responses), _QUIET_S)):
                return

    def upload(
        self, node_id: int, index: int, subindex: int, timeout_s: float = DEFAULT_SDO_TIMEOUT_S
    ) -> Procedure[bytes]:
        """Read an object's bytes. Raises SdoAbortedError or NoAnswerError."""
        return self._transfer(node_id, index, subindex, upload(index, subindex), timeout_s)

    def download(
        self, node_id: int, index: int, subindex: int, data: bytes, timeout_s: float = DEFAULT_SDO_TIMEOUT_S
    ) -> Procedure[None]:
        """Write an object's bytes. Raises SdoAbortedError or NoAnswerError."""
        return self._transfer(node_id, index, subindex, download(index, subindex, data), timeout_s)

    def upload_block(
        self,
        node_id: int,
        index: int,
        subindex: int,
        timeout_s: float = DEFAULT_SDO_TIMEOUT_S,
        block_size: int = MAX_BLOCK_SIZE,
        protocol_switch_threshold: int = 0,
    ) -> Procedure[bytes]:
        """Read an object's bytes by block transfer (see ``sdo_client.upload_block``), segmented if the node has none.

        Raises SdoAbortedError or NoAnswerError.
        """
        exchange = upload_block(index, subindex, block_size, protocol_switch_threshold)
        return self._transfer(node_id, index, subindex, exchange, timeout_s)

    def download_block(
        self, node_id: int, index: int, subindex: int, data: bytes, timeout_s: float = DEFAULT_SDO_TIMEOUT_S
    ) -> Procedure[None]:
        """Write an object's bytes by block transfer, segmented if the node has none.

        Raises SdoAbortedError or NoAnswerError.
        """
        return self._transfer(node_id, index, subindex, download_block(index, subindex, data), timeout_s)

    def read(self, node_id: int, index: int, subindex: int, data_type: DataType) -> Procedure[Value]:
        """Read a typed object; a length that is not the type's is answered with an SdoAbortedError."""
        data = yield from self.upload(node_id, index, subindex)
        try:
            return decode(data_type, data)
        except struct.error:
            code = AbortCode.LENGTH_MISMATCH
            raise SdoAbortedError(
                node_id, index, subindex, code, f"{len(data)} bytes are no {data_type.name}"
            ) from None

    def read_int(self, node_id: int, index: int, subindex: int, data_type: DataType) -> Procedure[int]:
        """Read an object of an integer type."""
        value = yield from self.read(node_id, index, subindex, data_type)
        return int(value)

    def write(self, node_id: int, index: int, subindex: int, data_type: DataType, value: Value) -> Procedure[None]:
        """Write a typed object."""
        yield from self.download(node_id, index, subindex, encode(data_type, value))

    def reset_communication(self, node_id: int, timeout_s: float) -> Procedure[None]:
        """Reset a node's communication and wait for its boot-up. Raises NoAnswerError."""
        node = self.nodes[node_id]
        before = node.boot_ups
        self.command(NmtCommand.RESET_COMMUNICATION, node_id)
        booted = yield from self.wait_for(lambda: node.boot_ups > before, timeout_s)
        if not booted:
            raise NoAnswerError(node_id, "its boot-up message", timeout_s)
