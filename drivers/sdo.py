"""SDO vocabulary shared by client and server: command specifiers and abort codes (CiA 301, 7.2.4.3)."""

from enum import IntEnum
from typing import Final

SDO_REQUEST_BASE: Final = 0x600
"""COB-ID of a request is this plus the server's node id."""
SDO_RESPONSE_BASE: Final = 0x580
"""COB-ID of a response is this plus the server's node id."""


class ClientCommand(IntEnum):
    """Client command specifiers, in bits 7 to 5 of a request's first byte."""

    DOWNLOAD_SEGMENT = 0
    INITIATE_DOWNLOAD = 1
    INITIATE_UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4
    BLOCK_UPLOAD = 5
    BLOCK_DOWNLOAD = 6


class ServerCommand(IntEnum):
    """Server command specifiers, in bits 7 to 5 of a response's first byte."""

    UPLOAD_SEGMENT = 0
    DOWNLOAD_SEGMENT = 1
    INITIATE_UPLOAD = 2
    INITIATE_DOWNLOAD = 3
    ABORT = 4
    BLOCK_DOWNLOAD = 5
    BLOCK_UPLOAD = 6


class AbortCode(IntEnum):
    """SDO abort codes (CiA 301, table 22)."""

    TOGGLE_BIT_NOT_ALTERNATED = 0x05030000
    PROTOCOL_TIMED_OUT = 0x05040000
    COMMAND_SPECIFIER_UNKNOWN = 0x05040001
    INVALID_BLOCK_SIZE = 0x05040002
    INVALID_SEQUENCE_NUMBER = 0x05040003
    CRC_ERROR = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    OBJECT_DOES_NOT_EXIST = 0x06020000
    NOT_PDO_MAPPABLE = 0x06040041
    PDO_LENGTH_EXCEEDED = 0x06040042
    PARAMETER_INCOMPATIBLE = 0x06040043
    DEVICE_INCOMPATIBLE = 0x06040047
    HARDWARE_ERROR = 0x06060000
    LENGTH_MISMATCH = 0x06070010
    LENGTH_TOO_HIGH = 0x06070012
    LENGTH_TOO_LOW = 0x06070013
    SUBINDEX_DOES_NOT_EXIST = 0x06090011
    VALUE_RANGE_EXCEEDED = 0x06090030
    VALUE_TOO_HIGH = 0x06090031
    VALUE_TOO_LOW = 0x06090032
    MAXIMUM_LESS_THAN_MINIMUM = 0x06090036
    GENERAL_ERROR = 0x08000000
    CANNOT_STORE = 0x08000020
    CANNOT_STORE_LOCAL_CONTROL = 0x08000021
    CANNOT_STORE_DEVICE_STATE = 0x08000022
    NO_OBJECT_DICTIONARY = 0x08000023
    NO_DATA_AVAILABLE = 0x08000024


def abort_text(code: int) -> str:
    """The abort code in words; an unknown code is called just that."""
    try:
        return AbortCode(code).name.replace("_", " ").lower()
    except ValueError:
        return "unknown abort code"
