"""The quick stop of a coupled machine: no axis is stopped, or lost, without the other one taking notice of it.

The master is stopped by its own drive (605Ah), as fast as its ramp 6085h allows, whether it is the one that failed or
not. The slave, as long as it has torque, stays on the cam of where the master *is*, and is stopped when the master
stands, or when the gateway closes its position loop and does not get it near the cam. A master that cannot be seen,
because its TPDOs have stopped or its resolver has, is taken to follow that ramp. A leap of a resolver is no motion: the
slave does not follow the master's, and is sent along with its own.
"""

import math
from collections.abc import Sequence
from typing import Final

from drivers.cia402 import COMMAND_DISABLE_VOLTAGE, COMMAND_QUICK_STOP
from gateway.cyclic.axis_channel import LEAP_GAP_CYCLES, AxisChannel
from gateway.cyclic.guard import Guard
from gateway.cyclic.watch import STATUSWORD_OPERATION_ENABLED, STATUSWORD_STATE_MASK
from gateway.record.sample import Phase
from gateway.units import wrap_counts
from mechanism.slave_law import SlaveLaw

REACHED_AFTER_CYCLES: Final = 2
"""A target sent now is applied at the next SYNC and reached at the one after it."""
BLEND_S: Final = 0.02
"""Within this the slave's target goes over from the demand that was to the cam of the actual position."""
STANDSTILL_S: Final = 0.05
STANDSTILL_COUNTS: Final = 2
WATCHED_S: Final = 0.1
"""So long a master takes that brakes; behind one that runs out, dry friction holds a slave for longer than a resolver
may be still."""
MAX_SKIPPED: Final = 1000
"""Cycles after which a master that nobody has seen stands, or is anywhere."""
CALM_CYCLES: Final = 5
"""A target that jumps is sent, applied, reached, and, where SYNC is missing, overshot; so long no drive is to stop."""
SPREAD_CYCLES: Final = 4
"""Over so many a leap goes into the target of a drive that misses SYNCs. It goes on with a jump until the next one, by
as much as the target has jumped: every other SYNC missing, it would swing about a single jump for as long as that
lasts, and what it makes of the second half of two undoes what it has made of the first."""
LED_RAD: Final = math.radians(10.0)
"""Farther from its target a slave whose position loop is closed here is not led by it: its own drive brakes better."""
POSITION_GAIN: Final = 0.7
VELOCITY_GAIN: Final = 0.4
"""Of the observer of the master: shares of the difference to the actual position, the second one per cycle."""

WAY_SHARE: Final = 4.0
"""By this part of its leap limit the way that an axis goes in a cycle changes from one to the next at most."""

MASTER: Final = 0
SLAVE: Final = 1


class _SeenAxis:
    """How far an axis goes, from one cycle in which it is seen to the next one: leaps of its resolver are no way."""

    __slots__ = ("_actual", "_axis", "_way", "unseen_cycles")

    def __init__(self, axis: AxisChannel) -> None:
        self._axis = axis
        self._actual = 0
        self._way = 0.0
        """Counts a cycle that the axis goes."""
        self.unseen_cycles = 0
        """Since it was seen last."""

    def begin(self, way: float) -> int:
        """It goes ``way`` (counts) a cycle now, and is to be seen from this cycle on, as if it had been seen before.

        Returns the counts that it has gone since then.
        """
        axis, gone = self._axis, round(way)
        self._actual = wrap_counts(axis.actual - gone)
        self._way = way
        self.unseen_cycles = max(axis.silent_cycles - 1, 0)
        return gone

    def look(self) -> float:
        """Counts gone since it was seen last, now that it is seen again."""
        axis = self._axis
        moved = wrap_counts(axis.actual - self._actual)
        self._actual = axis.actual
        cycles = self.unseen_cycles + 1
        self.unseen_cycles = 0
        expected = self._way * cycles
        if cycles <= LEAP_GAP_CYCLES + 1:
            if axis.sees_leap(moved, expected):
                return expected
        elif abs(moved + axis.leapt - expected) < abs(moved - expected):
            # How far it has gone is anybody's guess, but not that a leap has gone back meanwhile.
            moved += axis.leapt
            axis.leapt = 0
        # A leap too small to be told must not become the measure of the next way: no axis gets so much faster at once.
        slack = axis.leap_limit / WAY_SHARE
        self._way += min(max(moved / cycles - self._way, -slack), slack)
        return moved


class _LeapInTarget:
    """What an axis' resolver shows too much, as far as that is in the axis' target."""

    __slots__ = ("_axis", "_calm_cycles", "_goal", "_left", "counts")

    def __init__(self, axis: AxisChannel) -> None:
        self._axis = axis
        self.begin()

    def begin(self) -> None:
        """Nothing of a leap has been sent yet."""
        self._goal = 0
        self._left = 0
        """Cycles in which the goal is to be reached."""
        self.counts = 0
        self._calm_cycles = CALM_CYCLES
        """Since the target has jumped: a drive's own stop begins with the speed of its targets."""

    def step(self) -> None:
        """One cycle: towards the leap that has been seen."""
        axis = self._axis
        if axis.leapt != self._goal:
            self._goal = axis.leapt
            self._left = SPREAD_CYCLES if axis.rare_cycles else 1
        if self._left:
            self.counts += round((self._goal - self.counts) / self._left)
            self._left -= 1
            self._calm_cycles = 0
        else:
            self._calm_cycles += 1

    @property
    def is_calm(self) -> bool:
        """Whether the drive has long had a target that has not jumped."""
        return self._calm_cycles > CALM_CYCLES


class CoupledStop:
    """A `gateway.cyclic.demand.Demand` for two axes, master first, that takes over from the one that was followed."""

    def __init__(
        self, law: SlaveLaw, axes: Sequence[AxisChannel], guard: Guard, period_s: float, deceleration: float
    ) -> None:
        """``deceleration`` (rad/s^2): of the master's quick stop ramp, for as long as it cannot be seen."""
        self._law = law
        self._master, self._slave = axes
        self._guard = guard
        self._period_s = period_s
        self._deceleration = deceleration
        self._rad_per_count = math.tau / self._master.units.counts_per_revolution
        self._blend_cycles = max(round(BLEND_S / period_s), 1)
        self._standstill_cycles = max(round(STANDSTILL_S / period_s), 1)
        self._watched_cycles = round(WATCHED_S / period_s)
        self._led_counts = self._slave.units.counts_in(LED_RAD)
        self._cycle = 0
        self._offset = 0
        self._turns = 0
        self._slave_targets = [0] * (REACHED_AFTER_CYCLES + 1)
        """Where the slave is to be, as a resolver that tells the truth would show it: now, and in the next cycles."""
        self._seen_master, self._seen_slave = _SeenAxis(self._master), _SeenAxis(self._slave)
        self._seen_position = 0.0
        """Where the master was seen last, rad."""
        self._rest_from = 0
        self._rest_cycles = 0
        self._leap = _LeapInTarget(self._slave)
        self.targets = [0, 0]
        self.torque_offsets = [0, 0]
        self.velocities = [0.0, 0.0]
        self.master_position = 0.0
        self.master_velocity = 0.0
        self.phase = Phase.QUICK_STOP
        self.is_finished = False
        """The master stands, and the slave's drive has been told to stop too."""

    def begin(self, master_position: float, master_velocity: float, targets: Sequence[int]) -> None:
        """Take over with the next step.

        ``master_position`` (rad, unwrapped) and ``master_velocity`` (rad/s) are the demand's at the last SYNC, and
        ``targets`` (counts) what the axes were sent last.
        """
        master, slave = self._master, self._slave
        self.targets = list(targets)
        self._slave_targets = [targets[SLAVE]] * len(self._slave_targets)
        self._leap.begin()
        self._cycle = 0
        self._rest_cycles = 0
        self.is_finished = False
        revolution = master.units.counts_per_revolution
        shown = master.actual - master.leapt
        behind = math.remainder(master.units.counts(master_position) - shown, revolution)
        self._rest_from = shown
        seen_position = master_position - behind * self._rad_per_count
        position = seen_position if self._is_seen() else master_position
        # The first step goes on from the cycle before this one.
        self.master_position = position - master_velocity * self._period_s
        self.master_velocity = master_velocity
        revolution = slave.units.counts_per_revolution
        ahead = position + master_velocity * REACHED_AFTER_CYCLES * self._period_s
        theta5, slope = self._law.at(ahead)
        self.velocities = [master_velocity, slope * master_velocity]
        gone = self._seen_master.begin(master_velocity * self._period_s / self._rad_per_count)
        self._seen_position = seen_position - gone * self._rad_per_count
        self._seen_slave.begin(slope * master_velocity * self._period_s * revolution / math.tau)
        away = wrap_counts(targets[SLAVE] - slave.units.counts(theta5))
        # The turns by which the slave stands away from the cam's first one stay what they were.
        self._turns = round(away / revolution) * revolution
        self._offset = away - self._turns
        master.controlword = COMMAND_QUICK_STOP

    def step(self) -> None:
        """One cycle; see ``gateway.cyclic.demand.Demand``."""
        self._cycle += 1
        disabled = self._guard.disabled
        master, slave = self._master, self._slave
        self._observe()
        if slave.silent_cycles:
            self._seen_slave.unseen_cycles += 1
        else:
            self._seen_slave.look()
        self._leap.step()
        if disabled >> MASTER & 1:
            master.controlword = COMMAND_DISABLE_VOLTAGE
        if disabled >> SLAVE & 1:
            slave.controlword = COMMAND_DISABLE_VOLTAGE
        elif self._is_lost(slave) or (self._leap.is_calm and (self.is_finished or not self._is_led(slave))):
            slave.controlword = COMMAND_QUICK_STOP
        if self.is_finished:
            return
        ahead = self.master_position + self.master_velocity * REACHED_AFTER_CYCLES * self._period_s
        theta5, slope = self._law.at(ahead)
        left = max(1.0 - self._cycle / self._blend_cycles, 0.0)
        target = slave.units.counts(theta5) + self._turns + round(left * left * (3.0 - 2.0 * left) * self._offset)
        self._slave_targets = [*self._slave_targets[1:], target]
        # New lists: whoever keeps the last ones keeps that step's values.
        self.targets = [self.targets[MASTER], wrap_counts(target + self._leap.counts)]
        self.velocities = [self.master_velocity, slope * self.master_velocity]
        self.is_finished = self._rest_cycles >= self._standstill_cycles

    @property
    def followers(self) -> int:
        """Bit n: axis n follows its targets still, and shows it."""
        is_over = self.is_finished or self._cycle > self._watched_cycles
        return 0 if is_over or self._slave.controlword == COMMAND_QUICK_STOP else 1 << SLAVE

    def skip(self, cycles: int) -> None:
        """So many SYNCs have not been sent: what an axis has gone meanwhile is not a cycle's way."""
        self._seen_slave.unseen_cycles += cycles
        for _ in range(min(cycles, MAX_SKIPPED)):
            self._go_on()

    def controlled_stop(self) -> None:
        """Nothing: this is a stop, and a stronger one."""

    def _is_seen(self) -> bool:
        return self._master.silent_cycles == 0 and not self._guard.disabled >> MASTER & 1

    @staticmethod
    def _is_lost(axis: AxisChannel) -> bool:
        return axis.silent_cycles == 0 and axis.statusword & STATUSWORD_STATE_MASK != STATUSWORD_OPERATION_ENABLED

    def _is_led(self, slave: AxisChannel) -> bool:
        if slave.position_loop is None:
            return True
        if slave.silent_cycles:
            # A loop that hears nothing gives the torque that it gave last.
            return slave.silent_cycles <= LEAP_GAP_CYCLES
        return abs(wrap_counts(self._slave_targets[0] - slave.actual + slave.leapt)) <= self._led_counts

    def _observe(self) -> None:
        """Bring position and velocity of the master up to the last SYNC."""
        period_s = self._period_s
        expected = self.master_position + self.master_velocity * period_s
        if not self._is_seen():
            self._go_on()
            self._rest_cycles = 0 if self.master_velocity else self._rest_cycles + 1
            return
        master = self._seen_master
        cycles = master.unseen_cycles + 1
        # From the last count seen to this one, and from there to where the observer has the master.
        self._seen_position += master.look() * self._rad_per_count
        miss = self._seen_position - expected
        self.master_position = expected + POSITION_GAIN * miss
        # A miss that has grown for several cycles says so much less of the velocity: else rare sights make it swing up.
        self.master_velocity += VELOCITY_GAIN * miss / (period_s * cycles)
        shown = self._master.actual - self._master.leapt
        if abs(wrap_counts(shown - self._rest_from)) > STANDSTILL_COUNTS:
            self._rest_from = shown
            self._rest_cycles = 0
        else:
            self._rest_cycles += 1

    def _go_on(self) -> None:
        """A cycle in which nobody has seen the master; without torque, or unheard, it brakes."""
        if not self._is_seen():
            slower = max(abs(self.master_velocity) - self._deceleration * self._period_s, 0.0)
            self.master_velocity = math.copysign(slower, self.master_velocity) if slower else 0.0
        self.master_position += self.master_velocity * self._period_s
        self._seen_master.unseen_cycles += 1
