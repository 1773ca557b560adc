"""What the machine is to do so that its parameters show: the cam at several speeds, with ramps as steep as is allowed.

Gravity and dry friction are the same at every speed, viscous friction grows with it, inertia with its square and with
the ramps: only together can they be told apart. The model's own torque offsets are left out: an axis that they hold
within a count shows the same part of its controller's ripple at every SYNC, which would be taken for friction. Every
run is checked as any other before anything moves.
"""

from typing import Final

import yaml

from config.loading import ConfigError, parse_config
from config.schema import GatewayConfig
from gateway.errors import GatewayError
from gateway.running.preparation import PreparedRun, prepare

SPEED_SHARES: Final = (0.5, 0.75, 1.0)
"""Of the configured speed, which is never exceeded."""
RAMP_FACTORS: Final = (3.0, 2.0, 1.5, 1.0)
"""Of the configured ramp's acceleration, tried in this order; the jerk by its square, so that ramps stay ramps."""


def excitation_runs(config: GatewayConfig, machine_cycles: int) -> list[PreparedRun]:
    """A prepared run for each speed. Raises GatewayError if not even the configured ramps keep the limits."""
    return [_steepest(config, share, machine_cycles) for share in SPEED_SHARES]


def _steepest(config: GatewayConfig, share: float, machine_cycles: int) -> PreparedRun:
    refused: Exception | None = None
    for factor in RAMP_FACTORS:
        document = config.unaided.model_dump(mode="json")
        motion = document["motion"]
        motion["speed_rpm"] *= share
        motion["machine_cycles"] = machine_cycles
        motion["ramp_acceleration_rad_per_s2"] *= factor
        motion["ramp_jerk_rad_per_s3"] *= factor * factor
        try:
            return prepare(parse_config(yaml.safe_dump(document, sort_keys=False), config.path))
        except (ConfigError, GatewayError) as error:
            refused = error
    raise GatewayError(f"no excitation keeps the limits: {refused}")
