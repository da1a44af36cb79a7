"""What all sections of a scenario share: bounds, names and the error between two fields."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

PointM = tuple[Annotated[float, Field(ge=-5000, le=5000)], Annotated[float, Field(ge=-5000, le=5000)]]
Soc = Annotated[float, Field(gt=0, le=1)]
DroneId = Annotated[int, Field(ge=0, le=254)]
PhaseName = Literal["transit", "search", "track", "return"]


def inconsistent(at: tuple[str | int, ...], value: str, bound: str) -> PydanticCustomError:
    """An error between fields: `at` is the offending field's path below the section that checks it."""
    path = "".join(f"{part}." for part in at)[:-1] + ": " * bool(at)
    context = {"path": path, "value": value, "bound": bound, "at": at}
    return PydanticCustomError("inconsistent", "{path}{value}, must be {bound}", context)


class Section(BaseModel):
    """A frozen section of a scenario; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
