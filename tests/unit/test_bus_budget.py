"""The bus budget by hand, its refusals, and SDO held to its share."""

import contextlib
import json
import socket
import threading

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from config.bus_budget import bus_budget, deadline_without_wire_us, representable_cycle_us
from config.loading import ConfigError, load_config, parse_config
from drivers.frame import Frame
from drivers.socketcand_word import says_no_wire
from gateway.cli.cam_commands import check
from gateway.cyclic.sdo_pacing import SdoPacing
from gateway.errors import GatewayError
from gateway.running.assembly import build_core
from gateway.running.bus_address import BusAddress
from gateway.running.bus_budget import budget_json, has_wire, require_budget, tpdo_deadline_us
from gateway.running.preparation import prepare
from sim_drive.socketcand_session import SessionState, SocketcandSession

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
    places = {("virtual", "x"): False, ("socketcan", "vcan0"): False, ("socketcan", "can0"): True}
    places |= {("socketcan", "gone"): True, ("pcan", "PCAN_USBBUS1"): True}
    for (interface, channel), expected in places.items():
        assert has_wire(BusAddress(interface, channel, "", 0), net) is expected, (interface, channel)
    with pytest.raises(GatewayError, match=r"bus\.is_virtual: pcan X is a real bus, .* 600 us is taken to 145%"):
        require_budget(config, BusAddress("pcan", "X", "", 0), True)
    with pytest.raises(GatewayError, match=r"socketcand 127\.0\.0\.1:1 may stand before a real bus, on which"):
        require_budget(config, BusAddress("socketcand", "vcan0", "127.0.0.1", 1), True)
    require_budget(config, BusAddress("socketcand", "vcan0", "127.0.0.1", 1), False)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_a_socketcand_server_on_this_machine_is_taken_at_its_word_and_no_other(host):
    def server(name):
        return BusAddress("socketcand", "vcan0", name, 29536)

    assert not has_wire(server(host), says_no_wire=lambda *_: True)
    assert has_wire(server(host), says_no_wire=lambda *_: False)
    for far in ("192.0.2.7", "can-server.example", "0.0.0.0"):
        assert has_wire(server(far), says_no_wire=lambda *_: pytest.fail("nobody need be asked")), far


@pytest.mark.parametrize("is_virtual", [False, True])
def test_the_deadline_is_the_buses_whatever_the_configuration_takes_it_for(is_virtual):
    config = with_bus(is_virtual=is_virtual)
    assert tpdo_deadline_us(config, True) == pytest.approx(545.0)
    assert tpdo_deadline_us(config, False) == pytest.approx(750.0)


@contextlib.contextmanager
def answering(*answers):
    """A server that greets, hears one thing and gives the last of ``answers``; its port and what it has heard."""
    heard = []

    def serve(listener):
        connection, _ = listener.accept()
        with connection:
            connection.sendall(answers[0])
            if len(answers) > 1:
                heard.append(connection.recv(256))
                connection.sendall(answers[1])

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        yield listener.getsockname()[1], heard
        thread.join()


@pytest.mark.parametrize(
    ("answers", "expected"),
    [
        ((b"< hi >", b"< wire none >"), True),
        ((b"< hi >", b"< error unknown command >"), False),
        ((b"< hi >", b"< wire 500000 >"), False),
        ((b"< hi >", b""), False),
        ((b"",), False),
    ],
)
def test_a_server_that_does_not_say_that_it_has_no_wire_has_one(answers, expected):
    with answering(*answers) as (port, heard):
        assert says_no_wire("127.0.0.1", port) is expected
        assert heard in ([], [b"< wire >"])


def test_nobody_there_and_nobody_who_answers_have_a_wire():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        assert not says_no_wire("127.0.0.1", port, timeout_s=0.01)
    assert not says_no_wire("127.0.0.1", port)


def test_the_emulators_server_gives_its_word():
    session = SocketcandSession("vcan0")
    session.take_output()
    assert session.receive_data(b"< wire >") == []
    assert session.take_output() == b"< wire none >"
    assert session.state is SessionState.NO_BUS, "the greeting goes on as if nothing had been asked"
    session.receive_data(b"< open vcan0 >< wire >< rawmode >")
    assert session.take_output() == b"< ok >< wire none >< ok >"


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
