"""What the system really lends a process that asks for all there is: prints what it was told, and what came of it.

``python real_time_effects.py PRIORITY``, in a process of its own: locked memory is not for a test runner.
"""

import ctypes
import gc
import json
import os
import re
import sys
from pathlib import Path

from drivers.real_time import try_realtime

_PR_GET_TIMERSLACK = 30
LATER_BYTES = 16 << 20


def status(key: str, base: int = 10) -> int:
    """A number of /proc/self/status."""
    found = re.search(rf"{key}:\s*([0-9a-f]+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1], base)


def holds(path: Path) -> bool:
    """Whether this process has a file open."""
    links = Path("/proc/self/fd").iterdir()
    return path.exists() and any(link.exists() and link.samefile(path) for link in links)


def idle_latency_us() -> int | None:
    """The wake-up latency that the kernel keeps to, if this process holds it to one."""
    device = Path("/dev/cpu_dma_latency")
    if not holds(device):
        return None
    with device.open("rb", buffering=0) as file:
        return int.from_bytes(file.read(4) or b"", "little", signed=True)


def effects(priority: int) -> dict[str, object]:
    """Ask, and look."""
    processor = min(os.sched_getaffinity(0))
    settings = try_realtime(priority, processor)
    locked_kib, resident_kib = status("VmLck"), status("VmRSS")
    later = bytearray(LATER_BYTES)
    policy = os.sched_getscheduler(0)
    return {
        "settings": {setting.feature.name: [setting.is_on, setting.reason] for setting in settings},
        "capabilities": status("CapEff", 16),
        "policy": policy & ~os.SCHED_RESET_ON_FORK,
        "resets_on_fork": bool(policy & os.SCHED_RESET_ON_FORK),
        "priority": os.sched_getparam(0).sched_priority,
        "locked_share": locked_kib / resident_kib,
        "locked_later": (status("VmLck") - locked_kib) * 1024 >= len(later),
        "frozen": gc.get_freeze_count(),
        "processor": processor,
        "affinity": sorted(os.sched_getaffinity(0)),
        "idle_latency_us": idle_latency_us(),
        "slack_ns": ctypes.CDLL(None).prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0),
    }


if __name__ == "__main__":
    print(json.dumps(effects(int(sys.argv[1]))))
