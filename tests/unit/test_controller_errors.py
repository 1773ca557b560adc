"""The own controller: error frames, the netlink messages, when it is restarted and by whom, and what is told of it."""

import errno
import struct

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.bus_off import LOOK_NS, Restarter, RestartSettings
from drivers.can_link import LinkState, error_of, parse_link, restart_request
from drivers.controller import BusErrorClass, Controller, ControllerChanged, ErrorState
from drivers.errors import BusError
from drivers.frame import Frame
from drivers.python_can_port import PythonCanPort
from gateway.running.controller_watch import TELL_EVERY_NS, ControllerWatch, RestartTold

MS = 1_000_000
OFF, RESTARTED, CONTROLLER = BusErrorClass.BUS_OFF, BusErrorClass.RESTARTED, BusErrorClass.CONTROLLER


def crtl(bits, transmit=0, receive=0):
    return bytes((0, bits, 0, 0, 0, 0, transmit, receive))


@pytest.mark.parametrize(
    ("bits", "state"),
    [
        (0x04, ErrorState.WARNING),  # CAN_ERR_CRTL_RX_WARNING
        (0x08, ErrorState.WARNING),  # CAN_ERR_CRTL_TX_WARNING
        (0x10, ErrorState.PASSIVE),  # CAN_ERR_CRTL_RX_PASSIVE
        (0x20 | 0x08, ErrorState.PASSIVE),
        (0x40, ErrorState.ACTIVE),
        (0x01, ErrorState.ACTIVE),  # an overflow is no state
    ],
)
def test_the_error_state_is_that_of_the_controller_byte(bits, state):
    controller = Controller()
    controller.take(CONTROLLER, crtl(bits, 130, 7))
    assert controller.state is state
    assert (controller.transmit_errors, controller.receive_errors) == (130, 7)
    assert controller.is_restless is (state is not ErrorState.ACTIVE)


def test_bus_off_lasts_until_a_restart_whatever_else_is_reported_late():
    controller = Controller()
    controller.take(OFF | CONTROLLER, crtl(0x20))
    assert controller.is_off
    controller.take(CONTROLLER, crtl(0x20, 255))
    controller.take(CONTROLLER, crtl(0x08, 100))
    assert controller.is_off
    controller.take(RESTARTED, b"")
    assert (controller.state, controller.is_off, controller.transmit_errors) == (ErrorState.ACTIVE, False, 0)
    controller.take(OFF, b"")
    # What some drivers say instead of "restarted".
    controller.take(CONTROLLER, crtl(0x40))
    assert not controller.is_off


@given(st.lists(st.tuples(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8))))
def test_any_error_frames_are_taken_and_counted(frames):
    controller = Controller()
    for identifier, data in frames:
        controller.take(identifier, data)
        assert controller.is_off is (controller.state is ErrorState.OFF)
    assert controller.frame_count == len(frames)
    assert controller.counts[OFF] == sum(1 for identifier, _ in frames if identifier & OFF)


# -- netlink -----------------------------------------------------------------------------------------------------------

RESTART_OF_5 = bytes.fromhex(
    "38000000 1000 0500 01000000 00000000"  # 56 bytes, RTM_NEWLINK, request and acknowledge, sequence 1
    "00 00 0000 05000000 00000000 00000000"  # unspecified family, interface 5
    "1800 1200"  # linkinfo, 24 bytes
    "0800 0100 63616e00"  # kind: can
    "0c00 0200 0800 0700 01000000"  # data: restart 1
)


def test_a_restart_is_the_message_that_the_headers_say():
    assert restart_request(5) == RESTART_OF_5


def attribute(kind, value):
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def link_answer(data, kind=b"can\0"):
    info = attribute(1, kind) + attribute(2 | 0x8000, data)
    body = bytes(16) + attribute(3, b"can0\0") + attribute(18, info)
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 99) + body


def test_state_and_restart_are_read_out_of_the_kernels_answer():
    bus_off = attribute(4, struct.pack("=I", 3)) + attribute(6, struct.pack("=I", 100))
    assert parse_link(link_answer(bus_off)) == LinkState(ErrorState.OFF, 100)
    active = attribute(6, struct.pack("=I", 0)) + attribute(5, bytes(8)) + attribute(4, struct.pack("=I", 0))
    assert parse_link(link_answer(active)) == LinkState(ErrorState.ACTIVE, 0)
    stopped = attribute(4, struct.pack("=I", 4))
    assert parse_link(link_answer(stopped)) == LinkState(None, None)
    assert parse_link(link_answer(bus_off, b"vcan\0")) == LinkState(None, None)


@given(st.binary(max_size=120), st.integers(0, 120))
def test_an_answer_that_is_cut_off_or_nonsense_tells_nothing_and_raises_nothing(noise, cut):
    whole = link_answer(attribute(4, struct.pack("=I", 3)))
    parse_link(whole[:cut] + noise)
    error_of(noise)


def test_the_acknowledgement_carries_the_error():
    refused = struct.pack("=IHHIIi", 36, 2, 0, 1, 99, -errno.EPERM)
    assert (error_of(refused), error_of(struct.pack("=IHHIIi", 36, 2, 0, 1, 99, 0))) == (errno.EPERM, 0)
    assert error_of(link_answer(b"")) == errno.EPROTO


# -- restarts ----------------------------------------------------------------------------------------------------------


class FakeLink:
    def __init__(self, controller, restart_ms=0, refuses=False, revives_at=1):
        self.controller = controller
        self.restart_ms = restart_ms
        self.refuses = refuses
        self.revives_at = revives_at
        self.restarts = 0
        self.state = ErrorState.OFF

    def read(self):
        return LinkState(self.state, self.restart_ms)

    def restart(self):
        self.restarts += 1
        if self.refuses:
            raise BusError("socketcan", "can0", "to restart its controller needs CAP_NET_ADMIN; do this")
        if self.restarts >= self.revives_at:
            self.state = ErrorState.ACTIVE


def outage(restarter, controller, from_ns, until_ns):
    """Looks every millisecond; what was told, and when the controller was back."""
    controller.change(ErrorState.OFF)
    told = []
    for now_ns in range(from_ns, until_ns, MS):
        told += [(now_ns - from_ns, text) for text in restarter.look(now_ns)]
        if not controller.is_off:
            return told, now_ns - from_ns
    return told, None


def test_a_controller_that_nobody_else_restarts_is_restarted_after_the_delay():
    controller = Controller()
    link = FakeLink(controller)
    told, back_ns = outage(Restarter(controller, link, RestartSettings(0.1, 3)), controller, 0, 1000 * MS)
    assert told == [(0, "it is restarted after 100 ms"), (100 * MS, "it has been restarted (1 of at most 3 times)")]
    assert back_ns == 101 * MS
    assert link.restarts == 1


def test_a_controller_that_the_kernel_restarts_is_left_to_it():
    controller = Controller()
    link = FakeLink(controller, restart_ms=200)
    told, back_ns = outage(Restarter(controller, link, RestartSettings(0.1, 3)), controller, 0, 1000 * MS)
    assert told == [(0, "the kernel restarts it after 200 ms")]
    assert (back_ns, link.restarts) == (None, 0)
    link.state = ErrorState.WARNING
    _, back_ns = outage(Restarter(controller, link, RestartSettings(0.1, 3)), controller, 0, 1000 * MS)
    assert back_ns == LOOK_NS, "the link is asked: the driver has sent no error frame"
    assert controller.state is ErrorState.WARNING


def test_restarts_are_counted_over_the_whole_run():
    controller = Controller()
    link = FakeLink(controller, revives_at=2)
    restarter = Restarter(controller, link, RestartSettings(0.1, 3))
    _, back_ns = outage(restarter, controller, 0, 1000 * MS)
    assert (back_ns, link.restarts) == (201 * MS, 2)
    restarter.look(1000 * MS)
    link.state = ErrorState.OFF
    link.revives_at = 99
    told, back_ns = outage(restarter, controller, 2000 * MS, 9000 * MS)
    assert (back_ns, link.restarts) == (None, 3)
    controller.change(ErrorState.ACTIVE)
    restarter.look(9000 * MS)
    told, back_ns = outage(restarter, controller, 10_000 * MS, 12_000 * MS)
    assert told == [(0, "it has been restarted 3 times, and is not restarted any more")]
    assert (back_ns, link.restarts) == (None, 3)


def test_missing_privileges_are_one_sentence_with_the_remedy_and_nothing_is_tried_again():
    controller = Controller()
    link = FakeLink(controller, refuses=True)
    told, back_ns = outage(Restarter(controller, link, RestartSettings(0.1, 3)), controller, 0, 5000 * MS)
    assert [text for _, text in told][1:] == [
        "bus socketcan:can0: to restart its controller needs CAP_NET_ADMIN; do this"
    ]
    assert (back_ns, link.restarts) == (None, 1)


def test_without_a_link_there_is_nothing_but_waiting():
    controller = Controller()
    told, back_ns = outage(Restarter(controller, None, RestartSettings()), controller, 0, 1000 * MS)
    assert (len(told), back_ns) == (1, None)


# -- what is told ------------------------------------------------------------------------------------------------------


class Heard:
    def __init__(self):
        self.changes = []
        self.told = []

    def controller_changed(self, change):
        self.changes.append(change)

    def tell(self, event):
        self.told.append(event)


def test_states_short_of_bus_off_are_told_rarely_and_bus_off_at_once():
    controller, heard = Controller(), Heard()
    watch = ControllerWatch(controller, Restarter(controller, None, RestartSettings()), heard)
    controller.take(CONTROLLER, crtl(0x08, 100))
    for millisecond in range(900):
        # A controller on the verge: warning, passive, warning, with every frame.
        controller.take(CONTROLLER, crtl(0x20 if millisecond % 2 else 0x08, 128))
        if controller.is_restless:
            watch.look(TELL_EVERY_NS + millisecond * MS)
    assert [change.state for change in heard.changes] == [ErrorState.WARNING]
    controller.take(OFF, b"")
    watch.look(TELL_EVERY_NS + 901 * MS)
    assert heard.changes[-1] == ControllerChanged(TELL_EVERY_NS + 901 * MS, ErrorState.OFF, 128, 0)
    assert controller.is_restless, "it is looked after until it is back"
    assert isinstance(heard.told[0], RestartTold)
    controller.take(RESTARTED, b"")
    watch.look(TELL_EVERY_NS + 902 * MS)
    assert [change.state for change in heard.changes[1:]] == [ErrorState.OFF, ErrorState.ACTIVE]
    assert not controller.is_restless


def test_the_last_state_is_told_in_the_end():
    controller, heard = Controller(), Heard()
    watch = ControllerWatch(controller, Restarter(controller, None, RestartSettings()), heard)
    controller.change(ErrorState.WARNING)
    watch.look(0)
    controller.change(ErrorState.PASSIVE)
    watch.look(MS)
    assert controller.is_restless
    watch.look(TELL_EVERY_NS)
    assert [change.state for change in heard.changes] == [ErrorState.WARNING, ErrorState.PASSIVE]
    assert not controller.is_restless


# -- python-can --------------------------------------------------------------------------------------------------------


class FakePcan(can.BusABC):
    """A PCAN adapter: refuses everything while bus-off, tells so in its status word, and can be reset."""

    def __init__(self):
        self.code = 0
        self.sent = []
        self.coming = []

    def status(self):
        return self.code

    def reset(self):
        self.code = 0
        return True

    def recv(self, timeout=None):
        if self.code & 0x10:
            raise can.CanOperationError("Bus error: the CAN controller is in bus-off state.")
        return self.coming.pop(0) if self.coming else None

    def send(self, msg, timeout=None):
        if self.code & 0x10:
            raise can.CanOperationError("Failed to send")
        self.sent.append(msg.arbitration_id)

    def shutdown(self):
        self._is_shutdown = True


def test_a_pcan_adapter_that_is_bus_off_is_no_lost_bus_and_is_reset():
    bus = FakePcan()
    port = PythonCanPort(bus, "pcan", "PCAN_USBBUS1")
    port.outlives_bus_off = True
    assert port.send(Frame(0x201))
    bus.code = 0x10
    assert not port.send(Frame(0x202))
    assert port.controller.is_off
    assert port.receive() is None
    assert not port.wait(0.0)
    told, back_ns = outage(Restarter(port.controller, port.link, RestartSettings(0.1, 1)), port.controller, 0, 300 * MS)
    assert (told[-1][1], back_ns) == ("it has been restarted (1 of at most 1 times)", 101 * MS)
    assert port.send(Frame(0x203))
    assert bus.sent == [0x201, 0x203]
    bus.code = 0x40000
    bus.coming.append(can.Message(is_error_frame=True))
    assert port.receive() is None
    assert port.controller.state is ErrorState.PASSIVE
    port.close()


def test_what_fails_for_another_reason_is_still_a_lost_bus():
    bus = FakePcan()
    port = PythonCanPort(bus, "pcan", "PCAN_USBBUS1")
    bus.recv = lambda timeout=None: (_ for _ in ()).throw(can.CanOperationError("the device has gone"))
    with pytest.raises(BusError, match="the device has gone"):
        port.receive()
    port.close()


def test_socketcand_passes_on_the_kernels_classes_and_other_interfaces_tell_nothing():
    bus = FakePcan()
    for interface, is_off in (("socketcand", True), ("slcan", False)):
        port = PythonCanPort(bus, interface, "can0")
        port.outlives_bus_off = True
        bus.coming.append(can.Message(arbitration_id=int(OFF), is_error_frame=True, is_extended_id=True, data=b"\0"))
        assert port.receive() is None
        assert port.controller.is_off is is_off
        assert port.link is None
    port.close()
