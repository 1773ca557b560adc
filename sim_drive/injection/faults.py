"""Faults that the emulated machine makes on command: their kinds, what each takes, and one fault as a value."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum, unique
from math import isfinite
from typing import Final

from drivers.nmt import MAX_NODE_ID
from drivers.sdo import AbortCode
from sim_drive.communication.emcy import ErrorRegister
from sim_drive.logical_axes import MAX_AXES

MAX_COB_ID: Final = 0x7FF
MAX_TIME_S: Final = 1e6
MAX_DELAY_S: Final = 60.0
MAX_COUNTS: Final = 0x7FFFFFFF
MAX_FRAMES: Final = 1_000_000_000

_MAX_UNSIGNED32: Final = 0xFFFFFFFF
_MAX_UNSIGNED16: Final = 0xFFFF
_MAX_UNSIGNED8: Final = 0xFF


@unique
class FaultKind(Enum):
    """What can go wrong; the value is its name in scenarios and on the command line."""

    OVER_CURRENT = "over_current"
    OVER_VOLTAGE = "over_voltage"
    UNDER_VOLTAGE = "under_voltage"
    OVER_TEMPERATURE = "over_temperature"
    RESOLVER_LOSS = "resolver_loss"
    FOLLOWING_ERROR = "following_error"
    SAFE_TORQUE_OFF = "safe_torque_off"
    FROZEN_RESOLVER = "frozen_resolver"
    JUMPING_RESOLVER = "jumping_resolver"
    BROKEN_BRAKE = "broken_brake"
    MUTE_HEARTBEAT = "mute_heartbeat"
    NODE_RESET = "node_reset"
    POWER_CYCLE = "power_cycle"
    WRONG_IDENTITY = "wrong_identity"
    SLOW_SDO = "slow_sdo"
    SDO_ABORT = "sdo_abort"
    LOST_FRAMES = "lost_frames"
    LATE_FRAMES = "late_frames"
    DOUBLED_FRAMES = "doubled_frames"
    REORDERED_FRAMES = "reordered_frames"
    BUS_OFF = "bus_off"
    ERROR_PASSIVE = "error_passive"


@unique
class Direction(Enum):
    """Which frames of a drive a fault of frames concerns."""

    SENT = "sent"
    """What the drive transmits."""
    RECEIVED = "received"
    """What the drive is to hear; other nodes hear it as usual."""
    BOTH = "both"


@dataclass(frozen=True, slots=True)
class Trip:
    """How a drive trips: EMCY code (CiA 402-1, error codes) and the bits of 1001h."""

    error_code: int
    error_register: int
    is_torque_off: bool = False
    """The amplifier is off at once, whatever fault reaction 605Eh asks for."""
    lasts: bool = False
    """Without an end, its cause lasts until the end of the run; others are over at once, and can be reset."""


TRIPS: Final[Mapping[FaultKind, Trip]] = {
    FaultKind.OVER_CURRENT: Trip(0x2310, int(ErrorRegister.CURRENT), is_torque_off=True),
    FaultKind.OVER_VOLTAGE: Trip(0x3210, int(ErrorRegister.VOLTAGE)),
    FaultKind.UNDER_VOLTAGE: Trip(0x3220, int(ErrorRegister.VOLTAGE)),
    FaultKind.OVER_TEMPERATURE: Trip(0x4310, int(ErrorRegister.TEMPERATURE)),
    FaultKind.RESOLVER_LOSS: Trip(0x7305, int(ErrorRegister.DEVICE_PROFILE), is_torque_off=True),
    FaultKind.FOLLOWING_ERROR: Trip(0x8611, int(ErrorRegister.DEVICE_PROFILE)),
    # CiA has no one code for it: drives differ, so it is the one that is most often given another.
    FaultKind.SAFE_TORQUE_OFF: Trip(0xFF30, int(ErrorRegister.MANUFACTURER), is_torque_off=True, lasts=True),
}
"""The kinds that trip the drive."""

FRAME_FAULTS: Final = frozenset(
    {FaultKind.LOST_FRAMES, FaultKind.LATE_FRAMES, FaultKind.DOUBLED_FRAMES, FaultKind.REORDERED_FRAMES}
)
"""The kinds that do something to single frames."""


@dataclass(frozen=True, slots=True)
class FaultDescription:
    """What a kind of fault is, and which parameters it takes beside ``node_id``, ``at_s`` and ``for_s``."""

    text: str
    required: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    has_end: bool = True
    """Whether it takes ``for_s``."""


_SELECTION: Final = ("cob_id", "cob_id_mask", "direction", "probability", "count")
_IDENTITY: Final = ("vendor_id", "product_code", "revision_number", "serial_number")

FAULTS: Final[Mapping[FaultKind, FaultDescription]] = {
    FaultKind.OVER_CURRENT: FaultDescription(
        "trips with EMCY 2310h, torque off at once", optional=("error_code", "axis")
    ),
    FaultKind.OVER_VOLTAGE: FaultDescription("trips with EMCY 3210h", optional=("error_code", "axis")),
    FaultKind.UNDER_VOLTAGE: FaultDescription("trips with EMCY 3220h", optional=("error_code", "axis")),
    FaultKind.OVER_TEMPERATURE: FaultDescription("trips with EMCY 4310h", optional=("error_code", "axis")),
    FaultKind.RESOLVER_LOSS: FaultDescription(
        "trips with EMCY 7305h, torque off at once", optional=("error_code", "axis")
    ),
    FaultKind.FOLLOWING_ERROR: FaultDescription("trips with EMCY 8611h", optional=("error_code", "axis")),
    FaultKind.SAFE_TORQUE_OFF: FaultDescription(
        "trips with EMCY FF30h, torque off at once, no fault reset until it ends", optional=("error_code", "axis")
    ),
    FaultKind.FROZEN_RESOLVER: FaultDescription("the resolver shows what it showed when it froze", optional=("axis",)),
    FaultKind.JUMPING_RESOLVER: FaultDescription("the resolver shows so many counts too much", ("counts",), ("axis",)),
    FaultKind.BROKEN_BRAKE: FaultDescription("the holding brake does not hold", optional=("axis",)),
    FaultKind.MUTE_HEARTBEAT: FaultDescription("no heartbeat is sent, nor a boot-up message"),
    FaultKind.NODE_RESET: FaultDescription("the drive resets itself, and boots", has_end=False),
    FaultKind.POWER_CYCLE: FaultDescription("no supply: silent, brake engaged, RAM lost; boots at the end"),
    FaultKind.WRONG_IDENTITY: FaultDescription("another identity 1018h (one part of it at least)", optional=_IDENTITY),
    FaultKind.SLOW_SDO: FaultDescription("every SDO response comes so much later", ("delay_s",)),
    FaultKind.SDO_ABORT: FaultDescription(
        "SDO access to an object is aborted (subindex: default all, abort_code: default 08000000h)",
        ("index",),
        ("subindex", "abort_code"),
    ),
    FaultKind.LOST_FRAMES: FaultDescription("frames are lost", optional=_SELECTION),
    FaultKind.LATE_FRAMES: FaultDescription("frames come so much later", ("delay_s",), _SELECTION),
    FaultKind.DOUBLED_FRAMES: FaultDescription("frames come twice", optional=_SELECTION),
    FaultKind.REORDERED_FRAMES: FaultDescription(
        "a frame changes places with the next one of the selection", optional=_SELECTION
    ),
    FaultKind.BUS_OFF: FaultDescription("the drive hears and sends nothing, an enabled axis faults; EMCY 8140h after"),
    FaultKind.ERROR_PASSIVE: FaultDescription("EMCY 8120h as a warning, over at the end"),
}
"""Every kind, in the order in which they are listed."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of one drive; None where a parameter is not given.

    Raises ValueError, with a sentence, where a parameter is not the kind's, lacks, or is out of its bounds.
    """

    kind: FaultKind
    node_id: int
    at_s: float = 0.0
    """When it begins: seconds since the machine's first call, or, given to ``Injector.inject``, since then."""
    for_s: float | None = None
    """How long it lasts; None: to the end of the run (a trip: see ``Trip.lasts``)."""
    error_code: int | None = None
    """EMCY code in place of the usual one."""
    axis: int | None = None
    """In a node of several logical axes: the number of the one that is concerned, from 1; None: every one."""
    counts: int | None = None
    delay_s: float | None = None
    index: int | None = None
    subindex: int | None = None
    abort_code: int | None = None
    """One of `drivers.sdo.AbortCode`."""
    cob_id: int | None = None
    """A frame is concerned if its COB-ID is this one in the bits of ``cob_id_mask``; None: any."""
    cob_id_mask: int | None = None
    """Default 7FFh."""
    direction: Direction | None = None
    """Default both."""
    probability: float | None = None
    """Chance of every frame of the selection to be concerned, default 1."""
    count: int | None = None
    """Frames concerned at most; None: no limit."""
    vendor_id: int | None = None
    product_code: int | None = None
    revision_number: int | None = None
    serial_number: int | None = None

    def __post_init__(self) -> None:
        name = self.kind.value
        described = FAULTS[self.kind]
        if not 1 <= self.node_id <= MAX_NODE_ID:
            raise ValueError(f"{name}: node id {self.node_id} is not 1 to {MAX_NODE_ID}")
        given = [key for key in PARAMETERS if getattr(self, key) is not None]
        known = (*described.required, *described.optional)
        for key in given:
            if key not in known:
                takes = f"it takes {', '.join(known)}" if known else "it takes none"
                raise ValueError(f"{name}: has no parameter {key}, {takes}")
        for key in described.required:
            if key not in given:
                raise ValueError(f"{name}: needs {key}")
        if self.for_s is not None and not described.has_end:
            raise ValueError(f"{name}: happens at an instant, for_s cannot be given")
        if self.kind is FaultKind.WRONG_IDENTITY and not given:
            raise ValueError(f"{name}: needs one of {', '.join(_IDENTITY)}")
        self._check_bounds()

    def _check_bounds(self) -> None:
        name = self.kind.value
        for key, low, high in _BOUNDS:
            value = getattr(self, key)
            if value is not None and not (isfinite(value) and low <= value <= high):
                raise ValueError(f"{name}: {key} {value} is not {low:g} to {high:g}")
        for key in ("for_s", "delay_s", "probability", "counts"):
            if getattr(self, key) == 0:
                raise ValueError(f"{name}: {key} must not be 0")
        if self.abort_code is not None and self.abort_code not in _ABORT_CODES:
            raise ValueError(f"{name}: abort_code {self.abort_code:08X}h is no abort code of CiA 301")


PARAMETERS: Final = tuple(
    field.name for field in fields(Fault) if field.name not in {"kind", "node_id", "at_s", "for_s"}
)
"""Parameters that only some kinds take."""

_ABORT_CODES: Final = frozenset(int(code) for code in AbortCode)
_BOUNDS: Final[tuple[tuple[str, float, float], ...]] = (
    ("at_s", 0.0, MAX_TIME_S),
    ("for_s", 0.0, MAX_TIME_S),
    ("error_code", 1, _MAX_UNSIGNED16),
    ("axis", 1, MAX_AXES),
    ("counts", -MAX_COUNTS, MAX_COUNTS),
    ("delay_s", 0.0, MAX_DELAY_S),
    ("index", 1, _MAX_UNSIGNED16),
    ("subindex", 0, _MAX_UNSIGNED8),
    ("cob_id", 0, MAX_COB_ID),
    ("cob_id_mask", 0, MAX_COB_ID),
    ("probability", 0.0, 1.0),
    ("count", 1, MAX_FRAMES),
    *((key, 0, _MAX_UNSIGNED32) for key in _IDENTITY),
)


def describe_faults() -> str:
    """A table of all kinds for people: name, what it does, parameters."""
    width = max(len(kind.value) for kind in FAULTS)
    lines: list[str] = []
    for kind, described in FAULTS.items():
        lines.append(f"{kind.value:{width}}  {described.text}")
        parameters = (*described.required, *(f"[{key}]" for key in described.optional))
        if parameters:
            lines.append(f"{'':{width}}  {' '.join(parameters)}")
    return "\n".join(lines)
