"""Indices of the objects of CiA 301 and CiA 402, and of the emulated drive's own, by their standard names.

The only module, with the EDS files and the tests, where an object's index is written as a number.
"""

from typing import Final

# CiA 301, communication profile area
DEVICE_TYPE: Final = 0x1000
ERROR_REGISTER: Final = 0x1001
PREDEFINED_ERROR_FIELD: Final = 0x1003
COB_ID_SYNC: Final = 0x1005
COMMUNICATION_CYCLE_PERIOD: Final = 0x1006
SYNCHRONOUS_WINDOW_LENGTH: Final = 0x1007
MANUFACTURER_DEVICE_NAME: Final = 0x1008
GUARD_TIME: Final = 0x100C
LIFE_TIME_FACTOR: Final = 0x100D
STORE_PARAMETERS: Final = 0x1010
RESTORE_DEFAULT_PARAMETERS: Final = 0x1011
COB_ID_TIME: Final = 0x1012
COB_ID_EMCY: Final = 0x1014
INHIBIT_TIME_EMCY: Final = 0x1015
CONSUMER_HEARTBEAT_TIME: Final = 0x1016
PRODUCER_HEARTBEAT_TIME: Final = 0x1017
IDENTITY: Final = 0x1018
SYNCHRONOUS_COUNTER_OVERFLOW: Final = 0x1019
ERROR_BEHAVIOUR: Final = 0x1029
RPDO_COMMUNICATION: Final = 0x1400
RPDO_MAPPING: Final = 0x1600
TPDO_COMMUNICATION: Final = 0x1800
TPDO_MAPPING: Final = 0x1A00

# CiA 402, drive profile area
ABORT_CONNECTION_OPTION_CODE: Final = 0x6007
ERROR_CODE: Final = 0x603F
CONTROLWORD: Final = 0x6040
STATUSWORD: Final = 0x6041
QUICK_STOP_OPTION_CODE: Final = 0x605A
SHUTDOWN_OPTION_CODE: Final = 0x605B
DISABLE_OPERATION_OPTION_CODE: Final = 0x605C
FAULT_REACTION_OPTION_CODE: Final = 0x605E
MODES_OF_OPERATION: Final = 0x6060
MODES_OF_OPERATION_DISPLAY: Final = 0x6061
POSITION_DEMAND_VALUE: Final = 0x6062
POSITION_ACTUAL_VALUE: Final = 0x6064
FOLLOWING_ERROR_WINDOW: Final = 0x6065
FOLLOWING_ERROR_TIMEOUT: Final = 0x6066
VELOCITY_ACTUAL_VALUE: Final = 0x606C
TARGET_TORQUE: Final = 0x6071
MAX_TORQUE: Final = 0x6072
MOTOR_RATED_TORQUE: Final = 0x6076
TORQUE_ACTUAL_VALUE: Final = 0x6077
TARGET_POSITION: Final = 0x607A
HOME_OFFSET: Final = 0x607C
SOFTWARE_POSITION_LIMIT: Final = 0x607D
QUICK_STOP_DECELERATION: Final = 0x6085
POSITION_ENCODER_RESOLUTION: Final = 0x608F
HOMING_METHOD: Final = 0x6098
TORQUE_OFFSET: Final = 0x60B2
INTERPOLATION_TIME_PERIOD: Final = 0x60C2
FOLLOWING_ERROR_ACTUAL_VALUE: Final = 0x60F4
SUPPORTED_DRIVE_MODES: Final = 0x6502

# Emulated drive, manufacturer area
PROFILE_SLOT: Final = 0x3000
"""First of four profile slots, records: see ``PROFILE_SLOT_*`` for the sub-indices."""
PROFILE_SLOT_COUNT: Final = 4
PROFILE_SLOT_DATA: Final = 1
"""DOMAIN, write only in effect: the slot image of ``mechanism.cam_image``; it can be read back."""
PROFILE_SLOT_COMMAND: Final = 2
"""UNSIGNED8: 1 parses the data, 2 clears the slot; reads back 0 when done."""
PROFILE_SLOT_STATE: Final = 3
"""UNSIGNED8, read only: 0 empty, 1 loaded, 2 valid, 3 invalid."""
PROFILE_SLOT_ERROR: Final = 4
"""UNSIGNED8, read only: why the last parse failed, 0 for none."""
PROFILE_SLOT_CRC: Final = 5
"""UNSIGNED32, read only: CRC-32 (zlib) of the whole image in the slot."""
PROFILE_SLOT_POINTS: Final = 6
"""UNSIGNED32, read only: points of a valid table."""
PROFILE_SLOT_SELECTED: Final = 0x3010
"""UNSIGNED8: the slot that camming runs, 1 to 4; 0 for none."""
CAM_MASTER_POSITION: Final = 0x3011
"""INTEGER32, RPDO-mappable: position of the master axis in counts."""
CAM_MASTER_OFFSET: Final = 0x3012
"""INTEGER32: counts added to the master position before the table is read."""
CONTROLLER_GAINS: Final = 0x3020
"""Record: K_P, K_I, K_D, K_V, K_F of the position controller as integers over 256 (INTEGER32 each)."""
DRIVE_ENERGY: Final = 0x3040
"""Record, read only, INTEGER32 in mJ since power-on, modulo 2^32: drawn from the supply, work of the shaft, copper
loss."""
TIME_OF_DAY: Final = 0x3030
"""Record, read only: what the TIME messages have told; UNSIGNED32 milliseconds after midnight, UNSIGNED16 days since
1984-01-01."""
SET_POINT_WATCHDOG: Final = 0x3050
"""UNSIGNED16: interpolation times 60C2h without a set-point after which an enabled axis faults (8700h); 0 for none."""
SET_POINT_AGE: Final = 0x3051
"""UNSIGNED32, read only: how long (us) a cyclic mode's last set-point had acted when the axis lost its torque last."""

# The areas of the object dictionary (CiA 301, table 40)
COMMUNICATION_PROFILE_AREA: Final = range(0x1000, 0x2000)
MANUFACTURER_PROFILE_AREA: Final = range(0x2000, 0x6000)
STANDARDISED_PROFILE_AREA: Final = range(0x6000, 0xA000)

# CiA 402, drive profile area, continued
HALT_OPTION_CODE: Final = 0x605D
POSITION_WINDOW: Final = 0x6067
POSITION_WINDOW_TIME: Final = 0x6068
VELOCITY_DEMAND_VALUE: Final = 0x606B
VELOCITY_WINDOW: Final = 0x606D
VELOCITY_WINDOW_TIME: Final = 0x606E
VELOCITY_THRESHOLD: Final = 0x606F
VELOCITY_THRESHOLD_TIME: Final = 0x6070
TORQUE_DEMAND: Final = 0x6074
POLARITY: Final = 0x607E
MAX_PROFILE_VELOCITY: Final = 0x607F
MAX_MOTOR_SPEED: Final = 0x6080
PROFILE_VELOCITY: Final = 0x6081
PROFILE_ACCELERATION: Final = 0x6083
PROFILE_DECELERATION: Final = 0x6084
MOTION_PROFILE_TYPE: Final = 0x6086
TORQUE_SLOPE: Final = 0x6087
VELOCITY_ENCODER_RESOLUTION: Final = 0x6090
GEAR_RATIO: Final = 0x6091
FEED_CONSTANT: Final = 0x6092
HOMING_SPEEDS: Final = 0x6099
HOMING_ACCELERATION: Final = 0x609A
POSITION_OFFSET: Final = 0x60B0
VELOCITY_OFFSET: Final = 0x60B1
TOUCH_PROBE_FUNCTION: Final = 0x60B8
TOUCH_PROBE_STATUS: Final = 0x60B9
TOUCH_PROBE_1_POSITIVE_EDGE: Final = 0x60BA
TOUCH_PROBE_1_NEGATIVE_EDGE: Final = 0x60BB
TOUCH_PROBE_2_POSITIVE_EDGE: Final = 0x60BC
TOUCH_PROBE_2_NEGATIVE_EDGE: Final = 0x60BD
INTERPOLATION_SUB_MODE: Final = 0x60C0
INTERPOLATION_DATA_RECORD: Final = 0x60C1
INTERPOLATION_DATA_CONFIGURATION: Final = 0x60C4
MAX_ACCELERATION: Final = 0x60C5
MAX_DECELERATION: Final = 0x60C6
POSITIVE_TORQUE_LIMIT: Final = 0x60E0
NEGATIVE_TORQUE_LIMIT: Final = 0x60E1
POSITIONING_OPTION_CODE: Final = 0x60F2
DIGITAL_INPUTS: Final = 0x60FD
DIGITAL_OUTPUTS: Final = 0x60FE
TARGET_VELOCITY: Final = 0x60FF
END_VELOCITY: Final = 0x6082
PROFILE_JERK: Final = 0x60A4
INTERPOLATION_SYNC_DEFINITION: Final = 0x60C3
SINGLE_DEVICE_TYPE: Final = 0x67FF
