"""Profile slots 3000h to 3003h: a cam table is loaded as an image, then parsed, then valid; 3010h selects one."""

import zlib
from collections.abc import Callable
from enum import IntEnum, unique
from typing import Final, Protocol

from drivers.objects import (
    PROFILE_SLOT,
    PROFILE_SLOT_COMMAND,
    PROFILE_SLOT_COUNT,
    PROFILE_SLOT_CRC,
    PROFILE_SLOT_DATA,
    PROFILE_SLOT_ERROR,
    PROFILE_SLOT_POINTS,
    PROFILE_SLOT_SELECTED,
    PROFILE_SLOT_STATE,
)
from drivers.sdo import AbortCode
from mechanism.errors import CamFileError
from sim_drive.communication.dictionary import LiveDictionary
from sim_drive.logical_axes import of_axis

SLOT_CAPACITY: Final = 64 * 1024
"""Bytes that one slot takes."""
UNKNOWN_REASON: Final = 255
"""Shown as the error of a table that the decoder refused without a reason code."""


class CamTable(Protocol):
    """A decoded cam table."""

    @property
    def points(self) -> int:
        """Points of the table."""
        ...

    def slave_position(self, master_counts: int) -> float:
        """Slave position in counts where the master is at ``master_counts``, for any integer."""
        ...


CamDecoder = Callable[[bytes], CamTable]
"""Makes a table of an image; raises CamFileError, whose ``reason`` (if any) becomes the slot's error code."""


@unique
class SlotState(IntEnum):
    """Values of sub-index 3."""

    EMPTY = 0
    LOADED = 1
    VALID = 2
    INVALID = 3


@unique
class SlotCommand(IntEnum):
    """Values of sub-index 2."""

    NONE = 0
    PARSE = 1
    CLEAR = 2


class _Slot:
    __slots__ = ("command", "crc", "data", "error", "image", "number", "points", "reason", "state", "status", "table")

    def __init__(self, number: int, dictionary: LiveDictionary, axis: int) -> None:
        index = of_axis(PROFILE_SLOT + number - 1, axis)
        self.number = number
        self.data = dictionary.entry(index, PROFILE_SLOT_DATA)
        self.command = dictionary.entry(index, PROFILE_SLOT_COMMAND)
        self.state = dictionary.entry(index, PROFILE_SLOT_STATE)
        self.error = dictionary.entry(index, PROFILE_SLOT_ERROR)
        self.crc = dictionary.entry(index, PROFILE_SLOT_CRC)
        self.points = dictionary.entry(index, PROFILE_SLOT_POINTS)
        self.image = b""
        self.status = SlotState.EMPTY
        self.reason = 0
        self.table: CamTable | None = None

    def put(self, image: bytes, status: SlotState, reason: int = 0, table: CamTable | None = None) -> None:
        self.image = image
        self.status = status
        self.reason = reason
        self.table = table
        self.show()

    def show(self) -> None:
        """Put the slot's contents into the dictionary."""
        self.data.value = self.image
        self.state.value = int(self.status)
        self.error.value = self.reason
        self.crc.value = zlib.crc32(self.image) if self.image else 0
        self.points.value = 0 if self.table is None else self.table.points


class CamSlots:
    """The four slots of an axis. They stand for non-volatile memory: an NMT reset leaves them as they are."""

    __slots__ = ("_decode", "_slots", "is_running", "selected_number")

    def __init__(self, dictionary: LiveDictionary, decode: CamDecoder, axis: int = 1) -> None:
        """``axis``: the logical axis whose slots they are."""
        self._decode = decode
        self._slots = [_Slot(number, dictionary, axis) for number in range(1, PROFILE_SLOT_COUNT + 1)]
        self.selected_number = 0
        self.is_running = False
        """The drive is camming: the selected slot may be neither changed nor left."""
        dictionary.entry(of_axis(PROFILE_SLOT_SELECTED, axis)).on_write = self._on_selected
        for slot in self._slots:
            slot.data.capacity = SLOT_CAPACITY
            slot.data.on_domain = self._data_writer(slot)
            slot.command.on_write = self._command_writer(slot)
            slot.command.on_read = _read_no_command

    @property
    def selected_table(self) -> CamTable | None:
        """The valid table in the selected slot, or None."""
        return self._slots[self.selected_number - 1].table if self.selected_number else None

    def restore(self) -> None:
        """After the dictionary's defaults were restored: no slot is selected, and their contents show again."""
        self.selected_number = 0
        self.is_running = False
        for slot in self._slots:
            slot.show()

    def _is_locked(self, slot: _Slot) -> bool:
        return self.is_running and slot.number == self.selected_number

    def _on_selected(self, value: int, now_ns: int) -> AbortCode | None:
        if self.is_running and value != self.selected_number:
            return AbortCode.CANNOT_STORE_DEVICE_STATE
        self.selected_number = value
        return None

    def _data_writer(self, slot: _Slot) -> Callable[[bytes, int], AbortCode | None]:
        def write(image: bytes, now_ns: int) -> AbortCode | None:
            if self._is_locked(slot):
                return AbortCode.CANNOT_STORE_DEVICE_STATE
            slot.put(image, SlotState.LOADED if image else SlotState.EMPTY)
            return None

        return write

    def _command_writer(self, slot: _Slot) -> Callable[[int, int], AbortCode | None]:
        def write(value: int, now_ns: int) -> AbortCode | None:
            if value == SlotCommand.NONE:
                return None
            if self._is_locked(slot):
                return AbortCode.CANNOT_STORE_DEVICE_STATE
            if value == SlotCommand.CLEAR:
                slot.put(b"", SlotState.EMPTY)
            elif not slot.image:
                return AbortCode.NO_DATA_AVAILABLE
            else:
                self._parse(slot)
            return None

        return write

    def _parse(self, slot: _Slot) -> None:
        try:
            table = self._decode(slot.image)
        except CamFileError as error:
            reason = int(getattr(error, "reason", UNKNOWN_REASON))
            slot.put(slot.image, SlotState.INVALID, reason & 0xFF)
        else:
            slot.put(slot.image, SlotState.VALID, table=table)


def _read_no_command(now_ns: int) -> int:
    """A command is done by the time it can be read back."""
    return int(SlotCommand.NONE)
