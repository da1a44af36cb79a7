"""YAML in, `Scenario` out, and back. An error is one line with its place."""

from __future__ import annotations

import functools
import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from sortie.scenarios.reading.explain import explain
from sortie.scenarios.reading.files import found_beside, without_brackets
from sortie.scenarios.reading.nodes import (
    MAX_DEPTH,
    Issue,
    Node,
    ScenarioError,
    as_node,
    assign,
    child,
    dotted,
    nearest,
    plain,
    problems,
)
from sortie.scenarios.reading.strict_yaml import read_yaml, write_yaml
from sortie.scenarios.regular import regular
from sortie.scenarios.remarks import remarks
from sortie.scenarios.schema import Airframe, DescriptorForm, Scenario
from sortie.scenarios.schema.base import PresetSection
from sortie.scenarios.schema.conditions import ConditionSet

__all__ = ["Overrides", "ScenarioError", "build", "dump", "library", "load", "loads"]

Model = TypeVar("Model", bound=BaseModel)
MAX_BYTES = 1_000_000
INSTANTS = (("events",), ("policy", "changes"), ("policy", "commands"), ("policy", "replays"))
"""Lists of what is done at an instant, which must lie before the end."""
_LOG = logging.getLogger("sortie")
_LIBRARY = Path(__file__).parents[1] / "library"


# --- public --------------------------------------------------------------------------------------


Overrides = Sequence[str] | Mapping[str, object]
"""`key.path=value` as after `--set`, the value as YAML; or a map from key path to plain value. List entries by index."""


def load(path_or_name: str | Path, overrides: Overrides = ()) -> Scenario:
    """Read a scenario from a file, or from the library by its bare name.

    Args:
        path_or_name: a path, or the name of a library file such as `track_target`. Files that it names are looked for
            from here, then from where it lies.
        overrides: fields that differ from the file's.

    Raises:
        ScenarioError: one line that says which file, line and field, what is wrong and the bound.
    """
    text, source = read(path_or_name)
    return found_beside(loads(text, source, overrides), Path(source).parent)


def loads(text: str, source: str = "<text>", overrides: Overrides = ()) -> Scenario:
    """Read a scenario from text; `source` stands for the file name in errors. Raises ScenarioError."""
    return _scenario(tree(text, source), source, overrides)


def build(sections: Mapping[str, object], overrides: Overrides = (), source: str = "scenario") -> Scenario:
    """A scenario from plain sections, `{"name": "mine", "fleet": {"drones": 3}}`; `source` stands for the file name in errors.

    Raises:
        ScenarioError: one line that says which field, what is wrong and the bound.
    """
    return _scenario(as_node(sections, source), source, overrides)


def _scenario(root: Node, source: str, overrides: Overrides) -> Scenario:
    _refuse_old_key(root)
    for key, what, command in _OTHERS:
        if child(root, key) is not None and child(root, "name") is None:
            raise ScenarioError(f"{source}: is {what}, not a scenario; its command is: {command} {source}")
    written = root
    if isinstance(overrides, Mapping):
        for key, value in overrides.items():
            root = _assigned(root, key, as_node(value, "overrides"), "overrides")
    else:
        for override in overrides:
            root = _override(root, override)
    made = validated(shortened(root, written), Scenario)
    for line in remarks(made):
        _LOG.warning("%s: %s", made.name, line)
    return made


def shortened(root: Node, written: Node) -> Node:
    """Where an override sets `duration_s`, the tree without what the file does at instants after the end; a line says so."""
    duration = child(root, "duration_s")
    if duration is None or duration is child(written, "duration_s") or not isinstance(duration.value, int | float):
        return root
    for path in INSTANTS:
        whole, before = _at(root, path), _at(written, path)
        if (
            whole is None
            or whole is not before
            or not isinstance(whole.value, Sequence)
            or isinstance(whole.value, str)
        ):
            continue
        kept = [node for node in whole.value if not _begins_at(node) >= duration.value]
        left = len(whole.value) - len(kept)
        if left:
            text = "%s: %d of %d begin at duration_s = %g or later, and are left out"
            _LOG.warning(text, dotted(path), left, len(whole.value), duration.value)
            root = assign(root, path, replace(whole, value=kept))
    return root


def _at(node: Node | None, path: Sequence[str | int]) -> Node | None:
    for part in path:
        node = None if node is None else child(node, part)
    return node


def _begins_at(node: Node) -> float:
    at = child(node, "at_s")
    return at.value if at is not None and isinstance(at.value, int | float) else -math.inf


def read(path_or_name: str | Path, wanted: Mapping[str, Path] | None = None) -> tuple[str, str]:
    """A file's text and its path; a bare name is looked up in the library first.

    Args:
        wanted: the library's files of the kind that is read, which an error offers; None is scenarios, and a near miss of
            any kind.

    Raises:
        ScenarioError: no such file, or one that is no text.
    """
    path = {**library(), **campaigns(), **condition_sets()}.get(str(path_or_name), Path(path_or_name))
    try:
        with regular(path, or_pipe=True).open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file, {_nearby(path, wanted)}") from None
    except IsADirectoryError:
        raise ScenarioError(f"{path}: is a directory, must be a scenario file") from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise ScenarioError(f"{path}: cannot be read, {reason}") from None
    if len(data) > MAX_BYTES:
        raise ScenarioError(f"{path}: more than {MAX_BYTES} bytes, a scenario must have at most that")
    try:
        return data.decode("utf-8-sig"), str(path)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"{path}:{line}: byte 0x{data[error.start]:02x} is not UTF-8 text") from None


def tree(text: str, source: str) -> Node:
    """The text as a section of nodes, not yet held against any schema. Raises ScenarioError."""
    root = read_yaml(text, source)
    if root is None or root.value is None:
        raise ScenarioError(f"{source}: is empty, must hold at least a name")
    if not isinstance(root.value, dict):
        raise ScenarioError(f"{root.where}: {root.shown()} on top, must be a section that holds at least a name")
    return root


def validated(root: Node, model: type[Model]) -> Model:
    """The tree as a frozen model. Raises ScenarioError, with the first of its issues."""
    found = {issue.path: issue for issue in problems(root)}
    try:
        sections = without_brackets(plain(root))
    except ScenarioError as error:
        raise ScenarioError(f"{root.source}: {error}") from error
    try:
        # through JSON, where strict still lets a list be a tuple and a whole number a float
        made = model.model_validate_json(json.dumps(sections), strict=True)
    except ValidationError as error:
        for issue in explain(error, root, model):
            above = (found.get(issue.path[:n]) for n in range(len(issue.path) + 1))
            if not any(known and known.node.problem for known in above):
                found[issue.path] = issue  # says more than a doubt
    if found:
        raise _first(list(found.values()))
    return made


def dump(scenario: Scenario) -> str:
    """The resolved scenario, every default written out, as YAML that loads to an equal scenario."""
    data = scenario.model_dump(mode="json", exclude_none=True)
    return write_yaml(data)


def library() -> dict[str, Path]:
    """The shipped scenarios by name."""
    others = campaigns().keys() | condition_sets().keys()
    return {path.stem: path for path in sorted(_LIBRARY.glob("*.yaml")) if path.stem not in others}


@functools.cache
def campaigns() -> dict[str, Path]:
    """The shipped campaigns by name: files with `campaign` on top."""
    return _with_on_top("campaign")


@functools.cache
def condition_sets() -> dict[str, Path]:
    """The shipped sets of conditions by name: files with the key `conditions`."""
    return _with_on_top("conditions")


def _with_on_top(key: str) -> dict[str, Path]:
    texts = {path: path.read_text("utf-8") for path in sorted(_LIBRARY.glob("*.yaml"))}
    return {path.stem: path for path, text in texts.items() if re.search(f"^{key}:", text, re.MULTILINE)}


def load_conditions(path_or_name: str | Path) -> ConditionSet | None:
    """A set of conditions, with its base as a path; None if the file holds something else, such as a scenario.

    Raises:
        ScenarioError: as `load` does.
    """
    text, source = read(path_or_name)
    root = tree(text, source)
    _refuse_old_key(root)
    if child(root, "conditions") is None:
        return None
    conditions = validated(root, ConditionSet)
    return conditions.model_copy(update={"base": str(base_path(conditions.base, Path(source).parent, root))})


def base_path(name: str, here: Path, root: Node) -> Path:
    """Where the base of a campaign or of a set of conditions is: in the library, or beside its file.

    Args:
        name: as the field `base` has it.
        here: the folder of the file.
        root: the file's tree, of which an error names the line.

    Raises:
        ScenarioError: the base cannot be read, or is no scenario.
    """
    at = f"{(child(root, 'base') or root).where}: base: "
    path = {**library(), **campaigns(), **condition_sets()}.get(name, here / name)
    try:
        text, source = read(path)
    except ScenarioError as error:
        raise ScenarioError(f"{at}{error}") from None
    top = tree(text, source)
    for key, what in (("campaign", "a campaign itself"), ("conditions", "a set of conditions")):
        if child(top, key) is not None and child(top, "name") is None:
            raise ScenarioError(f"{at}{name}, must be a scenario, it is {what}")
    return path


def _refuse_old_key(root: Node) -> None:
    old = child(root, "contexts")
    if old is not None and child(root, "name") is None:
        raise ScenarioError(f"{old.where}: contexts: unknown key, it is now called conditions")


_OTHERS = (("campaign", "a campaign", "sortie campaign"), ("conditions", "a set of conditions", "sortie compare"))
"""What else lies in files like these, by the key that only it has."""

# --- overrides and errors ------------------------------------------------------------------------


def as_texts(overrides: Overrides) -> list[str]:
    """Overrides that can be read, as they stand after `--set`."""
    if not isinstance(overrides, Mapping):
        return [*overrides]
    return [f"{key}={json.dumps(plain(as_node(value)), ensure_ascii=False)}" for key, value in overrides.items()]


def _override(root: Node, override: str) -> Node:
    short = override if len(override) <= 80 else override[:77] + "..."
    source = f"--set {short}"
    key, equals, value = override.partition("=")
    if not equals or not all(key.strip().split(".")):
        raise ScenarioError(f"{source}: must be key.path=value")
    return _assigned(root, key, read_yaml(value, source, line=0) or Node(None, source, 0), source)


def _assigned(root: Node, key: object, new: Node, source: str) -> Node:
    parts = key.strip().split(".") if isinstance(key, str) else []
    if not all(parts) or not parts:
        raise ScenarioError(f"{source}: {key!r} is no field, must be key.path")
    if len(parts) > MAX_DEPTH:
        raise ScenarioError(f"{source}: {len(parts)} levels deep, must be at most {MAX_DEPTH}")
    return assign(_without_presets(root), parts, new)


def _without_presets(root: Node) -> Node:
    """A preset's name above the overridden field becomes the preset's values, so that the override changes one of them."""
    makes = _at(root, ("fleet", "makes"))
    count = len(makes.value) if makes is not None and isinstance(makes.value, list) else 0
    sections: list[tuple[tuple[str | int, ...], type[PresetSection]]] = [
        (("context", "form"), DescriptorForm),
        (("fleet", "airframe"), Airframe),
        *((("fleet", "makes", k, "airframe"), Airframe) for k in range(count)),
    ]
    for path, section in sections:
        node = _at(root, path)
        if node is not None and isinstance(node.value, str) and node.value in section.presets:
            values = as_node(section.presets[node.value], node.source, node.line)
            root = assign(root, [str(part) for part in path], values)
    return root


def _first(issues: Sequence[Issue]) -> ScenarioError:
    """The first issue in the file's order, `--set` last, and how many more there are."""
    first, *others = sorted(
        issues, key=lambda issue: (issue.node.line == 0, issue.node.line)
    )  # keeps the order of equals
    more = f" (and {len(others)} more)" if others else ""
    return ScenarioError(f"{first}{more}", [first, *others])


def _nearby(path: Path, wanted: Mapping[str, Path] | None) -> str:
    try:
        here = sorted(p.name for p in path.parent.glob("*.y*ml"))
    except (OSError, ValueError):
        here = []
    kinds = [*library(), *campaigns(), *condition_sets()] if wanted is None else [*wanted]
    known = {Path(name).stem: name for name in [*kinds, *here]}
    near = nearest(path.stem, known)
    there = ", ".join(library() if wanted is None else wanted)
    return f"did you mean {known[near]}?" if near else f"the library has {there}"
