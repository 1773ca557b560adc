"""The drive's application: the CiA 402 device behind the object dictionary, its modes, and the position demand.

Two frames of counts meet here. The *shaft* frame is what the resolver counts since power-on; the *user* frame is that
of the 60xxh objects: user = shaft + offset, as INTEGER32 with wrap. Homing moves the offset, never the demand in shaft
counts.
"""

from collections.abc import Callable
from enum import IntEnum, unique
from math import floor
from typing import Final

from drivers import objects
from drivers.node import Event
from drivers.sdo import AbortCode
from sim_drive.cam_slots import CamSlots
from sim_drive.cia402 import (
    COMMANDS,
    MODES,
    STATE_BITS,
    STOP_OPTIONS,
    Controlword,
    Mode,
    PowerCommand,
    PowerState,
    PowerStateChanged,
    Statusword,
    StopOption,
    next_state,
)
from sim_drive.demand import Demand
from sim_drive.dictionary import LiveDictionary
from sim_drive.emcy import EmergencyCode, EmergencyProducer, ErrorRegister
from sim_drive.homing import HOMING_METHODS, Homing, HomingStatus
from sim_drive.settings import DriveSettings

Latch = Callable[[int], tuple[int, float, int]]
"""Gives shaft position (counts), velocity (counts/s) and torque (per mille of rated torque) as of an instant in ns."""

FOLLOWING_ERROR_WINDOW_OFF: Final = 0xFFFFFFFF
CONTROLLER_GAIN_COUNT: Final = 5

_WRAP: Final = 1 << 32
_HALF: Final = 1 << 31
_INT16_MAX: Final = 32767
_NS_PER_MS: Final = 1_000_000
_S_PER_NS: Final = 1e-9

_BASE_BITS: Final = int(Statusword.VOLTAGE_ENABLED | Statusword.REMOTE)
_FOLLOWS: Final = int(Statusword.FOLLOWS_COMMAND)
_FOLLOWING_ERROR: Final = int(Statusword.FOLLOWING_ERROR)
_LIMITED: Final = int(Statusword.INTERNAL_LIMIT_ACTIVE)
_FAULT_RESET: Final = int(Controlword.FAULT_RESET)
_HOMING_START: Final = int(Controlword.HOMING_START)
_RESUMING: Final = (PowerState.QUICK_STOP_ACTIVE, PowerState.OPERATION_ENABLED)
_DRIVE_ERROR: Final = int(ErrorRegister.DEVICE_PROFILE)
# Members of an enumeration by a name of the module's own: looking them up in their class costs a call's time.
_OPERATION_ENABLED: Final = PowerState.OPERATION_ENABLED
_HOMING_MODE: Final = Mode.HOMING
_HOMING_IN_PROGRESS: Final = HomingStatus.IN_PROGRESS
_NO_CONTROLWORD: Final = -1


def wrap_int32(value: int) -> int:
    """``value`` modulo 2^32 as INTEGER32: position arithmetic of the drive wraps, as its counters do."""
    return ((value + _HALF) % _WRAP) - _HALF


@unique
class SetPointSource(IntEnum):
    """By what way a value comes into the dictionary."""

    SDO = 0
    EVENT_PDO = 1
    """RPDO of transmission type 254 or 255: it acts at once."""
    SYNC = 2
    """RPDO of transmission type 0 to 240: it acts at the SYNC."""


@unique
class _Following(IntEnum):
    NONE = 0
    POSITION = 1
    CAM = 2


_POSITION: Final = _Following.POSITION
_SYNC: Final = SetPointSource.SYNC


class Axis:
    """One CiA 402 axis. ``on_tick`` is its servo tick, ``sample`` and ``on_sync`` are what a SYNC does to it.

    In csp a target that a SYNC brings into effect is reached in a straight line one interpolation time (60C2h) later.
    If the next one is missing, the line goes on for one more interpolation time, then the position is held; after
    ``missing_set_point_limit`` interpolation times without a set-point the drive faults (8700h). A target by SDO or by
    an event-driven RPDO acts at once, promises no successor, and so is neither overrun nor guarded. Camming treats the
    master position in the same way, but takes an event-driven RPDO for a cyclic one too. Controlword bit 8 (halt) has
    no effect in the modes that the drive has.
    """

    __slots__ = (
        "_cam_target",
        "_controlword",
        "_demand",
        "_dictionary",
        "_emergency",
        "_events",
        "_following_error",
        "_following_error_since_ns",
        "_following_error_timeout",
        "_following_error_window",
        "_following_mode",
        "_gain_entries",
        "_home_offset",
        "_homing",
        "_homing_method",
        "_idle_controlword",
        "_internal_bits",
        "_interpolation_exponent",
        "_interpolation_value",
        "_is_cam_engaged",
        "_is_guarded",
        "_is_new_target",
        "_limit_high",
        "_limit_low",
        "_master",
        "_master_counts",
        "_master_offset",
        "_max_torque",
        "_mode",
        "_mode_display",
        "_mode_entry",
        "_new_target",
        "_node_id",
        "_offset",
        "_period_ns",
        "_period_s",
        "_position_actual",
        "_position_demand",
        "_quick_stop_deceleration",
        "_rated_torque_Nm",
        "_sampled_at_ns",
        "_set_point_at_ns",
        "_set_point_timeout_ns",
        "_settings",
        "_slots",
        "_state",
        "_statusword",
        "_stops_then_stays",
        "_target",
        "_torque_actual",
        "_torque_offset",
        "_velocity_actual",
        "gains",
        "is_powered",
        "latch",
        "position_demand_counts",
        "shaft_counts",
        "source",
    )

    def __init__(
        self,
        node_id: int,
        dictionary: LiveDictionary,
        settings: DriveSettings,
        slots: CamSlots,
        emergency: EmergencyProducer,
        events: list[Event],
    ) -> None:
        self._node_id = node_id
        self._dictionary = dictionary
        self._settings = settings
        self._slots = slots
        self._emergency = emergency
        self._events = events
        self.latch: Latch = _no_latch
        """Set by the drive."""
        self.source = SetPointSource.SDO
        """Set by whoever writes into the dictionary, around the writing."""

        entry = dictionary.entry
        self._controlword = entry(objects.CONTROLWORD)
        self._statusword = entry(objects.STATUSWORD)
        self._mode_entry = entry(objects.MODES_OF_OPERATION)
        self._mode_display = entry(objects.MODES_OF_OPERATION_DISPLAY)
        self._target = entry(objects.TARGET_POSITION)
        self._torque_offset = entry(objects.TORQUE_OFFSET)
        self._position_demand = entry(objects.POSITION_DEMAND_VALUE)
        self._position_actual = entry(objects.POSITION_ACTUAL_VALUE)
        self._velocity_actual = entry(objects.VELOCITY_ACTUAL_VALUE)
        self._torque_actual = entry(objects.TORQUE_ACTUAL_VALUE)
        self._following_error = entry(objects.FOLLOWING_ERROR_ACTUAL_VALUE)
        self._following_error_window = entry(objects.FOLLOWING_ERROR_WINDOW)
        self._following_error_timeout = entry(objects.FOLLOWING_ERROR_TIMEOUT)
        self._home_offset = entry(objects.HOME_OFFSET)
        self._homing_method = entry(objects.HOMING_METHOD)
        self._limit_low = entry(objects.SOFTWARE_POSITION_LIMIT, 1)
        self._limit_high = entry(objects.SOFTWARE_POSITION_LIMIT, 2)
        self._quick_stop_deceleration = entry(objects.QUICK_STOP_DECELERATION)
        self._interpolation_value = entry(objects.INTERPOLATION_TIME_PERIOD, 1)
        self._interpolation_exponent = entry(objects.INTERPOLATION_TIME_PERIOD, 2)
        self._max_torque = entry(objects.MAX_TORQUE)
        self._master = entry(objects.CAM_MASTER_POSITION)
        self._master_offset = entry(objects.CAM_MASTER_OFFSET)
        self._gain_entries = [entry(objects.CONTROLLER_GAINS, n + 1) for n in range(CONTROLLER_GAIN_COUNT)]
        self._rated_torque_Nm = settings.rated_torque_Nm
        self._set_defaults()
        self._set_hooks()

        self._demand = Demand()
        self._homing = Homing()
        self._idle_controlword = _NO_CONTROLWORD
        """The controlword that asks, as the one before it, for nothing new in the present state and mode."""
        self._offset = settings.initial_offset_counts
        self.shaft_counts = 0
        """Resolver counts at the last servo tick."""
        self.position_demand_counts = 0.0
        """Demand at the last servo tick, shaft frame."""
        self._state = PowerState.NOT_READY_TO_SWITCH_ON
        self._mode = Mode.NONE
        self._following_mode = _Following.NONE
        self.is_powered = False
        """Whether the amplifier may put torque on the motor."""
        self._stops_then_stays = False
        self._internal_bits = 0
        self._new_target = 0
        self._is_new_target = False
        self._is_guarded = False
        self._set_point_at_ns = 0
        self._set_point_timeout_ns = 0
        self._following_error_since_ns: int | None = None
        self._is_cam_engaged = False
        self._master_counts = 0
        self._cam_target = 0.0
        self._sampled_at_ns = -1
        self._period_ns = 0
        self._period_s = 0.0
        self.gains: tuple[int, ...] = ()
        self.restore()

    # -- set-up --------------------------------------------------------------------------------------------------

    def _set_defaults(self) -> None:
        settings = self._settings
        defaults = {
            (objects.IDENTITY, 1): settings.identity.vendor_id,
            (objects.IDENTITY, 2): settings.identity.product_code,
            (objects.IDENTITY, 3): settings.identity.revision_number,
            (objects.IDENTITY, 4): settings.identity.serial_number,
            (objects.POSITION_ENCODER_RESOLUTION, 1): settings.counts_per_revolution,
            (objects.MOTOR_RATED_TORQUE, 0): round(settings.rated_torque_Nm * 1000.0),
        }
        if settings.gains is not None:
            if len(settings.gains) != CONTROLLER_GAIN_COUNT:
                raise ValueError(f"a drive has {CONTROLLER_GAIN_COUNT} gains, not {len(settings.gains)}")
            defaults |= {(objects.CONTROLLER_GAINS, n + 1): gain for n, gain in enumerate(settings.gains)}
        for (index, subindex), value in defaults.items():
            entry = self._dictionary.entry(index, subindex)
            entry.default = value
            entry.value = value

    def _set_hooks(self) -> None:
        self._controlword.on_write = self._on_controlword
        self._mode_entry.on_write = self._on_mode
        self._target.on_write = self._on_target
        self._master.on_write = self._on_master
        self._homing_method.on_write = _check_homing_method
        self._interpolation_value.on_write = self._on_interpolation_value
        self._interpolation_exponent.on_write = self._on_interpolation_exponent
        for place, entry in enumerate(self._gain_entries):
            entry.on_write = self._gain_writer(place)
        for entry in (
            self._position_demand,
            self._position_actual,
            self._velocity_actual,
            self._torque_actual,
            self._following_error,
        ):
            entry.on_read = self._live_reader(entry.variable.index)

    def _live_reader(self, index: int) -> Callable[[int], int]:
        entry = self._dictionary.entry(index)

        def read(now_ns: int) -> int:
            self.sample(now_ns)
            return entry.value

        return read

    def _gain_writer(self, place: int) -> Callable[[int, int], AbortCode | None]:
        def write(value: int, now_ns: int) -> AbortCode | None:
            self.gains = (*self.gains[:place], value, *self.gains[place + 1 :])
            return None

        return write

    def restore(self) -> None:
        """Power-on state, from the values that the dictionary holds; the offset of the last homing is lost."""
        self._homing.reset()
        self._idle_controlword = _NO_CONTROLWORD
        self._offset = self._settings.initial_offset_counts
        self._mode = Mode.NONE
        self._is_guarded = False
        self._is_new_target = False
        self._disengage_cam()
        self.is_powered = False
        self._state = PowerState.NOT_READY_TO_SWITCH_ON
        self._internal_bits = 0
        self._following_error_since_ns = None
        self._sampled_at_ns = -1
        self.gains = tuple(entry.value for entry in self._gain_entries)
        self._set_period(self._interpolation_value.value, self._interpolation_exponent.value)
        self._demand.hold(float(self.shaft_counts))
        self._after_change()

    # -- what the machine reads ----------------------------------------------------------------------------------

    @property
    def state(self) -> PowerState:
        """State of the power drive system."""
        return self._state

    @property
    def mode(self) -> Mode:
        """Active mode of operation, as 6061h shows it."""
        return self._mode

    @property
    def is_homed(self) -> bool:
        """Whether homing has been attained since power-on."""
        return self._homing.status is HomingStatus.ATTAINED

    @property
    def offset_counts(self) -> int:
        """Position actual value minus shaft counts, before the wrap to INTEGER32."""
        return self._offset

    @property
    def torque_offset_Nm(self) -> float:  # noqa: N802 - the unit is part of the name
        """Torque offset 60B2h, to be added to the controller's torque; 0 unless operation is enabled."""
        if self._state is not _OPERATION_ENABLED:
            return 0.0
        return self._torque_offset.value * 0.001 * self._rated_torque_Nm

    @property
    def torque_limit_Nm(self) -> float:  # noqa: N802 - the unit is part of the name
        """Max torque 6072h."""
        return self._max_torque.value * 0.001 * self._rated_torque_Nm

    # -- the servo tick ------------------------------------------------------------------------------------------

    def on_tick(self, now_ns: int, shaft_counts: int) -> None:
        """One servo period: bring the demand up to ``now_ns`` and run what depends on time."""
        self.shaft_counts = shaft_counts
        if self._mode_entry.value != self._mode:
            self._switch_mode(now_ns)
        state = self._state
        if not self.is_powered:
            self.position_demand_counts = float(shaft_counts)
            self._demand.hold(float(shaft_counts))
            if state is PowerState.NOT_READY_TO_SWITCH_ON:
                # A fault whose cause has outlived a reset is a fault again.
                is_healthy = not self._emergency.has_persisting_fault
                ready = PowerState.SWITCH_ON_DISABLED if is_healthy else PowerState.FAULT_REACTION_ACTIVE
                self._go_to_state(ready, now_ns)
            elif state is PowerState.FAULT_REACTION_ACTIVE:
                self._go_to_state(PowerState.FAULT, now_ns)
            return
        demand = self._demand.at(now_ns)
        self.position_demand_counts = demand
        if state is _OPERATION_ENABLED:
            if self._is_guarded and now_ns - self._set_point_at_ns > self._set_point_timeout_ns:
                self.trip(EmergencyCode.SYNC_CONTROLLER, _DRIVE_ERROR, now_ns)
                return
            if self._homing.status is _HOMING_IN_PROGRESS:
                self._home(shaft_counts)
        elif self._demand.is_over(now_ns):
            if state is PowerState.FAULT_REACTION_ACTIVE:
                self._go_to_state(PowerState.FAULT, now_ns)
                return
            if not self._stops_then_stays:
                self._go_to_state(PowerState.SWITCH_ON_DISABLED, now_ns)
                return
        window = self._following_error_window.value
        if self._following_error_since_ns is not None or not -window <= demand - shaft_counts <= window:
            self._guard_following_error(demand - shaft_counts, now_ns)

    def _guard_following_error(self, error: float, now_ns: int) -> None:
        window = self._following_error_window.value
        if -window <= error <= window or window == FOLLOWING_ERROR_WINDOW_OFF:
            if self._following_error_since_ns is not None:
                self._following_error_since_ns = None
                self._set_internal_bit(_FOLLOWING_ERROR, False)
            return
        if self._following_error_since_ns is None:
            self._following_error_since_ns = now_ns
        timeout_ns = self._following_error_timeout.value * _NS_PER_MS
        if now_ns - self._following_error_since_ns < timeout_ns or self._internal_bits & _FOLLOWING_ERROR:
            return
        self._set_internal_bit(_FOLLOWING_ERROR, True)
        self.trip(EmergencyCode.FOLLOWING_ERROR, _DRIVE_ERROR, now_ns)

    def _home(self, shaft_counts: int) -> None:
        self._offset = self._homing.step(self._homing_method.value, shaft_counts, self._home_offset.value, self._offset)
        self._sampled_at_ns = -1
        self._after_change()

    # -- SYNC ----------------------------------------------------------------------------------------------------

    def sample(self, now_ns: int) -> None:
        """Bring the actual and demand values in the dictionary up to ``now_ns``."""
        if now_ns == self._sampled_at_ns:
            return
        self._sampled_at_ns = now_ns
        position, velocity, torque = self.latch(now_ns)
        demand = floor(self._demand.at(now_ns) + 0.5) if self.is_powered else position
        # What is within its type, as it nearly always is, is put there without a call.
        shown = position + self._offset
        self._position_actual.value = shown if -_HALF <= shown < _HALF else wrap_int32(shown)
        shown = demand + self._offset
        self._position_demand.value = shown if -_HALF <= shown < _HALF else wrap_int32(shown)
        error = demand - position
        self._following_error.value = error if -_HALF < error < _HALF else _clamp(error, _HALF - 1)
        rate = floor(velocity + 0.5)
        self._velocity_actual.value = rate if -_HALF < rate < _HALF else _clamp(rate, _HALF - 1)
        self._torque_actual.value = torque if -_INT16_MAX <= torque <= _INT16_MAX else _clamp(torque, _INT16_MAX)

    def on_sync(self, now_ns: int) -> None:
        """Let the set-points that the synchronous RPDOs have brought act."""
        if self._is_new_target:
            self._is_new_target = False
            if self._following_mode is _POSITION:
                self._follow_position(self._new_target, now_ns, self._period_s)
                self._guard(now_ns)
            elif self._following_mode is _Following.CAM:
                self._follow_cam(self._new_target, now_ns)

    def _guard(self, now_ns: int) -> None:
        """Expect the next set-point within the time-out from now on."""
        self._is_guarded = self._settings.missing_set_point_limit > 0
        self._set_point_at_ns = now_ns

    # -- set-points ----------------------------------------------------------------------------------------------

    def _on_target(self, value: int, now_ns: int) -> AbortCode | None:
        if self._following_mode is _POSITION:
            if self.source is _SYNC:
                self._new_target = value
                self._is_new_target = True
            else:
                # Nobody has promised a next one, so the line ends at the target.
                self._follow_position(value, now_ns, 0.0)
        return None

    def _follow_position(self, target: int, now_ns: int, overrun_s: float) -> None:
        low = self._limit_low.value
        high = self._limit_high.value
        is_limited = low < high and not low <= target <= high
        if is_limited:
            target = low if target < low else high
        if is_limited != bool(self._internal_bits & _LIMITED):
            self._set_internal_bit(_LIMITED, is_limited)
        demand = self._demand
        start = demand.at(now_ns)
        demand.go_from(start, self._to_shaft(target, start), now_ns, self._period_s, overrun_s)

    def _to_shaft(self, position: float, demand: float) -> float:
        """The shaft position that shows as ``position`` in the user frame and is nearest to ``demand``."""
        reference = floor(demand)
        distance = position - self._offset - reference
        return reference + ((distance + _HALF) % _WRAP) - _HALF

    # -- camming -------------------------------------------------------------------------------------------------

    def _on_master(self, value: int, now_ns: int) -> AbortCode | None:
        if self._following_mode is _Following.CAM:
            if self.source is SetPointSource.SYNC:
                self._new_target = value
                self._is_new_target = True
            else:
                self._follow_cam(value, now_ns)
        return None

    def _follow_cam(self, master: int, now_ns: int) -> None:
        table = self._slots.selected_table
        if table is None:
            self.trip(EmergencyCode.CAM_NOT_VALID, _DRIVE_ERROR, now_ns)
            return
        if self._is_cam_engaged:
            # The counter wraps, the master does not: a cam that advances by whole turns goes on.
            self._master_counts += wrap_int32(master - self._master_counts)
        else:
            self._master_counts = master
        slave = table.slave_position(self._master_counts + self._master_offset.value)
        start = self._demand.at(now_ns)
        target = self._to_shaft(slave, start)
        if not self._is_cam_engaged:
            if abs(target - start) > self._settings.cam_jump_window_counts:
                self.trip(EmergencyCode.CAM_JUMP, _DRIVE_ERROR, now_ns)
                return
            self._is_cam_engaged = True
            self._after_change()
        is_cyclic = self.source is not SetPointSource.SDO
        self._demand.go_from(start, target, now_ns, self._period_s, self._period_s if is_cyclic else 0.0)
        if is_cyclic:
            self._guard(now_ns)

    def _disengage_cam(self) -> None:
        self._is_cam_engaged = False
        self._slots.is_running = False

    # -- controlword and state -----------------------------------------------------------------------------------

    def _on_controlword(self, value: int, now_ns: int) -> AbortCode | None:
        if value == self._idle_controlword:
            return None
        self._idle_controlword = _NO_CONTROLWORD
        before: int = self._controlword.value
        if value & ~before & _FAULT_RESET and self._state is PowerState.FAULT:
            if not self._emergency.has_persisting_fault:
                self._emergency.reset_fault(now_ns)
                self._go_to_state(PowerState.SWITCH_ON_DISABLED, now_ns)
            return None
        command = COMMANDS[value & 0xFF]
        state = self._state
        self._execute(command, now_ns)
        if command is PowerCommand.ENABLE_OPERATION and state is PowerState.READY_TO_SWITCH_ON:
            self._execute(command, now_ns)
        if self._mode is _HOMING_MODE and self._state is _OPERATION_ENABLED:
            status = self._homing.status
            self._homing.command(bool(value & _HOMING_START))
            if self._homing.status is not status:
                self._after_change()
        elif value == before and next_state(self._state, command) is self._state:
            self._idle_controlword = value
        return None

    def _execute(self, command: PowerCommand, now_ns: int) -> None:
        state = self._state
        after = next_state(state, command)
        if after is state:
            return
        if after is PowerState.QUICK_STOP_ACTIVE:
            option = self._option(objects.QUICK_STOP_OPTION_CODE)
            if option is StopOption.DISABLE:
                after = PowerState.SWITCH_ON_DISABLED
            else:
                self._stops_then_stays = option is StopOption.RAMP_THEN_STAY
                self._demand.brake(now_ns, float(self._quick_stop_deceleration.value))
        elif (state, after) == _RESUMING and not self._stops_then_stays:
            return
        self._go_to_state(after, now_ns)

    def _option(self, index: int) -> StopOption:
        value: int = self._dictionary.entry(index).value
        return STOP_OPTIONS[value]

    def _go_to_state(self, state: PowerState, now_ns: int) -> None:
        before = self._state
        if state is before:
            return
        self._state = state
        self._idle_controlword = _NO_CONTROLWORD
        self._events.append(PowerStateChanged(now_ns, self._node_id, before, state))
        was_powered = self.is_powered
        self.is_powered = state is PowerState.OPERATION_ENABLED or (
            was_powered and state in {PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE}
        )
        if not self.is_powered or not was_powered:
            self._demand.hold(float(self.shaft_counts))
            self.position_demand_counts = float(self.shaft_counts)
            self._following_error_since_ns = None
        if before is PowerState.FAULT or state is PowerState.OPERATION_ENABLED:
            self._internal_bits = 0
        self._homing.interrupt()
        self._begin_following(now_ns)
        self._sampled_at_ns = -1
        self._after_change()

    def trip(self, error_code: int, register_bits: int, now_ns: int, *, persists: bool = False) -> None:
        """Raise an error that leads to a fault: EMCY at once, then the fault reaction 605Eh, then the state fault.

        ``persists``: no fault reset is accepted until ``EmergencyProducer.end_cause`` is called.
        """
        self._emergency.raise_error(error_code, register_bits, now_ns, is_fault=True, persists=persists)
        if self._state in {PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT}:
            return
        if self.is_powered:
            if self._option(objects.FAULT_REACTION_OPTION_CODE) is StopOption.DISABLE:
                self.is_powered = False
            elif self._state is PowerState.OPERATION_ENABLED:
                self._demand.brake(now_ns, float(self._quick_stop_deceleration.value))
        self._go_to_state(PowerState.FAULT_REACTION_ACTIVE, now_ns)

    # -- modes ---------------------------------------------------------------------------------------------------

    def _on_mode(self, value: int, now_ns: int) -> AbortCode | None:
        return None if value in MODES else AbortCode.VALUE_RANGE_EXCEEDED

    def _switch_mode(self, now_ns: int) -> None:
        self._mode = MODES[self._mode_entry.value]
        self._idle_controlword = _NO_CONTROLWORD
        self._homing.interrupt()
        self._internal_bits &= ~_LIMITED
        self._begin_following(now_ns)
        self._after_change()

    def _begin_following(self, now_ns: int) -> None:
        """Enter the present state and mode: from now on set-points count, and the first one is still to come.

        A line that is being followed is left to run out, so that changing mode in motion does not stop the axis dead.
        """
        self._is_new_target = False
        self._is_guarded = False
        self._disengage_cam()
        self._following_mode = _Following.NONE
        if self._state is not PowerState.OPERATION_ENABLED:
            return
        if self._mode is Mode.CYCLIC_SYNCHRONOUS_POSITION:
            self._following_mode = _Following.POSITION
        elif self._mode is Mode.CAMMING:
            if self._slots.selected_table is None:
                self.trip(EmergencyCode.CAM_NOT_VALID, _DRIVE_ERROR, now_ns)
                return
            self._following_mode = _Following.CAM
            self._slots.is_running = True

    # -- interpolation time 60C2h --------------------------------------------------------------------------------

    def _on_interpolation_value(self, value: int, now_ns: int) -> AbortCode | None:
        return self._change_period(value, self._interpolation_exponent.value)

    def _on_interpolation_exponent(self, value: int, now_ns: int) -> AbortCode | None:
        return self._change_period(self._interpolation_value.value, value)

    def _change_period(self, value: int, exponent: int) -> AbortCode | None:
        if self._following_mode is not _Following.NONE:
            return AbortCode.CANNOT_STORE_DEVICE_STATE
        self._set_period(value, exponent)
        return None

    def _set_period(self, value: int, exponent: int) -> None:
        self._period_ns = value * 10 ** (9 + exponent)
        self._period_s = self._period_ns * _S_PER_NS
        # Half a period of grace: the SYNC that is looked for may itself be a little late.
        limit = self._settings.missing_set_point_limit
        self._set_point_timeout_ns = self._period_ns * limit + self._period_ns // 2

    # -- statusword ----------------------------------------------------------------------------------------------

    def _set_internal_bit(self, bit: int, is_set: bool) -> None:
        self._internal_bits = self._internal_bits | bit if is_set else self._internal_bits & ~bit
        self._after_change()

    def _after_change(self) -> None:
        """Compose statusword and modes of operation display."""
        word = STATE_BITS[self._state] | _BASE_BITS
        internal = self._internal_bits
        if self._mode is Mode.HOMING:
            word |= self._homing.status_bits | internal & _LIMITED
        else:
            word |= internal
            if self._following_mode is _Following.POSITION or self._is_cam_engaged:
                word |= _FOLLOWS
        self._statusword.value = word
        self._mode_display.value = int(self._mode)


def _no_latch(now_ns: int) -> tuple[int, float, int]:
    return 0, 0.0, 0


def _check_homing_method(value: int, now_ns: int) -> AbortCode | None:
    return None if value in HOMING_METHODS else AbortCode.VALUE_RANGE_EXCEEDED


def _clamp(value: int, bound: int) -> int:
    return max(-bound, min(bound, value))
