"""Position loops that the gateway closes itself on the paper's machine: softer than the drives' own."""

from typing import Any

import yaml

from config.loading import load_config, parse_config
from config.schema import GatewayConfig

TORQUE_LOOPS = {
    "cv": {
        "proportional_Nm_per_rad": 20,
        "integrating_Nm_per_rad_s": 60,
        "derivative_Nms_per_rad": 0.3,
        "torque_limit_Nm": 4.5,
    },
    "servo": {
        "proportional_Nm_per_rad": 15,
        "integrating_Nm_per_rad_s": 60,
        "derivative_Nms_per_rad": 0.18,
        "torque_limit_Nm": 4.5,
    },
}
SOFT_FROZEN_DEG = 1.5
"""Dry friction holds an axis for longer behind them."""


def put_in_torque(document: dict[str, Any]) -> None:
    """Have the gateway close the position loops of a configuration's axes."""
    for name, gains in TORQUE_LOOPS.items():
        document["axes"][name]["position_loop"] = gains
    document["guard"]["frozen_actual"]["limit_deg"] = SOFT_FROZEN_DEG


def machine_in_torque() -> GatewayConfig:
    """The paper's machine behind these loops."""
    paper = load_config("paper")
    document = yaml.safe_load(paper.text)
    put_in_torque(document)
    return parse_config(yaml.safe_dump(document), paper.path)
