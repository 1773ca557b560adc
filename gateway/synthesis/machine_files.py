"""What was found, as a machine that `check`, `compile` and `run` take: a configuration, and the curve's file beside it.

The configuration is a template's, with the linkage, its masses, the curve and the servo axis' home and range put in
their places. Everything else - bus, drives, limits, guard - stays the template's.
"""

import re
from dataclasses import dataclass
from math import degrees, pi, radians, tau
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from config.conversion import dynamics_parameters, five_bar
from config.loading import ConfigError, parse_config
from config.schema import GatewayConfig, LinkSection
from gateway.errors import GatewayError
from gateway.running.preparation import PreparedRun, compile_config, prepare
from mechanism.cam import Cam
from mechanism.cam_profile import CamProfile
from mechanism.closure import ClosureTrack
from mechanism.curve import DesiredCurve
from mechanism.curve_points import curve_csv
from mechanism.dynamics import mass_matrix_and_bias
from mechanism.errors import CamLimitError, MechanismError
from mechanism.five_bar import FiveBar
from mechanism.synthesis.candidate import Candidate
from mechanism.synthesis.machine_model import MachineModel
from mechanism.synthesis.task import Variable

LARGEST_CAM_POINTS: Final = 16384
_RANGE_MARGIN_DEG: Final = 10.0
_SPEED_MARGIN: Final = 0.995
_ORDERS: Final = {"velocity": 1, "acceleration": 2, "jerk": 3}
_TABLE_FAULTS: Final = frozenset({"distance from the curve's spline", "binary table's error"})
_ROUNDS: Final = 8
_GAINS_KEPT: Final = 0.05
"""A change of inertia by less is no reason to change gains."""
_INERTIA_SAMPLES: Final = 72
_LARGEST_GAIN: Final = 1_000_000
_RANGE_SAMPLES: Final = 4097
_LINKS: Final = ("p", "q", "r", "s")

Float = NDArray[np.float64]
Document = dict[str, Any]


@dataclass(frozen=True, slots=True)
class MachineFiles:
    """The files of a machine, the machine prepared for a run, and what had to give so that it keeps its limits."""

    config: GatewayConfig
    path: Path
    curve_path: Path
    prepared: PreparedRun
    notes: tuple[str, ...]

    @property
    def violations(self) -> tuple[MechanismError | GatewayError, ...]:
        """What `check` has to say of it."""
        return self.prepared.violations


def machine_model(config: GatewayConfig) -> MachineModel:
    """How heavy links of other lengths are: each of the configuration's as a uniform bar with a mass at its far end.

    Bar and end mass are what mass and centre of mass of the configured link make them.
    """
    lengths = five_bar(config).to_array().tolist()
    links: list[LinkSection] = [getattr(config.machine.links, name) for name in _LINKS]
    densities: list[float] = []
    ends: list[float] = []
    for length, link in zip(lengths, links, strict=False):
        end = min(max(link.mass_kg * (2.0 * link.com_m / length - 1.0), 0.0), link.mass_kg)
        ends.append(end)
        densities.append((link.mass_kg - end) / length)
    master, slave = (axis.emulation for axis in config.ordered_axes)
    return MachineModel(
        linear_density_kg_per_m=(densities[0], densities[1], densities[2], densities[3]),
        end_mass_kg=(ends[0], ends[1], ends[2], ends[3]),
        end_effector_mass_kg=config.machine.end_effector_mass_kg,
        rotor_inertia_kg_m2=(master.inertia_kgm2, slave.inertia_kgm2),
        gravity_m_s2=config.machine.gravity_m_s2,
        viscous_N_m_s=(master.viscous_Nms, slave.viscous_Nms),
        coulomb_N_m=(master.coulomb_Nm, slave.coulomb_Nm),
    )


def curve_path_of(path: Path) -> Path:
    """Where the curve of a machine file goes."""
    return path.with_name(f"{path.stem}-curve.csv")


def write_machine(
    path: Path, candidate: Candidate, template: GatewayConfig, remark: str, is_speed_fixed: bool = False
) -> MachineFiles:
    """Write the machine file and its curve; ``remark`` is the file's first comment.

    A drive that cannot follow at the template's speed is given a lower one, unless ``is_speed_fixed``. What is wrong
    with the machine all the same is in ``violations``. Raises OSError, MechanismError for a curve that is none.
    """
    curve = candidate.curve()
    curve_path = curve_path_of(path)
    curve_path.write_text(curve_csv(curve), encoding="utf-8")
    document = _document(path, curve_path, candidate, curve, template)
    notes: list[str] = []
    _settle_home_and_range(document, candidate.servo_motion(), template)
    config, prepared = _prepared(document, path, remark)
    notes += _settle_gains(document, prepared, template)
    for _ in range(_ROUNDS):
        config, prepared = _prepared(document, path, remark)
        note = _relieve(document["motion"], prepared.violations, is_speed_fixed)
        if note is None:
            break
        notes.append(note)
    path.write_text(config.text, encoding="utf-8")
    return MachineFiles(config, path, curve_path, prepared, tuple(notes))


def _document(
    path: Path, curve_path: Path, candidate: Candidate, curve: DesiredCurve, template: GatewayConfig
) -> Document:
    document: Document = template.model_dump(mode="json", exclude_unset=True)
    bar = candidate.five_bar()
    document["name"] = re.sub(r"[^A-Za-z0-9_.-]", "-", path.stem).lstrip("_.-")[:64] or "mechanism"
    document["description"] = (
        f"Synthesised for {Path(curve.source or 'a curve').name}, on the machine of {template.name}"
    )
    document["machine"]["five_bar"] = _lengths(bar)
    document["machine"]["links"] = {
        name: _link(candidate.task.machine, index, float(candidate.variables[index]))
        for index, name in enumerate(_LINKS)
    }
    document["motion"]["curve"] = curve_path.name
    document["motion"]["speed_rpm"] = round(candidate.task.speed_rad_per_s * 30.0 / pi, 9)
    tolerances = candidate.task.tolerances
    if tolerances is not None:
        limit = max(template.motion.structural_error_limit_mm, round(float(tolerances.max()) * 1e3, 6))
        document["motion"]["structural_error_limit_mm"] = limit
    return document


def _lengths(bar: FiveBar) -> Document:
    def millimetres(*values: float) -> list[float]:
        return [round(value * 1e3, 6) + 0.0 for value in values]

    return {
        **{f"{name}_mm": millimetres(getattr(bar, name))[0] for name in _LINKS},
        "cv_pivot_mm": millimetres(*bar.cv_pivot),
        "servo_pivot_mm": millimetres(*bar.servo_pivot),
    }


def _link(model: MachineModel, index: int, length_m: float) -> Document:
    link = model.link(index, length_m)
    return {
        "mass_kg": float(f"{link.mass_kg:.9g}"),
        "com_m": float(f"{link.com_m:.9g}"),
        "inertia_com_kgm2": float(f"{link.inertia_com_kg_m2:.9g}"),
    }


def _slave(document: Document) -> Document:
    return next(axis for axis in document["axes"].values() if axis["role"] == "slave")


def _prepared(document: Document, path: Path, remark: str) -> tuple[GatewayConfig, PreparedRun]:
    comment = "".join(f"# {line}\n" for line in remark.splitlines())
    text = comment + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    try:
        config = parse_config(text, path)
    except ConfigError as error:
        # The template was sound: it is the mechanism that makes no machine.
        raise GatewayError(f"the mechanism found makes no machine: {error}") from None
    return config, prepare(config, is_strict=False)


def _settle_home_and_range(document: Document, track: ClosureTrack, template: GatewayConfig) -> None:
    """The servo axis' home is where the cam has it when the master is at home; its range is what the cam sweeps."""
    profile = CamProfile.through(track.theta2, track.theta5, track.net_turns, template.motion.cam_points)
    slave = _slave(document)
    home = radians(template.ordered_axes[0].home_angle_deg)
    slave["home_angle_deg"] = round(degrees(profile.at(home)[0]), 6) + 0.0
    limits = slave["limits"]
    if track.net_turns:
        limits.pop("position_deg", None)
        return
    swept = np.degrees(profile.at_many(np.linspace(0.0, tau, _RANGE_SAMPLES))[:, 0])
    limits["position_deg"] = [
        round(float(swept.min()) - _RANGE_MARGIN_DEG, 1),
        round(float(swept.max()) + _RANGE_MARGIN_DEG, 1),
    ]


def _settle_gains(document: Document, prepared: PreparedRun, template: GatewayConfig) -> list[str]:
    """The emulated controllers' gains grow with the inertia that their axis moves, so that they stay as stiff."""
    try:
        before = _mean_inertias(template, compile_config(template).cam)
        after = _mean_inertias(prepared.config, prepared.cam.cam)
    except MechanismError:
        return []
    notes: list[str] = []
    for name, factor in zip(template.axis_names, after / before, strict=True):
        if not (0.0 < factor < float("inf")) or abs(factor - 1.0) < _GAINS_KEPT:
            continue
        gains = document["axes"][name]["emulation"]["gains"]
        factor = min(float(factor), _LARGEST_GAIN / max(*gains.values(), 1))
        for gain, value in gains.items():
            gains[gain] = int(value * factor)
        notes.append(
            f"axes.{name}: the emulated drive's gains are {factor:.3g} times the template's, as the axis' inertia is; "
            "tune a real drive anew"
        )
    return notes


def _mean_inertias(config: GatewayConfig, cam: Cam) -> Float:
    """The mass matrix' diagonal (kg m^2; CV axis, servo axis), mean over the cycle."""
    parameters = dynamics_parameters(config).to_array()
    theta2 = np.linspace(0.0, tau, _INERTIA_SAMPLES, endpoint=False)
    theta5 = cam.profile.at_many(theta2)[:, 0]
    diagonal = np.array(
        [
            mass_matrix_and_bias(parameters, first, second, 0.0, 0.0, int(cam.closure))[0:3:2]
            for first, second in zip(theta2.tolist(), theta5.tolist(), strict=True)
        ]
    )
    return diagonal.mean(axis=0)


def _relieve(
    motion: Document, violations: tuple[MechanismError | GatewayError, ...], is_speed_fixed: bool
) -> str | None:
    """Change what makes the cam break limits that it need not break, and say so; None where nothing is left to do."""
    limits = [error for error in violations if isinstance(error, CamLimitError)]
    if any(error.what in _TABLE_FAULTS for error in limits) and motion["cam_points"] < LARGEST_CAM_POINTS:
        motion["cam_points"] *= 2
        return f"the cam has {motion['cam_points']} points, fewer do not resolve this motion"
    factors = [
        abs(error.limit / error.value) ** (1.0 / _ORDERS[error.what.split()[0]])
        for error in limits
        if error.what.split()[0] in _ORDERS
    ]
    if not factors or is_speed_fixed:
        return None
    # Velocity, acceleration and jerk of the slave fall with the master's speed, its square and its cube.
    factor = min(factors) * _SPEED_MARGIN
    speed = float(f"{motion['speed_rpm'] * factor:.3g}")
    before = motion["speed_rpm"]
    factor = speed / before
    worst = min(limits, key=lambda error: abs(error.limit / error.value))
    motion["speed_rpm"] = speed
    motion["ramp_acceleration_rad_per_s2"] = float(f"{motion['ramp_acceleration_rad_per_s2'] * factor**2:.4g}")
    motion["ramp_jerk_rad_per_s3"] = float(f"{motion['ramp_jerk_rad_per_s3'] * factor**3:.4g}")
    return f"the speed is {speed:g} rpm instead of {before:g}: there, {worst}"


def variables_mm(candidate: Candidate) -> dict[str, float]:
    """The mechanism's variables by name, mm, for scripts."""
    return {
        f"{variable.name.lower()}_mm": round(float(candidate.variables[variable]) * 1e3, 6) + 0.0
        for variable in Variable
    }
