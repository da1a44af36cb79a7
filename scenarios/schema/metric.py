"""`metrics`: figures of one's own."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sortie.scenarios.schema.base import ModelName, Params, Section


class Metric(Section):
    model: Annotated[str, ModelName("metric")] = Field(description="The function that computes it from the record.")
    params: Params = Field({}, description="Its keyword arguments.")
