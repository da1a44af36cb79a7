"""What all sections of a scenario share: bounds, names and the error between two fields."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
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


class PresetSection(Section):
    """A section that a scenario may also give as the name of a preset; it is stored as the preset's values."""

    presets: ClassVar[dict[str, dict[str, Any]]]
    """By name: the values that differ from the section's defaults."""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            if value not in cls.presets:
                raise inconsistent((), repr(value), f"{', '.join(cls.presets)} or a section")
            return cls.presets[value]
        return value

    @classmethod
    def names_in_schema(cls, schema: dict[str, Any]) -> None:
        """For `json_schema_extra`: let editors accept a preset's name beside the section."""
        schema["anyOf"] = [{"enum": list(cls.presets)}, {"$ref": schema.pop("$ref")}]
