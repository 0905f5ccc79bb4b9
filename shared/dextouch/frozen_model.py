"""Base of pydantic models that are immutable and refuse unknown fields, as almost all of ours."""

from pydantic import BaseModel, ConfigDict


class FrozenModel(BaseModel):
    """An immutable model without unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")
