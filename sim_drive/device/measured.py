"""What an axis measures and shows: actual and demand values of a SYNC, digital inputs and outputs."""

from collections.abc import Callable
from enum import IntFlag
from math import floor
from typing import Final

from drivers import objects
from drivers.object_dictionary import Value
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import Entry, LiveDictionary
from sim_drive.device.motion import Motion, wrap_int32
from sim_drive.settings import DriveSettings

_HALF: Final = 1 << 31
_INT16_MAX: Final = 32767


class DigitalOutput(IntFlag):
    """Bits of the physical outputs 60FEh:01 that mean something; 16 to 31 are outputs for whatever is wired there."""

    SET_BRAKE = 1 << 0


_SET_BRAKE: Final = int(DigitalOutput.SET_BRAKE)


class MeasuredMotion(Motion):
    """The part of an axis that puts measured values into the dictionary, and sets outputs."""

    __slots__ = (
        "_digital_inputs",
        "_following_error",
        "_has_switches",
        "_output_mask",
        "_outputs",
        "_position_actual",
        "_position_demand",
        "_sampled_at_ns",
        "_torque_actual",
        "_velocity_actual",
        "is_brake_released",
        "is_powered",
    )

    def __init__(self, dictionary: LiveDictionary, settings: DriveSettings, number: int = 1) -> None:
        super().__init__(dictionary, settings, number)
        entry = self.entry
        self._position_demand = entry(objects.POSITION_DEMAND_VALUE)
        self._position_actual = entry(objects.POSITION_ACTUAL_VALUE)
        self._velocity_actual = entry(objects.VELOCITY_ACTUAL_VALUE)
        self._torque_actual = entry(objects.TORQUE_ACTUAL_VALUE)
        self._following_error = entry(objects.FOLLOWING_ERROR_ACTUAL_VALUE)
        self._digital_inputs = entry(objects.DIGITAL_INPUTS)
        self._has_switches = bool(settings.switches.fitted)
        self._outputs = entry(objects.DIGITAL_OUTPUTS, 1)
        self._output_mask = entry(objects.DIGITAL_OUTPUTS, 2)
        self._sampled_at_ns = -1
        self.is_powered = False
        """Whether the amplifier may put torque on the motor; set by ``power``."""
        self.is_brake_released = False
        """Whether the holding brake is open: while there is torque to hold the axis, unless 60FEh says otherwise."""
        self._outputs.on_write = self._on_outputs
        self._output_mask.on_write = self._on_output_mask
        self._digital_inputs.on_read = self._read_inputs
        entry(objects.VELOCITY_DEMAND_VALUE).on_read = self._read_velocity_demand
        entry(objects.TORQUE_DEMAND).on_read = self._read_torque_demand
        for measured in (
            self._position_demand,
            self._position_actual,
            self._velocity_actual,
            self._torque_actual,
            self._following_error,
        ):
            measured.on_read = self._live_reader(measured)

    # -- outputs -------------------------------------------------------------------------------------------------

    @property
    def digital_outputs(self) -> int:
        """The outputs that are on: 60FEh:01 where the mask 60FEh:02 lets it act."""
        return self._outputs.value & self._output_mask.value

    def power(self, is_powered: bool) -> None:
        """Switch the amplifier on or off, and the holding brake with it."""
        self.is_powered = is_powered
        self._move_brake(self._outputs.value, self._output_mask.value)

    def _move_brake(self, outputs: int, mask: int) -> None:
        self.is_brake_released = not outputs & _SET_BRAKE if mask & _SET_BRAKE else self.is_powered

    def _on_outputs(self, value: int, now_ns: int) -> AbortCode | None:
        self._move_brake(value, self._output_mask.value)
        return None

    def _on_output_mask(self, value: int, now_ns: int) -> AbortCode | None:
        self._move_brake(self._outputs.value, value)
        return None

    # -- sampling ------------------------------------------------------------------------------------------------

    def _live_reader(self, entry: Entry) -> Callable[[int], Value]:
        def read(now_ns: int) -> Value:
            self.sample(now_ns)
            return entry.value

        return read

    def sample(self, now_ns: int) -> None:
        """Bring the actual and demand values in the dictionary up to ``now_ns``."""
        if now_ns == self._sampled_at_ns:
            return
        self._sampled_at_ns = now_ns
        position, velocity, torque = self.latch(now_ns)
        demand = floor(self.demand.at(now_ns) + 0.5) if self.is_powered else position
        if self._has_switches:
            self._digital_inputs.value = self.settings.switches.inputs(position)
        self._torque_actual.value = torque if -_INT16_MAX <= torque <= _INT16_MAX else clamp(torque, _INT16_MAX)
        if self.unit != 1.0 or self.velocity_unit != 1.0:
            position = self.scaling.position(position)
            demand = self.scaling.position(demand)
            velocity *= self.velocity_unit
        # What is within its type, as it nearly always is, is put there without a call.
        shown = position + self.offset
        self._position_actual.value = shown if -_HALF <= shown < _HALF else wrap_int32(shown)
        shown = demand + self.offset
        self._position_demand.value = shown if -_HALF <= shown < _HALF else wrap_int32(shown)
        error = demand - position
        self._following_error.value = error if -_HALF < error < _HALF else clamp(error, _HALF - 1)
        rate = floor(velocity + 0.5)
        self._velocity_actual.value = rate if -_HALF < rate < _HALF else clamp(rate, _HALF - 1)

    def sample_actual_position(self, now_ns: int) -> None:
        """``sample`` for a SYNC whose TPDOs carry no measured value but actual position and torque.

        The other values are brought up to date when they are asked for.
        """
        if now_ns == self._sampled_at_ns:
            return
        latch = self.latch
        position, _, torque = latch(now_ns)
        if self.unit != 1.0:
            position = self.scaling.position(position)
        shown = position + self.offset
        self._position_actual.value = shown if -_HALF <= shown < _HALF else wrap_int32(shown)
        self._torque_actual.value = torque if -_INT16_MAX <= torque <= _INT16_MAX else clamp(torque, _INT16_MAX)

    def forget_sample(self) -> None:
        """The frames of counts have moved: what has been sampled for this instant no longer holds."""
        self._sampled_at_ns = -1

    def _read_velocity_demand(self, now_ns: int) -> int:
        if not self.is_powered:
            return 0
        return clamp(floor(self.demand.velocity_at(now_ns) * self.velocity_unit + 0.5), _HALF - 1)

    def _read_torque_demand(self, now_ns: int) -> int:
        """What a torque mode asks for; under the position controller, what the amplifier gives."""
        if self.torque_demand is None:
            return clamp(self.latch(now_ns)[2], _INT16_MAX)
        return clamp(floor(self.torque_demand + 0.5), _INT16_MAX)

    def _read_inputs(self, now_ns: int) -> int:
        return self.settings.switches.inputs(self.latch(now_ns)[0])


def clamp(value: int, bound: int) -> int:
    """``value`` within ``bound`` either way."""
    return max(-bound, min(bound, value))
