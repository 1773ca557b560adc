"""Runs a program as one that the system lends nothing: no capability, no real-time priority, no locked memory.

``python unprivileged.py PROGRAM ARGUMENT...``; whoever has no privilege to give up runs it as well.
"""

import ctypes
import os
import resource
import sys

_PR_CAPBSET_DROP, _PR_SET_NO_NEW_PRIVS, _PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL = 24, 38, 47, 4
_CAPABILITIES = 64


def give_up_privileges() -> None:
    """What a program that is executed from here on may not do any more; neither may its children."""
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL, 0, 0, 0)
    for capability in range(_CAPABILITIES):
        # Refused beyond the kernel's last one, and to who has none to give up.
        prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
    prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
        resource.setrlimit(limit, (0, 0))


if __name__ == "__main__":
    give_up_privileges()
    os.execv(sys.argv[1], sys.argv[1:])
