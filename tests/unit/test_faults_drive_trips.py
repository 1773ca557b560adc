"""Drives that trip, reset, lose their power, identity, resolver or bus on command: what is seen on the bus."""

import pytest
from fault_line import Line

from sim_drive.device.drive import Drive
from sim_drive.injection.faults import FAULTS, Direction, Fault, FaultKind
from sim_drive.injection.injector import FaultEnded, FaultStarted

NODE = 5
TRIPS = [
    (FaultKind.OVER_CURRENT, "085#1023030000000000"),
    (FaultKind.OVER_VOLTAGE, "085#1032050000000000"),
    (FaultKind.UNDER_VOLTAGE, "085#2032050000000000"),
    (FaultKind.OVER_TEMPERATURE, "085#1043090000000000"),
    (FaultKind.RESOLVER_LOSS, "085#0573210000000000"),
    (FaultKind.FOLLOWING_ERROR, "085#1186210000000000"),
    (FaultKind.SAFE_TORQUE_OFF, "085#30FF810000000000"),
]


def statusword(line: Line) -> int:
    return line.read(0x6041) & 0x6F


@pytest.mark.parametrize(("kind", "emergency"), TRIPS)
def test_a_trip_sends_its_emcy_and_holds_until_its_cause_ends_and_it_is_reset(kind: FaultKind, emergency: str) -> None:
    line = Line([Fault(kind, NODE, at_s=0.5, for_s=1.0)])
    line.until(0.1)
    line.enable()
    heard = line.until(1.0)
    assert [text for text in heard if text.startswith("085")] == [emergency]
    code, register = int.from_bytes(bytes.fromhex(emergency[4:8]), "little"), int(emergency[8:10], 16)
    assert line.read(0x603F) == code
    assert line.read(0x1001) == register
    assert statusword(line) == 0x08
    assert line.read(0x1003, 1) == code
    line.write(0x6040, 0, 0x80, 2)
    assert statusword(line) == 0x08, "the cause is still there"
    line.write(0x6040, 0, 0x00, 2)
    line.until(1.6)
    assert statusword(line) == 0x08
    line.write(0x6040, 0, 0x80, 2)
    assert "085#0000000000000000" in line.heard()
    assert line.read(0x1001) == 0
    assert statusword(line) == 0x40
    assert line.read(0x603F) == 0


def test_without_an_end_a_trip_can_be_reset_at_once_but_safe_torque_off_cannot() -> None:
    for kind, after in ((FaultKind.OVER_CURRENT, 0x40), (FaultKind.SAFE_TORQUE_OFF, 0x08)):
        line = Line([Fault(kind, NODE, at_s=0.1)])
        line.until(0.2)
        assert statusword(line) == 0x08
        line.write(0x6040, 0, 0x80, 2)
        assert statusword(line) == after


def test_safe_torque_off_takes_the_torque_at_once_and_has_the_code_that_it_is_given() -> None:
    """Over-voltage brakes the axis in its fault reaction; STO does not, whatever 605Eh says."""
    still_powered = []
    for kind in (FaultKind.OVER_VOLTAGE, FaultKind.SAFE_TORQUE_OFF):
        line = Line([Fault(kind, NODE, at_s=0.5, error_code=0x5441)])
        line.until(0.1)
        assert line.write(0x605E, 0, 2, 2) == 0
        assert line.write(0x6085, 0, 1000, 4) == 0
        assert line.write(0x60C2, 1, 200, 1) == 0
        line.enable()
        line.until(0.45)
        assert line.write(0x607A, 0, 400, 4) == 0
        assert [text[:8] for text in line.until(0.51) if text.startswith("085")] == ["085#4154"]
        assert line.read(0x603F) == 0x5441
        assert line.read(0x605E) == 2
        still_powered.append(line.drive().is_powered)
    assert still_powered == [True, False]


def test_a_mute_heartbeat_is_silence_on_700h_alone() -> None:
    line = Line([Fault(FaultKind.MUTE_HEARTBEAT, NODE, at_s=1.0, for_s=1.0)])
    line.until(0.05)
    line.write(0x1017, 0, 100, 2)
    assert [text for text in line.until(0.99) if text == "705#7F"]
    assert [text for text in line.until(1.9) if text.startswith("705")] == []
    assert line.read(0x1017) == 100
    assert [text for text in line.until(2.5) if text == "705#7F"]


def test_a_fault_at_zero_is_there_before_the_drive_boots() -> None:
    assert Line([Fault(FaultKind.MUTE_HEARTBEAT, NODE)]).until(0.1) == []
    assert Line().until(0.1) == ["705#00"]
    line = Line([Fault(FaultKind.WRONG_IDENTITY, NODE, product_code=77)])
    line.until(0.1)
    assert (line.read(0x1018, 1), line.read(0x1018, 2), line.read(0x1018, 4)) == (0x4D2, 77, NODE)


def test_a_wrong_identity_outlives_a_reset_and_goes_at_its_end() -> None:
    line = Line([Fault(FaultKind.WRONG_IDENTITY, NODE, at_s=0.1, for_s=0.9, serial_number=9, vendor_id=1)])
    line.until(0.2)
    assert "705#00" in line.put(0x000, "8105")
    assert (line.read(0x1018, 1), line.read(0x1018, 4)) == (1, 9)
    line.until(1.1)
    assert (line.read(0x1018, 1), line.read(0x1018, 4)) == (0x4D2, NODE)


def test_a_node_reset_boots_and_loses_its_parameters() -> None:
    line = Line([Fault(FaultKind.NODE_RESET, NODE, at_s=0.5)])
    line.until(0.1)
    line.write(0x1017, 0, 1000, 2)
    line.enable()
    assert line.until(0.6) == ["705#00"]
    assert line.read(0x1017) == 0
    assert statusword(line) == 0x40
    assert not line.drive().is_powered


def test_a_power_cycle_is_deaf_mute_and_forgetful_and_boots_at_its_end() -> None:
    line = Line([Fault(FaultKind.POWER_CYCLE, NODE, at_s=1.0, for_s=2.0)])
    line.until(0.1)
    line.write(0x1017, 0, 20, 2)
    line.enable()
    assert "705#05" in line.until(0.999)
    assert line.drive().is_powered
    assert line.until(1.5) == []
    assert not line.drive().is_powered
    assert line.machine.next_wake_ns() is not None
    assert line.put(0x605, "4000100000000000") == []
    assert line.put(0x000, "8100") == []
    assert line.until(2.99) == []
    assert line.until(3.1) == ["705#00"]
    assert line.read(0x1017) == 0
    assert statusword(line) == 0x40


def test_what_was_stored_outlives_a_power_cycle_and_nothing_else_does() -> None:
    line = Line([Fault(FaultKind.POWER_CYCLE, NODE, at_s=1.0, for_s=0.5)])
    line.until(0.1)
    assert line.write(0x6065, 0, 1234, 4) == 0
    assert line.write(0x1010, 1, 0x65766173, 4) == 0
    assert line.write(0x6066, 0, 77, 2) == 0
    usual = Line().machine.drives[0]
    assert isinstance(usual, Drive)
    line.until(1.6)
    assert line.read(0x6065) == 1234
    assert line.read(0x6066).to_bytes(2, "little") == usual.dictionary.read(0x6066, 0, 0)


def test_a_drive_without_power_is_deaf_to_lss_too() -> None:
    """LSS switch state global to configuration, then inquire node id: answered with supply, and only then."""
    for faults, answers in (([], ["7E4#5E05000000000000"]), ([Fault(FaultKind.POWER_CYCLE, NODE, at_s=0.5)], [])):
        line = Line(faults)
        line.until(0.6)
        line.put(0x7E5, "0401000000000000")
        assert line.put(0x7E5, "5E00000000000000") == answers


def test_power_lost_twice_at_once_comes_back_with_the_later_end() -> None:
    line = Line(
        [
            Fault(FaultKind.POWER_CYCLE, NODE, at_s=1.0, for_s=1.0),
            Fault(FaultKind.POWER_CYCLE, NODE, at_s=1.5, for_s=1.0),
        ]
    )
    line.until(1.0)
    assert line.until(2.4) == []
    assert line.until(2.6) == ["705#00"]


def test_safe_torque_off_during_a_power_cut_is_found_at_power_on() -> None:
    line = Line(
        [Fault(FaultKind.POWER_CYCLE, NODE, at_s=0.5, for_s=0.5), Fault(FaultKind.SAFE_TORQUE_OFF, NODE, at_s=0.7)]
    )
    line.until(1.1)
    assert statusword(line) == 0x08
    assert line.read(0x603F) == 0xFF30


def test_bus_off_is_silence_faults_an_enabled_axis_and_tells_of_itself_afterwards() -> None:
    line = Line([Fault(FaultKind.BUS_OFF, NODE, at_s=1.0, for_s=0.5)])
    line.until(0.1)
    line.write(0x1017, 0, 20, 2)
    line.enable()
    line.until(0.999)
    assert line.until(1.4) == []
    assert line.put(0x605, "4000100000000000") == []
    heard = line.until(1.6)
    # 8140h joins the 8100h of the axis; when it goes, the other is still there, so no 0000h is sent.
    assert heard[0] == "085#4081110000000000"
    assert "705#05" in heard[1:]
    assert statusword(line) == 0x08
    assert line.read(0x603F) == 0x8140
    assert (line.read(0x1003, 1), line.read(0x1003, 2)) == (0x8140, 0x8100)


def test_bus_off_of_an_axis_at_rest_ends_without_a_fault() -> None:
    line = Line([Fault(FaultKind.BUS_OFF, NODE, at_s=1.0, for_s=0.5)])
    line.until(1.4)
    assert line.until(1.6) == ["085#4081110000000000", "085#0000000000000000"]
    assert statusword(line) == 0x40


def test_error_passive_is_a_warning() -> None:
    line = Line([Fault(FaultKind.ERROR_PASSIVE, NODE, at_s=0.5, for_s=0.5)])
    line.until(0.1)
    line.enable()
    assert line.until(0.6) == ["085#2081110000000000"]
    assert statusword(line) == 0x27
    assert line.until(1.1) == ["085#0000000000000000"]
    assert statusword(line) == 0x27


def test_a_frozen_resolver_shows_no_motion_and_a_jumping_one_a_jump() -> None:
    line = Line(
        [
            Fault(FaultKind.JUMPING_RESOLVER, NODE, at_s=0.5, for_s=0.2, counts=37),
            Fault(FaultKind.JUMPING_RESOLVER, NODE, at_s=0.6, for_s=0.2, counts=-7),
        ]
    )
    line.until(0.4)
    assert line.read(0x6064) == 0
    assert [(line.until(at_s), line.read(0x6064))[1] for at_s in (0.55, 0.65, 0.75, 0.85)] == [37, 30, 2**32 - 7, 0]

    line = Line([Fault(FaultKind.FROZEN_RESOLVER, NODE, at_s=0.5, for_s=0.5)])
    line.until(0.1)
    assert line.write(0x6065, 0, 0xFFFFFFFF, 4) == 0
    line.enable()
    line.until(0.55)
    before = line.read(0x6064)
    line.write(0x607A, 0, before + 40, 4)
    line.until(0.6)
    assert line.read(0x6064) == before
    assert line.machine.plant.angle(0) != pytest.approx(0.0, abs=1e-3), "the axis runs off, and nobody sees it"
    line.until(1.01)
    assert line.read(0x6064) != before


def test_a_broken_brake_lets_the_axis_turn() -> None:
    """A brake fails to hold while the drive is disabled, and the axis turns on where it was turning."""
    angles = []
    for kinds in ([], [FaultKind.BROKEN_BRAKE]):
        line = Line(
            [
                *(Fault(kind, NODE, at_s=0.4) for kind in kinds),
                Fault(FaultKind.OVER_CURRENT, NODE, at_s=0.51),
            ]
        )
        line.until(0.1)
        line.enable()
        line.until(0.5)
        line.write(0x607A, 0, 400, 4)
        line.until(0.52)
        before = line.machine.plant.angle(0)
        line.until(0.7)
        angles.append(abs(line.machine.plant.angle(0) - before))
    assert angles[1] > 2 * angles[0] + 1e-3


def test_sdo_abort_refuses_one_object_and_no_other() -> None:
    line = Line(
        [
            Fault(FaultKind.SDO_ABORT, NODE, at_s=0.5, for_s=0.5, index=0x1018, subindex=2, abort_code=0x06060000),
            Fault(FaultKind.SDO_ABORT, NODE, at_s=0.5, index=0x6098),
        ]
    )
    line.until(0.6)
    assert line.sdo("4018100200000000") == ["8018100200000606"]
    assert line.read(0x1018, 1) == 0x4D2
    assert line.write(0x6098, 0, 37, 1) == 0x08000000
    line.until(1.1)
    assert line.read(0x1018, 2) == 0x1024
    assert line.write(0x6098, 0, 37, 1) == 0x08000000


def test_slow_sdo_delays_every_response() -> None:
    line = Line([Fault(FaultKind.SLOW_SDO, NODE, at_s=0.5, delay_s=0.3)])
    line.until(0.6)
    assert line.put(0x605, "4000100000000000", 0.299) == []
    assert line.run(0.01) == ["585#4300100092010200"]


def test_events_tell_when_faults_begin_and_end() -> None:
    faults = [Fault(FaultKind.OVER_CURRENT, NODE, at_s=0.2), Fault(FaultKind.MUTE_HEARTBEAT, NODE, at_s=0.1, for_s=0.3)]
    line = Line(faults)
    line.until(0.15)
    assert line.injector.active == (faults[1],)
    line.until(1.0)
    told = [event for event in line.injector.take_events() if isinstance(event, FaultStarted | FaultEnded)]
    assert told == [
        FaultStarted(100_000_000, faults[1]),
        FaultStarted(200_000_000, faults[0]),
        FaultEnded(200_000_000, faults[0]),
        FaultEnded(400_000_000, faults[1]),
    ]
    assert line.injector.active == ()


def test_a_fault_can_be_injected_at_any_time() -> None:
    line = Line()
    line.until(0.5)
    line.injector.inject(Fault(FaultKind.OVER_CURRENT, NODE, at_s=0.25), line.now_ns)
    assert line.until(0.7) == []
    assert line.until(0.8) == ["085#1023030000000000"]
    line.injector.inject(Fault(FaultKind.NODE_RESET, NODE), line.now_ns)
    assert line.run(0.01) == ["705#00"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"kind": FaultKind.OVER_CURRENT, "node_id": 0}, "over_current: node id 0 is not 1 to 127"),
        ({"kind": FaultKind.OVER_CURRENT, "node_id": 5, "at_s": -1.0}, "over_current: at_s -1.0 is not 0 to 1e+06"),
        ({"kind": FaultKind.OVER_CURRENT, "node_id": 5, "for_s": float("nan")}, "for_s nan is not 0 to 1e+06"),
        ({"kind": FaultKind.OVER_CURRENT, "node_id": 5, "for_s": 0.0}, "for_s must not be 0"),
        ({"kind": FaultKind.JUMPING_RESOLVER, "node_id": 5}, "jumping_resolver: needs counts"),
        ({"kind": FaultKind.FROZEN_RESOLVER, "node_id": 5, "counts": 4}, "has no parameter counts, it takes axis"),
        ({"kind": FaultKind.MUTE_HEARTBEAT, "node_id": 5, "axis": 1}, "has no parameter axis, it takes none"),
        ({"kind": FaultKind.OVER_CURRENT, "node_id": 5, "axis": 9}, "over_current: axis 9 is not 1 to 8"),
        ({"kind": FaultKind.OVER_CURRENT, "node_id": 5, "counts": 4}, "no parameter counts, it takes error_code"),
        ({"kind": FaultKind.NODE_RESET, "node_id": 5, "for_s": 1.0}, "node_reset: happens at an instant"),
        ({"kind": FaultKind.WRONG_IDENTITY, "node_id": 5}, "needs one of vendor_id, product_code, revision_number"),
        ({"kind": FaultKind.SDO_ABORT, "node_id": 5, "index": 0x1000, "abort_code": 5}, "00000005h is no abort code"),
        ({"kind": FaultKind.LOST_FRAMES, "node_id": 5, "probability": 1.5}, "probability 1.5 is not 0 to 1"),
        ({"kind": FaultKind.LOST_FRAMES, "node_id": 5, "cob_id": 0x800}, "cob_id 2048 is not 0 to 2047"),
    ],
)
def test_a_wrong_fault_is_refused_with_a_sentence(arguments: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Fault(**arguments)
    assert sentence in str(caught.value)


def test_a_fault_of_a_node_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match=r"bus_off: the machine has no node 9 \(there are: 5, 7\)"):
        Line([Fault(FaultKind.BUS_OFF, 9)], (7, 5))
    line = Line()
    with pytest.raises(ValueError, match="no node 9"):
        line.injector.inject(Fault(FaultKind.BUS_OFF, 9), 0)


def test_every_kind_is_described() -> None:
    assert set(FAULTS) == set(FaultKind)
    assert {direction.value for direction in Direction} == {"sent", "received", "both"}


def test_a_fault_follows_its_drive_to_another_node_id():
    fault = Fault(FaultKind.MUTE_HEARTBEAT, 5, at_s=0.5, for_s=0.5)
    line = Line([fault])
    line.until(0.1)
    assert line.write(0x1017, 0, 100, 2) == 0
    for request in ("0401000000000000", "1109000000000000", "0400000000000000"):
        line.put(0x7E5, request)
    line.put(0x000, "8205")
    line.put(0x609, "2B17100064000000")
    assert "709#7F" in line.until(0.45)
    assert not any(text.startswith("709#") for text in line.until(0.95)[1:])
    assert "709#7F" in line.until(1.3)
    # What is injected from now on is for the node that there is.
    with pytest.raises(ValueError, match=r"no node 5 \(there are: 9\)"):
        line.injector.inject(fault, line.now_ns)
    line.injector.inject(Fault(FaultKind.OVER_CURRENT, 9), line.now_ns)
    assert "089#1023030000000000" in line.run(0.01)
