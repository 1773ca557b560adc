"""Samples in the units of the figures: errors, angles and points of every one."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.record.recording import CAM_ATTACHMENT, Recording, RecordingError
from gateway.record.run_constants import RunConstants
from gateway.record.sample import Phase, SampleArray
from mechanism.cam_file import parse_cam_file
from mechanism.cam_profile import CamProfile
from mechanism.errors import CamFileError
from mechanism.five_bar import Closure, FiveBar

_POSITION_RANGE: Final = 2.0**32
FOLLOWING_PHASES: Final = (Phase.RAMP_UP, Phase.CAM, Phase.RAMP_DOWN, Phase.CONTROLLED_STOP)
"""In these the axes follow the cam, so that a following error means something."""

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RunData:
    """Samples in the units of the figures; arrays have a row a sample, (n,), (n, axes) or (n, 2) for x and y.

    ``is_valid``, (n, axes): the axis' TPDO came. ``desired_mm`` and ``actual_mm`` are None without a mechanism.
    """

    constants: RunConstants
    samples: SampleArray
    phase: NDArray[np.int32]
    master_rad: FloatArray
    """theta2 demanded, unwrapped."""
    master_deg: FloatArray
    """theta2 demanded, 0 to 360."""
    is_valid: BoolArray
    demand_counts: FloatArray
    actual_counts: FloatArray
    """Positions without the wrap of INTEGER32."""
    error_counts: FloatArray
    error_deg: FloatArray
    torque_nm: FloatArray
    angle_rad: FloatArray
    """Joint angles from the actual positions."""
    desired_mm: FloatArray | None
    actual_mm: FloatArray | None

    @property
    def is_steady(self) -> BoolArray:
        """Samples at constant master speed."""
        return self.phase == Phase.CAM

    @property
    def is_following(self) -> BoolArray:
        """Samples during which the axes followed the cam."""
        return np.isin(self.phase, FOLLOWING_PHASES)


def prepare(samples: SampleArray, constants: RunConstants, cam: CamProfile | None = None) -> RunData:
    """Work out errors, angles and points of every sample.

    The desired point is the cam's at the demanded theta2; without ``cam`` it follows from the demanded counts.
    """
    counts_per_revolution = np.array([axis.counts_per_revolution for axis in constants.axes], dtype=np.float64)
    rated = np.array([axis.rated_torque_nm for axis in constants.axes])
    # Positions are INTEGER32 and wrap: the difference is taken modulo 2^32, and the demand made continuous.
    error = (samples["position_demand"] - samples["position_actual"]).astype(np.float64)
    demand = np.unwrap(samples["position_demand"].astype(np.float64), axis=0, period=_POSITION_RANGE)
    actual = demand - error
    axis_bits = 1 << np.arange(len(constants.axes))
    is_valid: BoolArray = (samples["flags"][:, None] & axis_bits) == 0
    master = samples["master_position"].astype(np.float64)
    angle = _angles(actual, constants)
    desired_mm = actual_mm = None
    mechanism = constants.mechanism
    if mechanism is not None:
        m = mechanism
        five_bar = FiveBar(m.p_m, m.q_m, m.r_m, m.s_m, m.cv_pivot_m, m.servo_pivot_m)
        closure = Closure(m.closure)
        if cam is not None:
            theta2, theta5 = master, cam.at_many(master)[:, 0]
        else:
            wanted = _angles(demand, constants)
            theta2, theta5 = wanted[:, constants.master_axis], wanted[:, constants.slave_axis]
        desired_mm = five_bar.end_effector(theta2, theta5, closure) * 1e3
        actual_mm = (
            five_bar.end_effector(angle[:, constants.master_axis], angle[:, constants.slave_axis], closure) * 1e3
        )
    return RunData(
        constants=constants,
        samples=samples,
        phase=samples["phase"],
        master_rad=master,
        master_deg=np.degrees(np.mod(master, math.tau)),
        is_valid=is_valid,
        demand_counts=demand,
        actual_counts=actual,
        error_counts=error,
        error_deg=error * 360.0 / counts_per_revolution,
        torque_nm=samples["torque_actual"] * rated / 1000.0,
        angle_rad=angle,
        desired_mm=desired_mm,
        actual_mm=actual_mm,
    )


def _angles(counts: FloatArray, constants: RunConstants) -> FloatArray:
    zero = np.array([axis.zero_rad for axis in constants.axes])
    scale = np.array([axis.direction * math.tau / axis.counts_per_revolution for axis in constants.axes])
    return zero + scale * counts


def cam_of(recording: Recording) -> CamProfile | None:
    """The cam that the recording carries, if it carries one. Raises ``RecordingError`` for one that is damaged."""
    if not recording.cam_text:
        return None
    try:
        return parse_cam_file(recording.cam_text, f"{recording.path}:{CAM_ATTACHMENT}").cam.profile
    except CamFileError as error:
        raise RecordingError(recording.path, f"carries an unusable cam: {error}") from error
