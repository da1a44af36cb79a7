"""What all sections of a scenario share: bounds, names and the error between two fields."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from sortie.scenarios.plugins.reference import FILE, installed

PointM = tuple[Annotated[float, Field(ge=-5000, le=5000)], Annotated[float, Field(ge=-5000, le=5000)]]
Soc = Annotated[float, Field(gt=0, le=1)]
MOST_DRONES = 5000
DroneId = Annotated[int, Field(ge=0, lt=MOST_DRONES)]
Params = dict[str, float | int | bool | str]
"""Keyword arguments of a model that can be replaced from outside."""
PhaseName = Literal["transit", "search", "track", "return"]


def inconsistent(at: tuple[str | int, ...], value: str, bound: str) -> PydanticCustomError:
    """An error between fields: `at` is the offending field's path below the section that checks it."""
    path = "".join(f"{part}." for part in at)[:-1] + ": " * bool(at)
    context = {"path": path, "value": value, "bound": bound, "at": at}
    return PydanticCustomError("inconsistent", "{path}{value}, must be {bound}", context)


_OF_THE_PAST: ContextVar[bool] = ContextVar("_OF_THE_PAST", default=False)


class Section(BaseModel):
    """A frozen section of a scenario; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _parameters_belong_to_a_model(self) -> Section:
        """`x_params` are for the model that `x` or `x_model` names."""
        fields = type(self).model_fields
        for at in (name for name in fields if name.endswith("_params") and getattr(self, name)):
            stem = at.removesuffix("_params")
            field = stem if stem in fields else f"{stem}_model"
            model = getattr(self, field)
            without = [name for mark in fields[field].metadata if isinstance(mark, ModelName) for name in mark.without]
            if (model is None or model in without) and not _OF_THE_PAST.get():
                where = f"there is no {field}" if model is None else f"{field} is {model}"
                raise inconsistent((at,), f"{getattr(self, at)}", f"left out where {where}")
        return self


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


@contextmanager
def models_of_the_past() -> Iterator[None]:
    """Accept every name of a model within the block: what flew once need not be installed to be read."""
    token = _OF_THE_PAST.set(True)
    try:
        yield
    finally:
        _OF_THE_PAST.reset(token)


@dataclass(frozen=True)
class ModelName:
    """Marks text that names a model: a built-in one, an installed plug-in, or `path/to/file.py:Name`."""

    kind: str
    builtin: tuple[str, ...] = ()
    take_params: tuple[str, ...] = ()
    """The built-in ones that take parameters."""

    @property
    def without(self) -> tuple[str, ...]:
        """The built-in ones that take no parameters."""
        return tuple(name for name in self.builtin if name not in self.take_params)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._known, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        names = [{"enum": list(self.builtin)}] if self.builtin else []
        return {"anyOf": [*names, {"type": "string", "description": "An installed plug-in, or path/to/file.py:Name."}]}

    def _known(self, name: str) -> str:
        if name in self.builtin or FILE.fullmatch(name) or name in installed(self.kind) or _OF_THE_PAST.get():
            return name
        expected = ", ".join(map(repr, (*self.builtin, *installed(self.kind))))
        raise PydanticCustomError("model_name", "unknown {kind}", {"kind": self.kind, "expected": expected})
