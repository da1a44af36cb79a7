"""What sections of the outcome share: the base of their models, quantities with unit and range, the flown sortie.

A section is a model of its figures, in the module that computes them: `compute` takes a `Flown` and returns them by
the names of the fields. `sortie.sim.results.outcome_fields.Outcome` puts the sections together.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field

from sortie.sim.results.record import SortieRecord

Span = tuple[float, float]
"""From a time (inclusive) to another (exclusive)."""
Computes = TypeVar("Computes", bound="Callable[[Flown], Any]")


def _quantity(unit: str, **ends: Any) -> Any:
    return Field(json_schema_extra={"unit": unit}, **ends)


Share = Annotated[float, _quantity("share", ge=0, le=1)]
Seconds = Annotated[float, _quantity("s", ge=0)]
Microseconds = Annotated[float, _quantity("µs", ge=0)]
Joules = Annotated[float, _quantity("J", ge=0)]
Volts = Annotated[float, _quantity("V", ge=0)]
Hertz = Annotated[float, _quantity("Hz", ge=0)]
Mbps = Annotated[float, _quantity("Mb/s", ge=0)]
PerMinute = Annotated[float, _quantity("1/min", ge=0)]
Size = Annotated[float, _quantity("B", ge=0)]
"""Of a mean or a median; a sum is `Bytes`."""
Bytes = Annotated[int, _quantity("B", ge=0)]
Count = Annotated[int, _quantity("", ge=0)]
Amount = Annotated[float, _quantity("", ge=0)]
"""That has no unit."""


def figure(meaning: str, **options: Any) -> Any:
    """A field of the outcome; `options` as of `pydantic.Field`."""
    return Field(description=meaning, **options)


class OutcomeSection(BaseModel):
    """Figures of a sortie. Unknown and missing ones are refused, and so are values that are out of range.

    A section of the outcome has a class method `compute`, which gives the figures of a flown sortie.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)


class Flown:
    """A flown sortie, of which sections compute their figures."""

    def __init__(self, record: SortieRecord) -> None:
        self.record, self.scenario, self.tables = record, record.scenario, record.tables
        self.parts: dict[Callable[[Flown], Any], Any] = {}

    @cached_property
    def phases(self) -> list[tuple[Span, str]]:
        """The mission's phases that come: from when to when, and their names."""
        phases, end_s = self.scenario.mission.phases, self.scenario.duration_s
        ends_s = [*(min(end_s, phase.at_s) for phase in phases[1:]), end_s]
        return [((p.at_s, until_s), p.phase) for p, until_s in zip(phases, ends_s, strict=True) if p.at_s < end_s]


def once(compute: Computes) -> Computes:
    """Decorates a function of a flown sortie that several sections call: its first result is kept."""

    @functools.wraps(compute)
    def part(flown: Flown) -> Any:
        if compute not in flown.parts:
            flown.parts[compute] = compute(flown)
        return flown.parts[compute]

    return cast(Computes, part)


def ratio(part: float, whole: float) -> float | None:
    """Part of a whole; None where the whole is 0."""
    return part / whole if whole else None
