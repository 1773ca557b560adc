"""The power drive system of an axis (CiA 402): its states, the controlword's commands, stops on the way, and faults."""

from abc import abstractmethod
from typing import Final

from drivers import objects
from drivers.node import Event
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import LiveDictionary
from sim_drive.communication.emcy import AxisErrors
from sim_drive.device.cia402 import (
    COMMANDS,
    QUICK_STOP_STAYS,
    STOP_RAMPS,
    AbortConnection,
    Controlword,
    PowerCommand,
    PowerState,
    PowerStateChanged,
    StopRamp,
    next_state,
)
from sim_drive.device.measured import MeasuredMotion
from sim_drive.settings import DriveSettings

_FAULT_RESET: Final = int(Controlword.FAULT_RESET)
# Members of an enumeration by a name of the module's own: looking them up in their class costs a call's time.
_OPERATION_ENABLED: Final = PowerState.OPERATION_ENABLED
NO_CONTROLWORD: Final = -1
_NS_PER_US: Final = 1_000
_LONGEST_US: Final = 0xFFFFFFFF
_OPTION_CODES: Final = {
    PowerState.SWITCHED_ON: objects.DISABLE_OPERATION_OPTION_CODE,
    PowerState.READY_TO_SWITCH_ON: objects.SHUTDOWN_OPTION_CODE,
}
"""How the axis stops on its way from Operation enabled to these states."""


class PowerDrive(MeasuredMotion):
    """The part of an axis that is the power state machine; the table of transitions is in `cia402`.

    A ramp before a state is left (605Bh, 605Ch) is run in the state; enabling the operation again calls it off.
    """

    __slots__ = (
        "_after_ramp",
        "_errors",
        "_events",
        "_following_error_since_ns",
        "_idle_controlword",
        "_set_point_age",
        "_state",
        "is_switched_off",
        "node_id",
        "position_demand_counts",
    )

    def __init__(
        self,
        node_id: int,
        dictionary: LiveDictionary,
        settings: DriveSettings,
        errors: AxisErrors,
        events: list[Event],
        number: int,
    ) -> None:
        super().__init__(dictionary, settings, number)
        self.node_id = node_id
        """For its events alone; the drive changes it when it gets another one."""
        self._errors = errors
        self._events = events
        self._state = PowerState.NOT_READY_TO_SWITCH_ON
        self._after_ramp: PowerState | None = None
        """The state that is next when the axis has come to rest."""
        self._idle_controlword = NO_CONTROLWORD
        """The controlword that asks, as the one before it, for nothing new in the present state and mode."""
        self._following_error_since_ns: int | None = None
        self.position_demand_counts = 0.0
        """Demand at the last servo tick, shaft frame."""
        self._set_point_age = self.entry(objects.SET_POINT_AGE)
        self.is_switched_off = False
        """Without supply, as the drive has it."""
        self.controlword.on_write = self._on_controlword

    @property
    def state(self) -> PowerState:
        """State of the power drive system."""
        return self._state

    @abstractmethod
    def _activate(self, now_ns: int) -> None:
        """Leave the mode that was active, and enter the selected one if operation is enabled."""

    @abstractmethod
    def _deactivate(self, now_ns: int) -> None:
        """Leave the mode that was active."""

    @abstractmethod
    def _tell_mode(self, controlword: int, now_ns: int) -> None:
        """Let the active mode, if there is one, have its bits of the controlword."""

    def _on_controlword(self, value: int, now_ns: int) -> AbortCode | None:
        if value == self._idle_controlword:
            return None
        self._idle_controlword = NO_CONTROLWORD
        before: int = self.controlword.value
        if value & ~before & _FAULT_RESET and self._state is PowerState.FAULT:
            if not self._errors.has_persisting_fault:
                self._errors.reset_fault(now_ns)
                self._go_to_state(PowerState.SWITCH_ON_DISABLED, now_ns)
            return None
        command = COMMANDS[value & 0xFF]
        state = self._state
        self._execute(command, now_ns)
        if command is PowerCommand.ENABLE_OPERATION and state is PowerState.READY_TO_SWITCH_ON:
            self._execute(command, now_ns)
        self._tell_mode(value, now_ns)
        if value == before and next_state(self._state, command) is self._state:
            self._idle_controlword = value
        return None

    def _execute(self, command: PowerCommand, now_ns: int) -> None:
        state = self._state
        after = next_state(state, command)
        if state is not _OPERATION_ENABLED:
            # There is no way back from a quick stop that is to end in another state (transition 16).
            if after is not state and (after is not _OPERATION_ENABLED or self._after_ramp is None):
                self._go_to_state(after, now_ns)
            return
        if after is state:
            if command is PowerCommand.ENABLE_OPERATION and self._after_ramp is not None:
                self._after_ramp = None
                self._activate(now_ns)
                self.show_status()
            return
        if after is PowerState.QUICK_STOP_ACTIVE:
            self._quick_stop(now_ns)
            return
        index = _OPTION_CODES.get(after)
        if index is not None and self._option(index) is not StopRamp.NONE:
            if self._after_ramp is None:
                self._stop(StopRamp.SLOW_DOWN, now_ns)
                self.show_status()
            if not self.demand.is_over(now_ns):
                self._after_ramp = after
                return
        self._go_to_state(after, now_ns)

    def _quick_stop(self, now_ns: int) -> None:
        code: int = self.entry(objects.QUICK_STOP_OPTION_CODE).value
        if code == StopRamp.NONE:
            self._go_to_state(PowerState.SWITCH_ON_DISABLED, now_ns)
            return
        stays = code >= QUICK_STOP_STAYS
        self._stop(STOP_RAMPS[code - QUICK_STOP_STAYS + 1 if stays else code], now_ns)
        self._go_to_state(PowerState.QUICK_STOP_ACTIVE, now_ns)
        self._after_ramp = None if stays else PowerState.SWITCH_ON_DISABLED

    def _option(self, index: int) -> StopRamp:
        value: int = self.entry(index).value
        return STOP_RAMPS[value]

    def _stop(self, ramp: StopRamp, now_ns: int) -> None:
        """Leave the active mode, and let the demand come to rest."""
        self._deactivate(now_ns)
        self.brake(self.deceleration_of(ramp), now_ns)

    def lose_connection(self, error_code: int, register_bits: int, now_ns: int, *, persists: bool = False) -> None:
        """The master is gone: EMCY, and, if the axis is enabled, what the option code 6007h says."""
        option = self.entry(objects.ABORT_CONNECTION_OPTION_CODE)
        action = int(option.load(now_ns)) if self.is_powered else 0
        if action == AbortConnection.FAULT:
            self.trip(error_code, register_bits, now_ns, persists=persists)
            return
        self._errors.raise_error(error_code, register_bits, now_ns, is_fault=False, persists=persists)
        if action == AbortConnection.DISABLE_VOLTAGE:
            self._execute(PowerCommand.DISABLE_VOLTAGE, now_ns)
        elif action == AbortConnection.QUICK_STOP:
            self._execute(PowerCommand.QUICK_STOP, now_ns)
        self._idle_controlword = NO_CONTROLWORD

    def _go_to_state(self, state: PowerState, now_ns: int) -> None:
        before = self._state
        if state is before:
            return
        self._state = state
        self._after_ramp = None
        self._idle_controlword = NO_CONTROLWORD
        self._events.append(PowerStateChanged(now_ns, self.node_id, before, state, self.number))
        was_powered = self.is_powered
        self.power(
            state is PowerState.OPERATION_ENABLED
            or (was_powered and state in {PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE})
        )
        if was_powered and not self.is_powered:
            self._keep_set_point_age(now_ns)
        if not self.is_powered or not was_powered:
            self.demand.hold(float(self.shaft_counts))
            self.position_demand_counts = float(self.shaft_counts)
            self._following_error_since_ns = None
        if before is PowerState.FAULT or state is PowerState.OPERATION_ENABLED:
            self.internal_bits = 0
        self._activate(now_ns)
        self._sampled_at_ns = -1
        self.show_status()

    def _keep_set_point_age(self, now_ns: int) -> None:
        """For whoever asks how long the axis has had torque without a master; 0 where no set-point has ever come."""
        age_us = (now_ns - self.set_point_at_ns) // _NS_PER_US if self.set_point_at_ns else 0
        self._set_point_age.value = min(age_us, _LONGEST_US)

    def trip(self, error_code: int, register_bits: int, now_ns: int, *, persists: bool = False) -> None:
        """Raise an error that leads to a fault: EMCY at once, then the fault reaction 605Eh, then the state fault.

        ``persists``: no fault reset is accepted until ``end_warning`` is called. An axis without supply notices nothing
        but a cause that persists, once it has one again.
        """
        if self.is_switched_off:
            if persists:
                self._errors.raise_error(error_code, register_bits, now_ns, is_fault=True, persists=True)
            return
        self._errors.raise_error(error_code, register_bits, now_ns, is_fault=True, persists=persists)
        if self._state in {PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT}:
            return
        if self.is_powered:
            ramp = self._option(objects.FAULT_REACTION_OPTION_CODE)
            if ramp is StopRamp.NONE:
                self.power(False)
                self._keep_set_point_age(now_ns)
            elif self._state is PowerState.OPERATION_ENABLED:
                self._stop(ramp, now_ns)
        self._go_to_state(PowerState.FAULT_REACTION_ACTIVE, now_ns)

    def warn(self, error_code: int, register_bits: int, now_ns: int) -> None:
        """Raise an error that leads to no fault: EMCY alone."""
        self._errors.raise_error(error_code, register_bits, now_ns, is_fault=False, persists=False)

    def end_warning(self, error_code: int, now_ns: int) -> None:
        """The cause of an error is gone; a fault that it has led to is still to be reset."""
        self._errors.end_cause(error_code, now_ns)
