"""The sample: one fixed binary record a cycle, the same bytes in the ring, in the recording and in numpy.

The layout is little-endian, ordered by size and naturally aligned, so that it is at the same time a ``struct``, a numpy
structured type and the body of a ROS 2 message in plain CDR (primitives and arrays of fixed size, which carry no
length). MCAP readers such as Foxglove therefore understand it with the schema text alone.
"""

import struct
from collections.abc import Callable, Sequence
from enum import IntEnum, IntFlag
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_AXES: Final = 8
CDR_HEADER: Final = b"\x00\x01\x00\x00"
"""Encapsulation header of CDR, little-endian; it stands before the sample in a recording only."""
INT32_MAX: Final = 2**31 - 1
SAMPLE_SCHEMA_NAME: Final = "drive_gateway/msg/Cycle"

SampleArray = NDArray[np.void]
"""Samples as a numpy structured array of ``SampleLayout.dtype``, shape (records,)."""


class Phase(IntEnum):
    """What the machine was doing in a cycle."""

    COMMISSIONING = 0
    STANDSTILL = 1
    RAMP_UP = 2
    CAM = 3
    RAMP_DOWN = 4
    CONTROLLED_STOP = 5
    QUICK_STOP = 6
    DISABLED = 7
    APPROACH = 8
    """On the slow way onto the cam."""


class SampleFlag(IntFlag):
    """What went wrong in a cycle; use ``missed_tpdo_flag`` for the axes' bits."""

    MISSED_TPDO_AXIS0 = 1 << 0
    MISSED_TPDO_AXIS1 = 1 << 1
    MISSED_TPDO_AXIS2 = 1 << 2
    MISSED_TPDO_AXIS3 = 1 << 3
    MISSED_TPDO_AXIS4 = 1 << 4
    MISSED_TPDO_AXIS5 = 1 << 5
    MISSED_TPDO_AXIS6 = 1 << 6
    MISSED_TPDO_AXIS7 = 1 << 7
    MISSED_RPDO_DEADLINE = 1 << 16
    """A demand went out after the next SYNC was due."""
    OVERRUN = 1 << 17
    """The loop took longer than a cycle, and at least one SYNC passed without it."""
    LATE_TPDO = 1 << 18
    """A TPDO came after its deadline, in this cycle or in the next one; no demand was made of it."""
    SEND_BUFFER_FULL = 1 << 19
    """The bus did not take a frame at once."""
    BUS_ERROR = 1 << 20
    """The controller reported an error frame."""
    SYNC_LOST = 1 << 21
    """At least one SYNC that another source was to send before this one was not seen."""


MISSED_TPDO_MASK: Final = (1 << MAX_AXES) - 1


def missed_tpdo_flag(axis: int) -> SampleFlag:
    """The flag that says that axis number ``axis`` (from 0) sent no TPDO for this SYNC."""
    return SampleFlag(1 << axis)


def saturate_int32(value: int) -> int:
    """``value``, held within int32: a host that stalls for seconds must not raise in the cycle's ``struct``."""
    return INT32_MAX if value > INT32_MAX else -INT32_MAX if value < -INT32_MAX else value


class _Field(NamedTuple):
    name: str
    code: str
    """Of the module struct."""
    ros_type: str
    per_axis: bool
    meaning: str


_FIELDS: Final[tuple[_Field, ...]] = (
    _Field("cycle", "q", "int64", False, "number of this cycle, k"),
    _Field("sync_ns", "q", "int64", False, "time of SYNC(k), monotonic or virtual"),
    _Field("master_position", "d", "float64", False, "theta2 demanded at SYNC(k), unwrapped, rad"),
    _Field("master_velocity", "d", "float64", False, "rad/s"),
    _Field("demand_velocity", "d", "float64", True, "velocity of the demand from plan and cam, rad/s"),
    _Field("sync_deviation_ns", "i", "int32", False, "SYNC(k) against its ideal instant"),
    _Field("sync_period_ns", "i", "int32", False, "SYNC(k) - SYNC(k-1)"),
    _Field("wake_lateness_ns", "i", "int32", False, "how late the loop woke"),
    _Field("tpdo_arrival_ns", "i", "int32", False, "last TPDO after SYNC(k)"),
    _Field("rpdo_lead_ns", "i", "int32", False, "last RPDO sent before the ideal instant of SYNC(k+1)"),
    _Field("loop_cpu_ns", "i", "int32", False, "processor time of the loop in the cycle before"),
    _Field("phase", "i", "int32", False, "see PHASE_*"),
    _Field("flags", "i", "int32", False, "bits, see FLAG_*"),
    _Field("position_demand", "i", "int32", True, "sent before SYNC(k-1), to be reached at SYNC(k), counts"),
    _Field("position_actual", "i", "int32", True, "latched at SYNC(k), counts"),
    _Field("statusword", "H", "uint16", True, "6041h"),
    _Field("torque_actual", "h", "int16", True, "per mille of rated torque"),
    _Field("torque_offset", "h", "int16", True, "feed-forward sent, per mille of rated torque"),
)
# Worked out when the sample is recorded, so that a viewer plots the error without a script.
_DERIVED: Final[tuple[_Field, ...]] = (
    _Field("master_angle_deg", "d", "float64", False, "theta2 within the machine cycle, 0 to 360 deg"),
    _Field("following_error", "i", "int32", True, "position_demand - position_actual, counts"),
)


class SampleLayout:
    """The record for machines with these axes.

    Attributes: ``axis_names``; ``format`` and ``size`` (bytes of one record, a multiple of 8) of the struct; ``dtype``,
    the same as a numpy structured type; ``recorded_dtype``, which has two derived fields more, and ``recorded_size``,
    the bytes of it that are recorded; ``schema_text``, the ROS 2 message definition of the latter; ``pack_into``.

    Raises ``ValueError`` for no axes, more than ``MAX_AXES``, or a name twice.
    """

    def __init__(self, axis_names: Sequence[str]) -> None:
        names = tuple(axis_names)
        if not 1 <= len(names) <= MAX_AXES:
            raise ValueError(f"a sample holds 1 to {MAX_AXES} axes, not {len(names)}")
        if len(set(names)) != len(names):
            raise ValueError(f"axis names must differ: {', '.join(names)}")
        self.axis_names: Final = names
        count = len(names)
        body = "".join(f"{count}{code}" if per_axis else code for _, code, _, per_axis, _ in _FIELDS)
        padding = -struct.calcsize("<" + body) % 8
        packer = struct.Struct(f"<{body}{padding}x")
        self.format: Final = packer.format
        self.size: Final = packer.size
        self.pack_into: Final[Callable[..., None]] = packer.pack_into
        """``pack_into(buffer, offset, *values)``, bound. The values, in order; [n] are n values, one an axis:

        cycle, sync_ns, master_position, master_velocity, demand_velocity[n],
        sync_deviation_ns, sync_period_ns, wake_lateness_ns, tpdo_arrival_ns, rpdo_lead_ns, loop_cpu_ns, phase, flags,
        position_demand[n], position_actual[n], statusword[n], torque_actual[n], torque_offset[n].

        Raises ``struct.error`` for a value outside its type: pass doubtful ones through ``saturate_int32``.
        """
        self.pack: Final[Callable[..., bytes]] = packer.pack
        self.dtype: Final = _dtype(_FIELDS, count)
        self.recorded_dtype: Final = _dtype((*_FIELDS, *_DERIVED), count)
        self.recorded_size: Final = self.recorded_dtype.itemsize - _trailing_padding(self.recorded_dtype)
        self.schema_text: Final = _schema_text(names)

    @property
    def axis_count(self) -> int:
        return len(self.axis_names)

    def derive(self, samples: SampleArray) -> SampleArray:
        """Samples (``dtype``) with the derived fields filled in (``recorded_dtype``), as they are recorded."""
        recorded = np.zeros(samples.shape, dtype=self.recorded_dtype)
        for name in self.dtype.names or ():
            recorded[name] = samples[name]
        recorded["master_angle_deg"] = np.degrees(np.mod(samples["master_position"], 2 * np.pi))
        recorded["following_error"] = samples["position_demand"] - samples["position_actual"]
        return recorded

    def strip(self, recorded: SampleArray) -> SampleArray:
        """The samples alone (``dtype``) of what ``derive`` made; the inverse of ``derive``."""
        samples = np.zeros(recorded.shape, dtype=self.dtype)
        for name in self.dtype.names or ():
            samples[name] = recorded[name]
        return samples


def _dtype(fields: Sequence[_Field], count: int) -> np.dtype[Any]:
    # align=True places fields as C and CDR do, each at a multiple of its own size
    columns = [(f.name, "<" + _NUMPY_CODES[f.code], (count,) if f.per_axis else ()) for f in fields]
    return np.dtype(columns, align=True)


def _trailing_padding(dtype: np.dtype[Any]) -> int:
    # CDR pads before a field, never after the last one
    return dtype.itemsize - max(field[1] + field[0].itemsize for field in dict(dtype.fields or {}).values())


_NUMPY_CODES: Final = {"q": "i8", "d": "f8", "i": "i4", "H": "u2", "h": "i2"}


def _schema_text(axis_names: Sequence[str]) -> str:
    count = len(axis_names)
    lines = ["# One cycle of the gateway. Values of an array, one an axis: " + ", ".join(axis_names)]
    for name, _, ros_type, per_axis, meaning in (*_FIELDS, *_DERIVED):
        lines.append(f"{ros_type}[{count}] {name}  # {meaning}" if per_axis else f"{ros_type} {name}  # {meaning}")
    lines.extend(f"int32 PHASE_{phase.name}={phase.value}" for phase in Phase)
    lines.extend(f"int32 FLAG_{flag.name}={flag.value}" for flag in SampleFlag)
    return "\n".join(lines) + "\n"
