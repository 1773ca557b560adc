"""Gains into the drives and out of them by SDO: the manufacturer's object, verified by reading it back."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from drivers import objects
from drivers.errors import NodeError
from drivers.master import Master, Procedure
from drivers.object_dictionary import DataType
from gateway.errors import GatewayError
from gateway.running.commissioning import NodeSettings, check_identity
from gateway.tuning.controller import GAIN_NAMES, GainPair, Gains

_I32: Final = DataType.INTEGER32


def read_gains(master: Master, nodes: Sequence[NodeSettings]) -> Procedure[GainPair]:
    """The gains that both drives have now, after a check of their identities.

    Raises GatewayError for a gain that no configuration can hold, drivers.errors.NodeError if a drive does not answer,
    or has no such object.
    """
    pair: list[Gains] = []
    for node in nodes:
        yield from check_identity(master, node)
        values: list[int] = []
        for subindex in range(1, len(GAIN_NAMES) + 1):
            value = yield from master.read_int(node.node_id, objects.CONTROLLER_GAINS, subindex, _I32)
            values.append(value)
        pair.append(Gains(*values))
    return pair[0], pair[1]


def write_gains(master: Master, nodes: Sequence[NodeSettings], gains: GainPair) -> Procedure[GainPair]:
    """Write gains to both drives; returns those that were there before.

    What reads back wrong, or is refused, leaves the gains that were there in force on both drives. Raises as
    ``read_gains`` does.
    """
    before = yield from read_gains(master, nodes)
    try:
        yield from _write(master, nodes, gains)
        held = yield from read_gains(master, nodes)
    except NodeError:
        # Whoever still answers gets its old gains back; why the writing failed is the error that is told.
        for node, old in zip(nodes, before, strict=True):
            with suppress(NodeError):
                yield from _write(master, [node], (old,))
        raise
    if held != gains:
        yield from _write(master, nodes, before)
        names = " and ".join(n.name for n, has, wanted in zip(nodes, held, gains, strict=True) if has != wanted)
        raise GatewayError(f"axis {names}: the gains read back wrong, the old ones were written again")
    return before


def _write(master: Master, nodes: Sequence[NodeSettings], gains: Sequence[Gains]) -> Procedure[None]:
    for node, wanted in zip(nodes, gains, strict=True):
        for subindex, value in enumerate(wanted.values, 1):
            yield from master.write(node.node_id, objects.CONTROLLER_GAINS, subindex, _I32, value)
