"""The command line ``drive-gateway``: the one place where the gateway meets the emulator.

Standard output is for results, standard error for progress and complaints. Exit status: 0 done, 1 the machine or a
check said no, 2 wrong use or bad input.
"""

from gateway.cli.app import main

__all__ = ["main"]
