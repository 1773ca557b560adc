"""Whether a socketcand server stands before a wire: a question of ours, which an emulator's server answers.

The program socketcand knows no such command and says ``< error unknown command >``; whoever does not say that there is
no wire is taken to have one.
"""

import socket
from typing import Final

COMMAND: Final = "wire"
QUESTION: Final = b"< wire >"
NO_WIRE: Final = b"< wire none >"
"""The answer of a server whose frames take no time."""
ANSWER_TIMEOUT_S: Final = 2.0
_MAX_REPLY_BYTES: Final = 256


def says_no_wire(host: str, port: int, timeout_s: float = ANSWER_TIMEOUT_S) -> bool:
    """Whether the server at ``host`` and ``port`` says itself that its bus has no wire; no answer says nothing."""
    try:
        with socket.create_connection((host, port), timeout_s) as stream:
            stream.settimeout(timeout_s)
            # The greeting is waited for: a command that comes with it may be taken for part of the handshake.
            if not stream.recv(_MAX_REPLY_BYTES):
                return False
            stream.sendall(QUESTION)
            return stream.recv(_MAX_REPLY_BYTES).strip() == NO_WIRE
    except OSError:
        return False
