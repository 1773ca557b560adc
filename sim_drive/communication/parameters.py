"""Store and restore parameters, 1010h and 1011h (CiA 301, 7.5.2.13 and 7.5.2.14), over a store that is handed in."""

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, Protocol

from drivers import objects
from drivers.node import Event
from drivers.object_dictionary import decode, encode
from drivers.sdo import AbortCode
from sim_drive.communication.cob_ids import COB_ID_MASK
from sim_drive.communication.dictionary import Entry, LiveDictionary
from sim_drive.logical_axes import in_first_axis

Place = tuple[int, int]
"""Index and sub-index."""

SAVE_SIGNATURE: Final = int.from_bytes(b"save", "little")
LOAD_SIGNATURE: Final = int.from_bytes(b"load", "little")
SAVES_ON_COMMAND: Final = 1
"""What both objects read as: parameters are saved, or restored, on command and not by themselves."""

AREAS: Final[Mapping[int, tuple[range, ...]]] = MappingProxyType(
    {
        1: (
            objects.COMMUNICATION_PROFILE_AREA,
            objects.STANDARDISED_PROFILE_AREA,
            objects.MANUFACTURER_PROFILE_AREA,
        ),
        2: (objects.COMMUNICATION_PROFILE_AREA,),
        3: (objects.STANDARDISED_PROFILE_AREA,),
        4: (objects.MANUFACTURER_PROFILE_AREA,),
    }
)
"""Which objects the sub-indices of 1010h and 1011h are about."""

VOLATILE_OBJECTS: Final = frozenset(
    {
        objects.PREDEFINED_ERROR_FIELD,
        objects.STORE_PARAMETERS,
        objects.RESTORE_DEFAULT_PARAMETERS,
        objects.CONTROLWORD,
        objects.MODES_OF_OPERATION,
        objects.TARGET_POSITION,
        objects.TARGET_TORQUE,
        objects.TARGET_VELOCITY,
        objects.POSITION_OFFSET,
        objects.VELOCITY_OFFSET,
        objects.TORQUE_OFFSET,
        objects.TOUCH_PROBE_FUNCTION,
        objects.INTERPOLATION_DATA_RECORD,
        objects.INTERPOLATION_DATA_CONFIGURATION,
        objects.DIGITAL_OUTPUTS,
        objects.CAM_MASTER_POSITION,
        objects.PROFILE_SLOT_SELECTED,
        *range(objects.PROFILE_SLOT, objects.PROFILE_SLOT + objects.PROFILE_SLOT_COUNT),
    }
)
"""Writable objects that are commands, demands or contents of their own, and so no parameters."""


_PDO_PARAMETERS: Final = frozenset(
    first + number for first in (objects.RPDO_COMMUNICATION, objects.TPDO_COMMUNICATION) for number in range(512)
)
"""Communication parameters of every PDO there may be."""


@dataclass(frozen=True, slots=True)
class StoredParameters:
    """What a drive keeps while it has no supply."""

    values: Mapping[Place, bytes] = field(default_factory=dict[Place, bytes])
    """Little-endian bytes, as SDO carries them."""
    node_id: int | None = None
    """Stored by LSS, 1 to 127, or 255 for none at all; None: the one that the drive is made with."""
    bit_timing: int | None = None
    """Index into the bit timing table of CiA 305, stored by LSS."""
    saved_as: int | None = None
    """Node id that the drive had when ``values`` were saved; None: not known."""


class ParameterStoreError(Exception):
    """Parameters cannot be loaded or saved; the message is one sentence that says why."""


class ParameterStore(Protocol):
    """The drive's non-volatile memory."""

    def load(self) -> StoredParameters | None:
        """What was saved last, None if nothing is. Raises ParameterStoreError if it is damaged or out of reach."""
        ...

    def save(self, parameters: StoredParameters) -> None:
        """Replace what was saved, whole or not at all. Raises ParameterStoreError."""
        ...


class MemoryParameterStore:
    """A store that lives as long as the process."""

    __slots__ = ("_saved",)

    def __init__(self) -> None:
        self._saved: StoredParameters | None = None

    def load(self) -> StoredParameters | None:
        """See ParameterStore."""
        return self._saved

    def save(self, parameters: StoredParameters) -> None:
        """See ParameterStore."""
        self._saved = parameters


@dataclass(frozen=True, slots=True)
class ParametersLost(Event):
    """The stored parameters cannot be used, and the drive has its default values; ``reason`` is one sentence."""

    node_id: int
    reason: str


class ParameterMemory:
    """What the drive has stored, and the objects by which a client has it store and restore.

    Values in the dictionary are those of the default or of the store after power-on and after a reset; restoring makes
    no difference before the next of these, as CiA 301 has it.
    """

    __slots__ = ("_dictionary", "_on_saved", "_store", "damage", "node_id", "stored")

    def __init__(
        self, node_id: int, dictionary: LiveDictionary, store: ParameterStore, on_saved: Callable[[int], None]
    ) -> None:
        """Load what ``store`` has; ``on_saved(now_ns)``: something has been saved or restored."""
        self.node_id = node_id
        """Of the drive; it sets another one."""
        self._dictionary = dictionary
        self._store = store
        self._on_saved = on_saved
        self.stored = StoredParameters()
        self.damage: str | None = None
        """Why what was stored cannot be used, in one sentence; None if it can, or nothing was."""
        try:
            loaded = store.load()
            if loaded is not None:
                self._check(loaded)
                self.stored = loaded
        except ParameterStoreError as error:
            self.damage = str(error)
        for subindex in AREAS:
            for index, act in (
                (objects.STORE_PARAMETERS, self._saver(subindex)),
                (objects.RESTORE_DEFAULT_PARAMETERS, self._restorer(subindex)),
            ):
                entry = dictionary.entry(index, subindex)
                entry.on_write = act
                entry.on_read = _read_capability

    def apply(self, first_index: int, last_index: int) -> None:
        """Put the stored values of this range of indices into the dictionary, without asking the hooks.

        A COB-ID that was the default of the node id under which it was saved becomes that of the present one.
        """
        for place, data in self.stored.values.items():
            if first_index <= place[0] <= last_index:
                entry = self._dictionary.entry(*place)
                entry.value = decode(entry.data_type, data)
                saved_as = self.stored.saved_as
                if saved_as is not None and _is_cob_id(*place) and isinstance(entry.default, int):
                    was_default = entry.default - self.node_id + saved_as
                    if not (entry.value ^ was_default) & COB_ID_MASK:
                        entry.value = entry.value & ~COB_ID_MASK | entry.default & COB_ID_MASK

    def save_layer_settings(self, node_id: int, bit_timing: int | None, now_ns: int) -> bool:
        """Store what LSS has configured; whether it has worked."""
        return self._save(replace(self.stored, node_id=node_id, bit_timing=bit_timing), now_ns)

    def _entries(self, subindex: int) -> Iterator[Entry]:
        areas = AREAS[subindex]
        return (e for e in self._dictionary if is_storable(e) and any(e.variable.index in area for area in areas))

    def _check(self, parameters: StoredParameters) -> None:
        for place, data in parameters.values.items():
            entry = self._dictionary.get(*place)
            if entry is None or not is_storable(entry):
                raise ParameterStoreError(f"{_name(place)} is stored, which is no parameter of this drive")
            try:
                value = decode(entry.data_type, data)
            except struct.error:
                raise ParameterStoreError(
                    f"{_name(place)} is stored with {len(data)} bytes, but has {entry.size}"
                ) from None
            low, high = entry.low_limit, entry.high_limit
            if not isinstance(value, bytes) and (
                (low is not None and value < low) or (high is not None and value > high)
            ):
                raise ParameterStoreError(f"{_name(place)} is stored as {value}, outside {low} to {high}")

    def _save(self, parameters: StoredParameters, now_ns: int) -> bool:
        try:
            self._store.save(parameters)
        except ParameterStoreError:
            return False
        self.stored = parameters
        self.damage = None
        self._on_saved(now_ns)
        return True

    def _saver(self, subindex: int) -> Callable[[int, int], AbortCode | None]:
        def save(value: int, now_ns: int) -> AbortCode | None:
            if value != SAVE_SIGNATURE:
                return AbortCode.CANNOT_STORE
            values = dict(self.stored.values)
            for entry in self._entries(subindex):
                variable = entry.variable
                values[variable.index, variable.subindex] = encode(entry.data_type, entry.value)
            is_done = self._save(replace(self.stored, values=values, saved_as=self.node_id), now_ns)
            return None if is_done else AbortCode.HARDWARE_ERROR

        return save

    def _restorer(self, subindex: int) -> Callable[[int, int], AbortCode | None]:
        def restore(value: int, now_ns: int) -> AbortCode | None:
            if value != LOAD_SIGNATURE:
                return AbortCode.CANNOT_STORE
            areas = AREAS[subindex]
            values = {
                place: data for place, data in self.stored.values.items() if not any(place[0] in area for area in areas)
            }
            saved_as = self.stored.saved_as if values else None
            is_done = self._save(replace(self.stored, values=values, saved_as=saved_as), now_ns)
            return None if is_done else AbortCode.HARDWARE_ERROR

        return restore


def is_storable(entry: Entry) -> bool:
    """Whether an entry is a parameter: writable, of fixed length, and no command or demand."""
    variable = entry.variable
    return (
        variable.access.is_writable
        and variable.access.is_readable
        and variable.size is not None
        and variable.index >= objects.DEVICE_TYPE
        and in_first_axis(variable.index) not in VOLATILE_OBJECTS
    )


def _is_cob_id(index: int, subindex: int) -> bool:
    """Whether it is a COB-ID whose default depends on the node id: that of EMCY or of a PDO."""
    return (index == objects.COB_ID_EMCY and subindex == 0) or (subindex == 1 and index in _PDO_PARAMETERS)


def _name(place: Place) -> str:
    return f"{place[0]:04X}h:{place[1]:02X}"


def _read_capability(now_ns: int) -> int:
    return SAVES_ON_COMMAND
