"""Named sets of gains for both axes of a machine, to be run and compared; data in ``config/gains``."""

from collections.abc import Mapping
from typing import Annotated, Final

import yaml
from pydantic import Field

from config.emulation_section import GainsSection
from config.loading import SHIPPED, parse_config, parse_model, read_text
from config.model import Model
from config.schema import GatewayConfig

LOOSE_FROZEN_DEG: Final = 3.0
"""How far the demand of an axis with such gains may go while the axis stands."""
LOOSE_UNANSWERED_PERMILLE: Final = 1000
"""How far its torque may change meanwhile."""


class GainSet(Model):
    """Gains of both axes, and what they are for."""

    title: Annotated[str, Field(min_length=1, max_length=200)]
    note: Annotated[str, Field(max_length=500)] = ""
    master: GainsSection
    slave: GainsSection


class GainSets(Model):
    """A file of ``config/gains``."""

    sets: Annotated[dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")], GainSet], Field(min_length=1)]


def load_gain_sets(name: str) -> Mapping[str, GainSet]:
    """The shipped sets of gains for the configuration of that name. Raises ConfigError."""
    path = SHIPPED / "gains" / f"{name}.yaml"
    return parse_model(read_text(path), path, GainSets).sets


def with_gain_set(config: GatewayConfig, gains: GainSet) -> GatewayConfig:
    """``config`` with these gains in its emulated drives and nothing that helps the controller; its text says so too.

    The guard's limits for a frozen actual value and for unanswered torque are ``LOOSE_FROZEN_DEG`` and
    ``LOOSE_UNANSWERED_PERMILLE`` at least.

    Raises ConfigError.
    """
    axes = dict(config.axes)
    for name, own in zip(config.axis_names, (gains.master, gains.slave), strict=True):
        emulation = axes[name].emulation.model_copy(update={"gains": own})
        axes[name] = axes[name].model_copy(update={"emulation": emulation})
    # A loose axis stands in dry friction at its turning points while the demand goes on by more than a tight one would.
    frozen = config.guard.frozen_actual
    wide = frozen.model_copy(update={"limit_deg": max(frozen.limit_deg, LOOSE_FROZEN_DEG)})
    pushed = config.guard.unanswered_torque
    strong = pushed.model_copy(update={"limit_permille": max(pushed.limit_permille, LOOSE_UNANSWERED_PERMILLE)})
    guard = config.guard.model_copy(update={"frozen_actual": wide, "unanswered_torque": strong})
    changed = config.unaided.model_copy(update={"axes": axes, "guard": guard})
    return parse_config(yaml.safe_dump(changed.model_dump(mode="json"), sort_keys=False), config.path)
