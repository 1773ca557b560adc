"""The whole chain against machines with the plant's options on, in virtual time."""

import pytest

from config.emulation_section import GainsSection
from config.gain_sets import GainSet, with_gain_set
from config.loading import load_config, parse_config
from config.schema import GatewayConfig
from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import StopReason
from gateway.running.assembly import build_core
from gateway.running.core import GatewayCore
from gateway.running.preparation import prepare
from sim_drive.assembly import build_machine
from sim_drive.machine import EmulatedMachine

pytestmark = pytest.mark.slow

PAPER = load_config("paper")
SECOND = 1_000_000_000
BRAKE = "      brake_torque_Nm: 6.0\n"
MODEST = (GainsSection(K_P=2500, K_V=20_000, K_F=20_000), GainsSection(K_P=2500, K_V=15_000, K_F=15_000))
"""Gains that a motor bears whose link is not rigidly on it: its own inertia is a seventieth of the crank's."""


class Sink:
    """Takes samples and forgets them."""

    def append(self, *values: float) -> None: ...


def with_options(cv: str, servo: str) -> GatewayConfig:
    first, second, rest = PAPER.text.split(BRAKE)
    return parse_config(f"{first}{cv}{BRAKE}{second}{servo}{BRAKE}{rest}", PAPER.path)


def run(config: GatewayConfig) -> tuple[GatewayCore, EmulatedMachine]:
    prepared = prepare(config, 1)
    machine = build_machine(config, seed=3, record_ticks=8192)
    core = build_core(config, prepared.cam.profile, prepared.plan, Sink())
    bus = VirtualBus([core, machine], config.bus.bit_rate)
    bus.run_while(lambda: not core.is_done, 20 * SECOND)
    assert core.failure is None
    return core, machine


def modest(config: GatewayConfig) -> GatewayConfig:
    return with_gain_set(config, GainSet(title="modest", master=MODEST[0], slave=MODEST[1]))


def counts(machine: EmulatedMachine) -> list[tuple[int, ...]]:
    return [record.counts for record in machine.records]


def extremes(machine: EmulatedMachine) -> list[int]:
    return [
        max(abs(round(record.demands_counts[axis]) - record.counts[axis]) for record in machine.records)
        for axis in (0, 1)
    ]


@pytest.fixture(scope="module")
def plain() -> EmulatedMachine:
    return run(modest(PAPER))[1]


@pytest.mark.parametrize(
    ("cv", "servo", "most"),
    [
        ("friction_law: smoothed", "friction_law: smoothed", 5),
        (
            "coupling: {stiffness_Nm_per_rad: 600, damping_Nms_per_rad: 0.05}",
            "coupling: {stiffness_Nm_per_rad: 500, damping_Nms_per_rad: 0.05, backlash_deg: 0.1}",
            5,
        ),
        ("resolver_eccentricity_counts: 12", "resolver_noise_counts: 1", 20),
        ("breakaway_Nm: 0.2", "breakaway_Nm: 0.15", 5),
    ],
    ids=["smoothed friction", "flexible with play", "eccentric and noisy resolvers", "breakaway"],
)
def test_the_chain_runs_its_cycle(plain: EmulatedMachine, cv: str, servo: str, most: int) -> None:
    core, machine = run(modest(with_options(f"      {cv}\n", f"      {servo}\n")))
    assert core.stopped_by is StopReason.COMPLETED
    found, without = extremes(machine), extremes(plain)
    print(f"{cv}; {servo}: greatest errors {found} counts, {without} without")
    assert all(abs(here - there) <= most for here, there in zip(found, without, strict=True))
    assert counts(machine) != counts(plain)
