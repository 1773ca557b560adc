"""The EMCY of every trip as the package ``canopen`` understands it."""

import pytest
from canopen.emcy import EmcyConsumer, EmcyError

from drivers.frame import Frame
from drivers.node import Event
from drivers.virtual_time import VirtualBus
from sim_drive.assembly import free_machine
from sim_drive.injection.faults import TRIPS, Fault, FaultKind
from sim_drive.injection.injector import Injector

NODE = 5
SECOND = 1_000_000_000


class Listener:
    """Hands the EMCY frames of node 5 to the consumer of ``canopen``."""

    def __init__(self, consumer: EmcyConsumer) -> None:
        self.consumer = consumer

    def receive(self, frame: Frame, now_ns: int) -> None:
        if frame.cob_id == 0x080 + NODE:
            self.consumer.on_emcy(frame.cob_id, frame.data, now_ns * 1e-9)

    def next_wake_ns(self) -> int | None:
        return None

    def wake(self, now_ns: int) -> None:
        raise AssertionError("nobody asked for it")

    def take_frames(self) -> list[Frame]:
        return []

    def take_events(self) -> list[Event]:
        return []


def heard(fault: Fault) -> list[EmcyError]:
    consumer = EmcyConsumer()
    bus = VirtualBus([Listener(consumer), Injector(free_machine([NODE]), [fault])], 1_000_000)
    bus.run_until(SECOND)
    return consumer.log


@pytest.mark.parametrize(
    ("kind", "description"),
    [
        (FaultKind.OVER_CURRENT, "Current"),
        (FaultKind.OVER_VOLTAGE, "Voltage"),
        (FaultKind.UNDER_VOLTAGE, "Voltage"),
        (FaultKind.OVER_TEMPERATURE, "Temperature"),
        (FaultKind.RESOLVER_LOSS, ""),  # it knows 70xxh of the additional modules alone
        (FaultKind.FOLLOWING_ERROR, "Monitoring"),
        (FaultKind.SAFE_TORQUE_OFF, "Device Specific"),
        (FaultKind.ERROR_PASSIVE, "Monitoring"),
    ],
)
def test_the_class_of_the_code_is_that_of_the_fault(kind: FaultKind, description: str) -> None:
    (error,) = heard(Fault(kind, NODE, at_s=0.5))
    assert error.timestamp == pytest.approx(0.5, abs=1e-3)
    assert error.data == bytes(5)
    if kind in TRIPS:
        assert (error.code, error.register & ~1) == (TRIPS[kind].error_code, TRIPS[kind].error_register)
    assert error.get_desc() == description
