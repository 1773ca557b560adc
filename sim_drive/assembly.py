"""Builds the emulated machine that a configuration describes."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import inf, radians
from pathlib import Path
from typing import Final

from config.conversion import closure_at_home, dynamics_parameters, home_angles
from config.emulation_section import FrictionLaw
from config.loading import SHIPPED
from config.quirks import Quirk
from config.schema import SINGULAR_SHARE, AxisSection, GatewayConfig
from drivers.eds import describe_any_node
from drivers.object_dictionary import ObjectDictionary
from mechanism.cam_image import decode_cam_image
from sim_drive.communication.parameter_file import make_parameter_store
from sim_drive.device.drive import Drive
from sim_drive.device.energy_meter import attach_energy_meter
from sim_drive.logical_axes import MAX_AXES, eds_of_axes
from sim_drive.machine import EmulatedMachine
from sim_drive.machine_axis import MachineAxis
from sim_drive.node_row import describe_row
from sim_drive.physics.compliant import CompliantPlant
from sim_drive.physics.coupling import Coupling
from sim_drive.physics.driveline import AxisDriveline, MotorParameters
from sim_drive.physics.free_axis import FreeAxisParameters, FreeAxisPlant
from sim_drive.physics.plant import CoupledPlant, Plant, PlantParameters
from sim_drive.physics.servo import DemandResolution
from sim_drive.settings import DriveIdentity, DriveSettings
from sim_drive.switches import Switches

SHIPPED_EDS: Final = SHIPPED / "eds" / "sim_drive.eds"
FREE_AXIS: Final = FreeAxisParameters(inertia_kg_m2=0.002, viscous_N_m_s=0.005, coulomb_N_m=0.05)
"""What a drive of ``free_machine`` moves."""
FREE_AXIS_GAINS: Final = (4000, 0, 0, 45_000, 45_000)
"""3020h of a drive of ``free_machine``: the paper's, which suit the inertia."""

_FEW_NODES: Final = 3


def build_machine(
    config: GatewayConfig, seed: int = 0, start_ns: int = 0, record_ticks: int = 0, *, in_one_node: bool = False
) -> EmulatedMachine:
    """The configuration's drives and coupled plant, standing at the home position with the brakes engaged.

    ``start_ns``: the host's time at which it is put on the bus; ``seed`` decides the resolvers' noise;
    ``record_ticks``: see EmulatedMachine. ``in_one_node``: both axes are logical axes of one drive, which has the node
    id, the identity and all habits of the first. Raises drivers.errors.EdsError or mechanism.errors.MechanismError.
    """
    axes = config.ordered_axes
    settings = [drive_settings(axis, config) for axis in axes]
    if in_one_node:
        quirks = frozenset[Quirk]().union(*(own.quirks for own in settings))
        first, *further = (replace(own, quirks=quirks) for own in settings)
        settings = [replace(first, further_axes=tuple(further))]
    describe = _describe(config.relative(config.emulator.eds), settings[0])
    node_ids = [axis.node_id for axis in axes]
    drives = [_make_drive(node_id, own, describe) for node_id, own in zip(node_ids, settings, strict=False)]
    parameters = PlantParameters(
        dynamics=dynamics_parameters(config),
        closure=closure_at_home(config),
        axes=(_driveline(axes[0]), _driveline(axes[1])),
        singular_sine=SINGULAR_SHARE * config.machine.minimum_transmission_sine,
        substeps=config.emulator.sub_steps,
    )
    theta2, theta5 = home_angles(config)
    plant = _plant(parameters, (_coupling(axes[0]), _coupling(axes[1])), theta2, theta5)
    _attach_meters(drives, plant)
    return EmulatedMachine(drives, plant, [_machine_axis(axis) for axis in axes], start_ns, seed, record_ticks)


def free_machine(
    node_ids: Sequence[int],
    *,
    settings: DriveSettings | None = None,
    start_ns: int = 0,
    seed: int = 0,
    record_ticks: int = 0,
) -> EmulatedMachine:
    """Drives without a configuration, each axis moving a shaft that is coupled to nothing, at 0 rad, brake engaged.

    ``settings``: of every drive, save that each has its node id for a serial number, and in the name of a parameter
    file; by default those of the EDS file that ships, with gains that suit the axis. ``start_ns``, ``seed``,
    ``record_ticks``: see EmulatedMachine. Several machines may share a bus, if all node ids on it differ.

    Raises ValueError if a node id is not 1 to 127, or is given twice, or there is none.
    """
    if not node_ids:
        raise ValueError("a machine needs a node")
    for node_id in node_ids:
        if node_ids.count(node_id) > 1:
            raise ValueError(f"node id {node_id} is given twice, every node id must be unique")
    common = DriveSettings(gains=FREE_AXIS_GAINS) if settings is None else settings
    describe = _describe(SHIPPED_EDS, common)
    if len(node_ids) > _FEW_NODES:
        describe = describe_row(describe)
    drives = [_make_drive(node_id, _settings_in_row(common, node_id), describe) for node_id in node_ids]
    axes = [
        MachineAxis(own.counts_per_revolution, rated_torque_Nm=own.rated_torque_Nm)
        for _ in drives
        for own in (common, *common.further_axes)
    ]
    plant = FreeAxisPlant([FREE_AXIS] * len(axes), [0.0] * len(axes))
    _attach_meters(drives, plant)
    return EmulatedMachine(drives, plant, axes, start_ns, seed, record_ticks)


def settings_of_axes(settings: DriveSettings, axes: int) -> DriveSettings:
    """A drive of so many logical axes, all of them with ``settings``. Raises ValueError: not 1 to 8."""
    if not 1 <= axes <= MAX_AXES:
        raise ValueError(f"a node has 1 to {MAX_AXES} axes, not {axes}")
    return replace(settings, further_axes=(settings,) * (axes - 1))


def _describe(eds: Path, settings: DriveSettings) -> Callable[[int], ObjectDictionary]:
    axes = len(settings.further_axes) + 1
    return describe_any_node(eds, lambda text: eds_of_axes(text, axes))


def _settings_in_row(common: DriveSettings, node_id: int) -> DriveSettings:
    file = common.parameter_file
    return replace(
        common,
        identity=replace(common.identity, serial_number=node_id),
        parameter_file=None if file is None else file.with_stem(f"{file.stem}-{node_id}"),
    )


def drive_settings(axis: AxisSection, config: GatewayConfig) -> DriveSettings:
    """What the emulated drive of an axis is; an identity that the configuration leaves open is the emulator's own."""
    given, own, gains = axis.identity, DriveIdentity(), axis.emulation.gains
    return DriveSettings(
        identity=DriveIdentity(
            own.vendor_id if given.vendor_id is None else given.vendor_id,
            own.product_code if given.product_code is None else given.product_code,
            own.revision_number if given.revision_number is None else given.revision_number,
            axis.node_id if given.serial_number is None else given.serial_number,
        ),
        counts_per_revolution=axis.counts_per_revolution,
        rated_torque_Nm=axis.rated_torque_Nm,
        gains=(gains.K_P, gains.K_I, gains.K_D, gains.K_V, gains.K_F),
        missing_set_point_limit=config.emulator.missing_sync_limit,
        switches=switches(axis),
        quirks=axis.emulation.quirks,
    )


def _plant(
    parameters: PlantParameters, couplings: tuple[Coupling | None, Coupling | None], theta2: float, theta5: float
) -> Plant:
    if couplings == (None, None):
        return CoupledPlant(parameters, theta2, theta5)
    return CompliantPlant(parameters, couplings, theta2, theta5)


def _coupling(axis: AxisSection) -> Coupling | None:
    section = axis.emulation.coupling
    if section is None:
        return None
    return Coupling(
        stiffness_N_m_per_rad=section.stiffness_Nm_per_rad,
        damping_N_m_s_per_rad=section.damping_Nms_per_rad,
        backlash_rad=radians(section.backlash_deg),
        link_side_inertia_kg_m2=section.link_side_inertia_kgm2,
    )


def _attach_meters(drives: Sequence[Drive], plant: Plant) -> None:
    for place, axis in enumerate(axis for drive in drives for axis in drive.axes):
        attach_energy_meter(axis, partial(plant.axis_energy, place))


def _make_drive(node_id: int, settings: DriveSettings, describe: Callable[[int], ObjectDictionary]) -> Drive:
    return Drive(node_id, describe(node_id), settings, decode_cam_image, make_parameter_store(settings), describe)


def switches(axis: AxisSection) -> Switches:
    """The switches of an axis in shaft counts, rounded to whole ones."""
    section = axis.emulation.switches

    def counts(angle_deg: float) -> int:
        return round(angle_deg / 360.0 * axis.counts_per_revolution)

    low, high, home = section.negative_limit_deg, section.positive_limit_deg, section.home_deg
    return Switches(
        negative_limit=-inf if low is None else counts(low),
        positive_limit=inf if high is None else counts(high),
        home=None if home is None else (counts(home[0]), counts(home[1])),
        index=counts(section.index_deg),
    )


def _driveline(axis: AxisSection) -> AxisDriveline:
    emulation = axis.emulation
    return AxisDriveline(
        torque_limit_Nm=emulation.torque_limit_Nm,
        torque_time_constant_s=emulation.torque_time_constant_s,
        brake_torque_Nm=emulation.brake_torque_Nm,
        friction_smoothing_rad_per_s=(
            emulation.friction_smoothing_rad_per_s if emulation.friction_law is FrictionLaw.SMOOTHED else 0.0
        ),
        breakaway_N_m=emulation.breakaway_Nm,
        motor=MotorParameters(
            torque_constant_Nm_per_A=emulation.motor.torque_constant_Nm_per_A,
            resistance_ohm=emulation.motor.resistance_ohm,
            supply_voltage_V=inf if emulation.motor.supply_voltage_V is None else emulation.motor.supply_voltage_V,
            regeneration=emulation.motor.regeneration,
            idle_W=emulation.motor.idle_W,
        ),
    )


def _machine_axis(axis: AxisSection) -> MachineAxis:
    return MachineAxis(
        counts_per_revolution=axis.counts_per_revolution,
        torque_per_volt=axis.emulation.torque_per_volt_Nm,
        rated_torque_Nm=axis.rated_torque_Nm,
        resolver_noise_counts=axis.emulation.resolver_noise_counts,
        demand_resolution=DemandResolution[axis.emulation.demand_rounding.name],
        output_delay_periods=axis.emulation.output_delay_periods,
        resolver_eccentricity_counts=axis.emulation.resolver_eccentricity_counts,
        resolver_eccentricity_rad=radians(axis.emulation.resolver_eccentricity_deg),
    )
