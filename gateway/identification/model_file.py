"""Identified parameters as the section ``feed_forward`` of a configuration."""

from typing import Any, Final

import yaml

from config.schema import FeedForwardSection
from gateway.identification.fit import Identification
from mechanism.dynamics import DynamicsParameters, LinkParameters

HEAD: Final = "# Identified parameters: the model for torque offsets, to be put into a configuration.\n"
_DIGITS: Final = 8


def model_section(parameters: DynamicsParameters, axis_names: tuple[str, ...]) -> dict[str, Any]:
    """The section as plain values; axes are master and slave."""
    p = parameters
    section: dict[str, Any] = {
        "enabled": True,
        "links": {name: _link(link) for name, link in (("p", p.p), ("q", p.q), ("r", p.r), ("s", p.s))},
        "end_effector_mass_kg": _short(p.end_effector_mass_kg),
        "axes": {
            name: {
                "inertia_kgm2": _short(p.rotor_inertia_kg_m2[axis]),
                "viscous_Nms": _short(max(p.viscous_N_m_s[axis], 0.0)),
                "coulomb_Nm": _short(max(p.coulomb_N_m[axis], 0.0)),
            }
            for axis, name in enumerate(axis_names)
        },
    }
    FeedForwardSection.model_validate(section)
    return section


def _link(link: LinkParameters) -> dict[str, float]:
    return {
        "mass_kg": _short(link.mass_kg),
        "com_m": _short(link.com_m),
        "com_perp_m": _short(link.com_perp_m),
        "inertia_com_kgm2": _short(link.inertia_com_kg_m2),
    }


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def model_text(result: Identification, axis_names: tuple[str, ...]) -> str:
    """A YAML fragment with the section."""
    return HEAD + yaml.safe_dump({"feed_forward": model_section(result.parameters, axis_names)}, sort_keys=False)
