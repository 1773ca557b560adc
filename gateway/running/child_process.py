"""Processes that must not outlive the one that started them, however it ends.

``python -m gateway.running.child_process PARENT_PID MODULE ARGUMENT...`` runs a module under this rule.
"""

import ctypes
import os
import runpy
import signal
import sys
from typing import Final

_PR_SET_PDEATHSIG: Final = 1


def end_with(parent_pid: int) -> None:
    """Ask the kernel for a SIGTERM to this process when its parent dies, killed or not."""
    try:
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    except (OSError, AttributeError):
        return
    # A parent that died before the request was made sends nothing any more.
    if os.getppid() != parent_pid:
        os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    """Run the module named on the command line."""
    end_with(int(sys.argv[1]))
    module = sys.argv[2]
    sys.argv[:] = [module, *sys.argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
