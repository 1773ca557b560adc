"""NMT vocabulary shared by master and slaves (CiA 301, 7.2.8), and the COB-IDs of the pre-defined connection set."""

from enum import IntEnum
from typing import Final

NMT_COB_ID: Final = 0x000
SYNC_COB_ID: Final = 0x080
EMCY_BASE: Final = 0x080
HEARTBEAT_BASE: Final = 0x700
ALL_NODES: Final = 0
MAX_NODE_ID: Final = 127


class NmtCommand(IntEnum):
    """Command specifier, first byte of an NMT frame."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """NMT states as heartbeats carry them."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F
