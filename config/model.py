"""The base of every section of a configuration file, and the kinds of value that more than one of them has."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0.0, le=1e6)]
NotNegative = Annotated[float, Field(ge=0.0, le=1e6)]
Point = Annotated[tuple[float, float], Field()]
AxisName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]


class Model(BaseModel):
    """Base of every section: frozen, no unknown keys, no NaN, no silent conversion from text."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)
