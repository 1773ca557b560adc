"""How heavy a mechanism is that does not exist yet: bars of a given weight per metre, and what sits at their ends."""

from dataclasses import dataclass

from mechanism.dynamics import STANDARD_GRAVITY, DynamicsParameters, LinkParameters
from mechanism.errors import ParameterError, finite
from mechanism.five_bar import FiveBar


@dataclass(frozen=True, slots=True)
class MachineModel:
    """Uniform bars with a point mass at the far end; links in the order p, q, r, s, pairs are (CV axis, servo axis).

    The defaults are the shipped reference machine: p of steel 40 x 10 mm with 125 g at its end, q, r and s of aluminium
    15 x 4 mm, 12 g in each of the moving joints of s and of q and r, in a vertical plane. Raises ParameterError.
    """

    linear_density_kg_per_m: tuple[float, float, float, float] = (3.14, 0.162, 0.162, 0.162)
    width_m: tuple[float, float, float, float] = (0.040, 0.015, 0.015, 0.015)
    end_mass_kg: tuple[float, float, float, float] = (0.125, 0.0, 0.0, 0.012)
    end_effector_mass_kg: float = 0.012
    rotor_inertia_kg_m2: tuple[float, float] = (1.2e-4, 1.2e-4)
    gravity_m_s2: tuple[float, float] = STANDARD_GRAVITY
    viscous_N_m_s: tuple[float, float] = (0.005, 0.005)
    coulomb_N_m: tuple[float, float] = (0.04, 0.05)
    coulomb_velocity_rad_per_s: float = 0.1

    def __post_init__(self) -> None:
        for name, values in (
            ("linear_density_kg_per_m", self.linear_density_kg_per_m),
            ("width_m", self.width_m),
            ("end_mass_kg", self.end_mass_kg),
        ):
            if len(values) != 4 or not finite(*values) or min(values) < 0.0:
                raise ParameterError(name, values, "four finite values of 0 or more")
        if not (finite(self.coulomb_velocity_rad_per_s) and self.coulomb_velocity_rad_per_s >= 0.0):
            raise ParameterError("coulomb_velocity_rad_per_s", self.coulomb_velocity_rad_per_s, "0 or more")
        # The rest is held to its bounds where the equations of motion hold it, on any mechanism.
        self.dynamics(FiveBar(1.0, 1.0, 1.0, 1.0, (0.0, 0.0), (1.0, 0.0)))

    def link(self, index: int, length_m: float) -> LinkParameters:
        """Mass properties of link ``index`` (0 to 3: p, q, r, s) of this length."""
        bar = self.linear_density_kg_per_m[index] * length_m
        end = self.end_mass_kg[index]
        mass = bar + end
        com = (0.5 * bar + end) * length_m / mass if mass > 0.0 else 0.0
        about_first_joint = (bar / 3.0 + end) * length_m * length_m + bar * self.width_m[index] ** 2 / 12.0
        return LinkParameters(mass, com, 0.0, max(about_first_joint - mass * com * com, 0.0))

    def dynamics(self, five_bar: FiveBar) -> DynamicsParameters:
        """What the equations of motion need for these lengths."""
        return DynamicsParameters(
            five_bar,
            self.link(0, five_bar.p),
            self.link(1, five_bar.q),
            self.link(2, five_bar.r),
            self.link(3, five_bar.s),
            self.end_effector_mass_kg,
            self.rotor_inertia_kg_m2,
            self.gravity_m_s2,
            self.viscous_N_m_s,
            self.coulomb_N_m,
        )
