"""YAML in, `Scenario` out, and back; whatever is wrong is told in one line with its place.

The reader takes a strict part of YAML 1.2: maps, lists, plain decimals, true and false, null, text,
anchors within bounds. What YAML 1.1 and 1.2 read differently (yes, on, 017, 1_000, 1:30) is refused
rather than guessed, and so are tags, merge keys and duplicate keys. No value is coerced: `'0.5'` is
text, `5.0` no whole number; a whole number does where a number is asked for.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from sortie.scenarios.reading.explain import explain
from sortie.scenarios.reading.files import found_beside
from sortie.scenarios.reading.nodes import (
    Issue,
    Node,
    Scalar,
    ScenarioError,
    as_node,
    assign,
    child,
    nearest,
    plain,
    problems,
)
from sortie.scenarios.schema import Airframe, DescriptorForm, Scenario
from sortie.scenarios.schema.conditions import ConditionSet

__all__ = ["Overrides", "ScenarioError", "build", "dump", "library", "load", "loads"]

Model = TypeVar("Model", bound=BaseModel)
MAX_BYTES = 1_000_000
MAX_WEIGHT = 50_000
"""Values after alias expansion; long text counts once a hundred characters."""
MAX_DEPTH = 20

_Parser: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # only its event stream is used
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
    if isinstance(overrides, Mapping):
        for key, value in overrides.items():
            root = _assigned(root, key, as_node(value, "overrides"), "overrides")
    else:
        for override in overrides:
            root = _override(root, override)
    return validated(root, Scenario)


def read(path_or_name: str | Path) -> tuple[str, str]:
    """A file's text and its path; a bare name is looked up in the library first. Raises ScenarioError."""
    path = {**library(), **campaigns(), **condition_sets()}.get(str(path_or_name), Path(path_or_name))
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file, {_nearby(path)}") from None
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
    root = _read(text, source)
    if root is None or root.value is None:
        raise ScenarioError(f"{source}: is empty, must hold at least a name")
    if not isinstance(root.value, dict):
        raise ScenarioError(f"{root.where}: {root.shown()} on top, must be a section that holds at least a name")
    return root


def validated(root: Node, model: type[Model]) -> Model:
    """The tree as a frozen model. Raises ScenarioError, with the first of its issues."""
    found = {issue.path: issue for issue in problems(root)}
    try:
        # through JSON, where strict still lets a list be a tuple and a whole number a float
        made = model.model_validate_json(json.dumps(plain(root)), strict=True)
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
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100))


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
    """A set of conditions; None if the file holds something else, such as a scenario.

    Raises:
        ScenarioError: as `load` does.
    """
    text, source = read(path_or_name)
    root = tree(text, source)
    _refuse_old_key(root)
    return validated(root, ConditionSet) if child(root, "conditions") is not None else None


def _refuse_old_key(root: Node) -> None:
    old = child(root, "contexts")
    if old is not None and child(root, "name") is None:
        raise ScenarioError(f"{old.where}: contexts: unknown key, it is now called conditions")


_OTHERS = (("campaign", "a campaign", "sortie campaign"), ("conditions", "a set of conditions", "sortie compare"))
"""What else lies in files like these, by the key that only it has."""

# --- overrides and errors ------------------------------------------------------------------------


def _override(root: Node, override: str) -> Node:
    short = override if len(override) <= 80 else override[:77] + "..."
    source = f"--set {short}"
    key, equals, value = override.partition("=")
    if not equals or not all(key.strip().split(".")):
        raise ScenarioError(f"{source}: must be key.path=value")
    return _assigned(root, key, _read(value, source, line=0) or Node(None, source, 0), source)


def _assigned(root: Node, key: object, new: Node, source: str) -> Node:
    parts = key.strip().split(".") if isinstance(key, str) else []
    if not all(parts) or not parts:
        raise ScenarioError(f"{source}: {key!r} is no field, must be key.path")
    if len(parts) > MAX_DEPTH:
        raise ScenarioError(f"{source}: {len(parts)} levels deep, must be at most {MAX_DEPTH}")
    return assign(_without_presets(root), parts, new)


def _without_presets(root: Node) -> Node:
    """A preset's name above the overridden field becomes the preset's values, so that the override changes one of them."""
    for path, section in ((("fleet", "airframe"), Airframe), (("context", "form"), DescriptorForm)):
        node = child(child(root, path[0]) or root, path[1])
        if node is not None and isinstance(node.value, str) and node.value in section.presets:
            root = assign(root, path, as_node(section.presets[node.value], node.source, node.line))
    return root


def _first(issues: Sequence[Issue]) -> ScenarioError:
    """The first issue in the file's order, `--set` last, and how many more there are."""
    first = min(issues, key=lambda issue: (issue.node.line == 0, issue.node.line))  # min keeps the order of equals
    more = f" (and {len(issues) - 1} more)" if len(issues) > 1 else ""
    return ScenarioError(f"{first}{more}")


def _nearby(path: Path) -> str:
    try:
        here = sorted(p.name for p in path.parent.glob("*.y*ml"))
    except (OSError, ValueError):
        here = []
    known = {Path(name).stem: name for name in [*library(), *campaigns(), *condition_sets(), *here]}
    near = nearest(path.stem, known)
    return f"did you mean {known[near]}?" if near else f"the library has {', '.join(library())}"


# --- the strict reader ---------------------------------------------------------------------------

_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)(e[-+]?[0-9]+)?", re.IGNORECASE)
_NOT_FINITE = re.compile(r"[-+]?\.inf|\.nan", re.IGNORECASE)
_ODD_WORD = re.compile(r"yes|no|on|off", re.IGNORECASE)
_ODD_NUMBER = re.compile(
    r"[-+]?(0[xob][0-9a-f_]+|[0-9][0-9_]*(\.[0-9_]*)?(e[-+]?[0-9]+)?|[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?)",
    re.IGNORECASE,
)
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
_WORDS: dict[str, Scalar] = {
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
}


def read_scalar(text: str) -> tuple[Scalar, str, str]:
    """A plain scalar's value, the problem and the doubt about it (see Node), if any."""
    if text in _WORDS:
        return _WORDS[text], "", ""
    if _INT.fullmatch(text):
        return (int(text), "", "") if len(text) <= 30 else (0, f"{text[:12]}..., must have at most 30 digits", "")
    if _FLOAT.fullmatch(text):
        value = float(text)
        return (value, "", "") if math.isfinite(value) else (0.0, f"{text[:40]}, must be a finite number", "")
    if _NOT_FINITE.fullmatch(text):
        return 0.0, f"{text}, must be a finite number", ""
    if _ODD_WORD.fullmatch(text):
        return text, "", "write true or false"
    if _ODD_NUMBER.fullmatch(text):
        return text, "", "write it as a plain decimal"
    return text, "", ""


class _EventReader:
    """Builds nodes from the parser's events, within the bounds, so that nothing is expanded before it is weighed."""

    def __init__(self, text: str, source: str, line: int) -> None:
        self.events: Iterator[Any] = yaml.parse(text, Loader=_Parser)
        self.source = source
        self.first_line = line
        self.weight = 0
        self.anchors: dict[str, tuple[Node, int, int] | None] = {}
        """By anchor: its node, weight and height; None while it is still open."""

    def line(self, event: Any) -> int:
        return self.first_line + int(event.start_mark.line) if self.first_line else 0

    def fail(self, event: Any, what: str) -> ScenarioError:
        return ScenarioError(f"{Node(None, self.source, self.line(event)).where}: {what}")

    def document(self) -> Node | None:
        root: Node | None = None
        documents = 0
        for event in self.events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise self.fail(event, "a second document begins here, must be one")
            elif not isinstance(event, yaml.StreamStartEvent | yaml.StreamEndEvent | yaml.DocumentEndEvent):
                root = self.node(event, 1)[0]
        return root

    def node(self, event: Any, depth: int) -> tuple[Node, int]:
        """The node that begins with `event`, and its height (1 for a scalar)."""
        if isinstance(event, yaml.AliasEvent):
            return self.alias(event, depth)
        self.grow(event, depth, 1)
        before = self.weight
        if event.anchor is not None:
            self.anchors[event.anchor] = None
        if isinstance(event, yaml.ScalarEvent):
            node, height = self.scalar(event), 1
        elif isinstance(event, yaml.MappingStartEvent):
            node, height = self.mapping(event, depth)
        else:
            node, height = self.sequence(event, depth)
        if event.tag is not None:
            tag = event.tag.replace("tag:yaml.org,2002:", "!!")[:60]
            node = replace(node, problem=f"tag {tag} is not allowed, values are plain")
        if event.anchor is not None:
            self.anchors[event.anchor] = (node, self.weight - before + 1, height)
        return node, height

    def grow(self, event: Any, depth: int, weight: int) -> None:
        self.weight += weight
        if self.weight > MAX_WEIGHT:
            raise self.fail(event, f"more than {MAX_WEIGHT} values, aliases expanded, must be at most that")
        if depth > MAX_DEPTH:
            raise self.fail(event, f"{depth} levels deep, must be at most {MAX_DEPTH}")

    def alias(self, event: Any, depth: int) -> tuple[Node, int]:
        if event.anchor not in self.anchors:
            raise self.fail(event, f"alias *{event.anchor[:60]} has no anchor before it")
        known = self.anchors[event.anchor]
        if known is None:
            raise self.fail(event, f"alias *{event.anchor[:60]} stands inside its own anchor")
        node, weight, height = known
        self.grow(event, depth + height - 1, weight)
        return node, height

    def scalar(self, event: Any) -> Node:
        text = event.value
        self.grow(event, 0, len(text) // 100)
        if not event.implicit[0]:  # quoted, a block, or tagged
            return Node(text, self.source, self.line(event), json.dumps(text, ensure_ascii=False))
        value, problem, doubt = read_scalar(text)
        shown = json.dumps(text, ensure_ascii=False) if isinstance(value, str) and not doubt else text
        return Node(value, self.source, self.line(event), shown, problem, doubt)

    def sequence(self, start: Any, depth: int) -> tuple[Node, int]:
        entries, height = [], 1
        for event in self.events:
            if isinstance(event, yaml.SequenceEndEvent):
                break
            node, tall = self.node(event, depth + 1)
            entries.append(node)
            height = max(height, tall + 1)
        return Node(entries, self.source, self.line(start)), height

    def mapping(self, start: Any, depth: int) -> tuple[Node, int]:
        fields: dict[str, Node] = {}
        height = 1
        for event in self.events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            if not isinstance(event, yaml.ScalarEvent):
                raise self.fail(event, "a key must be a plain word")
            self.grow(event, depth + 1, 1 + len(event.value) // 100)
            key, line, plain_key = event.value, self.line(event), event.implicit[0]
            node, tall = self.node(next(self.events), depth + 1)
            node = replace(node, line=line)  # the key's line, the one a reader looks for
            if event.tag is not None or event.anchor is not None:
                node = replace(node, problem="tags and anchors on keys are not allowed")
            elif key == "<<" and plain_key:
                node = replace(node, problem="merge keys are not allowed, write the fields out")
            elif key in fields:
                first = fields[key].line
                node = replace(node, problem=f"duplicate key, first on line {first}" if first else "duplicate key")
            fields[key] = node
            height = max(height, tall + 1)
        return Node(fields, self.source, self.line(start)), height


def _read(text: str, source: str, line: int = 1) -> Node | None:
    """The text as nodes; None if there is none. `line` is the number of its first line, 0 for no numbers."""
    if odd := _UNPRINTABLE.search(text):
        at = Node(None, source, line and line + text.count("\n", 0, odd.start()))
        raise ScenarioError(f"{at.where}: character U+{ord(odd.group()):04X} is not allowed in YAML")
    try:
        return _EventReader(text, source, line).document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        row = mark.line if mark else 0
        at = Node(None, source, line and line + row)
        raise ScenarioError(f"{at.where}: {_syntax(text, row, line, error)}") from None
    except yaml.YAMLError as error:
        raise ScenarioError(f"{source}: not YAML, {str(error).splitlines()[0]}") from None


def _syntax(text: str, row: int, first_line: int, error: yaml.MarkedYAMLError) -> str:
    lines = text.splitlines()
    if row < len(lines) and "\t" in lines[row][: len(lines[row]) - len(lines[row].lstrip())]:
        return "a tab indents this line, must be spaces"
    context = f" {error.context}" if error.context else ""
    begun = error.context_mark.line if error.context_mark else row
    since = f" from line {first_line + begun}" if first_line and begun != row else ""
    return f"not YAML, {error.problem}{context}{since}"


# --- the writer ----------------------------------------------------------------------------------


class _Dumper(yaml.SafeDumper):
    """Quotes whatever the strict reader, or a reader of YAML 1.1, would take for something else than text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)  # list entries stand to the right of their key


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    value, problem, doubt = read_scalar(text)
    style = '"' if problem or doubt or not isinstance(value, str) or not text.isprintable() else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


def _represent_list(dumper: yaml.SafeDumper, entries: list[Any]) -> yaml.SequenceNode:
    flow = all(isinstance(x, int | float | str) or (isinstance(x, list) and len(x) <= 3) for x in entries)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", entries, flow_style=flow)


_Dumper.add_representer(str, _represent_text)
_Dumper.add_representer(list, _represent_list)
