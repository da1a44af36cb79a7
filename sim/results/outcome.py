"""The outcome of a sortie: the values of outcome.json, each computed from the record when it is first read.

Everything is computed from the record's tables, piece after piece: they may be larger than memory. `outcome.md` beside
this file lists every field.
"""

from __future__ import annotations

import math
from collections import UserDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from sortie.sim.results.outcome_fields import FIGURES, Outcome
from sortie.sim.results.outcome_names import is_zero_count, lacking
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.section import Flown

_LATER = object()
"""Stands in an outcome for a figure that nobody has read yet."""


def outcome(record: SortieRecord) -> OutcomeDict:
    """All figures of one sortie, JSON-ready; ratios of nothing are null. A field is computed when it is first read."""
    return OutcomeDict(dict.fromkeys(Outcome.model_fields, _LATER), Flown(record))


class OutcomeDict(dict[str, Any]):
    """An outcome as a dictionary of plain dictionaries, lists and numbers, as in `outcome.json`.

    Example:
        >>> read = OutcomeDict({"ap50": {"mission": 0.5, "fusion": None}, "battery": {"0": 0.9}})
        >>> read["ap50"]["mission"], read.get("ap50.mission"), read.get("ap50.hota", "nothing"), read.flat()
        (0.5, 0.5, 'nothing', {'ap50.mission': 0.5, 'battery.0': 0.9})
    """

    def __init__(self, values: Mapping[str, Any] | Iterable[tuple[str, Any]] = (), flown: Flown | None = None) -> None:
        """Args: `flown` computes the values that stand for later."""
        super().__init__(values)
        self._flown = flown

    def __getitem__(self, name: str) -> Any:
        value = super().__getitem__(name)
        if value is _LATER and self._flown is not None:
            self[name] = value = FIGURES[name](self._flown)
        return value

    def __iter__(self) -> Iterator[str]:
        return (
            super().__iter__()
        )  # a dict that iterates in its own way is copied by its keys and values, not as it lies in memory

    def get(self, name: str, default: Any = None) -> Any:
        """A figure by its name, which may have dots: `ap50.mission`. A count that is not there is 0."""
        try:
            return self.at(name)
        except KeyError:
            return default

    def at(self, name: str) -> Any:
        """A figure by its name with dots; list items by number. A count that is not there is 0.

        Raises:
            KeyError: no such field, naming the fields that there are.
        """
        value: Any = self
        parts = name.split(".")
        for depth, part in enumerate(parts):
            if isinstance(value, list) and part.isdigit() and int(part) < len(value):
                value = value[int(part)]
            elif isinstance(value, dict) and part in value:
                value = value[part]
            elif is_zero_count(name, self._drones):
                return 0
            else:
                where, known = ".".join(parts[:depth]) or "the outcome", "nothing"
                if isinstance(value, dict):
                    known = ", ".join(value)
                elif isinstance(value, list):
                    known = f"0 … {len(value) - 1}"
                raise KeyError(f"{name}: {where} has no {part!r}, it has {known}")
        return value

    def number(self, name: str) -> float | None:
        """A figure as a number; None where this flight has none, 0 of a count. Another flight may have one."""
        try:
            value = self.at(name)
        except KeyError:
            return lacking(name, self._drones)
        return float(value) if value is not None and math.isfinite(value) else None

    def flat(self) -> dict[str, float]:
        """All numbers by their names with dots; those without a value are left out."""
        return {name: value for name, value in leaves(self) if is_number(value)}

    def model(self) -> Outcome:
        """The outcome as a frozen pydantic model, validated.

        Raises:
            pydantic.ValidationError: a figure is missing, unknown or out of its range.
        """
        return Outcome.model_validate(self.data)

    @property
    def data(self) -> dict[str, Any]:
        """All values in a plain dictionary. `pprint` prints them, as those of any dictionary that has them as `data`."""
        return dict(self)

    __repr__ = UserDict.__repr__

    @property
    def _drones(self) -> int:
        return len(self["battery"]) if "battery" in self else 0

    def _complete(self) -> None:
        for name in self:
            self[name]
        self._flown = None  # the record may leave memory

    def __reduce__(self) -> Any:
        return OutcomeDict, (self.data,)


def _with_all_values(name: str) -> Callable[..., Any]:
    """A method of dictionaries that looks at values, after all of them have been computed."""
    method = getattr(dict, name)

    def looking(*outcomes: Any, **options: Any) -> Any:
        for each in outcomes:
            if isinstance(each, OutcomeDict):
                each._complete()
        return method(*outcomes, **options)

    return looking


for _name in ("items", "values", "pop", "popitem", "setdefault", "__eq__", "__ne__", "__or__", "__ror__"):
    setattr(OutcomeDict, _name, _with_all_values(_name))


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """All values of an outcome that are no section or list, with their names."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from leaves(inner, f"{name}.{k}")
    else:
        yield name, value


def is_number(value: Any) -> bool:
    """Whether a figure is a number; yes and no are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)
