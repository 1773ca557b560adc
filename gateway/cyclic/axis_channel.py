"""One axis as the cycle sees it."""

from drivers.cia402 import COMMAND_DISABLE_VOLTAGE
from drivers.pdo import RPDO_BASE, TPDO_BASE
from gateway.cyclic.position_loop import PositionLoop
from gateway.units import AxisUnits


class AxisChannel:
    """What the cycle sends to a drive, and what came back last."""

    __slots__ = (
        "actual",
        "controlword",
        "following_error_limit",
        "name",
        "node_id",
        "position_loop",
        "rpdo_cob_id",
        "silent_cycles",
        "statusword",
        "target",
        "torque",
        "torque_offset",
        "tpdo_cob_id",
        "units",
    )

    def __init__(
        self,
        name: str,
        node_id: int,
        units: AxisUnits,
        following_error_limit: int,
        position_loop: PositionLoop | None = None,
    ) -> None:
        """``position_loop``: the gateway closes it and sends torques; None leaves it to the drive."""
        self.name = name
        self.node_id = node_id
        self.units = units
        self.following_error_limit = following_error_limit
        self.position_loop = position_loop
        self.rpdo_cob_id = RPDO_BASE[0] + node_id
        self.tpdo_cob_id = TPDO_BASE[0] + node_id
        self.controlword = COMMAND_DISABLE_VOLTAGE
        self.target = 0
        self.torque_offset = 0
        self.statusword = 0
        self.actual = 0
        self.torque = 0
        self.silent_cycles = 0
        """Cycles in a row that have been without its TPDO."""
