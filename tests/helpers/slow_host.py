"""The reference machine for a computer that is late now and then: what a configuration in a file begins with."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

CONFIG = Path(__file__).resolve().parents[2] / "config"
LATENESS = ("missed_tpdo", "missed_deadline", "axis_silent")
"""Conditions of the guard that a busy or slow computer brings about."""


def slow_host_paper(warned: Iterable[str] = LATENESS) -> dict[str, Any]:
    """``paper`` for any folder: its drives without a watch over SYNC, its guard warning of ``warned`` alone."""
    config = yaml.safe_load((CONFIG / "paper.yaml").read_text())
    config["motion"]["curve"] = str(CONFIG / config["motion"]["curve"])
    config["emulator"]["eds"] = str(CONFIG / config["emulator"]["eds"])
    for axis in config["axes"].values():
        del axis["sync_watchdog"]
    config["guard"] |= {name: {"reaction": "warn"} for name in warned}
    # A cycle that is lost on the way is 16 counts of travel at 4 ms.
    config["guard"]["frozen_actual"] = {"limit_deg": 10.0, "reaction": "disable"}
    return config
