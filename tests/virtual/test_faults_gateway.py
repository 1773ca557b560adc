"""The gateway against an emulated machine whose drives fail on command: why it stops, and that it ends safely."""

import pytest

from config.loading import load_config, parse_config
from config.quirks import Quirk
from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from gateway.cyclic.guard import StopReason
from gateway.running.assembly import build_core
from gateway.running.preparation import prepare
from sim_drive.assembly import build_machine
from sim_drive.injection.faults import Direction, Fault, FaultKind
from sim_drive.injection.injector import Injector

PAPER = load_config("paper")
PREPARED = prepare(PAPER, 1)
SECOND = 1_000_000_000
CV, SERVO = 1, 2
MOVING_S = 2.0
"""The machine is on its cam then."""


class NoSink:
    """Throws the samples away."""

    def append(self, *values: float) -> None:
        pass


class Run:
    """A whole session of the gateway, and half a second after it."""

    def __init__(self, *faults: Fault, quirks: frozenset[Quirk] = frozenset(), seed: int = 0) -> None:
        named = ", ".join(quirk.value for quirk in quirks)
        text = PAPER.text.replace("    emulation:\n", f"    emulation:\n      quirks: [{named}]\n")
        self.machine = build_machine(parse_config(text, PAPER.path))
        assert all(drive.settings.quirks == quirks for drive in self.machine.drives)
        self.core = build_core(PAPER, PREPARED.cam.profile, PREPARED.plan, NoSink())
        self.frames: list[tuple[int, Frame]] = []
        self.bus = VirtualBus(
            [self.core, Injector(self.machine, faults, seed)],
            PAPER.bus.bit_rate,
            trace=lambda at_ns, frame: self.frames.append((at_ns, frame)),
            on_event=_ignore,
        )
        self.bus.run_while(lambda: not self.core.is_done, 30 * SECOND)
        self.end_s = self.bus.now_ns / SECOND
        self.bus.run_until(self.bus.now_ns + SECOND // 2)

    @property
    def reason(self) -> StopReason | None:
        return self.core.stopped_by

    def assert_ends_disabled(self) -> None:
        assert self.core.is_done
        assert not any(drive.is_powered for drive in self.machine.drives)


def _ignore(_node: int, _event: Event) -> None:
    pass


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault(FaultKind.OVER_CURRENT, SERVO, MOVING_S), StopReason.EMERGENCY),
        (Fault(FaultKind.OVER_VOLTAGE, CV, MOVING_S), StopReason.EMERGENCY),
        (Fault(FaultKind.SAFE_TORQUE_OFF, CV, MOVING_S), StopReason.EMERGENCY),
        (Fault(FaultKind.JUMPING_RESOLVER, SERVO, MOVING_S, counts=500), StopReason.FOLLOWING_ERROR),
        (Fault(FaultKind.MUTE_HEARTBEAT, SERVO, MOVING_S), StopReason.HEARTBEAT_LOST),
        (Fault(FaultKind.NODE_RESET, SERVO, MOVING_S), StopReason.HEARTBEAT_LOST),
        (Fault(FaultKind.POWER_CYCLE, SERVO, MOVING_S, 1.0), StopReason.AXIS_SILENT),
        (Fault(FaultKind.BUS_OFF, SERVO, MOVING_S, 0.5), StopReason.AXIS_SILENT),
        (
            Fault(FaultKind.LOST_FRAMES, SERVO, MOVING_S, cob_id=0x180 + SERVO, direction=Direction.SENT),
            StopReason.AXIS_SILENT,
        ),
        (Fault(FaultKind.WRONG_IDENTITY, SERVO, product_code=7), StopReason.COMMISSIONING),
        (Fault(FaultKind.SDO_ABORT, SERVO, index=0x6060), StopReason.COMMISSIONING),
        (Fault(FaultKind.SLOW_SDO, SERVO, delay_s=3.0), StopReason.COMMISSIONING),
    ],
)
def test_a_fault_stops_the_machine_for_its_reason_and_in_one_piece(fault: Fault, reason: StopReason) -> None:
    run = Run(fault)
    assert run.reason is reason
    run.assert_ends_disabled()
    assert run.machine.plant.torn_at_s is None
    assert run.end_s < 5.0


@pytest.mark.parametrize(
    "fault",
    [
        Fault(FaultKind.JUMPING_RESOLVER, SERVO, MOVING_S, counts=20),
        Fault(FaultKind.LOST_FRAMES, SERVO, MOVING_S, cob_id=0x180 + SERVO, probability=0.02),
        Fault(FaultKind.LATE_FRAMES, SERVO, MOVING_S, cob_id=0x180 + SERVO, delay_s=0.0003),
        Fault(FaultKind.REORDERED_FRAMES, SERVO, MOVING_S, probability=0.01),
        Fault(FaultKind.SLOW_SDO, SERVO, delay_s=0.1),
        Fault(FaultKind.BROKEN_BRAKE, SERVO, MOVING_S),
        Fault(FaultKind.ERROR_PASSIVE, SERVO, MOVING_S, 0.5),
    ],
)
def test_what_is_bearable_is_borne(fault: Fault) -> None:
    run = Run(fault)
    assert run.reason is StopReason.COMPLETED
    run.assert_ends_disabled()
    assert run.machine.plant.torn_at_s is None


def test_a_wrong_identity_is_told_with_what_was_found() -> None:
    run = Run(Fault(FaultKind.WRONG_IDENTITY, SERVO, product_code=7))
    assert "node 2 has product code 00000007h" in str(run.core.failure)


@pytest.mark.parametrize("node", [CV, SERVO])
def test_a_frozen_resolver_is_noticed_before_it_tears_the_linkage(node: int) -> None:
    run = Run(Fault(FaultKind.FROZEN_RESOLVER, node, MOVING_S))
    assert run.reason is StopReason.FROZEN_ACTUAL
    run.assert_ends_disabled()
    assert run.machine.plant.torn_at_s is None


def test_the_same_faults_and_seed_give_the_same_frames_at_the_same_nanoseconds() -> None:
    faults = (
        Fault(FaultKind.LOST_FRAMES, SERVO, 1.5, 0.5, probability=0.05),
        Fault(FaultKind.LATE_FRAMES, CV, 1.8, 0.5, probability=0.1, delay_s=0.0004),
        Fault(FaultKind.OVER_CURRENT, SERVO, 2.4),
    )
    first, second, other = (Run(*faults, seed=seed) for seed in (1, 1, 2))
    assert first.frames == second.frames
    assert first.frames != other.frames


@pytest.mark.slow
@pytest.mark.parametrize(
    "quirk",
    [
        Quirk.RPDO_ACTS_ON_RECEIPT,
        Quirk.RTR_BIT_MUST_BE_KEPT,
        Quirk.REMAP_REFUSED_IN_OPERATIONAL,
        Quirk.OTHER_REMAP_ABORT_CODE,
        Quirk.NO_BLOCK_TRANSFER,
        Quirk.NO_HOMING_METHOD_0,
        Quirk.SET_POINT_ACKNOWLEDGE_STAYS,
        Quirk.SLOW_MODE_SWITCH,
        Quirk.INTERPOLATION_TIME_IN_MILLISECONDS,
        Quirk.CYCLE_PERIOD_NEEDED,
        Quirk.NO_ABORT_OPTION,
    ],
)
def test_the_gateway_lives_with_the_quirk(quirk: Quirk) -> None:
    run = Run(quirks=frozenset({quirk}))
    assert run.reason is StopReason.COMPLETED
    assert run.core.failure is None
    run.assert_ends_disabled()


@pytest.mark.parametrize(
    ("quirk", "sentence"),
    [
        (Quirk.SYNCHRONOUS_TPDO_REFUSED, "node 2: SDO 1800h:02 aborted with 06090030h"),
        (Quirk.NO_CYCLIC_POSITION_MODE, "node 2: SDO 6060h:00 aborted with 06090030h"),
        (Quirk.ABORT_OPTION_STAYS, "node 2 holds 0 in 6007h:00 (abort connection option code), although 1 was written"),
        (Quirk.TORQUE_OFFSET_NOT_MAPPABLE, "node 2: SDO 1600h:03 aborted with 06040041h"),
    ],
)
def test_the_gateway_refuses_the_quirk_in_a_sentence(quirk: Quirk, sentence: str) -> None:
    run = Run(quirks=frozenset({quirk}))
    assert run.reason is StopReason.COMMISSIONING
    assert sentence in str(run.core.failure)
    run.assert_ends_disabled()


@pytest.mark.parametrize("quirk", [Quirk.NO_BOOT_UP, Quirk.SHORT_BOOT_UP])
def test_without_a_proper_boot_up_message_the_gateway_ends_in_order(quirk: Quirk) -> None:
    """It need not put up with it, but what it does is one thing or the other."""
    run = Run(quirks=frozenset({quirk}))
    run.assert_ends_disabled()
    refused = "boot-up message" in str(run.core.failure)
    assert (run.reason is StopReason.COMPLETED) != refused
