"""What a drive is told so that it stops by itself without the gateway: written, read back, and what it lacks told."""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.errors import SdoAbortedError
from drivers.master import Master, Procedure
from drivers.node import Event
from drivers.object_dictionary import DataType
from drivers.sdo import AbortCode
from gateway.errors import CommissioningError


@dataclass(frozen=True, slots=True)
class DriveGuard:
    """One object that guards the machine from within the drive, and the value that it is to hold."""

    name: str
    """As the standard has it."""
    index: int
    subindex: int
    data_type: DataType
    value: int
    is_optional: bool = False
    """A drive may lack it, which is then told."""
    tolerance: float = 0.0
    """Share of the value by which what is read may differ, where drives keep it in a unit of their own."""
    is_packed: bool = False
    """Several fields in one number, which is therefore told in hexadecimal digits."""

    @property
    def place(self) -> str:
        """Index and sub-index as manuals write them."""
        return f"{self.index:04X}h:{self.subindex:02X}"

    def show(self, value: int) -> str:
        """A value of the object in words."""
        return f"{value:08X}h" if self.is_packed else str(value)

    def is_kept(self, value: int) -> bool:
        """Whether what the drive holds is what was written."""
        return abs(value - self.value) <= self.tolerance * abs(self.value)


@dataclass(frozen=True, slots=True)
class GuardsSet(Event):
    """An axis' drive holds these guards: they have been written, and read back."""

    axis: str
    guards: tuple[DriveGuard, ...]


@dataclass(frozen=True, slots=True)
class GuardMissing(Event):
    """An axis' drive has no such object: what it would guard is up to the drive, or left to other guards."""

    axis: str
    guard: DriveGuard


def write_guards(master: Master, node_id: int, guards: Sequence[DriveGuard]) -> Procedure[None]:
    """Write all of them in their order; an optional object that is not there is passed over. Raises NodeError."""
    for guard in guards:
        try:
            yield from master.write(node_id, guard.index, guard.subindex, guard.data_type, guard.value)
        except SdoAbortedError as error:
            if not (guard.is_optional and is_absence(error)):
                raise


def check_guards(master: Master, axis: str, node_id: int, guards: Sequence[DriveGuard]) -> Procedure[None]:
    """Read all of them back, and tell which are held, and which are not there.

    Raises CommissioningError with every object that holds another value than was written; NodeError.
    """
    held: list[DriveGuard] = []
    problems: list[str] = []
    for guard in guards:
        try:
            found = yield from master.read_int(node_id, guard.index, guard.subindex, guard.data_type)
        except SdoAbortedError as error:
            if not (guard.is_optional and is_absence(error)):
                raise
            master.events.append(GuardMissing(master.now_ns, axis, guard))
            continue
        if guard.is_kept(found):
            held.append(guard)
        else:
            problems.append(
                f"node {node_id} holds {guard.show(found)} in {guard.place} ({guard.name}), although "
                f"{guard.show(guard.value)} was written to it"
            )
    if problems:
        raise CommissioningError(problems)
    master.events.append(GuardsSet(master.now_ns, axis, tuple(held)))


def is_absence(error: SdoAbortedError) -> bool:
    """Whether the drive says that it has no such object, or no such sub-index."""
    return error.code in {AbortCode.OBJECT_DOES_NOT_EXIST, AbortCode.SUBINDEX_DOES_NOT_EXIST}
