"""Errors of the bus, SDO, CiA 402 and the configuration of a node; each carries the values that explain it."""


class DriveError(Exception):
    """Root of every error that ``drivers`` raises."""


class BusError(DriveError):
    """The bus cannot be opened, or has gone away.

    Attributes: ``interface``, ``channel`` (what was asked for) and ``reason``.
    """

    def __init__(self, interface: str, channel: str, reason: str) -> None:
        super().__init__(f"bus {interface}:{channel}: {reason}")
        self.interface = interface
        self.channel = channel
        self.reason = reason


class EdsError(DriveError):
    """An EDS file cannot be read, or says something impossible."""


class NodeError(DriveError):
    """Something is wrong with one node; ``node_id`` names it."""

    def __init__(self, node_id: int, message: str) -> None:
        super().__init__(f"node {node_id}: {message}")
        self.node_id = node_id


class SdoAbortedError(NodeError):
    """An SDO transfer was aborted, by either side.

    Attributes: ``index``, ``subindex``, ``code`` (CiA 301, table of SDO abort codes).
    """

    def __init__(self, node_id: int, index: int, subindex: int, code: int, text: str) -> None:
        super().__init__(node_id, f"SDO {index:04X}h:{subindex:02X} aborted with {code:08X}h ({text})")
        self.index = index
        self.subindex = subindex
        self.code = code


class NoAnswerError(NodeError):
    """A node did not answer within its time; ``what`` says what was waited for, ``timeout_s`` for how long."""

    def __init__(self, node_id: int, what: str, timeout_s: float) -> None:
        super().__init__(node_id, f"no answer within {timeout_s:g} s while waiting for {what}")
        self.what = what
        self.timeout_s = timeout_s
