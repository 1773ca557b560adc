"""The bus budget by hand, its refusals, and SDO held to its share."""

import json

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from config.bus_budget import bus_budget, deadline_without_wire_us, representable_cycle_us
from config.loading import ConfigError, load_config, parse_config
from drivers.frame import Frame
from gateway.cli.cam_commands import check
from gateway.cyclic.sdo_pacing import SdoPacing
from gateway.errors import GatewayError
from gateway.running.assembly import build_core
from gateway.running.bus_address import BusAddress
from gateway.running.bus_budget import budget_json, has_wire, require_budget
from gateway.running.preparation import prepare

CONFIG = load_config("paper")


def with_bus(**bus):
    document = yaml.safe_load(CONFIG.text)
    document["bus"] |= bus
    return parse_config(yaml.safe_dump(document), CONFIG.path)


def test_two_axes_at_one_kilohertz_by_hand():
    """SYNC 55 bits; PDOs and SDO of 8 bytes 135; a heartbeat 47 + 8 + 10 = 65, of three nodes every 50 cycles."""
    budget = CONFIG.budget
    assert [(row.what, round(row.wire_us, 6)) for row in budget.rows] == [
        ("SYNC", 55.0),
        ("RPDOs", 270.0),
        ("TPDOs", 270.0),
        ("heartbeats", 3.9),
        ("SDO reserve", 270.0),
    ]
    assert budget.wire_us == pytest.approx(868.9)
    # 865 us of what does not depend on the cycle in 0.9 of it, less the heartbeats' 3.9 us a ms: 965.3 us.
    assert budget.shortest_cycle_us == 970
    # 5 % for the host, two RPDOs, and a frame that has just begun.
    assert budget.tpdo_deadline_us == pytest.approx(950 - 3 * 135)
    assert bus_budget(2, 4000, 1_000_000, 50, 2).tpdo_deadline_us == pytest.approx(0.8 * 4000)


@pytest.mark.parametrize(
    ("cycle_us", "representable"),
    [(1, 1), (255, 255), (256, 260), (595, 600), (966, 970), (2551, 2600), (100_000, 100_000)],
)
def test_cycles_that_60c2h_can_say(cycle_us, representable):
    assert representable_cycle_us(cycle_us) == representable


@given(
    st.integers(1, 8), st.sampled_from([125_000, 250_000, 500_000, 1_000_000]), st.integers(1, 8), st.integers(20, 500)
)
def test_the_cycle_that_would_fit_fits_and_no_shorter_one_does(axes, bit_rate, sdo_frames, heartbeat_ms):
    shortest = bus_budget(axes, 1000, bit_rate, heartbeat_ms, sdo_frames).shortest_cycle_us
    assert bus_budget(axes, shortest, bit_rate, heartbeat_ms, sdo_frames).is_within_bound
    # What 60C2h can say: 1 to 255 times a power of ten.
    sayable = {value * 10**exponent for value in range(1, 256) for exponent in range(6)}
    assert shortest in sayable
    if shorter := max((cycle for cycle in sayable if cycle < shortest), default=0):
        assert not bus_budget(axes, shorter, bit_rate, heartbeat_ms, sdo_frames).is_within_bound


def test_a_cycle_of_600_us_is_too_full_for_a_real_bus():
    with pytest.raises(ConfigError) as refused:
        with_bus(cycle_us=600)
    (problem,) = refused.value.problems
    assert "bus.cycle_us: 600 us is too short for 2 axes at 1000000 bit/s" in problem
    assert "would take 145% of it (bound 90%), 970 us would fit" in problem


def test_a_cycle_of_600_us_is_allowed_where_frames_take_no_time_and_refused_on_a_real_bus(tmp_path):
    config = with_bus(cycle_us=600, is_virtual=True)
    assert config.tpdo_deadline_us == 350.0
    assert [deadline_without_wire_us(us) for us in (200, 500, 1000, 4000)] == [100.0, 250.0, 750.0, 3200.0]
    assert not budget_json(config)["is_within_bound"]
    (tmp_path / "devices" / "virtual" / "net" / "vcan0").mkdir(parents=True)
    (tmp_path / "devices" / "pci0" / "net" / "can0").mkdir(parents=True)
    net = tmp_path / "net"
    net.mkdir()
    (net / "vcan0").symlink_to(tmp_path / "devices" / "virtual" / "net" / "vcan0")
    (net / "can0").symlink_to(tmp_path / "devices" / "pci0" / "net" / "can0")
    places = {("socketcand", "vcan0"): False, ("virtual", "x"): False, ("socketcan", "vcan0"): False}
    places |= {("socketcan", "can0"): True, ("socketcan", "gone"): True, ("pcan", "PCAN_USBBUS1"): True}
    for (interface, channel), expected in places.items():
        assert has_wire(BusAddress(interface, channel, "", 0), net) is expected, (interface, channel)
    require_budget(config, BusAddress("socketcand", "vcan0", "127.0.0.1", 1))
    with pytest.raises(GatewayError, match=r"bus\.is_virtual: pcan X is a real bus, .* 600 us is taken to 145%"):
        require_budget(config, BusAddress("pcan", "X", "", 0))


def test_check_prints_the_budget_as_a_table_and_as_json(capsys):
    check("paper")
    text = capsys.readouterr().out
    assert "868.9" in text
    assert "86.9%" in text
    assert "shortest cycle that fits is 970 us" in text
    check("paper", as_json=True)
    bus = json.loads(capsys.readouterr().out)["bus"]
    assert (bus["load"], bus["bound"], bus["shortest_cycle_us"], bus["tpdo_deadline_us"]) == (0.8689, 0.9, 970, 545.0)


def requests(count, first=0):
    return [Frame(0x601, bytes((number,) * 8)) for number in range(first, first + count)]


def test_sdo_is_let_through_a_request_a_cycle_in_order():
    pacing = SdoPacing(2)
    heartbeat = Frame(0x77F, b"\x05")
    assert pacing.release([*requests(3), heartbeat], 7) == [heartbeat, requests(3)[0]]
    assert pacing.waiting
    assert pacing.release([], 7) == []
    assert pacing.release(requests(1, 3), 8) == [requests(3)[1]]
    assert pacing.release([], 9) == [requests(3)[2]]
    assert pacing.release([], 10) == requests(1, 3)
    assert not pacing.waiting
    assert pacing.release(requests(2), None) == requests(2), "no cycle, no limit"


@pytest.mark.parametrize(("frames_a_cycle", "sent"), [(1, 5), (2, 10), (3, 10), (8, 40)])
def test_the_reserve_says_how_many(frames_a_cycle, sent):
    pacing = SdoPacing(frames_a_cycle)
    released = pacing.release(requests(100), 0)
    for cycle in range(1, 10):
        released += pacing.release([], cycle)
    assert released == requests(100)[:sent]
    assert released + pacing.release([], None) == requests(100)


def test_the_core_holds_its_requests_back_while_the_cycle_runs():
    prepared = prepare(CONFIG, 1)
    core = build_core(CONFIG, prepared.cam.profile, prepared.plan, None)
    core.master.outbox = requests(3)
    assert core.take_frames() == requests(3)
    core.loop.start(0)
    core.master.outbox = requests(3)
    assert core.take_frames() == requests(1)
    core.loop.cycle += 1
    assert core.take_frames() == requests(1, 1)
