"""The outcome of a sortie: the values of outcome.json, each computed from the record when it is first read.

Everything is computed from the record's tables, piece after piece: they may be larger than memory. `outcome.md` beside
this file lists every field.
"""

from __future__ import annotations

import functools
import math
from collections import UserDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

from sortie.fleet.energy.battery import CAUSES, RECORDED
from sortie.fleet.messages.auth import DropReason
from sortie.radio.transmission import Status
from sortie.scenarios.intervals import FLAG, Range
from sortie.scenarios.reading.nodes import nearest
from sortie.sim.folders import RunError
from sortie.sim.results.outcome_fields import FIGURES, WALL, Outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.section import Flown
from sortie.sim.results.traffic import REASONS

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
        """Args: `flown` is what values that stand for later are computed from."""
        super().__init__(values)
        self._flown = flown

    def __getitem__(self, name: str) -> Any:
        value = super().__getitem__(name)
        if value is _LATER and self._flown is not None:
            self[name] = value = FIGURES[name](self._flown)
        return value

    def __iter__(self) -> Iterator[str]:
        return super().__iter__()  # without this, dict() and ** would copy what lies in memory, values for later too

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
                known = f"0 … {len(value) - 1}" if isinstance(value, list) else "nothing"
                known = ", ".join(value) if isinstance(value, dict) else known
                where = ".".join(parts[:depth]) or "the outcome"
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
        """All values in a plain dictionary; `pprint` looks for them under this name."""
        return dict(self)

    __repr__ = UserDict.__repr__

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:  # of IPython and notebooks
        printer.pretty(self.data)

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


for _name in ("items", "values", "pop", "popitem", "setdefault", "__eq__", "__ne__"):
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


# --- names -------------------------------------------------------------------------------------------

Schema = dict[str, Any]
"""JSON Schema of a field or a section."""


@functools.cache
def outcome_schema() -> Schema:
    """The outcome's JSON Schema."""
    return Outcome.model_json_schema()


def _resolved(schema: Schema) -> Schema:
    """A schema without reference; of a field that may be null, that of its value."""
    schema = next(iter(schema.get("anyOf", [schema])))
    return outcome_schema()["$defs"][schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema


def fields(schema: Schema | None = None, path: str = "") -> Iterator[tuple[str, Schema, Schema]]:
    """Every field of a section, those inside it after it: its name, its schema as declared, and that of its value.

    In names `*` stands for each key of an object, and `[]` for each entry of a list.
    """
    for name, declared in (schema or outcome_schema())["properties"].items():
        here = _resolved(declared)
        yield f"{path}{name}", declared, here
        mark = ".*" if here.get("additionalProperties") else "[]" if "items" in here else ""
        inner = _resolved(here.get("items") or here.get("additionalProperties") or here)
        if "properties" in inner:
            yield from fields(inner, f"{path}{name}{mark}.")


@functools.cache
def counted() -> tuple[str, ...]:
    """Where an outcome counts by key: a key that is not there was counted 0 times."""
    kinds = ((name, here.get("additionalProperties")) for name, _, here in fields())
    return tuple(name for name, kind in kinds if kind and kind.get("type") == "integer")


def is_zero_count(name: str, drones: int) -> bool:
    """Whether a dotted name that an outcome of so many drones does not have is a count of 0; policies are not known here."""
    section, _, key = name.rpartition(".")
    return section in counted() and key in open_keys(drones, 0, (), traced=False)[section]


def lacking(name: str, drones: int) -> int | None:
    """What a run of so many drones has of a number that another run has and its own outcome lacks: 0 of a count, but for
    one of a drone that is not there; else None.

    Example:
        >>> lacking("distrusted_by.1", 2), lacking("distrusted_by.7", 2), lacking("policies.decisions.silence", 2)
        (0, None, 0)
    """
    of_nobody = name.startswith("distrusted_by.") and not is_zero_count(name, drones)
    return 0 if name.startswith(tuple(f"{section}." for section in counted())) and not of_nobody else None


def open_keys(
    drones: int, phases: int, policies: Collection[str], *, traced: bool, metrics: Collection[str] = ()
) -> dict[str, Collection[str]]:
    """What the objects of an outcome that are open (`*` in the reference) may be keyed by, and how many phases there are.

    Args:
        drones, phases: at most so many.
        policies: those that may decide, as the record names them.
        traced: whether drones may follow a trace.
        metrics: names of the user's own.
    """
    ids = tuple(map(str, range(drones)))
    part = {Status.PARTIAL: (*REASONS[Status.LOST], *REASONS[Status.EXPIRED])}
    return {
        "payload_fates": tuple(f"{s}/{r}" if r else str(s) for s, reasons in (REASONS | part).items() for r in reasons),
        "descriptor_drops": tuple(map(str, DropReason)),
        "battery": ids,
        "drones": ids,
        "connectivity.articulation": ids,
        "distrusted_by": ids,
        "energy_j": (*CAUSES, *([RECORDED] if traced else []), "total"),
        "policies.decisions": tuple(name for name in policies if "." not in name),  # a dot would lead further
        "phases": tuple(map(str, range(phases))),
        "metrics": metrics,
        "own_files": (),  # digests are no numbers
    }


def check_number(name: str, keys: Mapping[str, Collection[str]]) -> None:
    """Hold a dotted name against the reference: some run's outcome may have a number there.

    Args:
        keys: as `open_keys` gives them; a list that is not among them may be of any length.

    Raises:
        RunError: it never has one: no such field, wall clock, or no number; with what could have been meant.
    """
    if name.partition(".")[0] in WALL:
        raise RunError(f"{name}: is wall clock, a metric must follow from the run alone")
    if what := _no_number(kind_at(name, keys)):
        raise RunError(f"{name}: is {what}, a metric must be a number")


def kind_at(name: str, keys: Mapping[str, Collection[str]]) -> Schema:
    """The kind of a field of an outcome, by its dotted name.

    Args:
        keys: as `open_keys` gives them; a list that is not among them may be of any length.

    Raises:
        RunError: no outcome has it; with what could have been meant.
    """
    kind, above = outcome_schema(), ""
    for part in name.split("."):
        known = kind.get("properties", keys.get(above))
        below = _below(kind, part)
        counts = known is None and "items" in kind and part.isdecimal() and part.isascii()
        if below is None or not (counts or part in (known or ())):
            raise RunError(f"{name}: {above or 'the outcome'} has no {part!r}, {_instead(kind, part, known)}")
        kind, above = below, f"{above}.{part}" if above else part
    return kind


def possible(name: str) -> Range:
    """The values that a metric can have, by its dotted name; any value where the reference does not have it.

    Example:
        >>> possible("drones.2.soc"), possible("bytes.data_sent")
        (Range(low=0.0, high=1.0, yes_or_no=False), Range(low=0.0, high=inf, yes_or_no=False))
    """
    kind: Schema | None = outcome_schema()
    for part in name.split("."):
        kind = None if kind is None else _below(kind, part)
    if kind is None:
        return Range()
    if kind.get("type") == "boolean":
        return FLAG
    return Range(float(kind.get("minimum", -math.inf)), float(kind.get("maximum", math.inf)))


def _below(kind: Schema, part: str) -> Schema | None:
    """The kind of what stands under a key or number; None where nothing can."""
    found = kind.get("properties", {}).get(part) or kind.get("additionalProperties") or kind.get("items")
    return _resolved(found) if found else None


def _instead(kind: Schema, part: str, keys: Collection[str] | None) -> str:
    """What could have been meant by a key that is not there, or what there is."""
    what = _no_number(kind)
    if what in ("", "text"):
        return f"it is {what or 'a number'}"
    if what == "a list" and keys is None:
        return "it has entries by number"
    known = list(keys or ())
    if all(key.isdecimal() for key in known):
        return f"it has {known[0]} … {known[-1]}" if known else "it has none that can be named"
    near = nearest(part, known)
    return f"did you mean {near}?" if near else f"it has {', '.join(known)}"


def _no_number(kind: Schema) -> str:
    """What a field is that is no number, in words; empty where it is one."""
    return {"object": "a section", "array": "a list", "string": "text"}.get(kind["type"], "")
