"""One emulated CANopen node: NMT, SDO, PDO, SYNC, heartbeats and EMCY around CiA 402 axes; a core without I/O."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from config.quirks import Quirk
from drivers import objects
from drivers.frame import Frame
from drivers.nmt import HEARTBEAT_BASE, MAX_NODE_ID, NMT_COB_ID, NmtCommand, NmtState
from drivers.node import Event
from drivers.object_dictionary import ObjectDictionary
from drivers.sdo import SDO_REQUEST_BASE, ClientCommand
from sim_drive.communication.dictionary import LiveDictionary
from sim_drive.communication.emcy import EmergencyCode, EmergencyProducer, ErrorRegister
from sim_drive.communication.heartbeat import HeartbeatConsumer, HeartbeatProducer
from sim_drive.communication.lss_slave import LSS_REQUEST_COB_ID, UNCONFIGURED_NODE_ID, LssHooks, LssSlave
from sim_drive.communication.nmt_slave import next_state, parse_command
from sim_drive.communication.node_guarding import NodeGuard
from sim_drive.communication.parameters import MemoryParameterStore, ParameterMemory, ParametersLost, ParameterStore
from sim_drive.communication.sdo_server import SdoServer
from sim_drive.communication.time_of_day import TimeConsumer, TimeOfDay
from sim_drive.device.axis import Axis
from sim_drive.device.cam_slots import CamDecoder, CamSlots
from sim_drive.device.cia402 import Mode, PowerState
from sim_drive.device.pdo_exchange import PDO_COUNT, FrameHandler, PdoExchange, RequestHandler
from sim_drive.device.quirks import apply_quirks
from sim_drive.logical_axes import MAX_AXES, of_axis
from sim_drive.settings import DriveIdentity, DriveSettings

__all__ = [
    "PDO_COUNT",
    "UNCONFIGURED_NODE_ID",
    "BitTimingActivated",
    "Drive",
    "DriveIdentity",
    "DriveSettings",
    "NmtStateChanged",
    "NodeIdChanged",
]

_NS_PER_S: Final = 1_000_000_000
_LAST_COMMUNICATION_INDEX: Final = 0x1FFF
_LAST_INDEX: Final = 0xFFFF

_COMMUNICATION_ERRORS: Final = (
    EmergencyCode.HEARTBEAT,
    EmergencyCode.PDO_TOO_SHORT,
    EmergencyCode.PDO_TOO_LONG,
    EmergencyCode.SYNC_LENGTH,
    EmergencyCode.RPDO_TIMEOUT,
)
"""Errors whose cause ends with a reset, because what noticed them starts anew."""

_BLOCK_COMMANDS: Final = frozenset({int(ClientCommand.BLOCK_DOWNLOAD), int(ClientCommand.BLOCK_UPLOAD)})
_UNKNOWN_COMMAND: Final = 0xE0


@dataclass(frozen=True, slots=True)
class NmtStateChanged(Event):
    """The drive has entered an NMT state."""

    node_id: int
    state: NmtState


@dataclass(frozen=True, slots=True)
class NodeIdChanged(Event):
    """The drive has taken another node id, which LSS or its store has given it; 255 is none."""

    old_node_id: int
    node_id: int


@dataclass(frozen=True, slots=True)
class BitTimingActivated(Event):
    """The LSS master has all nodes change their bit rate; the emulated bus has none to change.

    ``bit_timing`` is an index into the table of CiA 305.
    """

    node_id: int
    bit_timing: int
    delay_ms: int


class Drive:
    """The core of one drive. It boots at its first ``wake``, and takes no frame before.

    Without a node id (``UNCONFIGURED_NODE_ID``) it does not boot, and takes LSS frames alone.

    ``outbox`` and ``events`` are lists that a host may also empty in place; they are never replaced.
    """

    def __init__(
        self,
        node_id: int,
        dictionary: ObjectDictionary,
        settings: DriveSettings,
        decode_cam: CamDecoder,
        store: ParameterStore | None = None,
        describe: Callable[[int], ObjectDictionary] | None = None,
    ) -> None:
        """Make a drive that is switched off; ``dictionary`` is what ``load_eds`` gives for this node id.

        With ``settings.further_axes`` it has several logical axes (``logical_axes.eds_of_axes`` makes the EDS of it).

        ``store`` is its non-volatile memory (see ``parameter_file.make_parameter_store``); None: one of its own, which
        is lost with the drive. ``describe`` gives the dictionary for any node id (``drivers.eds.describe_any_node``);
        without it LSS cannot give the drive another one. What is stored for LSS goes before ``node_id``.

        Raises:
            ValueError: ``node_id`` is neither 1 to 127 nor, with ``describe``, 255, or ``gains`` are not five, or there
                are more than eight axes.
            KeyError: the dictionary lacks an object that the drive needs.
        """
        if not 1 <= node_id <= MAX_NODE_ID and (node_id != UNCONFIGURED_NODE_ID or describe is None):
            raise ValueError(f"node_id must be 1 to {MAX_NODE_ID}, not {node_id}")
        if len(settings.further_axes) >= MAX_AXES:
            raise ValueError(f"a node has at most {MAX_AXES} axes, not {len(settings.further_axes) + 1}")
        self.node_id = node_id
        """It changes at a reset, if LSS has given another one."""
        self._made_node_id: Final = node_id
        self._describe: Final = describe
        self.settings: Final = settings
        self.outbox: list[Frame] = []
        self.events: list[Event] = []
        self.dictionary: Final = LiveDictionary(dictionary)
        self.watches_events = False
        """Whether ``after_servo_tick`` has anything to do."""
        self.subscriptions_changed = True
        """Set whenever ``cob_ids`` gives something else than before; whoever re-reads it sets it back."""

        numbers = range(1, len(settings.further_axes) + 2)
        codes = [self.dictionary.entry(of_axis(objects.ERROR_CODE, number)) for number in numbers]
        self._emergency = EmergencyProducer(node_id, self.dictionary, self.outbox, self.events, codes)
        self._cam_slots = [CamSlots(self.dictionary, decode_cam, number) for number in numbers]
        self.axes: Final = tuple(
            Axis(
                node_id, self.dictionary, own, self._cam_slots[number - 1], self._emergency.of_axis(number),
                self.events, number,
            )
            for number, own in zip(numbers, (settings, *settings.further_axes), strict=True)
        )  # fmt: skip
        """The logical axes, one in most nodes."""
        self.axis: Final = self.axes[0]
        self._set_identity()
        sdo_timeout_ns = round(settings.sdo_timeout_s * _NS_PER_S)
        self._sdo = SdoServer(node_id, self.dictionary, self.outbox, sdo_timeout_ns, settings.sdo_block_size)
        self._producer = HeartbeatProducer(node_id, self.dictionary, self.outbox)
        self._consumer = HeartbeatConsumer(self.dictionary, self._on_guard_change, self._subscribe)
        self._guard = NodeGuard(node_id, self.dictionary, self.outbox, self._on_guard_change)
        self._time = TimeConsumer(self.dictionary, self._subscribe)
        self._emergency.on_held_back = self._expect_wake
        self._pdos = PdoExchange(
            self.dictionary,
            self.axes,
            self.outbox,
            self._emergency,
            self._subscribe,
            self._expect_wake,
            acts_on_receipt=Quirk.RPDO_ACTS_ON_RECEIPT in settings.quirks,
        )
        self._communication_error = self.dictionary.entry(objects.ERROR_BEHAVIOUR, 1)
        self._memory = ParameterMemory(
            node_id, self.dictionary, store or MemoryParameterStore(), self._on_parameters_saved
        )
        hooks = LssHooks(self._memory.save_layer_settings, self._on_lss_waiting, self._on_bit_timing)
        self._lss = LssSlave(node_id, self.dictionary, self.outbox, hooks, can_change=describe is not None)
        if self._memory.stored.values:
            self._memory.apply(objects.DEVICE_TYPE, _LAST_INDEX)
            for axis in self.axes:
                axis.restore()

        self._handlers: dict[int, FrameHandler] = {}
        self._request_handlers: dict[int, RequestHandler] = {}
        """By the COB-ID of a remote frame."""
        self.nmt_state = NmtState.BOOT_UP
        self._boot_due_ns: int | None = 0
        self._is_powered_on = False
        self.is_switched_off = False
        """Without supply, by ``switch_off``."""
        self._next_wake_ns: int | None = 0
        self.is_wake_stale = False
        """Whether ``next_wake_ns`` has to look anew."""
        apply_quirks(self)

    def _set_identity(self) -> None:
        identity = self.settings.identity
        parts = (identity.vendor_id, identity.product_code, identity.revision_number, identity.serial_number)
        for subindex, part in enumerate(parts, start=1):
            entry = self.dictionary.entry(objects.IDENTITY, subindex)
            entry.default = part
            entry.value = part

    # -- the seam ------------------------------------------------------------------------------------------------

    def cob_ids(self) -> set[int]:
        """COB-IDs that the drive listens to."""
        return {*self._handlers, *self._request_handlers}

    def handler_of(self, cob_id: int) -> FrameHandler | None:
        """What ``receive`` does with a data frame of this COB-ID, until ``subscriptions_changed``."""
        return self._handlers.get(cob_id)

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Take a frame of another node; what is not for this drive passes by."""
        handler = self._handlers.get(frame.cob_id)
        if frame.is_remote:
            self._take_request(frame.cob_id, now_ns)
        elif handler is not None:
            handler(frame.data, now_ns)

    def _take_request(self, cob_id: int, now_ns: int) -> None:
        handler = self._request_handlers.get(cob_id)
        if handler is not None:
            self.is_wake_stale = True
            handler(now_ns)

    def next_wake_ns(self) -> int | None:
        """When heartbeats, SDO or PDO timers, or the boot-up want ``wake``."""
        if self.is_wake_stale:
            self.is_wake_stale = False
            self._next_wake_ns = self._find_next_wake()
        return self._next_wake_ns

    def wake(self, now_ns: int) -> None:
        """Do what is due."""
        self.is_wake_stale = True
        if self.is_switched_off:
            return
        if self._boot_due_ns is not None:
            if not self._is_powered_on:
                self._is_powered_on = True
                self._boot_due_ns = now_ns + round(self.settings.boot_up_delay_s * _NS_PER_S)
                self._take_node_id(self._persistent_node_id, now_ns)
            if now_ns < self._boot_due_ns:
                return
            self._boot_up(now_ns)
        if self.node_id == UNCONFIGURED_NODE_ID:
            return
        self._consumer.wake(now_ns)
        self._guard.wake(now_ns)
        self._emergency.wake(now_ns)
        self._sdo.wake(now_ns)
        self._pdos.wake(now_ns)
        self._producer.wake(now_ns, self.nmt_state)

    def take_frames(self) -> list[Frame]:
        """Frames to be sent, oldest first."""
        if not self.outbox:
            return []
        frames = self.outbox.copy()
        self.outbox.clear()
        return frames

    def take_events(self) -> list[Event]:
        """Events since the last call, oldest first."""
        events = self.events.copy()
        self.events.clear()
        return events

    def _find_next_wake(self) -> int | None:
        if self.is_switched_off:
            return None
        if self._boot_due_ns is not None:
            return self._boot_due_ns
        if self.node_id == UNCONFIGURED_NODE_ID:
            return None
        timers = (self._consumer, self._guard, self._emergency, self._sdo, self._pdos, self._producer)
        dues = [timer.next_wake_ns() for timer in timers]
        return min((due for due in dues if due is not None), default=None)

    # -- what the machine uses -----------------------------------------------------------------------------------

    def after_servo_tick(self, now_ns: int) -> None:
        """Every axis has had its servo tick: see what event-driven TPDOs make of it."""
        if self.watches_events:
            self._pdos.poll(now_ns)

    def on_servo_tick(self, now_ns: int, *shaft_counts: int) -> None:
        """One servo period of a drive that no machine moves, with the resolvers' counts since power-on."""
        for axis, counts in zip(self.axes, shaft_counts, strict=True):
            axis.on_tick(now_ns, counts)
        self.after_servo_tick(now_ns)

    @property
    def position_demand_counts(self) -> float:
        """Position demand of the first axis at the last servo tick, in shaft counts."""
        return self.axis.position_demand_counts

    @property
    def is_powered(self) -> bool:
        """Whether the amplifier of any axis may put torque on its motor."""
        return any(axis.is_powered for axis in self.axes)

    @property
    def power_state(self) -> PowerState:
        """State of the CiA 402 state machine of the first axis."""
        return self.axis.state

    @property
    def mode(self) -> Mode:
        """Active mode of operation of the first axis."""
        return self.axis.mode

    def time_of_day(self, now_ns: int) -> TimeOfDay | None:
        """What the TIME messages have told, carried on to ``now_ns``; None if none has come."""
        return self._time.now(now_ns)

    def trip(
        self, error_code: int, error_register_bits: int, now_ns: int, *, persists: bool = False, axis: int | None = None
    ) -> None:
        """Make an axis fault (by its number from 1; None: every one): EMCY, fault reaction, fault.

        ``persists`` until ``end_trip`` is called. A drive that is switched off notices nothing but a cause that
        persists, once it is on again.
        """
        for each in self.axes:
            if axis in (None, each.number):
                each.trip(error_code, error_register_bits, now_ns, persists=persists)

    def end_trip(self, error_code: int, now_ns: int, *, axis: int | None = None) -> None:
        """The cause of a persisting trip has gone, so that a fault reset is accepted again."""
        for each in self.axes:
            if axis in (None, each.number):
                each.end_warning(error_code, now_ns)

    def warn(self, error_code: int, error_register_bits: int, now_ns: int) -> None:
        """Raise an error of the node that does not lead to a fault; it lasts until ``end_warning`` is called."""
        if not self.is_switched_off:
            self._emergency.raise_error(error_code, error_register_bits, now_ns, is_fault=False, persists=True)

    def end_warning(self, error_code: int, now_ns: int) -> None:
        """The cause of ``warn`` has gone."""
        self._emergency.end_cause(error_code, now_ns)

    def lose_connection(self, now_ns: int) -> None:
        """The drive has been cut off from the bus: an enabled axis faults (8100h)."""
        if not self.is_switched_off:
            self._lose_connection(now_ns)

    def switch_off(self, now_ns: int) -> None:
        """Take the supply away: no torque, brake engaged, deaf and mute, and all that is in RAM is lost."""
        self.is_switched_off = True
        for axis in self.axes:
            axis.is_switched_off = True
        self._enter(NmtState.BOOT_UP, now_ns)
        self._reset(True, now_ns)
        self.outbox.clear()
        self.is_wake_stale = True

    def switch_on(self, now_ns: int) -> None:
        """Give the supply back: the drive boots."""
        if self.is_switched_off:
            self.is_switched_off = False
            for axis in self.axes:
                axis.is_switched_off = False
            self._is_powered_on = False
            self._boot_due_ns = now_ns
            self.is_wake_stale = True

    # -- NMT -----------------------------------------------------------------------------------------------------

    def _on_nmt(self, data: bytes, now_ns: int) -> None:
        command = parse_command(data, self.node_id)
        if command is None:
            return
        self.is_wake_stale = True
        is_reset = command in {NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION}
        state = next_state(command)
        if state is self.nmt_state:
            return
        self._enter(state, now_ns)
        if state is NmtState.STOPPED or command is NmtCommand.RESET_COMMUNICATION:
            self._lose_connection(now_ns)
        if is_reset:
            self._reset(command is NmtCommand.RESET_NODE, now_ns)

    def _lose_connection(self, now_ns: int) -> None:
        """An axis that is enabled does not go on without its master."""
        for axis in self.axes:
            if axis.is_powered:
                axis.lose_connection(EmergencyCode.COMMUNICATION, ErrorRegister.COMMUNICATION, now_ns)

    def _reset(self, is_whole_node: bool, now_ns: int) -> None:
        self._take_node_id(self._persistent_node_id if is_whole_node else self._lss.pending_node_id, now_ns)
        last_index = _LAST_INDEX if is_whole_node else _LAST_COMMUNICATION_INDEX
        self.dictionary.restore_defaults(objects.DEVICE_TYPE, last_index)
        self._memory.apply(objects.DEVICE_TYPE, last_index)
        self._sdo.reset()
        for code in _COMMUNICATION_ERRORS:
            self._emergency.end_cause(code, now_ns)
        if is_whole_node:
            self._emergency.forget()
            for slots in self._cam_slots:
                slots.restore()
            for axis in self.axes:
                axis.restore()
            self._time.forget()
        self._emergency.restore()
        self._handlers = {}
        self._request_handlers = {}
        self.subscriptions_changed = True
        if self.is_switched_off:
            self._boot_due_ns = None
            return
        self._boot_due_ns = now_ns + round(self.settings.boot_up_delay_s * _NS_PER_S)
        if now_ns >= self._boot_due_ns:
            self._boot_up(now_ns)

    def _boot_up(self, now_ns: int) -> None:
        self._boot_due_ns = None
        if self.node_id == UNCONFIGURED_NODE_ID:
            self._handlers = {LSS_REQUEST_COB_ID: self._on_lss}
            self.subscriptions_changed = True
            return
        self._pdos.restore(now_ns)
        self._producer.restore(now_ns)
        self._consumer.restore()
        self._guard.restore()
        self._pdos.rearrange(now_ns)
        self._producer.send_boot_up()
        if Quirk.NO_BOOT_UP in self.settings.quirks:
            self.outbox.pop()
        elif Quirk.SHORT_BOOT_UP in self.settings.quirks:
            self.outbox.append(Frame(self.outbox.pop().cob_id))
        self._enter(NmtState.PRE_OPERATIONAL, now_ns)
        if self._memory.damage is not None:
            self._tell_loss(self._memory.damage, now_ns)

    @property
    def _persistent_node_id(self) -> int:
        stored = self._memory.stored.node_id
        return self._made_node_id if stored is None or self._describe is None else stored

    def _take_node_id(self, node_id: int, now_ns: int) -> None:
        """Become another node, with the communication parameters that it has by default or from the store."""
        self._lss.restart(node_id)
        if node_id == self.node_id:
            return
        self.events.append(NodeIdChanged(now_ns, self.node_id, node_id))
        self.node_id = node_id
        self._memory.node_id = node_id
        if self._describe is not None and node_id != UNCONFIGURED_NODE_ID:
            self.dictionary.redescribe(self._describe(node_id))
            self.dictionary.restore_defaults(objects.DEVICE_TYPE, _LAST_COMMUNICATION_INDEX)
            self._memory.apply(objects.DEVICE_TYPE, _LAST_COMMUNICATION_INDEX)
        for service in (self._emergency, self._sdo, self._producer, self._guard):
            service.set_node_id(node_id)
        for axis in self.axes:
            axis.node_id = node_id

    def _tell_loss(self, reason: str, now_ns: int) -> None:
        if not self._emergency.is_active(EmergencyCode.PARAMETERS_LOST):
            self.events.append(ParametersLost(now_ns, self.node_id, reason))
        self._emergency.raise_error(
            EmergencyCode.PARAMETERS_LOST, ErrorRegister.DEVICE_PROFILE, now_ns, is_fault=False, persists=False
        )

    def _on_parameters_saved(self, now_ns: int) -> None:
        self._emergency.end_cause(EmergencyCode.PARAMETERS_LOST, now_ns)

    def _enter(self, state: NmtState, now_ns: int) -> None:
        self.nmt_state = state
        self.events.append(NmtStateChanged(now_ns, self.node_id, state))
        self._emergency.is_silent = state in {NmtState.STOPPED, NmtState.BOOT_UP}
        self._sdo.reset()
        self._pdos.enter(state is NmtState.OPERATIONAL, now_ns)
        self.watches_events = self._pdos.watches_events

    # -- subscriptions -------------------------------------------------------------------------------------------

    def _subscribe(self) -> None:
        handlers: dict[int, FrameHandler] = {}
        for cob_id, handler in self._pdos.handlers():
            _add(handlers, cob_id, handler)
        for node_id in self._consumer.node_ids:
            _add(handlers, HEARTBEAT_BASE + node_id, self._heartbeat_handler(node_id))
        if self._time.cob_id is not None:
            _add(handlers, self._time.cob_id, self._on_time)
        _add(handlers, LSS_REQUEST_COB_ID, self._on_lss)
        _add(handlers, SDO_REQUEST_BASE + self.node_id, self._on_sdo)
        _add(handlers, NMT_COB_ID, self._on_nmt)
        self._handlers = handlers
        self.watches_events = self._pdos.watches_events
        self._request_handlers = self._pdos.request_handlers()
        self._request_handlers[HEARTBEAT_BASE + self.node_id] = self._on_guard_request
        self.is_wake_stale = True
        self.subscriptions_changed = True

    def _heartbeat_handler(self, node_id: int) -> FrameHandler:
        def handle(data: bytes, now_ns: int) -> None:
            self.is_wake_stale = True
            self._consumer.receive(node_id, data, now_ns)

        return handle

    def _on_guard_request(self, now_ns: int) -> None:
        self._guard.on_request(self.nmt_state, now_ns)

    def _on_time(self, data: bytes, now_ns: int) -> None:
        if self.nmt_state is not NmtState.STOPPED:
            self._time.receive(data, now_ns)

    def _on_lss(self, data: bytes, now_ns: int) -> None:
        self.is_wake_stale = True
        self._lss.receive(data, now_ns)

    def _on_lss_waiting(self, now_ns: int) -> None:
        """A node that had no node id, and has been given one, boots."""
        if self.node_id == UNCONFIGURED_NODE_ID != self._lss.pending_node_id:
            self._reset(False, now_ns)

    def _on_bit_timing(self, bit_timing: int, delay_ms: int, now_ns: int) -> None:
        self.events.append(BitTimingActivated(now_ns, self.node_id, bit_timing, delay_ms))

    def _expect_wake(self) -> None:
        self.is_wake_stale = True

    def _on_sdo(self, data: bytes, now_ns: int) -> None:
        if self.nmt_state in {NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL}:
            self.is_wake_stale = True
            if data and data[0] >> 5 in _BLOCK_COMMANDS and Quirk.NO_BLOCK_TRANSFER in self.settings.quirks:
                # A command that no server knows, so that this one answers as to any other.
                data = bytes((_UNKNOWN_COMMAND, *data[1:]))
            self._sdo.receive(data, now_ns)

    # -- error control of the master, by heartbeat or guarding -------------------------------------------------------

    def _on_guard_change(self, is_lost: bool, now_ns: int) -> None:
        if not is_lost:
            if not self._consumer.has_lost and not self._guard.is_lost:
                self._emergency.end_cause(EmergencyCode.HEARTBEAT, now_ns)
            return
        if not self.is_powered:
            self._emergency.raise_error(
                EmergencyCode.HEARTBEAT, ErrorRegister.COMMUNICATION, now_ns, is_fault=False, persists=True
            )
        for axis in self.axes:
            if axis.is_powered:
                axis.lose_connection(EmergencyCode.HEARTBEAT, ErrorRegister.COMMUNICATION, now_ns, persists=True)
        action = self._communication_error.value
        if action == 0 and self.nmt_state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL, now_ns)
        elif action == 2 and self.nmt_state is not NmtState.STOPPED:
            self._enter(NmtState.STOPPED, now_ns)


def _add(handlers: dict[int, FrameHandler], cob_id: int, handler: FrameHandler) -> None:
    """Let ``handler`` take frames of ``cob_id``, after those that already do."""
    first = handlers.get(cob_id)
    if first is None:
        handlers[cob_id] = handler
        return

    def both(data: bytes, now_ns: int) -> None:
        first(data, now_ns)
        handler(data, now_ns)

    handlers[cob_id] = both
