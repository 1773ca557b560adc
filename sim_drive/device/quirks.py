"""Gives an emulated drive the habits of real ones, by hooks before those of its dictionary.

The habits that concern more than what a master may write are in the drive's own parts, which ask its settings.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from config.quirks import Quirk
from drivers import objects
from drivers.nmt import NmtState
from drivers.pdo import PDO_COB_ID_NO_RTR, MappingEntry
from drivers.sdo import AbortCode
from sim_drive.communication.dictionary import Entry
from sim_drive.device.cia402 import Mode
from sim_drive.logical_axes import in_first_axis

if TYPE_CHECKING:
    from sim_drive.device.drive import Drive

__all__ = ["MODE_SWITCH_NS", "SYNC_PATIENCE_NS", "Quirk", "apply_quirks", "describe_quirks"]

MODE_SWITCH_NS: Final = 100_000_000
"""What a mode switch takes with ``Quirk.SLOW_MODE_SWITCH``."""
SYNC_PATIENCE_NS: Final = 500_000
"""How late a SYNC may be with ``Quirk.LATE_SYNC_FREEZES``."""

_MILLISECONDS: Final = -3
_CYCLIC_MODES: Final = frozenset(
    {
        int(Mode.CYCLIC_SYNCHRONOUS_POSITION),
        int(Mode.CYCLIC_SYNCHRONOUS_VELOCITY),
        int(Mode.CYCLIC_SYNCHRONOUS_TORQUE),
    }
)
_EVENT_DRIVEN: Final = 254
_PARAMETER_RANGE: Final = 0x200
"""From 1400h to 15FFh are what 1600h to 17FFh map, and so on: CiA 301 gives each kind of PDO object 200h indices."""

_Check = Callable[[int], AbortCode | None]


def apply_quirks(drive: "Drive") -> None:
    """Put the habits of ``drive.settings.quirks`` before the dictionary's own checks; once, when those are there."""
    for quirk in Quirk:
        if quirk in drive.settings.quirks and quirk in _APPLY:
            _APPLY[quirk](drive)


def describe_quirks() -> str:
    """The names of all habits, one a line."""
    return "\n".join(quirk.value for quirk in Quirk)


def _refuse(entry: Entry, check: _Check) -> None:
    """Ask ``check`` before the hook that is there; an abort code refuses the value."""
    inner = entry.on_write

    def on_write(value: int, now_ns: int) -> AbortCode | None:
        refusal = check(value)
        if refusal is not None or inner is None:
            return refusal
        return inner(value, now_ns)

    entry.on_write = on_write


def _refuse_values(entry: Entry, is_refused: Callable[[int], bool]) -> None:
    _refuse(entry, lambda value: AbortCode.VALUE_RANGE_EXCEEDED if is_refused(value) else None)


def _of_range(drive: "Drive", first_index: int, subindex: int | None = None) -> list[Entry]:
    """Entries of one kind of PDO object that are there; all but sub-index 0, or one sub-index."""
    return [
        entry
        for entry in drive.dictionary
        if first_index <= entry.variable.index < first_index + _PARAMETER_RANGE
        and (entry.variable.subindex == subindex if subindex is not None else entry.variable.subindex > 0)
    ]


def _refuse_synchronous_tpdos(drive: "Drive") -> None:
    for entry in _of_range(drive, objects.TPDO_COMMUNICATION, 2):
        entry.default = entry.value = max(entry.value, _EVENT_DRIVEN)
        _refuse_values(entry, lambda value: value < _EVENT_DRIVEN)


def _keep_rtr_bit(drive: "Drive") -> None:
    def keep(entry: Entry) -> None:
        _refuse_values(entry, lambda value: bool((value ^ entry.value) & PDO_COB_ID_NO_RTR))

    for entry in _of_range(drive, objects.TPDO_COMMUNICATION, 1):
        keep(entry)


def _refuse_remap_in_operational(drive: "Drive") -> None:
    def check(value: int) -> AbortCode | None:
        return AbortCode.CANNOT_STORE_DEVICE_STATE if drive.nmt_state is NmtState.OPERATIONAL else None

    for first_index in (objects.RPDO_COMMUNICATION, objects.TPDO_COMMUNICATION):
        for entry in _of_range(drive, first_index):
            _refuse(entry, check)
    for first_index in (objects.RPDO_MAPPING, objects.TPDO_MAPPING):
        for entry in (*_of_range(drive, first_index, 0), *_of_range(drive, first_index)):
            _refuse(entry, check)


def _change_remap_abort_code(drive: "Drive") -> None:
    def change(entry: Entry) -> None:
        inner = entry.on_write
        if inner is None:
            return

        def on_write(value: int, now_ns: int) -> AbortCode | None:
            refusal = inner(value, now_ns)
            return AbortCode.VALUE_RANGE_EXCEEDED if refusal is AbortCode.UNSUPPORTED_ACCESS else refusal

        entry.on_write = on_write

    for first_index in (objects.RPDO_MAPPING, objects.TPDO_MAPPING):
        for entry in (*_of_range(drive, first_index, 0), *_of_range(drive, first_index)):
            change(entry)


def _refuse_homing_method_0(drive: "Drive") -> None:
    for axis in drive.axes:
        _refuse_values(axis.entry(objects.HOMING_METHOD), lambda value: value == 0)


def _take_milliseconds_alone(drive: "Drive") -> None:
    for axis in drive.axes:
        _refuse_values(axis.entry(objects.INTERPOLATION_TIME_PERIOD, 2), lambda value: value != _MILLISECONDS)


def _need_cycle_period(drive: "Drive") -> None:
    period = drive.dictionary.entry(objects.COMMUNICATION_CYCLE_PERIOD)

    def check(value: int) -> AbortCode | None:
        return AbortCode.CANNOT_STORE_DEVICE_STATE if value in _CYCLIC_MODES and not period.value else None

    for axis in drive.axes:
        _refuse(axis.entry(objects.MODES_OF_OPERATION), check)


def _remove_cyclic_position(drive: "Drive") -> None:
    mode = int(Mode.CYCLIC_SYNCHRONOUS_POSITION)
    for axis in drive.axes:
        supported = axis.entry(objects.SUPPORTED_DRIVE_MODES)
        supported.default = supported.value = supported.value & ~(1 << (mode - 1))
        _refuse_values(axis.entry(objects.MODES_OF_OPERATION), lambda value: value == mode)


def _remove_abort_option(drive: "Drive") -> None:
    _keep_abort_option(drive)
    for axis in drive.axes:
        place = axis.entry(objects.ABORT_CONNECTION_OPTION_CODE).variable.index, None
        drive.dictionary.refusals[place] = AbortCode.OBJECT_DOES_NOT_EXIST


def _keep_abort_option(drive: "Drive") -> None:
    for axis in drive.axes:
        axis.entry(objects.ABORT_CONNECTION_OPTION_CODE).on_read = lambda now_ns: 0


def _refuse_torque_offset(drive: "Drive") -> None:
    def check(value: int) -> AbortCode | None:
        is_it = bool(value) and in_first_axis(MappingEntry.from_word(value).index) == objects.TORQUE_OFFSET
        return AbortCode.NOT_PDO_MAPPABLE if is_it else None

    for first_index in (objects.RPDO_MAPPING, objects.TPDO_MAPPING):
        for entry in _of_range(drive, first_index):
            _refuse(entry, check)


_APPLY: Final[Mapping[Quirk, Callable[["Drive"], None]]] = {
    Quirk.SYNCHRONOUS_TPDO_REFUSED: _refuse_synchronous_tpdos,
    Quirk.RTR_BIT_MUST_BE_KEPT: _keep_rtr_bit,
    Quirk.REMAP_REFUSED_IN_OPERATIONAL: _refuse_remap_in_operational,
    Quirk.OTHER_REMAP_ABORT_CODE: _change_remap_abort_code,
    Quirk.NO_HOMING_METHOD_0: _refuse_homing_method_0,
    Quirk.INTERPOLATION_TIME_IN_MILLISECONDS: _take_milliseconds_alone,
    Quirk.CYCLE_PERIOD_NEEDED: _need_cycle_period,
    Quirk.NO_CYCLIC_POSITION_MODE: _remove_cyclic_position,
    Quirk.NO_ABORT_OPTION: _remove_abort_option,
    Quirk.ABORT_OPTION_STAYS: _keep_abort_option,
    Quirk.TORQUE_OFFSET_NOT_MAPPABLE: _refuse_torque_offset,
}
