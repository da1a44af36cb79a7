"""The strict part of YAML 1.2 that scenarios are written in: text to nodes, plain values to text.

It has maps, lists, plain decimals, true and false, null, text,
anchors within bounds. What YAML 1.1 and 1.2 read differently (yes, on, 017, 1_000, 1:30) is refused
rather than guessed, and so are tags, merge keys and duplicate keys. No value is coerced: `'0.5'` is
text, `5.0` no whole number; a whole number does where a number is asked for.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import yaml

from sortie.scenarios.reading.nodes import MAX_DEPTH, Node, Scalar, ScenarioError

MAX_WEIGHT = 50_000
"""Values after alias expansion; long text counts once a hundred characters."""
_Parser: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # only its event stream is used

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


def read_yaml(text: str, source: str, line: int = 1) -> Node | None:
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
    if "nesting depth" in (error.problem or ""):  # libyaml 0.2.6 on has a limit of its own, far beyond this one
        return f"{MAX_DEPTH + 1} levels deep, must be at most {MAX_DEPTH}"
    context = f" {error.context}" if error.context else ""
    begun = error.context_mark.line if error.context_mark else row
    since = f" from line {first_line + begun}" if first_line and begun != row else ""
    return f"not YAML, {error.problem}{context}{since}"


def write_yaml(data: object) -> str:
    """Plain values as YAML that reads back as the same values."""
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100))


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
