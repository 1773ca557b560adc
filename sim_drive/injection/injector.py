"""Makes the faults of `faults` happen: a core around the emulated machine, which any host can drive."""

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from random import Random
from typing import Final

from drivers import objects
from drivers.frame import Frame
from drivers.nmt import HEARTBEAT_BASE, NMT_COB_ID, NmtCommand
from drivers.node import Event
from drivers.sdo import SDO_RESPONSE_BASE, AbortCode
from sim_drive.communication.emcy import ErrorRegister
from sim_drive.device.drive import Drive
from sim_drive.injection.faults import FRAME_FAULTS, MAX_COB_ID, TRIPS, Direction, Fault, FaultKind
from sim_drive.machine import EmulatedMachine

BUS_OFF_RECOVERED: Final = 0x8140
"""EMCY of a drive that is back on the bus (CiA 301, table 26)."""
ERROR_PASSIVE: Final = 0x8120
"""EMCY of a CAN controller in error passive mode (CiA 301, table 26)."""
REORDER_PATIENCE_NS: Final = 1_000_000_000
"""A frame that waits to change places with the next one goes on after this time, if none comes."""

_NS_PER_S: Final = 1_000_000_000
_NEVER: Final = 1 << 63
_DISABLE: Final = 0
"""Of 605Eh: switch the amplifier off."""
_COMMUNICATION: Final = int(ErrorRegister.COMMUNICATION)


@dataclass(frozen=True, slots=True)
class FaultStarted(Event):
    """A fault begins."""

    fault: Fault


@dataclass(frozen=True, slots=True)
class FaultEnded(Event):
    """A fault is over."""

    fault: Fault


class _FrameFault:
    """A fault of frames at work."""

    __slots__ = ("_cob_id", "_direction", "_mask", "_probability", "_remaining", "fault", "held")

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self._mask = (MAX_COB_ID if fault.cob_id_mask is None else fault.cob_id_mask) if fault.cob_id is not None else 0
        self._cob_id = (fault.cob_id or 0) & self._mask
        self._direction = fault.direction or Direction.BOTH
        self._probability = 1.0 if fault.probability is None else fault.probability
        self._remaining = fault.count
        self.held: dict[Direction, tuple[int, Frame]] = {}
        """With reordered frames: the number and the frame that waits for its next one."""

    def selects(self, frame: Frame, direction: Direction) -> bool:
        """Whether the frame is of the selection."""
        return self._direction in {direction, Direction.BOTH} and frame.cob_id & self._mask == self._cob_id

    def strikes(self, source: Random) -> bool:
        """Whether chance and count have it that this frame of the selection is concerned."""
        if self._remaining == 0 or (self._probability < 1.0 and source.random() >= self._probability):
            return False
        if self._remaining is not None:
            self._remaining -= 1
        return True


class _AxisTap:
    """Between one axis and its motor; a `sim_drive.machine.AxisTap`."""

    __slots__ = ("_frozen", "_last", "added_counts", "is_brake_broken")

    def __init__(self) -> None:
        self._last = 0
        self._frozen: int | None = None
        self.added_counts = 0
        self.is_brake_broken = False

    def freeze(self, is_frozen: bool) -> None:
        """Let the resolver show, from now on, what it showed last."""
        self._frozen = (self._last if self._frozen is None else self._frozen) if is_frozen else None

    def show(self, counts: int) -> int:
        if self._frozen is not None:
            return self._frozen
        self._last = counts + self.added_counts
        return self._last


class _Tap:
    """Between one drive and its surroundings; a `sim_drive.machine.DriveTap`."""

    __slots__ = (
        "_injector",
        "axes",
        "drive",
        "frame_faults",
        "is_cut_off",
        "is_mute",
        "own_refusals",
        "place",
        "sdo_delay_ns",
    )

    def __init__(self, injector: "Injector", place: int, drive: Drive) -> None:
        self._injector = injector
        self.place = place
        self.drive = drive
        self.axes = tuple(_AxisTap() for _ in drive.axes)
        self.is_cut_off = False
        self.is_mute = False
        self.own_refusals = dict(drive.dictionary.refusals)
        """What the drive lacks in good health."""
        self.sdo_delay_ns = 0
        self.frame_faults: list[_FrameFault] = []

    def hear(self, frame: Frame, now_ns: int) -> Sequence[Frame]:
        if self.is_cut_off or self.drive.is_switched_off:
            return ()
        return self._pass(frame, Direction.RECEIVED, now_ns)

    def tell(self, frame: Frame, now_ns: int) -> Sequence[Frame]:
        if self.is_cut_off or (self.is_mute and frame.cob_id == HEARTBEAT_BASE + self.drive.node_id):
            return ()
        if self.sdo_delay_ns and frame.cob_id == SDO_RESPONSE_BASE + self.drive.node_id:
            self._injector.hold(self.place, frame, Direction.SENT, now_ns + self.sdo_delay_ns)
            return ()
        return self._pass(frame, Direction.SENT, now_ns)

    def _pass(self, frame: Frame, direction: Direction, now_ns: int) -> Sequence[Frame]:
        frames = [frame]
        for fault in self.frame_faults:
            if fault.selects(frame, direction):
                frames = self._strike(fault, frames, direction, now_ns)
        return frames

    def _strike(self, active: _FrameFault, frames: list[Frame], direction: Direction, now_ns: int) -> list[Frame]:
        injector = self._injector
        fault = active.fault
        after: list[Frame] = []
        for frame in frames:
            waiting = active.held.pop(direction, None)
            if waiting is not None:
                number, earlier = waiting
                after.append(frame)
                if injector.release(number):
                    after.append(earlier)
            elif not active.strikes(injector.source):
                after.append(frame)
            elif fault.kind is FaultKind.DOUBLED_FRAMES:
                after += (frame, frame)
            elif fault.kind is FaultKind.LATE_FRAMES:
                injector.hold(self.place, frame, direction, now_ns + _span_ns(fault.delay_s))
            elif fault.kind is FaultKind.REORDERED_FRAMES:
                number = injector.hold(self.place, frame, direction, now_ns + REORDER_PATIENCE_NS)
                active.held[direction] = number, frame
        return after


@dataclass(frozen=True, slots=True)
class _Turn:
    """A fault begins or ends."""

    fault: Fault
    tap: _Tap
    is_start: bool


@dataclass(frozen=True, slots=True)
class _HeldFrame:
    place: int
    frame: Frame
    direction: Direction


class Injector:
    """The machine with its faults: a `drivers.node.Node` in place of the machine's own.

    Faults come and go at their own exact instants, in simulation time, which begins with the first call of ``receive``
    or ``wake``. At one instant faults and held-back frames come first, in the order in which they were put there, then
    what falls to the machine: a fault at 0 s is there before the drives boot. Frames are lost, late, doubled or
    reordered where the single drive meets the bus, so that other drives are not concerned. Several faults may be at
    work at once: what two of the same kind do lasts until both are over; of two that cannot be had together
    (identities, delays of SDO) the later one counts. A fault's node is the drive that has its node id when the fault is
    given, and stays that drive if LSS makes another node of it.
    """

    def __init__(self, machine: EmulatedMachine, faults: Iterable[Fault] = (), seed: int = 0) -> None:
        """Take over ``machine``; all chance comes from ``seed``.

        Raises ValueError where a fault is for a node that the machine does not have, or one of its drives is no Drive.
        """
        self.machine: Final = machine
        self.source: Final = Random(seed)  # noqa: S311 - reproducible on purpose
        self._taps: Final[list[_Tap]] = []
        for place, drive in enumerate(machine.drives):
            if not isinstance(drive, Drive):
                raise ValueError(f"drive {place} of the machine is no Drive, it cannot be made to fail")
            self._taps.append(_Tap(self, place, drive))
        for place, tap in enumerate(self._taps):
            machine.put_tap(place, tap)
        self._agenda: list[tuple[int, int, _Turn | _HeldFrame]] = []
        self._number = count()
        self._held: set[int] = set()
        self._active: list[tuple[_Tap, Fault]] = []
        self._events: list[Event] = []
        self._start_ns: int | None = None
        self._waiting = [(self._find(fault), fault) for fault in faults]

    @property
    def active(self) -> tuple[Fault, ...]:
        """Faults that have begun and not ended, oldest first; trips that are over at once are not among them."""
        return tuple(fault for _, fault in self._active)

    def inject(self, fault: Fault, now_ns: int) -> None:
        """Let ``fault`` begin ``fault.at_s`` after ``now_ns``, the host's present.

        On a virtual bus it is done between two runs. Raises ValueError for a node that the machine does not have.
        """
        tap = self._find(fault)
        self._begin(now_ns)
        self._plan(tap, fault, now_ns)
        self._work_off(now_ns)

    # -- the seam ------------------------------------------------------------------------------------------------

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Hand a frame of the bus to the machine."""
        self._begin(now_ns)
        self._work_off(now_ns - 1)
        self.machine.receive(frame, now_ns)

    def next_wake_ns(self) -> int | None:
        """The machine's next wake, or the next fault."""
        due_ns = self.machine.next_wake_ns()
        if not self._agenda:
            return due_ns
        own_ns = self._agenda[0][0]
        return own_ns if due_ns is None or own_ns < due_ns else due_ns

    def wake(self, now_ns: int) -> None:
        """Do what is due, faults and machine, in the order of their instants."""
        self._begin(now_ns)
        self._work_off(now_ns)
        self.machine.wake(now_ns)

    def take_frames(self) -> list[Frame]:
        """What the machine sends."""
        return self.machine.take_frames()

    def take_events(self) -> list[Event]:
        """Events of the machine, and the faults that began and ended."""
        events = self.machine.take_events()
        if self._events:
            events = sorted([*events, *self._events], key=lambda event: event.at_ns)
            self._events = []
        return events

    # -- time ----------------------------------------------------------------------------------------------------

    def hold(self, place: int, frame: Frame, direction: Direction, until_ns: int) -> int:
        """Let a frame pass at ``until_ns``; gives a number for ``release``."""
        number = self._put(until_ns, _HeldFrame(place, frame, direction))
        self._held.add(number)
        return number

    def release(self, number: int) -> bool:
        """Take a held frame back; False if it has passed already."""
        is_held = number in self._held
        self._held.discard(number)
        return is_held

    def _begin(self, now_ns: int) -> None:
        if self._start_ns is None:
            self._start_ns = now_ns
            for tap, fault in self._waiting:
                self._plan(tap, fault, now_ns)
            self._waiting.clear()

    def _plan(self, tap: _Tap, fault: Fault, from_ns: int) -> None:
        at_ns = from_ns + round(fault.at_s * _NS_PER_S)
        self._put(at_ns, _Turn(fault, tap, True))
        if fault.for_s is not None:
            self._put(at_ns + max(1, round(fault.for_s * _NS_PER_S)), _Turn(fault, tap, False))

    def _put(self, at_ns: int, item: _Turn | _HeldFrame) -> int:
        number = next(self._number)
        heapq.heappush(self._agenda, (at_ns, number, item))
        return number

    def _work_off(self, now_ns: int) -> None:
        while self._agenda and self._agenda[0][0] <= now_ns:
            at_ns, number, item = heapq.heappop(self._agenda)
            if at_ns != self._start_ns:
                self.machine.wake(at_ns - 1)
            if isinstance(item, _Turn):
                self._turn(item, at_ns)
            elif self.release(number):
                self._let_pass(item, at_ns)

    def _let_pass(self, held: _HeldFrame, now_ns: int) -> None:
        tap = self._taps[held.place]
        if not tap.is_cut_off and not tap.drive.is_switched_off:
            move = self.machine.transmit if held.direction is Direction.SENT else self.machine.deliver
            move(held.place, held.frame, now_ns)

    # -- faults --------------------------------------------------------------------------------------------------

    def _find(self, fault: Fault) -> _Tap:
        """Where the fault is to be made. Raises ValueError if there is no such node or axis."""
        taps = {tap.drive.node_id: tap for tap in self._taps}
        tap = taps.get(fault.node_id)
        if tap is None:
            known = ", ".join(str(node_id) for node_id in sorted(taps))
            raise ValueError(f"{fault.kind.value}: the machine has no node {fault.node_id} (there are: {known})")
        if fault.axis is not None and fault.axis > len(tap.axes):
            axes = "1 axis" if len(tap.axes) == 1 else f"{len(tap.axes)} axes"
            raise ValueError(f"{fault.kind.value}: axis {fault.axis}: node {fault.node_id} has {axes}")
        return tap

    def _turn(self, turn: _Turn, now_ns: int) -> None:
        fault = turn.fault
        tap = turn.tap
        if turn.is_start:
            self._active.append((tap, fault))
            self._events.append(FaultStarted(now_ns, fault))
            self._start(fault, tap, now_ns)
            if self._is_momentary(fault):
                self._active.remove((tap, fault))
                self._events.append(FaultEnded(now_ns, fault))
        else:
            self._active.remove((tap, fault))
            self._events.append(FaultEnded(now_ns, fault))
            self._end(fault, tap, now_ns)
        self._set_tap(fault.kind, tap)
        self.machine.refresh(now_ns)

    def _is_momentary(self, fault: Fault) -> bool:
        if fault.for_s is not None:
            return False
        trip = TRIPS.get(fault.kind)
        return fault.kind is FaultKind.NODE_RESET or (trip is not None and not trip.lasts)

    def _start(self, fault: Fault, tap: _Tap, now_ns: int) -> None:
        drive = tap.drive
        if fault.kind in TRIPS:
            self._trip(fault, drive, now_ns)
        elif fault.kind in FRAME_FAULTS:
            tap.frame_faults.append(_FrameFault(fault))
        elif fault.kind is FaultKind.NODE_RESET:
            drive.receive(Frame(NMT_COB_ID, bytes((NmtCommand.RESET_NODE, drive.node_id))), now_ns)
        elif fault.kind is FaultKind.POWER_CYCLE:
            drive.switch_off(now_ns)
        elif fault.kind is FaultKind.BUS_OFF:
            # The tap closes first, so that the EMCY of it stays where it cannot go.
            tap.is_cut_off = True
            drive.lose_connection(now_ns)
            self.machine.refresh(now_ns)
        elif fault.kind is FaultKind.ERROR_PASSIVE:
            drive.warn(ERROR_PASSIVE, _COMMUNICATION, now_ns)

    def _trip(self, fault: Fault, drive: Drive, now_ns: int) -> None:
        trip = TRIPS[fault.kind]
        for axis in drive.axes:
            if not _concerns(fault, axis.number):
                continue
            reaction = axis.entry(objects.FAULT_REACTION_OPTION_CODE)
            wanted = reaction.value
            if trip.is_torque_off:
                reaction.value = _DISABLE
            axis.trip(_code_of(fault), trip.error_register, now_ns, persists=not self._is_momentary(fault))
            reaction.value = wanted

    def _end(self, fault: Fault, tap: _Tap, now_ns: int) -> None:
        drive = tap.drive
        goes_on = any(other.kind is fault.kind for other in self._of(tap))
        if fault.kind in TRIPS:
            self._end_trip(fault, tap, now_ns)
        elif fault.kind in FRAME_FAULTS:
            self._end_frame_fault(fault, tap, now_ns)
        elif goes_on:
            return
        elif fault.kind is FaultKind.POWER_CYCLE:
            drive.switch_on(now_ns)
        elif fault.kind is FaultKind.BUS_OFF:
            tap.is_cut_off = False
            drive.warn(BUS_OFF_RECOVERED, _COMMUNICATION, now_ns)
            drive.end_warning(BUS_OFF_RECOVERED, now_ns)
        elif fault.kind is FaultKind.ERROR_PASSIVE:
            drive.end_warning(ERROR_PASSIVE, now_ns)

    def _end_trip(self, fault: Fault, tap: _Tap, now_ns: int) -> None:
        """The cause is gone for every axis that no other fault trips with the same code."""
        code = _code_of(fault)
        same = [other for other in self._of(tap) if other.kind in TRIPS and _code_of(other) == code]
        for axis in tap.drive.axes:
            if _concerns(fault, axis.number) and not any(_concerns(other, axis.number) for other in same):
                tap.drive.end_trip(code, now_ns, axis=axis.number)

    def _end_frame_fault(self, fault: Fault, tap: _Tap, now_ns: int) -> None:
        active = next(active for active in tap.frame_faults if active.fault == fault)
        tap.frame_faults.remove(active)
        for direction, (number, frame) in active.held.items():
            if self.release(number):
                self._let_pass(_HeldFrame(tap.place, frame, direction), now_ns)

    def _of(self, tap: _Tap) -> list[Fault]:
        return [fault for concerned, fault in self._active if concerned is tap]

    def _set_tap(self, kind: FaultKind, tap: _Tap) -> None:
        """Bring the tap in line with the faults of this kind that are at work."""
        faults = [fault for fault in self._of(tap) if fault.kind is kind]
        for number, axis_tap in enumerate(tap.axes, start=1):
            own = [fault for fault in faults if _concerns(fault, number)]
            if kind is FaultKind.FROZEN_RESOLVER:
                axis_tap.freeze(bool(own))
            elif kind is FaultKind.JUMPING_RESOLVER:
                axis_tap.added_counts = sum(fault.counts or 0 for fault in own)
            elif kind is FaultKind.BROKEN_BRAKE:
                axis_tap.is_brake_broken = bool(own)
        if kind is FaultKind.MUTE_HEARTBEAT:
            tap.is_mute = bool(faults)
        elif kind is FaultKind.SLOW_SDO:
            tap.sdo_delay_ns = _span_ns(faults[-1].delay_s) if faults else 0
        elif kind is FaultKind.SDO_ABORT:
            injected = {
                (fault.index or 0, fault.subindex): AbortCode(fault.abort_code or AbortCode.GENERAL_ERROR)
                for fault in faults
            }
            tap.drive.dictionary.refusals = tap.own_refusals | injected
        elif kind is FaultKind.WRONG_IDENTITY:
            self._set_identity(faults, tap.drive)

    def _set_identity(self, faults: Sequence[Fault], drive: Drive) -> None:
        identity = drive.settings.identity
        own = (identity.vendor_id, identity.product_code, identity.revision_number, identity.serial_number)
        for fault in faults:
            given = (fault.vendor_id, fault.product_code, fault.revision_number, fault.serial_number)
            own = tuple(mine if other is None else other for mine, other in zip(own, given, strict=True))
        for subindex, value in enumerate(own, start=1):
            entry = drive.dictionary.entry(objects.IDENTITY, subindex)
            entry.default = value
            entry.value = value


def _concerns(fault: Fault, axis: int) -> bool:
    return fault.axis in (None, axis)


def _code_of(fault: Fault) -> int:
    return TRIPS[fault.kind].error_code if fault.error_code is None else fault.error_code


def _span_ns(span_s: float | None) -> int:
    return round((span_s or 0.0) * _NS_PER_S)
