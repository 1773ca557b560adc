"""The equations of motion in the form that identification needs: torque = Y(theta, theta', theta'') p, linear in p.

p are the barycentric parameters of the links about their own first joint (mass, first moments along and across,
inertia about the joint), the mass at the end effector, and viscous and Coulomb friction of both axes. A pivoted link
has no mass of its own in them, for it never lifts its pivot; its inertia has that of its motor in it.

Columns of Y are inverse dynamics with one parameter at 1 and the others at 0, so that they are those of
`mechanism.dynamics` by construction. Not all of them can be told apart (`base_columns`): a mass at the end of q does
the same whether it is q's or the end effector's.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mechanism.dynamics import DynamicsParameters, LinkParameters, inverse_dynamics_along
from mechanism.errors import ParameterError
from mechanism.five_bar import Closure

Float = NDArray[np.float64]

PARAMETER_NAMES: Final[tuple[str, ...]] = (
    "p.inertia",
    "p.moment_along",
    "p.moment_across",
    "q.mass",
    "q.moment_along",
    "q.moment_across",
    "q.inertia",
    "r.mass",
    "r.moment_along",
    "r.moment_across",
    "r.inertia",
    "s.inertia",
    "s.moment_along",
    "s.moment_across",
    "end_effector.mass",
    "viscous.master",
    "viscous.slave",
    "coulomb.master",
    "coulomb.slave",
)
"""kg m^2, kg m, kg, N m s/rad and N m."""
PARAMETER_UNITS: Final[dict[str, str]] = {
    "inertia": "kg m^2",
    "moment_along": "kg m",
    "moment_across": "kg m",
    "mass": "kg",
    "master": "",
    "slave": "",
}
_COUNT: Final = len(PARAMETER_NAMES)
_SLENDER: Final = 0.95
"""Greatest share of a link's inertia about its joint that its centre of mass alone may account for."""
# Of the flat array of DynamicsParameters.
_LINKS: Final = 8
_LINK_SIZE: Final = 4
_END_EFFECTOR: Final = 24
_VISCOUS: Final = 29
_COULOMB: Final = 31
_RANK_TOLERANCE: Final = 1e-8


def unit_of(name: str) -> str:
    """Unit of a parameter by its name."""
    if name.startswith("viscous"):
        return "N m s/rad"
    return "N m" if name.startswith("coulomb") else PARAMETER_UNITS[name.split(".")[1]]


def _columns() -> list[list[tuple[float, Float]]]:
    """Of each parameter the sum of inverse dynamics that is its column: factors, and what stands in the flat array."""

    def link(number: int, mass: float, along: float, across: float, inertia: float) -> Float:
        flat = np.zeros(33)
        flat[_LINKS + _LINK_SIZE * number :][:_LINK_SIZE] = mass, along, across, inertia
        return flat

    def single(place: int) -> list[tuple[float, Float]]:
        flat = np.zeros(33)
        flat[place] = 1.0
        return [(1.0, flat)]

    def inertia(number: int) -> list[tuple[float, Float]]:
        return [(1.0, link(number, 0.0, 0.0, 0.0, 1.0))]

    def moments(number: int) -> list[list[tuple[float, Float]]]:
        # A mass of 1 at a distance of 1 is mass, moment and inertia of 1 in one.
        rest = [(-1.0, link(number, 1.0, 0.0, 0.0, 0.0)), (-1.0, link(number, 0.0, 0.0, 0.0, 1.0))]
        return [[(1.0, link(number, 1.0, 1.0, 0.0, 0.0)), *rest], [(1.0, link(number, 1.0, 0.0, 1.0, 0.0)), *rest]]

    def carried(number: int) -> list[list[tuple[float, Float]]]:
        return [[(1.0, link(number, 1.0, 0.0, 0.0, 0.0))], *moments(number), inertia(number)]

    return [
        inertia(0),
        *moments(0),
        *carried(1),
        *carried(2),
        inertia(3),
        *moments(3),
        single(_END_EFFECTOR),
        single(_VISCOUS),
        single(_VISCOUS + 1),
        single(_COULOMB),
        single(_COULOMB + 1),
    ]


def regressor(
    params: DynamicsParameters, closure: Closure, theta: Float, omega: Float, alpha: Float, coulomb_velocity: float
) -> Float:
    """Y (n, 2, 19) of n states; theta (rad), omega (rad/s), alpha (rad/s^2) are (n, 2), columns master and slave.

    Of ``params`` only linkage and gravity count. ``coulomb_velocity``: see `mechanism.dynamics.friction_torque`.
    """
    common = params.to_array()
    result = np.zeros((len(theta), 2, _COUNT))
    torque = np.zeros((len(theta), 2))
    x, v, a = (np.ascontiguousarray(part, dtype=np.float64) for part in (theta, omega, alpha))
    for column, terms in enumerate(_columns()):
        for factor, flat in terms:
            flat[:_LINKS] = common[:_LINKS]
            flat[27:29] = common[27:29]
            inverse_dynamics_along(flat, x, v, a, int(closure), coulomb_velocity, torque)
            result[:, :, column] += factor * torque
    return result


def to_vector(params: DynamicsParameters) -> Float:
    """The 19 parameters, in the order of ``PARAMETER_NAMES``."""

    def barycentric(link: LinkParameters) -> tuple[float, float, float, float]:
        mass, along, across = link.mass_kg, link.com_m, link.com_perp_m
        inertia = link.inertia_com_kg_m2 + mass * (along * along + across * across)
        return mass, mass * along, mass * across, inertia

    p, q, r, s = (barycentric(link) for link in (params.p, params.q, params.r, params.s))
    rotor = params.rotor_inertia_kg_m2
    return np.array(
        [
            p[3] + rotor[0],
            *p[1:3],
            *q,
            *r,
            s[3] + rotor[1],
            *s[1:3],
            params.end_effector_mass_kg,
            *params.viscous_N_m_s,
            *params.coulomb_N_m,
        ]
    )


def from_vector(vector: Float, nominal: DynamicsParameters) -> DynamicsParameters:
    """Parameters with these 19 values; what they leave open (rotors, the shape of p and s) is ``nominal``'s.

    Raises ParameterError where they are those of no body: a negative mass or inertia.
    """
    named: dict[str, float] = dict(zip(PARAMETER_NAMES, vector.tolist(), strict=True))

    def carried(name: str, carrier: str, reach: float) -> LinkParameters:
        inertia, moments = named[f"{name}.inertia"], (named[f"{name}.moment_along"], named[f"{name}.moment_across"])
        if not inertia > 0.0:
            raise ParameterError(f"the identified inertia of link {name} about its joint", inertia, "positive")
        # With less mass than this the moments would need more inertia than there is. What is added at its joint is
        # taken off the link that carries it, which no torque shows.
        least = (moments[0] ** 2 + moments[1] ** 2) / (_SLENDER * inertia)
        mass = max(named[f"{name}.mass"], least)
        added = mass - named[f"{name}.mass"]
        named[f"{carrier}.moment_along"] -= added * reach
        named[f"{carrier}.inertia"] -= added * reach * reach
        along, across = moments[0] / mass, moments[1] / mass
        return LinkParameters(mass, along, across, inertia - mass * (along * along + across * across))

    def pivoted(name: str, before: LinkParameters, rotor: float) -> LinkParameters:
        inertia = named[f"{name}.inertia"] - rotor
        if not inertia > 0.0:
            raise ParameterError(f"the identified inertia of link {name} about its pivot", inertia, "positive")
        # Its mass does nothing but in its moment and inertia; the shape is kept: radius of gyration by distance.
        reach = before.mass_kg * (before.com_m**2 + before.com_perp_m**2)
        share = reach / (reach + before.inertia_com_kg_m2)
        moments = np.hypot(named[f"{name}.moment_along"], named[f"{name}.moment_across"])
        if not (moments > 0.0 and share > 0.0):
            return LinkParameters(before.mass_kg, 0.0, 0.0, inertia)
        mass = float(moments) ** 2 / (inertia * share)
        along, across = named[f"{name}.moment_along"] / mass, named[f"{name}.moment_across"] / mass
        return LinkParameters(mass, along, across, inertia * (1.0 - share))

    def friction(name: str) -> tuple[float, float]:
        return named[f"{name}.master"], named[f"{name}.slave"]

    rotor, linkage = nominal.rotor_inertia_kg_m2, nominal.five_bar
    q, r = carried("q", "p", linkage.p), carried("r", "s", linkage.s)
    return replace(
        nominal,
        p=pivoted("p", nominal.p, rotor[0]),
        q=q,
        r=r,
        s=pivoted("s", nominal.s, rotor[1]),
        end_effector_mass_kg=named["end_effector.mass"],
        viscous_N_m_s=friction("viscous"),
        coulomb_N_m=friction("coulomb"),
    )


def base_columns(matrix: Float, scale: Float) -> list[int]:
    """Columns that are independent of each other, of a regressor (rows, 19) scaled by ``scale`` (19,); the rest follow.

    By Gram-Schmidt with pivoting: which combinations can be told apart depends on linkage and gravity alone, if the
    states of the rows are general enough.
    """
    scaled = matrix * scale
    norms = np.linalg.norm(scaled, axis=0)
    rest = scaled / np.where(norms > 0.0, norms, 1.0)
    found: list[int] = []
    for _ in range(_COUNT):
        lengths = np.linalg.norm(rest, axis=0)
        column = int(np.argmax(lengths))
        if lengths[column] <= _RANK_TOLERANCE:
            break
        found.append(column)
        direction = rest[:, column] / lengths[column]
        rest = rest - np.outer(direction, direction @ rest)
    return sorted(found)
