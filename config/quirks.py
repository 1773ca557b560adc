"""Habits of real drives that a master has to live with, by the names that configurations give them."""

from enum import Enum, unique


@unique
class Quirk(Enum):
    """One habit; named after what it does, with the drives or stacks in which it has been met."""

    NO_BOOT_UP = "no_boot_up"
    """No boot-up message after power-on or a reset: the drive is in pre-operational without a word (the slave of the
    Python package ``canopen``)."""
    SHORT_BOOT_UP = "short_boot_up"
    """The boot-up message has no data byte (CANopenNode, issue 102)."""
    RPDO_ACTS_ON_RECEIPT = "rpdo_acts_on_receipt"
    """A synchronous RPDO acts when it is received, not at the next SYNC (``canopen``, issue 400)."""
    SYNCHRONOUS_TPDO_REFUSED = "synchronous_tpdo_refused"
    """TPDOs are event-driven alone: transmission types 0 to 240 are refused (drives that send their statusword on
    change)."""
    RTR_BIT_MUST_BE_KEPT = "rtr_bit_must_be_kept"
    """A TPDO's COB-ID is refused where bit 30 differs from what it was (``canopen``, issue 228)."""
    REMAP_REFUSED_IN_OPERATIONAL = "remap_refused_in_operational"
    """PDO parameters may be changed in pre-operational alone (08000022h)."""
    OTHER_REMAP_ABORT_CODE = "other_remap_abort_code"
    """A change of mapping in the wrong order is refused with 06090030h, as lely-core does, not with 06010000h as
    CANopenNode does."""
    NO_BLOCK_TRANSFER = "no_block_transfer"
    """SDO block transfers are refused as an unknown command (05040001h), as by many small drives."""
    NO_HOMING_METHOD_0 = "no_homing_method_0"
    """6098h takes no 0 (ros2_canopen, issue 328)."""
    SET_POINT_ACKNOWLEDGE_STAYS = "set_point_acknowledge_stays"
    """Statusword bit 12 is set as long as operation is enabled, whatever the mode (ros2_canopen, issue 345)."""
    SLOW_MODE_SWITCH = "slow_mode_switch"
    """6061h follows 6060h after 100 ms."""
    INTERPOLATION_TIME_IN_MILLISECONDS = "interpolation_time_in_milliseconds"
    """60C2h:02 takes -3 alone (Nanotec PD4-C; Elmo counts in milliseconds too)."""
    CYCLE_PERIOD_NEEDED = "cycle_period_needed"
    """Cyclic modes are refused while 1006h is 0 (isel IMD20)."""
    NO_CYCLIC_POSITION_MODE = "no_cyclic_position_mode"
    """Mode 8 is refused, and not among the modes of 6502h (drives that only interpolate)."""
    LATE_SYNC_FREEZES = "late_sync_freezes"
    """In cyclic modes, with 1006h set, a SYNC that is more than 0.5 ms late freezes the axis where its demand is, and
    sets statusword bit 15, until the next SYNC (isel IMD20)."""
    NO_ABORT_OPTION = "no_abort_option"
    """6007h is not there, which the standard allows: the loss of the master is told by EMCY, and nothing follows."""
    ABORT_OPTION_STAYS = "abort_option_stays"
    """6007h takes any value without a word, reads as 0, and so does nothing (objects for show)."""
    TORQUE_OFFSET_NOT_MAPPABLE = "torque_offset_not_mappable"
    """60B2h is there, but no PDO takes it (06040041h)."""
