"""The drive's application: the CiA 402 device behind the object dictionary.

The axis runs its servo tick, selects the mode of operation, guards the following error and composes the statusword.
The power state machine is in `power_drive`, what a SYNC samples in `measured`, what a mode of operation does with
set-points in `modes`, and what they all share in `motion`.
"""

from collections.abc import Callable
from typing import Final

from config.quirks import Quirk
from drivers import objects
from drivers.node import Event
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import Entry, LiveDictionary
from sim_drive.communication.emcy import AxisErrors, EmergencyCode, ErrorRegister
from sim_drive.device.cam_slots import CamSlots
from sim_drive.device.cia402 import (
    MODES,
    STATE_BITS,
    Controlword,
    Mode,
    PowerState,
    Statusword,
)
from sim_drive.device.modes.base import Holding, OperationMode
from sim_drive.device.modes.camming import Camming
from sim_drive.device.modes.cyclic import CyclicPosition, CyclicTorque, CyclicVelocity
from sim_drive.device.modes.homing import Homing, HomingStatus
from sim_drive.device.modes.interpolated import InterpolatedPosition
from sim_drive.device.modes.profile_position import ProfilePosition
from sim_drive.device.modes.profile_torque import ProfileTorque
from sim_drive.device.modes.profile_velocity import ProfileVelocity
from sim_drive.device.motion import Latch, SetPointSource, wrap_int32
from sim_drive.device.power_drive import NO_CONTROLWORD, PowerDrive
from sim_drive.device.quirks import MODE_SWITCH_NS, SYNC_PATIENCE_NS
from sim_drive.device.touch_probe import TouchProbe
from sim_drive.settings import DriveSettings
from sim_drive.switches import DigitalInput

__all__ = ["CONTROLLER_GAIN_COUNT", "FOLLOWING_ERROR_WINDOW_OFF", "Axis", "Latch", "SetPointSource", "wrap_int32"]

FOLLOWING_ERROR_WINDOW_OFF: Final = 0xFFFFFFFF
CONTROLLER_GAIN_COUNT: Final = 5

_HALF: Final = 1 << 31
_NS_PER_MS: Final = 1_000_000
_NS_PER_US: Final = 1_000

_BASE_BITS: Final = int(Statusword.VOLTAGE_ENABLED | Statusword.REMOTE)
_FOLLOWING_ERROR: Final = int(Statusword.FOLLOWING_ERROR)
_LIMITED: Final = int(Statusword.INTERNAL_LIMIT_ACTIVE)
_FROZEN: Final = int(Statusword.FROZEN)
_HALT: Final = int(Controlword.HALT)
_DRIVE_ERROR: Final = int(ErrorRegister.DEVICE_PROFILE)
# Members of an enumeration by a name of the module's own: looking them up in their class costs a call's time.
_OPERATION_ENABLED: Final = PowerState.OPERATION_ENABLED
_TIMED_MODES: Final = frozenset(
    {
        Mode.CYCLIC_SYNCHRONOUS_POSITION,
        Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
        Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        Mode.INTERPOLATED_POSITION,
        Mode.CAMMING,
    }
)
"""Modes in which the interpolation time must not change."""


class Axis(PowerDrive):
    """One CiA 402 axis. ``on_tick`` is its servo tick, ``sample`` and ``on_sync`` are what a SYNC does to it."""

    __slots__ = (
        "_active",
        "_coming_mode",
        "_cycle_period",
        "_enabled_bits",
        "_following_error_timeout",
        "_following_error_window",
        "_freezes",
        "_gain_entries",
        "_has_stops",
        "_homing",
        "_interpolation_exponent",
        "_interpolation_value",
        "_mode",
        "_mode_display",
        "_mode_entry",
        "_modes",
        "_rated_torque_Nm",
        "_statusword",
        "_synced_at_ns",
        "_ticking",
        "_torque_limits",
        "_torque_offset",
        "_touch_probe",
        "_watchdog",
        "gains",
        "is_frozen",
        "negative_torque_limit_Nm",
        "on_sync",
        "torque_limit_Nm",
    )

    def __init__(
        self,
        node_id: int,
        dictionary: LiveDictionary,
        settings: DriveSettings,
        slots: CamSlots,
        errors: AxisErrors,
        events: list[Event],
        number: int = 1,
    ) -> None:
        super().__init__(node_id, dictionary, settings, errors, events, number)

        entry = self.entry
        self._statusword = entry(objects.STATUSWORD)
        self._mode_entry = entry(objects.MODES_OF_OPERATION)
        self._mode_display = entry(objects.MODES_OF_OPERATION_DISPLAY)
        self._torque_offset = entry(objects.TORQUE_OFFSET)
        self._following_error_window = entry(objects.FOLLOWING_ERROR_WINDOW)
        self._following_error_timeout = entry(objects.FOLLOWING_ERROR_TIMEOUT)
        self._interpolation_value = entry(objects.INTERPOLATION_TIME_PERIOD, 1)
        self._interpolation_exponent = entry(objects.INTERPOLATION_TIME_PERIOD, 2)
        self._watchdog = entry(objects.SET_POINT_WATCHDOG)
        self._torque_limits = (
            entry(objects.MAX_TORQUE),
            entry(objects.POSITIVE_TORQUE_LIMIT),
            entry(objects.NEGATIVE_TORQUE_LIMIT),
        )
        self.torque_limit_Nm = 0.0
        """What max torque 6072h and the positive torque limit 60E0h allow."""
        self.negative_torque_limit_Nm = 0.0
        """What 6072h and 60E1h allow in the negative direction, as a positive number."""
        self._gain_entries = [entry(objects.CONTROLLER_GAINS, n + 1) for n in range(CONTROLLER_GAIN_COUNT)]
        self._rated_torque_Nm = settings.rated_torque_Nm
        self._touch_probe = TouchProbe(self)
        self._set_defaults()
        self._set_hooks()

        self._homing = Homing(self)
        self._modes: dict[Mode, OperationMode] = {
            Mode.NONE: Holding(self),
            Mode.HOMING: self._homing,
            Mode.PROFILE_POSITION: ProfilePosition(self),
            Mode.PROFILE_VELOCITY: ProfileVelocity(self),
            Mode.PROFILE_TORQUE: ProfileTorque(self),
            Mode.INTERPOLATED_POSITION: InterpolatedPosition(self),
            Mode.CYCLIC_SYNCHRONOUS_POSITION: CyclicPosition(self),
            Mode.CYCLIC_SYNCHRONOUS_VELOCITY: CyclicVelocity(self),
            Mode.CYCLIC_SYNCHRONOUS_TORQUE: CyclicTorque(self),
            Mode.CAMMING: Camming(self, slots),
        }
        self._active: OperationMode | None = None
        """The selected mode while operation is enabled."""
        self._ticking: OperationMode | None = None
        """The active mode if it has something to do at every servo tick."""
        self.on_sync: Callable[[int], None] = _nothing
        """Let the set-points that the synchronous RPDOs have brought act: the active mode's own."""
        self._mode = Mode.NONE
        self._coming_mode: tuple[int, int] | None = None
        """With a slow mode switch: the mode, and when it is entered."""
        has_limit_switches = bool(settings.switches.fitted & ~DigitalInput.HOME)
        self._has_stops = has_limit_switches or Quirk.LATE_SYNC_FREEZES in settings.quirks
        self._freezes = Quirk.LATE_SYNC_FREEZES in settings.quirks
        self._cycle_period = dictionary.entry(objects.COMMUNICATION_CYCLE_PERIOD)
        self._synced_at_ns: int | None = None
        self.is_frozen = False
        """With the habit of freezing: whether a SYNC is late."""
        is_odd = Quirk.SET_POINT_ACKNOWLEDGE_STAYS in settings.quirks
        self._enabled_bits = int(Statusword.SET_POINT_ACKNOWLEDGE) if is_odd else 0
        """Set in the statusword whenever operation is enabled."""
        self.gains: tuple[int, ...] = ()
        self.restore()

    # -- set-up --------------------------------------------------------------------------------------------------

    def _set_defaults(self) -> None:
        settings = self.settings
        defaults = {
            (objects.POSITION_ENCODER_RESOLUTION, 1): settings.counts_per_revolution,
            (objects.VELOCITY_ENCODER_RESOLUTION, 1): settings.counts_per_revolution,
            (objects.FEED_CONSTANT, 1): settings.counts_per_revolution,
            (objects.MOTOR_RATED_TORQUE, 0): round(settings.rated_torque_Nm * 1000.0),
            (objects.SET_POINT_WATCHDOG, 0): settings.missing_set_point_limit,
        }
        if settings.gains is not None:
            if len(settings.gains) != CONTROLLER_GAIN_COUNT:
                raise ValueError(f"a drive has {CONTROLLER_GAIN_COUNT} gains, not {len(settings.gains)}")
            defaults |= {(objects.CONTROLLER_GAINS, n + 1): gain for n, gain in enumerate(settings.gains)}
        for (index, subindex), value in defaults.items():
            entry = self.entry(index, subindex)
            entry.default = value
            entry.value = value

    def _set_hooks(self) -> None:
        self._mode_entry.on_write = self._on_mode
        self._interpolation_value.on_write = self._on_interpolation_value
        self._interpolation_exponent.on_write = self._on_interpolation_exponent
        self._watchdog.on_write = self._on_watchdog
        for entry in (*self._scale_entries, self.entry(objects.POLARITY)):
            entry.on_write = self._scaling_writer(entry)
        for place, entry in enumerate(self._torque_limits):
            entry.on_write = self._torque_limit_writer(place)
        for place, entry in enumerate(self._gain_entries):
            entry.on_write = self._gain_writer(place)

    def _scaling_writer(self, entry: Entry) -> Callable[[int, int], AbortCode | None]:
        def write(value: int, now_ns: int) -> AbortCode | None:
            if self.is_powered:
                return AbortCode.CANNOT_STORE_DEVICE_STATE
            self.set_scaling(entry, value)
            return None

        return write

    def _gain_writer(self, place: int) -> Callable[[int, int], AbortCode | None]:
        def write(value: int, now_ns: int) -> AbortCode | None:
            self.gains = (*self.gains[:place], value, *self.gains[place + 1 :])
            return None

        return write

    def restore(self) -> None:
        """Power-on state, from the values that the dictionary holds; the offset of the last homing is lost."""
        self._state = PowerState.NOT_READY_TO_SWITCH_ON
        self._mode = Mode.NONE
        self._after_ramp = None
        self._activate(0)
        self.torque_demand = None
        for mode in self._modes.values():
            mode.reset()
        self._touch_probe.restore()
        self._idle_controlword = NO_CONTROLWORD
        self.set_scaling()
        self.offset = self.settings.initial_offset_counts
        self.power(False)
        self.internal_bits = 0
        self._following_error_since_ns = None
        self._sampled_at_ns = -1
        self.gains = tuple(entry.value for entry in self._gain_entries)
        self._limit_torque(*(entry.value for entry in self._torque_limits))
        self.set_period(self._interpolation_value.value, self._interpolation_exponent.value)
        self.set_watchdog(self._watchdog.value)
        self.set_point_at_ns = 0
        self.demand.hold(float(self.shaft_counts))
        self.show_status()

    # -- what the machine reads ----------------------------------------------------------------------------------

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
        return self.offset

    @property
    def torque_offset_Nm(self) -> float:  # noqa: N802 - the unit is part of the name
        """Torque offset 60B2h, to be added to the controller's torque; 0 unless operation is enabled."""
        if self._state is not _OPERATION_ENABLED:
            return 0.0
        return self._torque_offset.value * 0.001 * self._rated_torque_Nm

    @property
    def torque_demand_Nm(self) -> float | None:  # noqa: N802 - the unit is part of the name
        """Torque that a torque mode asks for, within its limits; None where the position controller decides.

        A limit switch lets no torque pass that would drive the axis further on.
        """
        demand = self.torque_demand
        if demand is None or not self.is_powered:
            return None
        torque = demand * 0.001 * self._rated_torque_Nm
        if self.barred and self.is_barred(torque):
            return 0.0
        return max(-self.negative_torque_limit_Nm, min(self.torque_limit_Nm, torque))

    def _limit_torque(self, maximum: int, positive: int, negative: int) -> None:
        permille_Nm = 0.001 * self._rated_torque_Nm
        self.torque_limit_Nm = min(maximum, positive) * permille_Nm
        self.negative_torque_limit_Nm = min(maximum, negative) * permille_Nm

    def _torque_limit_writer(self, place: int) -> Callable[[int, int], AbortCode | None]:
        def write(value: int, now_ns: int) -> AbortCode | None:
            bounds: list[int] = [entry.value for entry in self._torque_limits]
            bounds[place] = value
            self._limit_torque(*bounds)
            return None

        return write

    # -- the servo tick ------------------------------------------------------------------------------------------

    def on_tick(self, now_ns: int, shaft_counts: int) -> None:
        """One servo period: bring the demand up to ``now_ns`` and run what depends on time."""
        self.shaft_counts = shaft_counts
        if self._touch_probe.is_enabled:
            self._touch_probe.on_tick()
        if self._mode_entry.value != self._mode and self._is_mode_due(now_ns):
            self._switch_mode(now_ns)
        state = self._state
        if not self.is_powered:
            self._tick_without_power(now_ns)
            return
        demand = self.demand.at(now_ns)
        self.position_demand_counts = demand
        if self._active is not None:
            if self._has_stops:
                self._look_for_stops(now_ns)
                demand = self.demand.at(now_ns)
            if self.is_guarded and now_ns - self.set_point_at_ns > self.set_point_timeout_ns:
                self.trip(EmergencyCode.SYNC_CONTROLLER, _DRIVE_ERROR, now_ns)
                return
            if self._ticking is not None:
                self._ticking.on_tick(now_ns)
                self.position_demand_counts = demand = self.demand.at(now_ns)
        elif self.demand.is_over(now_ns):
            if state is PowerState.FAULT_REACTION_ACTIVE:
                self._go_to_state(PowerState.FAULT, now_ns)
                return
            if self._after_ramp is not None:
                self._go_to_state(self._after_ramp, now_ns)
                return
        window = self._following_error_window.value
        error = (demand - shaft_counts) * self.unit
        if self._following_error_since_ns is not None or not -window <= error <= window:
            self._guard_following_error(error, now_ns)

    def _tick_without_power(self, now_ns: int) -> None:
        if self.is_switched_off:
            return
        state = self._state
        shaft_counts = self.shaft_counts
        self.position_demand_counts = float(shaft_counts)
        self.demand.hold(float(shaft_counts))
        if state is PowerState.NOT_READY_TO_SWITCH_ON:
            # A fault whose cause has outlived a reset is a fault again.
            is_healthy = not self._errors.has_persisting_fault
            ready = PowerState.SWITCH_ON_DISABLED if is_healthy else PowerState.FAULT_REACTION_ACTIVE
            self._go_to_state(ready, now_ns)
        elif state is PowerState.FAULT_REACTION_ACTIVE:
            self._go_to_state(PowerState.FAULT, now_ns)

    def _guard_following_error(self, error: float, now_ns: int) -> None:
        window = self._following_error_window.value
        if -window <= error <= window or window == FOLLOWING_ERROR_WINDOW_OFF:
            if self._following_error_since_ns is not None:
                self._following_error_since_ns = None
                self.set_internal_bit(_FOLLOWING_ERROR, False)
            return
        if self._following_error_since_ns is None:
            self._following_error_since_ns = now_ns
        timeout_ns = self._following_error_timeout.value * _NS_PER_MS
        if now_ns - self._following_error_since_ns < timeout_ns or self.internal_bits & _FOLLOWING_ERROR:
            return
        self.set_internal_bit(_FOLLOWING_ERROR, True)
        self.trip(EmergencyCode.FOLLOWING_ERROR, _DRIVE_ERROR, now_ns)

    # -- modes ---------------------------------------------------------------------------------------------------

    def _tell_mode(self, controlword: int, now_ns: int) -> None:
        active = self._active
        if active is None:
            return
        active.on_controlword(controlword, now_ns)
        is_halted = bool(controlword & _HALT)
        if is_halted is not self.is_halted and self._active is active:
            self.is_halted = is_halted
            if is_halted:
                active.halt(now_ns)
            else:
                active.resume(now_ns)
            self.show_status()

    def _on_mode(self, value: int, now_ns: int) -> AbortCode | None:
        return None if value in MODES else AbortCode.VALUE_RANGE_EXCEEDED

    def _is_mode_due(self, now_ns: int) -> bool:
        """Whether the mode that 6060h asks for is to be entered now; a slow drive takes its time."""
        if Quirk.SLOW_MODE_SWITCH not in self.settings.quirks:
            return True
        wanted: int = self._mode_entry.value
        if self._coming_mode is None or self._coming_mode[0] != wanted:
            self._coming_mode = wanted, now_ns + MODE_SWITCH_NS
        if now_ns < self._coming_mode[1]:
            return False
        self._coming_mode = None
        return True

    def _switch_mode(self, now_ns: int) -> None:
        self._mode = MODES[self._mode_entry.value]
        self._idle_controlword = NO_CONTROLWORD
        self.internal_bits &= ~_LIMITED
        self._activate(now_ns)
        self.show_status()

    def _deactivate(self, now_ns: int) -> None:
        active = self._active
        self._active = None
        self._ticking = None
        self.on_sync = _nothing
        self.is_guarded = False
        self.is_halted = False
        self.barred = 0
        self.is_at_switch = False
        self.is_frozen = False
        self._synced_at_ns = None
        if active is not None:
            active.leave(now_ns)

    def _activate(self, now_ns: int) -> None:
        """Leave the mode that was active, and enter the selected one if operation is enabled."""
        self._deactivate(now_ns)
        if self._state is not _OPERATION_ENABLED or self._after_ramp is not None:
            return
        mode = self._modes[self._mode]
        self._active = mode
        self._ticking = mode if mode.is_ticking else None
        self.on_sync = mode.on_sync
        if self._freezes and self._mode in _TIMED_MODES:
            self.on_sync = self._watch_sync(mode)
        self.is_halted = bool(self.controlword.value & _HALT)
        mode.enter(now_ns)
        if self.is_halted and self._active is mode:
            mode.halt(now_ns)

    # -- the habit of freezing when a SYNC is late ------------------------------------------------------------------

    def _watch_sync(self, mode: OperationMode) -> Callable[[int], None]:
        def on_sync(now_ns: int) -> None:
            self._synced_at_ns = now_ns
            if self.is_frozen:
                self.is_frozen = False
                self.show_status()
            mode.on_sync(now_ns)

        return on_sync

    def _look_for_stops(self, now_ns: int) -> None:
        if self._freezes:
            self._freeze_if_late(now_ns)
        self.look_at_switches(now_ns, self._mode is Mode.HOMING)

    def _freeze_if_late(self, now_ns: int) -> None:
        cycle_ns: int = self._cycle_period.value * _NS_PER_US
        if self._synced_at_ns is None or not cycle_ns or self.is_frozen:
            return
        if now_ns - self._synced_at_ns > cycle_ns + SYNC_PATIENCE_NS:
            self.is_frozen = True
            self.demand.hold(self.demand.at(now_ns))
            self.show_status()

    # -- interpolation time 60C2h --------------------------------------------------------------------------------

    def _on_interpolation_value(self, value: int, now_ns: int) -> AbortCode | None:
        return self._change_period(value, self._interpolation_exponent.value)

    def _on_interpolation_exponent(self, value: int, now_ns: int) -> AbortCode | None:
        return self._change_period(self._interpolation_value.value, value)

    def _change_period(self, value: int, exponent: int) -> AbortCode | None:
        if self._active is not None and self._mode in _TIMED_MODES:
            return AbortCode.CANNOT_STORE_DEVICE_STATE
        self.set_period(value, exponent)
        return None

    def _on_watchdog(self, value: int, now_ns: int) -> AbortCode | None:
        self.set_watchdog(value)
        return None

    # -- statusword ----------------------------------------------------------------------------------------------

    def show_status(self) -> None:
        """Compose statusword and modes of operation display."""
        mode = self._modes[self._mode]
        internal = self.internal_bits & _LIMITED if mode.owns_bit_13 else self.internal_bits
        word = STATE_BITS[self._state] | _BASE_BITS | internal | mode.status_bits
        if self._state is _OPERATION_ENABLED:
            word |= self._enabled_bits
        if self.is_at_switch:
            word |= _LIMITED
        if self.is_frozen:
            word |= _FROZEN
        self._statusword.value = word
        self._mode_display.value = int(self._mode)


def _nothing(now_ns: int) -> None:
    pass
