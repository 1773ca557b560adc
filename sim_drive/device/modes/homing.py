"""Homing mode (CiA 402-2, clause 11): on limit switches, a home switch, index pulses, or the current position."""

from enum import IntEnum, unique
from typing import Final, NamedTuple

from drivers import objects
from drivers.sdo import AbortCode
from sim_drive.device.cia402 import Controlword, Statusword
from sim_drive.device.modes.base import OperationMode
from sim_drive.device.motion import Motion
from sim_drive.device.profiles import to_velocity
from sim_drive.switches import DigitalInput


class HomingMethod(NamedTuple):
    """How home is found: the edge of a switch, then perhaps an index pulse.

    ``search``: direction in which the switch is looked for where it is off. ``final``: direction in which its edge, and
    the index pulse after it, are crossed. ``leaves``: whether the switch goes off at that edge, rather than on.
    """

    switch: DigitalInput | None
    search: int
    final: int
    leaves: bool
    has_index: bool


_HOME: Final = DigitalInput.HOME
_EDGES: Final = (
    (DigitalInput.NEGATIVE_LIMIT, -1, 1, True),  # 1
    (DigitalInput.POSITIVE_LIMIT, 1, -1, True),
    (_HOME, 1, -1, True),  # 3 and 4: the switch is on towards the positive end
    (_HOME, 1, 1, False),
    (_HOME, -1, 1, True),  # 5 and 6: towards the negative end
    (_HOME, -1, -1, False),
    (_HOME, 1, -1, True),  # 7: below the lower edge, 8 within it, 9 within the upper edge, 10 above it
    (_HOME, 1, 1, False),
    (_HOME, 1, -1, False),
    (_HOME, 1, 1, True),
    (_HOME, -1, 1, True),  # 11 to 14: the mirror image
    (_HOME, -1, -1, False),
    (_HOME, -1, 1, False),
    (_HOME, -1, -1, True),
)
_WITHOUT_INDEX: Final = 16
"""Methods 17 to 30 are 1 to 14 without the index pulse."""
NO_HOMING: Final = 0
"""Method 0: the drive's zero stays where it is, and homing is attained at once."""
CURRENT_POSITION: Final = frozenset({35, 37})

HOMING_METHODS: Final[dict[int, HomingMethod | None]] = {
    **{number: HomingMethod(*edge, True) for number, edge in enumerate(_EDGES, start=1)},
    **{number: HomingMethod(*edge, False) for number, edge in enumerate(_EDGES, start=1 + _WITHOUT_INDEX)},
    33: HomingMethod(None, -1, -1, False, True),
    34: HomingMethod(None, 1, 1, False, True),
    NO_HOMING: None,
    **dict.fromkeys(CURRENT_POSITION),
}
"""Every value that 6098h takes; None for methods without motion."""


@unique
class HomingStatus(IntEnum):
    """Progress of homing."""

    IDLE = 0
    """Not started, or interrupted."""
    IN_PROGRESS = 1
    ATTAINED = 2
    FAILED = 3


@unique
class _Phase(IntEnum):
    SEARCH = 0
    """Towards the switch, fast."""
    CLEAR = 1
    """Out of the switch, fast, to come back into it slowly."""
    EDGE = 2
    INDEX = 3
    STOP = 4
    """Home is known, and the axis comes to rest."""


_REACHED: Final = int(Statusword.TARGET_REACHED)
_ATTAINED: Final = int(Statusword.HOMING_ATTAINED)
_ERROR: Final = int(Statusword.HOMING_ERROR)
_START: Final = int(Controlword.HOMING_START)


class Homing(OperationMode):
    """Starts on the rising edge of controlword bit 4, and is interrupted by its falling.

    With the methods on the current position the position actual value becomes the home offset 607Ch where the axis
    stands.

    An edge is crossed with the lower of the speeds 6099h, coming from the side that the method names; home is where a
    capture input would latch it. The position actual value becomes the home offset 607Ch there, at once, and the axis
    comes to rest where its deceleration takes it. A limit switch on the way to the home switch turns the search around
    once; any other limit switch in the way, or a switch that is not fitted, is a homing error (bit 13). Software
    position limits do not count while homing. Directions are the shaft's, whatever the polarity 607Eh.
    """

    __slots__ = (
        "_acceleration",
        "_before",
        "_direction",
        "_has_seen",
        "_has_turned",
        "_home",
        "_home_offset",
        "_is_resting",
        "_is_started",
        "_method",
        "_method_entry",
        "_number",
        "_phase",
        "_speed",
        "_speeds",
        "_switches",
        "status",
    )

    is_ticking = True
    owns_bit_13 = True

    def __init__(self, motion: Motion) -> None:
        super().__init__(motion)
        self._method_entry = motion.entry(objects.HOMING_METHOD)
        self._method_entry.on_write = _check_method
        self._home_offset = motion.entry(objects.HOME_OFFSET)
        self._speeds = (motion.entry(objects.HOMING_SPEEDS, 1), motion.entry(objects.HOMING_SPEEDS, 2))
        self._acceleration = motion.entry(objects.HOMING_ACCELERATION)
        self._switches = motion.settings.switches
        self.status = HomingStatus.IDLE
        self._is_started = False
        self._is_resting = True
        self._method = HomingMethod(None, 1, 1, False, False)
        self._number = NO_HOMING
        self._phase = _Phase.STOP
        self._direction = 1
        self._speed = 0.0
        self._has_turned = False
        self._has_seen = False
        """The switch has been on while the axis moved the way the phase wants; before that, off means nothing yet."""
        self._before = 0
        """Shaft counts of the tick before."""
        self._home = 0
        """The index pulse that is looked for, in shaft counts."""

    @property
    def status_bits(self) -> int:
        """Bit 10 target reached (or at rest), 12 homing attained, 13 homing error."""
        if self.status is HomingStatus.IN_PROGRESS:
            return 0
        bits = _REACHED if self._is_resting else 0
        if self.status is HomingStatus.ATTAINED:
            return bits | _ATTAINED
        return bits | _ERROR if self.status is HomingStatus.FAILED else bits

    def reset(self) -> None:
        """Forget that the axis was homed."""
        self.status = HomingStatus.IDLE
        self._is_resting = True

    def enter(self, now_ns: int) -> None:
        """Come to rest, and wait for a rising edge of bit 4."""
        self.is_active = True
        self._is_started = bool(self.motion.controlword.value & _START)
        self.motion.slow_down(now_ns)

    def leave(self, now_ns: int) -> None:
        """Interrupt what is in progress."""
        self.is_active = False
        self._is_resting = True
        if self.status is HomingStatus.IN_PROGRESS:
            self.status = HomingStatus.IDLE

    def on_controlword(self, value: int, now_ns: int) -> None:
        """Take bit 4."""
        start = bool(value & _START)
        if start is self._is_started:
            return
        self._is_started = start
        if start:
            self._start(now_ns)
        elif self.status is HomingStatus.IN_PROGRESS:
            self._end(HomingStatus.IDLE, now_ns)
        self.motion.show_status()

    def resume(self, now_ns: int) -> None:
        """Go on with the search."""
        if self.status is HomingStatus.IN_PROGRESS and self._phase is not _Phase.STOP:
            self._go(self._direction, self._speed, now_ns)

    def _start(self, now_ns: int) -> None:
        self.status = HomingStatus.IN_PROGRESS
        self._number = int(self._method_entry.value)
        method = HOMING_METHODS[self._number]
        self._phase = _Phase.STOP
        if method is None:
            return
        self._method = method
        self._has_turned = False
        self._before = self.motion.shaft_counts
        switch = method.switch
        if switch is None:
            self._seek_index(self._before + method.final, now_ns)
        elif not self._switches.fitted & switch:
            self._end(HomingStatus.FAILED, now_ns)
        elif self._switches.inputs(self._before) & switch:
            self._find_edge(now_ns)
        else:
            self._phase = _Phase.SEARCH
            self._go(method.search, self._fast, now_ns)

    def _go(self, direction: int, speed: float, now_ns: int) -> None:
        self._direction = direction
        self._speed = speed
        demand = self.motion.demand
        rate = self._rate
        demand.plan(to_velocity(demand.velocity_at(now_ns), direction * speed, rate, rate), now_ns)

    @property
    def _fast(self) -> float:
        """Speed of the search for the switch, in counts/s."""
        return self.motion.rate_of(self._speeds[0].value)

    @property
    def _slow(self) -> float:
        """Speed of the search for the edge and the index pulse, in counts/s."""
        return self.motion.rate_of(self._speeds[1].value)

    @property
    def _rate(self) -> float:
        """Homing acceleration in counts/s^2."""
        return self.motion.rate_of(self._acceleration.value)

    def _brake(self, now_ns: int) -> None:
        self.motion.demand.brake(now_ns, self._rate)

    def _end(self, status: HomingStatus, now_ns: int) -> None:
        self.status = status
        self._is_resting = self.motion.demand.is_over(now_ns)
        if not self._is_resting:
            self._brake(now_ns)

    def _find_edge(self, now_ns: int) -> None:
        """The switch is on: cross its edge in the final direction, or get out of it first for that."""
        method = self._method
        velocity = self.motion.demand.velocity_at(now_ns)
        self._has_seen = velocity * (method.final if method.leaves else -method.final) > 0.0
        if method.leaves:
            self._phase = _Phase.EDGE
            self._go(method.final, self._slow, now_ns)
        else:
            self._phase = _Phase.CLEAR
            self._go(-method.final, self._fast, now_ns)

    def _seek_index(self, counts: int, now_ns: int) -> None:
        method = self._method
        self._home = self._switches.next_index(counts, method.final, self.motion.settings.counts_per_revolution)
        if self._phase is not _Phase.EDGE:
            self._go(method.final, self._slow, now_ns)
        self._phase = _Phase.INDEX

    def _be_home(self, counts: int, now_ns: int) -> None:
        motion = self.motion
        motion.offset = self._home_offset.value - motion.scaling.position(counts)
        motion.forget_sample()
        self._phase = _Phase.STOP
        self._brake(now_ns)

    def on_tick(self, now_ns: int) -> None:
        """Look at the switches, and decide where to go."""
        motion = self.motion
        was = self.status_bits
        if self.status is HomingStatus.IN_PROGRESS:
            if self._phase is not _Phase.STOP:
                if not motion.is_halted:
                    self._look(now_ns)
            elif motion.demand.is_over(now_ns):
                if self._number in CURRENT_POSITION:
                    motion.offset = self._home_offset.value - motion.scaling.position(motion.shaft_counts)
                    motion.forget_sample()
                self._is_resting = True
                self.status = HomingStatus.ATTAINED
        else:
            self._is_resting = motion.demand.is_over(now_ns)
        self._before = motion.shaft_counts
        if self.status_bits != was:
            motion.show_status()

    def _look(self, now_ns: int) -> None:
        method = self._method
        counts = self.motion.shaft_counts
        inputs = self._switches.inputs(counts)
        limit = DigitalInput.POSITIVE_LIMIT if self._direction > 0 else DigitalInput.NEGATIVE_LIMIT
        if inputs & limit and limit is not method.switch:
            if self._phase is not _Phase.SEARCH or self._has_turned:
                self._end(HomingStatus.FAILED, now_ns)
            else:
                self._has_turned = True
                self._go(-self._direction, self._speed, now_ns)
            return
        if self._phase is _Phase.INDEX:
            if (counts - self._home) * method.final >= 0:
                self._be_home(self._home, now_ns)
            return
        if method.switch is not None:
            self._look_at(method.switch, bool(inputs & method.switch), counts, now_ns)

    def _look_at(self, switch: DigitalInput, is_on: bool, counts: int, now_ns: int) -> None:
        method = self._method
        if self._phase is _Phase.SEARCH:
            if is_on:
                self._find_edge(now_ns)
        elif self._phase is _Phase.EDGE and not method.leaves:
            if is_on:
                self._cross(switch, counts, now_ns)
        elif is_on:
            # An overshoot may have left the switch on the far side; then the axis comes back through it.
            if self.motion.demand.velocity_at(now_ns) * self._direction > 0.0:
                self._has_seen = True
        elif self._has_seen:
            if method.leaves:
                self._cross(switch, counts, now_ns)
            else:
                self._phase = _Phase.EDGE
                self._go(method.final, self._slow, now_ns)

    def _cross(self, switch: DigitalInput, counts: int, now_ns: int) -> None:
        edge = self._switches.edge(switch, self._before, counts)
        if not self._method.has_index:
            self._be_home(edge, now_ns)
            return
        self._seek_index(edge, now_ns)
        if (counts - self._home) * self._method.final >= 0:
            self._be_home(self._home, now_ns)


def _check_method(value: int, now_ns: int) -> AbortCode | None:
    return None if value in HOMING_METHODS else AbortCode.VALUE_RANGE_EXCEEDED
