"""Which fields of a scenario name files, and where those are looked for."""

from __future__ import annotations

import copy
import functools
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from sortie.scenarios.plugins.reference import installed, is_file
from sortie.scenarios.reading.call_text import read_call
from sortie.scenarios.reading.explain import sections_of
from sortie.scenarios.reading.nodes import Node, ScenarioError, problems
from sortie.scenarios.reading.nodes import plain as plain_value
from sortie.scenarios.reading.strict_yaml import read_yaml
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.base import ModelName
from sortie.scenarios.shipped import companions, located

FIELDS = ("fleet.trace", "radio.trace", "perception.weights", "perception.codebook", "perception.recording")
"""Fields that name a file; so do the weights and the codebook of a make."""
MODELS = {
    "radio.path_loss": "path_loss",
    "radio.link": "link",
    "perception.detector": "detector",
    "perception.fusion": "fusion",
    "perception.recorded_fusion": "recorded_fusion",
    "fleet.airframe.power_model": "power",
    "fleet.battery.cell_model": "cell",
    "fleet.sensor": "sensor",
    "fleet.mobility": "mobility",
    "policy.name": "policy",
}
"""The kind of model that a field names. Makes name policies, power models and cells too, groups of drones mobility models,
changes of policy policies, events of kind `own` events, and `metrics` metrics."""


HERE = Path()
_FUNCTION = re.compile(r"(.+)(:[^\W\d]\w*)")
_PARAMETER = re.compile(r"([^\W\d]\w*)\s*=\s*(.+)", re.DOTALL)
_POLICIES = {"policy": {"name"}, "changes": {"name"}, "makes": {"policy"}}
"""Sections that name a policy, and the field that does."""
_CALLABLE = frozenset(field.rpartition(".")[2] for field in MODELS) - {"name", "recorded_fusion"} | {"model"}


def params_of(field: str) -> str:
    """The field that has the parameters of the model that a field names.

    Example:
        >>> [params_of(field) for field in ("link", "power_model", "model")]
        ['link_params', 'power_params', 'params']
    """
    return "params" if field in ("name", "model") else f"{field.removesuffix('_model')}_params"


def without_brackets(sections: Any, within: str = "") -> Any:
    """Plain sections, valid or not, in which models are named without brackets; their parameters stand where they belong.

    Args:
        within: the key that the sections stand under.

    Example:
        >>> without_brackets({"radio": {"link": "own.py:Name(loss_db=3)", "link_params": {"clear_s": 1}}})
        {'radio': {'link': 'own.py:Name', 'link_params': {'loss_db': 3}}}
    """
    if isinstance(sections, list):
        return [without_brackets(each, within) for each in sections]
    if not isinstance(sections, dict):
        return sections
    plain = {k: v if str(k).endswith("params") else without_brackets(v, k) for k, v in sections.items()}
    for name in (_CALLABLE | _POLICIES.get(within, set())) & plain.keys():
        model, parts = (read_call(plain[name]) if isinstance(plain[name], str) else None) or (None, [])
        pairs = [_PARAMETER.fullmatch(part) for part in parts]
        if model is not None and all(pairs):
            plain |= {name: model, params_of(name): {p[1]: _value(f"{model}({p[0]})", p[2]) for p in pairs if p}}
    return plain


def _value(source: str, text: str) -> object:
    """A parameter's value, as YAML.

    Raises:
        ScenarioError: it is no YAML, or YAML that can be read in two ways, naming the source.
    """
    node = read_yaml(text, source, line=0) or Node(None, source, 0)
    for issue in problems(node):
        raise ScenarioError(str(issue))
    return plain_value(node)


def builtin(field: str) -> tuple[str, ...]:
    """The built-in models that a field of the schema may name.

    Example:
        >>> builtin("fleet.airframe.power_model")
        ('level', 'momentum')
    """
    section: type[BaseModel] = Scenario
    *above, key = field.split(".")
    for name in above:
        (section,) = sections_of(section.model_fields[name].annotation)
    named = (item for item in section.model_fields[key].metadata if isinstance(item, ModelName))
    return next((item.builtin for item in named), ())


def named_files(sections: dict[str, Any]) -> list[str]:
    """Every file that a scenario's plain sections name, as it is written there, and those that belong to weights among them."""
    named = [(key, _split(holder[key])[0]) for holder, key in _places(sections)]
    beside = [str(path) for key, name in named if key == "weights" for path in companions(Path(name))]
    return [name for _, name in named] + beside


def with_files(sections: dict[str, Any], place: Callable[[str], str], folder: Path = HERE) -> dict[str, Any]:
    """The sections with every file's name replaced by what `place` makes of it.

    Args: `folder`: where files that parameters name may lie too; `place` must find them there.
    """
    changed = copy.deepcopy(sections)
    for holder, key in _places(changed, folder):
        file, function = _split(holder[key])
        holder[key] = place(file) + function
    for kind, holder, key in _models(changed):
        if is_file(name := (read_call(holder[key]) or (holder[key],))[0]) or name in installed(kind):
            holder[key] = _brackets_with_files(holder[key], place, folder)
    return changed


def _brackets_with_files(text: str, place: Callable[[str], str], folder: Path) -> str:
    """`file.py:Name(table=a.csv)` with the files of its parameters replaced."""
    model, parts = read_call(text) or (text, [])
    changed = list(parts)
    for i, pair in enumerate(map(_PARAMETER.fullmatch, parts)):
        value = None if pair is None else _value(f"{model}({pair[1]})", pair[2])
        if pair is not None and _names_a_file(value, folder):
            changed[i] = f"{pair[1]}={json.dumps(place(str(value)), ensure_ascii=False)}"
    return text if changed == parts else f"{model}({', '.join(changed)})"


def found_beside(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario with files that are not where they are named, but lie so beside `folder`, named there."""
    sections = scenario.model_dump(mode="json", exclude_none=True)
    changed = with_files(sections, lambda name: placed(name, folder), folder)
    return scenario if changed == sections else Scenario.model_validate_json(json.dumps(changed), strict=True)


def placed(name: str, folder: Path) -> str:
    """The name as it is if it leads somewhere from here; else below `folder` if it leads somewhere there; else as it is: it may
    name a shipped file."""
    return name if not name or os.path.exists(name) or not os.path.exists(folder / name) else str(folder / name)


def value_at(field: str, sections: Any) -> Any:
    """The value of a dotted field in plain sections.

    Example:
        >>> value_at("events.0.model", {"events": [{"model": "rain.py:Front"}]})
        'rain.py:Front'
    """
    for name in field.split("."):
        sections = sections[int(name) if isinstance(sections, list) else name]
    return sections


def named_models(sections: dict[str, Any]) -> list[tuple[str, str]]:
    """Every model that a scenario's plain sections name, with its kind first: built-in, installed and in files."""
    return [(kind, holder[key]) for kind, holder, key in _models(sections)]


def models_with_params(sections: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Every model that a scenario's plain sections name: its kind, its name and its parameters."""
    for kind, holder, key in _models(sections):
        yield kind, holder[key], holder.get(params_of(key)) or {}


def ensure_files(sections: dict[str, Any]) -> None:
    """Refuse a scenario whose fields name files that are not there.

    Raises:
        ScenarioError: naming the field and the file.
    """
    for field, holder, key in _files(sections):
        if not os.path.exists(located(Path(holder[key]))):
            raise ScenarioError(f"{field}: {holder[key]}: no such file")


def _files(sections: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Where fields that are for files name one: the field, the section and its key."""
    for field in FIELDS:
        yield from ((field, *at) for at in _given(sections, (field,)))
    for i, make in enumerate(sections.get("fleet", {}).get("makes", ())):
        for key in ("weights", "codebook"):
            yield from ((f"fleet.makes.{i}.{key}", *at) for at in _given(make, (key,)))


def _places(sections: dict[str, Any], folder: Path = HERE) -> Iterator[tuple[dict[str, Any], str]]:
    """Where files are named: the section and its key. Files of parameters may also lie beside `folder`."""
    yield from ((holder, key) for _, holder, key in _files(sections))
    for kind, holder, key in _models(sections):
        if is_file(holder[key]):
            yield holder, key
        if is_file(holder[key]) or holder[key] in installed(kind):
            params = holder.get(params_of(key)) or {}
            yield from ((params, k) for k, v in params.items() if _names_a_file(v, folder))


def _names_a_file(value: object, folder: Path) -> bool:
    """Whether a parameter of a model is the name of a file, such as a table that the model reads, or of a folder.

    A name has a suffix or a slash. Otherwise a word such as `train` would mean a file that lies there by chance. The
    working folder and the folders above it never count, so `/`, `./` and `../` are text.
    """
    if not isinstance(value, str) or not ("/" in value or Path(value).suffix):
        return False
    there = Path(placed(value, folder))
    return os.path.isfile(there) or (os.path.isdir(there) and not Path.cwd().is_relative_to(there.resolve()))


def _models(sections: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Where models are named: the kind, the section and its key."""
    for field, kind in MODELS.items():
        yield from ((kind, *at) for at in _given(sections, (field,)))
    for make in sections.get("fleet", {}).get("makes", ()):
        yield from (("policy", *at) for at in _given(make, ("policy",)))
        yield from (("power", *at) for at in _given(make, ("airframe.power_model",)))
        yield from (("cell", *at) for at in _given(make, ("battery.cell_model",)))
    for group in sections.get("fleet", {}).get("groups", ()):
        yield from (("mobility", *at) for at in _given(group, ("mobility",)))
    for change in sections.get("policy", {}).get("changes", ()):
        yield "policy", change, "name"
    for event in sections.get("events", ()):
        yield from (("event", *at) for at in _given(event, ("model",)))
    for metric in sections.get("metrics", {}).values():
        yield from (("metric", *at) for at in _given(metric, ("model",)))


def _given(sections: dict[str, Any], fields: Iterable[str]) -> Iterator[tuple[dict[str, Any], str]]:
    """The section and the key of each field that is there."""
    for field in fields:
        *above, key = field.split(".")
        section: Any = functools.reduce(lambda inside, name: inside.get(name) or {}, above, sections)
        if isinstance(section, dict) and section.get(key) is not None:  # otherwise a preset's name
            yield section, key


def _split(text: str) -> tuple[str, str]:
    """`file.py:function` or `file.py:function(key=value)` as the file, and the rest with its colon; else a file alone."""
    called = read_call(text)
    name = text if called is None else called[0]
    found = _FUNCTION.fullmatch(name)
    return (found[1], text[len(found[1]) :]) if found else (text, "")
