"""After a stop that the guard called for: every axis brought back to where a new run may begin, and never to motion.

An axis whose node has restarted, or was cut off, is commissioned anew, alone. A fault is reset once, with a real edge;
one whose cause goes on stays. An axis that has lost its reference is not homed where it happens to stand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.cia402 import state_of
from drivers.errors import NodeError
from drivers.master import Master, Procedure
from drivers.nmt import NmtState
from drivers.node import Event
from gateway.errors import CommissioningError
from gateway.running.commissioning import NetworkSettings, commission, start_nodes
from gateway.running.powering import FAULTY, AxisPower, AxisSetup

TPDO_TIMEOUT_S = 0.2
ATTEMPTS = 2
"""A node may go away once more while it is recovered; one that does so again is not to be relied on."""


@dataclass(frozen=True, slots=True)
class AxisRecovered(Event):
    """What has become of an axis after a stop; ``is_ready``: a new run may begin as far as it is concerned."""

    axis: str
    is_ready: bool
    is_commissioned_anew: bool
    text: str


class Recovery:
    """The procedure, for all axes of a session; the cycle runs, and no drive is enabled."""

    def __init__(
        self, master: Master, power: AxisPower, axes: Sequence[AxisSetup], network: NetworkSettings, timeout_s: float
    ) -> None:
        """``timeout_s``: how long a node may be away before it is given up."""
        self._master = master
        self._power = power
        self._axes = tuple(axes)
        self._network = network
        self._timeout_s = timeout_s
        self._boot_ups = {axis.node.node_id: 0 for axis in axes}

    def note_commissioned(self) -> None:
        """All nodes have been commissioned: a boot-up after this is a restart."""
        for node_id in self._boot_ups:
            self._boot_ups[node_id] = self._master.nodes[node_id].boot_ups

    def run(self) -> Procedure[list[AxisRecovered]]:
        """Recover every axis; what went wrong with one is in its event, and stops no other."""
        outcomes: list[AxisRecovered] = []
        for axis in self._axes:
            try:
                outcome = yield from self._recover(axis)
            except CommissioningError as error:
                outcome = self._told(axis, False, False, "; ".join(error.problems))
            except NodeError as error:
                outcome = self._told(axis, False, False, str(error))
            outcomes.append(outcome)
        return outcomes

    def _told(self, axis: AxisSetup, is_ready: bool, is_anew: bool, text: str) -> AxisRecovered:
        return AxisRecovered(self._master.now_ns, axis.node.name, is_ready, is_anew, text)

    def _is_away(self, axis: AxisSetup) -> bool:
        """Silent, or back again from somewhere, since it was commissioned."""
        node_id = axis.node.node_id
        return axis.channel.silent_cycles > 0 or self._master.nodes[node_id].boot_ups != self._boot_ups[node_id]

    def _recover(self, axis: AxisSetup) -> Procedure[AxisRecovered]:
        node = self._master.nodes[axis.node.node_id]
        is_away = self._is_away(axis) or node.is_lost or node.state is not NmtState.OPERATIONAL
        for _ in range(ATTEMPTS):
            if is_away:
                yield from self._await_return(axis)
            try:
                outcome = yield from self._make_ready(axis, is_away)
            except (CommissioningError, NodeError):
                # A node that is being commissioned is silent in any case.
                if is_away or not self._is_away(axis):
                    raise
            else:
                if not self._is_away(axis):
                    return outcome
            is_away = True
        raise CommissioningError([f"node {axis.node.node_id} has been lost again while it was recovered"])

    def _make_ready(self, axis: AxisSetup, is_away: bool) -> Procedure[AxisRecovered]:
        if is_away:
            yield from self._bring_back(axis)
        had_fault = state_of(axis.channel.statusword) in FAULTY
        yield from self._power.reset_fault(axis)
        is_homed = axis.homing_method is None or (yield from self._power.is_homed(axis))
        done = ["commissioned anew"] if is_away else []
        done += ["fault reset"] if had_fault else []
        done += ["ready for a new run" if is_homed else "its reference is lost: bring the linkage to its home position"]
        return self._told(axis, is_homed, is_away, ", ".join(done))

    def _await_return(self, axis: AxisSetup) -> Procedure[None]:
        node_id, master = axis.node.node_id, self._master
        node, since_ns = master.nodes[node_id], master.now_ns
        boot_ups = self._boot_ups[node_id]
        alive = yield from master.wait_for(
            lambda: node.boot_ups > boot_ups or node.heartbeat_at_ns > since_ns or axis.channel.silent_cycles == 0,
            self._timeout_s,
        )
        if not alive:
            raise CommissioningError([f"node {node_id} has not come back within {self._timeout_s:g} s"])

    def _bring_back(self, axis: AxisSetup) -> Procedure[None]:
        node_id, master = axis.node.node_id, self._master
        yield from commission(master, [axis.node], self._network)
        self._boot_ups[node_id] = master.nodes[node_id].boot_ups
        start_nodes(master, [axis.node])
        # The count of the cycle that is under way may still be from before.
        yield from self._power.cycles(2)
        heard = yield from master.wait_for(lambda: axis.channel.silent_cycles == 0, TPDO_TIMEOUT_S)
        if not heard:
            raise CommissioningError([f"node {node_id} sends no TPDO after SYNC"])
