"""The base of every section of a configuration file."""

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """Base of every section: frozen, no unknown keys, no NaN, no silent conversion from text."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)
