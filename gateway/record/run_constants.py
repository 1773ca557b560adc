"""What a reader of samples must know about the machine: kept in the ring's header and in the recording."""

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

from config.schema import GatewayConfig, Role


@dataclass(frozen=True, slots=True)
class AxisConstants:
    """One axis: joint angle = ``zero_rad`` + ``direction`` x 2 pi x counts / ``counts_per_revolution``."""

    name: str
    counts_per_revolution: int
    rated_torque_nm: float
    """Rated torque, N m, at the joint; torque objects are per mille of it."""
    zero_rad: float = 0.0
    """Joint angle at position 0 counts."""
    direction: int = 1
    """1 where counts grow with the joint angle, -1 where they fall."""


@dataclass(frozen=True, slots=True)
class MechanismConstants:
    """The five-bar: link lengths and pivots in metres; ``closure``, the number of a ``five_bar.Closure``."""

    p_m: float
    q_m: float
    r_m: float
    s_m: float
    cv_pivot_m: tuple[float, float]
    servo_pivot_m: tuple[float, float]
    closure: int


@dataclass(frozen=True, slots=True)
class RunConstants:
    """The machine as a run saw it; axes in the order of the samples' arrays."""

    config_name: str
    period_s: float
    """Cycle, s."""
    axes: tuple[AxisConstants, ...]
    master_axis: int = 0
    """Number of the axis that turns at constant velocity (theta2)."""
    slave_axis: int = 1
    """Number of the axis on the cam (theta5)."""
    mechanism: MechanismConstants | None = None

    @property
    def axis_names(self) -> tuple[str, ...]:
        return tuple(axis.name for axis in self.axes)

    def to_json(self) -> str:
        """Compact JSON with sorted keys: the same constants give the same text."""
        return json.dumps(asdict(self), sort_keys=True, separators=(",", ":"), allow_nan=False)

    @classmethod
    def from_config(cls, config: GatewayConfig, closure: int) -> "RunConstants":
        """The machine of a configuration; ``closure`` is the assembly mode that its cam was compiled for."""
        five_bar = config.machine.five_bar
        roles = [axis.role for axis in config.ordered_axes]
        return cls(
            config_name=config.name,
            period_s=config.cycle_s,
            axes=tuple(
                AxisConstants(name, axis.counts_per_revolution, axis.rated_torque_Nm, math.radians(axis.home_angle_deg))
                for name, axis in zip(config.axis_names, config.ordered_axes, strict=True)
            ),
            master_axis=roles.index(Role.MASTER),
            slave_axis=roles.index(Role.SLAVE),
            mechanism=MechanismConstants(
                p_m=five_bar.p_mm * 1e-3,
                q_m=five_bar.q_mm * 1e-3,
                r_m=five_bar.r_mm * 1e-3,
                s_m=five_bar.s_mm * 1e-3,
                cv_pivot_m=(five_bar.cv_pivot_mm[0] * 1e-3, five_bar.cv_pivot_mm[1] * 1e-3),
                servo_pivot_m=(five_bar.servo_pivot_mm[0] * 1e-3, five_bar.servo_pivot_mm[1] * 1e-3),
                closure=closure,
            ),
        )

    @classmethod
    def from_json(cls, text: str) -> "RunConstants":
        """Read what ``to_json`` wrote. Raises ``ValueError`` for anything else."""
        try:
            raw: dict[str, Any] = json.loads(text)
            mechanism: dict[str, Any] | None = raw["mechanism"]
            return cls(
                config_name=str(raw["config_name"]),
                period_s=float(raw["period_s"]),
                axes=tuple(AxisConstants(**axis) for axis in raw["axes"]),
                master_axis=int(raw["master_axis"]),
                slave_axis=int(raw["slave_axis"]),
                mechanism=None if mechanism is None else _mechanism(mechanism),
            )
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"not the constants of a run: {error}") from error


def _mechanism(raw: dict[str, Any]) -> MechanismConstants:
    cv_x, cv_y = raw["cv_pivot_m"]
    servo_x, servo_y = raw["servo_pivot_m"]
    return MechanismConstants(
        p_m=float(raw["p_m"]),
        q_m=float(raw["q_m"]),
        r_m=float(raw["r_m"]),
        s_m=float(raw["s_m"]),
        cv_pivot_m=(float(cv_x), float(cv_y)),
        servo_pivot_m=(float(servo_x), float(servo_y)),
        closure=int(raw["closure"]),
    )
