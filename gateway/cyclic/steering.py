"""What the axes are told in each cycle: guard, demand, reactions, in this order; nothing of SYNCs and deadlines.

A drive in cyclic synchronous position reaches the target that it applied at SYNC(k-1) at SYNC(k), where it also latches
its actual position. So the following error of cycle k compares the target that was *sent* in cycle k-2 with the actual
value latched at SYNC(k): both belong to the same instant.
"""

from typing import Final

from config.guard_section import Reaction
from drivers.cia402 import COMMAND_DISABLE_VOLTAGE, COMMAND_QUICK_STOP
from gateway.cyclic.axis_channel import AxisChannel
from gateway.cyclic.demand import Demand
from gateway.cyclic.guard import Guard
from gateway.cyclic.listeners import ErrorObserver
from gateway.cyclic.position_loop import PositionLoop
from gateway.cyclic.reactions import CoupledStop
from gateway.cyclic.watch import STATUSWORD_OPERATION_ENABLED, STATUSWORD_STATE_MASK, CycleWatch
from gateway.record.sample import Phase
from gateway.units import HALF_RANGE, RANGE_MASK

_COMMISSIONING: Final = Phase.COMMISSIONING
_CAM: Final = Phase.CAM


Step = tuple[float, float, list[float], list[int], list[int], Phase]
"""A demand: master position, master velocity, velocities, targets, torque offsets, phase. Its lists are not changed."""


class Steering:
    """What all axes are to do, cycle by cycle.

    Until ``follow`` is called the target of a drive without torque is its actual position, and it is held from the
    moment the drive is enabled, so that the axis stays where it is.
    """

    __slots__ = (
        "_applied",
        "_coupled_stop",
        "_demand",
        "_is_coupled_stop_due",
        "_no_torque_offsets",
        "_no_velocities",
        "_observer",
        "_sent",
        "_watch",
        "axes",
        "guard",
        "in_force",
        "is_guarding_enabled",
        "phase",
    )

    def __init__(
        self,
        axes: list[AxisChannel],
        guard: Guard,
        watch: CycleWatch | None = None,
        coupled_stop: CoupledStop | None = None,
    ) -> None:
        """``watch`` is what every cycle is compared with, ``coupled_stop`` how a machine whose axes depend on each
        other makes a quick stop; without the latter every drive makes its own.
        """
        self.axes = axes
        self.guard = guard
        self.phase = Phase.COMMISSIONING
        self.is_guarding_enabled = False
        """Set while all drives are meant to be in Operation enabled."""
        self._watch = watch or CycleWatch(guard, axes)
        self._coupled_stop = coupled_stop
        self._is_coupled_stop_due = False
        self._demand: Demand | None = None
        self._observer: ErrorObserver | None = None
        self._no_velocities = [0.0] * len(axes)
        self._no_torque_offsets = [0] * len(axes)
        nothing = (0.0, 0.0, self._no_velocities, [0] * len(axes), self._no_torque_offsets, _COMMISSIONING)
        self.in_force: Step = nothing
        self._applied: Step = nothing
        self._sent: Step = nothing
        """Demands by age: reached at the last SYNC, applied at the last SYNC, sent last."""

    # -- commands ------------------------------------------------------------------------------------------------

    def follow(self, demand: Demand | None, observer: ErrorObserver | None = None) -> None:
        """Take the targets from ``demand`` from the next cycle on; None: hold them at the actual positions.

        ``observer`` is shown the following errors as long as the demand is followed.
        """
        self._demand = demand
        self._observer = observer

    def command(self, controlword: int) -> None:
        """Send this controlword to every axis from the next RPDO on."""
        for axis in self.axes:
            axis.controlword = controlword

    def begin_guarding(self) -> None:
        """All drives are in Operation enabled, and are meant to stay in it."""
        self.is_guarding_enabled = True
        self._watch.begin()

    def trust_loads(self) -> None:
        """Every axis has been seen to carry its load."""
        self._watch.trust_loads()

    def controlled_stop(self) -> None:
        """Ramp the master down on the cam, if anything is in motion."""
        if self._demand is not None:
            self._demand.controlled_stop()

    def quick_stop(self) -> None:
        """Stop as fast as the drives can, and take the torque from the axes that the guard has disabled.

        The demand is left behind; a machine in motion whose axes depend on each other makes a coupled stop. Does
        nothing to drives that are being disabled.
        """
        if self.phase is Phase.DISABLED:
            return
        if self.phase is not Phase.QUICK_STOP:
            self.is_guarding_enabled = False
            is_on_cam = self._demand is not None and Phase.RAMP_UP <= self.phase <= Phase.CONTROLLED_STOP
            is_coupled = is_on_cam and self._coupled_stop is not None
            # It begins with the actual values of the cycle that is closed next.
            self._is_coupled_stop_due = is_coupled
            self.follow(None)
            self.phase = Phase.QUICK_STOP
            if not is_coupled:
                self.command(COMMAND_QUICK_STOP)
        disabled = self.guard.disabled
        if disabled:
            for number, axis in enumerate(self.axes):
                if disabled >> number & 1:
                    axis.controlword = COMMAND_DISABLE_VOLTAGE

    def react(self) -> None:
        """Do what the guard calls for; also for conditions that are noticed outside the cycle."""
        reaction = self.guard.reaction
        if reaction is Reaction.QUICK_STOP or reaction is Reaction.DISABLE:
            self.quick_stop()
        elif reaction is Reaction.CONTROLLED_STOP:
            self.controlled_stop()

    # -- the cycle -----------------------------------------------------------------------------------------------

    def step(self, awaited: int, is_taken: bool, is_unheard: bool, now_ns: int) -> None:
        """One cycle, whose TPDOs are here: what every axis is to be sent is then in its channel.

        ``awaited``: bit n, the TPDO of axis n is missing; ``is_taken``: the demand that was sent last was on the bus
        before the last SYNC, so that the drives apply it; ``is_unheard``: what is made now reaches nobody.
        """
        self.in_force = self._applied
        if is_taken:
            self._applied = self._sent
        if self.phase is not _COMMISSIONING:
            self._check(awaited, now_ns)
        if self._observer is not None and not awaited:
            self._show_errors(self._observer)
        if self._is_coupled_stop_due and not is_unheard:
            self._begin_coupled_stop()
        demand = self._demand
        if demand is None:
            for axis in self.axes:
                # A drive that holds torque keeps its target: one that follows the actual position has no stiffness.
                if axis.statusword & STATUSWORD_STATE_MASK != STATUSWORD_OPERATION_ENABLED:
                    axis.target = axis.actual
            nothing = self._no_torque_offsets
            targets = [axis.target for axis in self.axes]
            self._sent = (self._sent[0], 0.0, self._no_velocities, targets, nothing, self.phase)
        elif is_taken:
            # A demand that came too late is sent once more instead: two steps at once would be a jump.
            demand.step()
            self.phase = demand.phase
            self._sent = (
                demand.master_position,
                demand.master_velocity,
                demand.velocities,
                demand.targets,
                demand.torque_offsets,
                demand.phase,
            )
        _, _, _, targets, torque_offsets, _ = self._sent
        for number, axis in enumerate(self.axes):
            axis.target = targets[number]
            torque = torque_offsets[number]
            if axis.position_loop is not None:
                torque = self._close_position_loop(number, axis, axis.position_loop, torque, awaited)
            axis.torque_offset = torque

    def skip(self, cycles: int) -> None:
        """So many SYNCs have not been sent: what an axis has gone meanwhile is not a cycle's way."""
        self._watch.forget()
        if self._coupled_stop is not None:
            self._coupled_stop.skip(cycles)

    def let_settle(self) -> None:
        """All axes have been left without a demand, and have to be set in motion anew."""
        self._watch.let_settle()

    def _close_position_loop(
        self, number: int, axis: AxisChannel, loop: PositionLoop, offset: int, awaited: int
    ) -> int:
        """Torque for an axis in cyclic synchronous torque: target and actual value are those of this SYNC."""
        if axis.statusword & STATUSWORD_STATE_MASK != STATUSWORD_OPERATION_ENABLED:
            return loop.reset()
        if awaited >> number & 1:
            return loop.hold()
        _, _, velocities, targets, _, _ = self.in_force
        return loop.update(targets[number], axis.actual, velocities[number], offset)

    def _check(self, awaited: int, now_ns: int) -> None:
        if self.phase is Phase.DISABLED:
            # Drives without torque call for no reaction; which of them is there is asked all the same.
            self._watch.note_silence(awaited)
            return
        master_position, _, velocities, targets, torque_offsets, phase = self.in_force
        stop = self._coupled_stop
        followers = stop.followers if stop is not None and self._demand is stop and phase is Phase.QUICK_STOP else 0
        self._watch.check(
            awaited,
            targets,
            torque_offsets,
            velocities,
            master_position,
            phase,
            self.is_guarding_enabled,
            followers,
            now_ns,
        )
        if self.guard.tripped:
            self.react()

    def _begin_coupled_stop(self) -> None:
        self._is_coupled_stop_due = False
        if self._coupled_stop is not None:
            self._coupled_stop.begin(self.in_force[0], self.in_force[1], self._sent[3])
            self._demand = self._coupled_stop

    def _show_errors(self, observer: ErrorObserver) -> None:
        position, velocity, _, targets, _, phase = self.in_force
        errors = [
            (target - axis.actual + HALF_RANGE & RANGE_MASK) - HALF_RANGE
            for target, axis in zip(targets, self.axes, strict=True)
        ]
        is_steady = phase is _CAM and self.guard.is_quiet
        observer.observe(position, velocity, errors, is_steady)
