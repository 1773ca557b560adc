"""A bus in virtual time with emulated drives on it: frames as text (``605#4000100000000000``), spans in ms.

The bench knows no service of CANopen but the two lines of an SDO transfer that fits into one frame; what is sent, and
what has to come back, stands in the tests.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace
from math import tau

from drivers.eds import describe_any_node
from drivers.frame import Frame
from drivers.object_dictionary import ObjectDictionary
from mechanism.cam_image import decode_cam_image
from sim_drive.assembly import FREE_AXIS, FREE_AXIS_GAINS, SHIPPED_EDS
from sim_drive.device.drive import Drive
from sim_drive.logical_axes import eds_of_axes
from sim_drive.machine import EmulatedMachine
from sim_drive.machine_axis import MachineAxis
from sim_drive.physics.free_axis import FreeAxisPlant
from sim_drive.settings import DriveSettings

MS = 1_000_000


@functools.cache
def described(node_id: int, axes: int = 1) -> ObjectDictionary:
    return describe_any_node(SHIPPED_EDS, lambda text: eds_of_axes(text, axes))(node_id)


def build(node_ids: Sequence[int], settings: DriveSettings | None, noise_counts: float) -> EmulatedMachine:
    """As ``free_machine`` does, with the EDS read once, and resolvers that may be noisy; serial number = node id."""
    common = DriveSettings(gains=FREE_AXIS_GAINS) if settings is None else settings
    axes = len(common.further_axes) + 1
    drives = [
        Drive(
            node_id,
            described(node_id, axes),
            replace(common, identity=replace(common.identity, serial_number=node_id)),
            decode_cam_image,
            describe=functools.partial(described, axes=axes),
        )
        for node_id in node_ids
    ]
    axis = MachineAxis(rated_torque_Nm=common.rated_torque_Nm, resolver_noise_counts=noise_counts)
    count = axes * len(drives)
    plant = FreeAxisPlant([FREE_AXIS] * count, [0.0] * count)
    return EmulatedMachine(drives, plant, [axis] * count)


def text_of(frame: Frame) -> str:
    return f"{frame.cob_id:03X}#{'R' if frame.is_remote else bytes(frame.data).hex().upper()}"


class Bus:
    """Node 5 by default, on an axis of its own; ``trace`` has every frame of both directions with its instant."""

    def __init__(
        self,
        node_ids: Sequence[int] = (5,),
        settings: DriveSettings | None = None,
        noise_counts: float = 0.0,
        is_booted: bool = True,
    ) -> None:
        self.machine = build(node_ids, settings, noise_counts)
        self.node_id = node_ids[0]
        self.now_ns = 0
        self.trace: list[tuple[int, str]] = []
        if is_booted:
            self.run(5)

    # -- time and frames -----------------------------------------------------------------------------------------

    def _collect(self) -> list[str]:
        texts = [text_of(frame) for frame in self.machine.take_frames()]
        self.trace += [(self.now_ns, text) for text in texts]
        self.machine.take_events()
        return texts

    def run_timed(self, span_ms: float) -> list[tuple[float, str]]:
        """Let time pass; gives what was sent, with the milliseconds since the call."""
        start_ns = self.now_ns
        end_ns = start_ns + round(span_ms * MS)
        sent: list[tuple[float, str]] = []
        while (due_ns := self.machine.next_wake_ns()) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.machine.wake(self.now_ns)
            sent += [((self.now_ns - start_ns) / MS, text) for text in self._collect()]
        self.now_ns = end_ns
        return sent

    def run(self, span_ms: float) -> list[str]:
        """Let time pass; gives what was sent."""
        return [text for _, text in self.run_timed(span_ms)]

    def send(self, text: str) -> list[str]:
        """Put a frame on the bus; gives what was sent at the same instant."""
        cob_id, data = text.split("#")
        is_remote = data == "R"
        self.trace.append((self.now_ns, text.upper()))
        frame = Frame(int(cob_id, 16), b"" if is_remote else bytes.fromhex(data), is_remote)
        self.machine.receive(frame, self.now_ns)
        return self._collect()

    # -- SDO -----------------------------------------------------------------------------------------------------

    def sdo(self, request: str) -> str:
        """Send an SDO request; gives the response, "" if there was none."""
        own = f"{0x580 + self.node_id:03X}#"
        answers = [text for text in self.send(f"{0x600 + self.node_id:03X}#{request}") if text.startswith(own)]
        assert len(answers) <= 1, answers
        return answers[0].removeprefix(own) if answers else ""

    def done(self, *requests: str) -> None:
        """Send expedited downloads, each of which has to succeed."""
        for request in requests:
            assert self.sdo(request) == "60" + request[2:8].upper() + "00000000", request

    def abort(self, request: str) -> int:
        """Send a request that has to be aborted with its own multiplexer; gives the code."""
        answer = self.sdo(request)
        assert answer[:8] == "80" + request[2:8].upper(), f"{request}: {answer}"
        return int.from_bytes(bytes.fromhex(answer[8:]), "little")

    def abort_of_transfer(self, request: str, place: str) -> int:
        """The same for a request without a multiplexer, within the transfer of ``place``."""
        answer = self.sdo(request)
        assert answer[:8] == "80" + place, f"{request}: {answer}"
        return int.from_bytes(bytes.fromhex(answer[8:]), "little")

    def value(self, place: str, *, signed: bool = False) -> int:
        """Upload an integer; ``place`` as on the wire: ``"416000"`` is 6041h:00."""
        answer = bytes.fromhex(self.sdo("40" + place + "00000000"))
        assert answer[0] & 0xE3 == 0x43, answer.hex()
        assert answer[1:4] == bytes.fromhex(place)
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=signed)

    # -- what the axis is in ---------------------------------------------------------------------------------------

    @property
    def statusword(self) -> int:
        return self.value("416000")

    @property
    def drive(self):
        return self.machine.drives[0]

    @property
    def shaft_counts(self) -> float:
        """Where the axis really is: the angle of the plant."""
        return self.machine.plant.angle(0) * 4096 / tau

    def trip(self, code: int = 0x2310, register: int = 0x02, persists: bool = False) -> list[str]:
        """Over-current by default; gives the frames of that instant."""
        self.machine.drives[0].trip(code, register, self.now_ns, persists=persists)
        self.machine.refresh(self.now_ns)
        return self._collect()

    def enable(self, mode: str = "08") -> None:
        """To Operation enabled in a mode, by SDO."""
        self.done("2F606000" + mode + "000000")
        self.run(3)
        self.done("2B40600006000000", "2B40600007000000", "2B4060000F000000")
        assert self.statusword & 0x6F == 0x27
