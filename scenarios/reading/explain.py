"""Validation errors in the scenario's own words: which line, which field, which value, which bound."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from sortie.scenarios.reading.nodes import Issue, Node, Path, child, dotted, nearest, one_of
from sortie.scenarios.schema import Scenario

_WANTED = {
    "model_type": "a section",
    "dict_type": "a section",
    "tuple_type": "a list",
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
}
_BOUNDS = {
    "greater_than": ("gt", ">"),
    "greater_than_equal": ("ge", "≥"),
    "less_than": ("lt", "<"),
    "less_than_equal": ("le", "≤"),
}
_UNITS = frozenset(["m", "s", "hz", "mps", "db", "dbm", "ghz", "mhz", "mbps", "w", "wh", "mohm", "deg", "bytes", "km"])
CLOSE = 0.8
"""How alike (of difflib) a key of the same section must be to come before one that is spelt so elsewhere."""
_WITH_UNIT = re.compile(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?\s*[a-zµ°%/]", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?", re.IGNORECASE)


def explain(error: ValidationError, root: Node, top: type[BaseModel] = Scenario) -> list[Issue]:
    """The errors of a scenario's validation (or of another model on top), one issue a field, in pydantic's order."""
    wanted: dict[Path, list[str]] = {}  # a union reports each of its members: gather them into one line
    issues: dict[Path, Issue] = {}
    for detail in error.errors(include_url=False):
        path, node = _locate(root, detail)
        kind = detail["type"]
        if kind == "missing" and isinstance(path[-1], int):  # a point with too few coordinates
            issues[path[:-1]] = Issue(node, path[:-1], f"{node.shown()}, must have {path[-1] + 1} entries")
            continue
        if kind in ("too_short", "too_long") and not _length_is_wrong(detail, node):
            continue  # follows from an entry that is wrong itself
        if kind in _WANTED:
            wanted.setdefault(path, []).append(_WANTED[kind])
            what = f"{node.shown()}, must be {_wants(wanted[path])}{_hint(node, path, wanted[path])}"
            issues[path] = Issue(node, path, what)
        elif path not in issues:
            issues[path] = Issue(node, path, partial(_say, detail, node, path, root, top))
    return list(issues.values())


def _say(detail: ErrorDetails, node: Node, path: Path, root: Node, top: type[BaseModel]) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    if kind in _BOUNDS:
        key, sign = _BOUNDS[kind]
        return f"{node.shown()}, must be {sign} {_figure(context[key])}"
    if kind == "inconsistent":
        return f"{context['value']}, must be {context['bound']}"
    if kind == "extra_forbidden":
        return f"unknown key, {_known(path, root, top)}"
    if kind == "union_tag_not_found":
        kinds = [get_args(member.model_fields["kind"].annotation)[0] for member in candidates_at(path[:-1], root, top)]
        return f"missing, must be {one_of(kinds)}"
    if kind == "missing":
        return "missing, must be given"
    if kind == "literal_error":
        return f"{node.shown()}, must be {context['expected'].replace(chr(39), '')}{_meant(node, context['expected'])}"
    if kind == "model_name":
        names = context["expected"].replace(chr(39), "")
        listed = f"{names} or path/to/file.py:Name" if names else "path/to/file.py:Name"
        return f"{node.shown()}, must be {listed}{_meant(node, context['expected'])}"
    if kind == "union_tag_invalid":
        tags = re.findall(r"'(\w+)'", context["expected_tags"])
        return f"{node.shown()}, must be {one_of(tags)}{_meant(node, context['expected_tags'])}"
    if kind in ("too_short", "too_long"):
        bound = context.get("min_length", context.get("max_length"))
        few = "at least" if kind == "too_short" else "at most"
        return f"{node.shown()}, must have {few} {bound} {'entry' if bound == 1 else 'entries'}"
    if kind in ("string_too_short", "string_too_long"):
        bound = context.get("min_length", context.get("max_length"))
        few = "at least" if kind == "string_too_short" else "at most"
        return f"{len(str(node.value))} characters, must have {few} {bound}"
    if kind == "string_pattern_mismatch":
        return f"{node.shown()}, must match {context['pattern']}"
    if kind == "finite_number":
        return f"{node.shown()}, must be a finite number"
    return f"{node.shown()}, {detail['msg']}"


def _locate(root: Node, detail: ErrorDetails) -> tuple[Path, Node]:
    """The field's path as written in the file, and its node, or the nearest one above if it is missing."""
    loc = list(detail["loc"])
    if detail["type"] == "inconsistent":
        loc += detail["ctx"]["at"]
    if detail["type"].startswith("union_tag"):
        loc.append("kind")
    may_be_missing = detail["type"] in ("missing", "union_tag_not_found", "inconsistent")
    path: list[str | int] = []
    node = root
    for i, part in enumerate(loc):
        below = child(node, part)
        if below is not None:
            path.append(part)
            node = below
        elif may_be_missing and i == len(loc) - 1:
            path.append(part)
        # else it is pydantic's name for a member of a union, which is not in the file
    return tuple(path), node


def _length_is_wrong(detail: ErrorDetails, node: Node) -> bool:
    if not isinstance(node.value, Sequence):
        return True
    context = detail["ctx"]
    return not context.get("min_length", 0) <= len(node.value) <= context.get("max_length", len(node.value))


def _figure(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"


def _wants(names: Sequence[str]) -> str:
    distinct = dict.fromkeys(n for n in names if not (n == "a whole number" and "a number" in names))
    return one_of(", ".join(distinct).replace("true or false", "true, false").split(", "))


def _hint(node: Node, path: Path, wants: Sequence[str]) -> str:
    """What to write instead, where the slip is a common one."""
    number = {"a number", "a whole number"} & set(wants)
    if isinstance(node.value, str) and number:
        if node.doubt:
            return f", {node.doubt}" if re.search("[0-9]", node.value) else ""
        if _NUMBER.fullmatch(node.value):
            return ", write it without quotes"
        if _WITH_UNIT.match(node.value):
            name = next((part for part in reversed(path) if isinstance(part, str)), "")
            unit = f": the unit is in the name {name}" if name.rpartition("_")[2] in _UNITS else ""
            return f", write the number alone{unit}"
    if wants == ["a whole number"] and isinstance(node.value, float):
        return ", write it without a point"
    if wants == ["text"] and not isinstance(node.value, Mapping | list):
        return ", put it in quotes"
    if node.value is None and "a section" in wants:
        return ", or leave the line out for its defaults"
    return ""


def _meant(node: Node, expected: str) -> str:
    near = nearest(str(node.value), re.findall(r"'(\w+)'", expected))
    return f", did you mean {near}?" if near else ""


def _known(path: Path, root: Node, top: type[BaseModel] = Scenario) -> str:
    """What could have been meant by an unknown key."""
    key = str(path[-1])
    section = section_at(path[:-1], root, top)
    names = list(section.model_fields) if section else []
    homes = [f"in {dotted(at)}" if at else "at the top level" for at, name in _all_fields(top) if name == key]
    if close := difflib.get_close_matches(key[:80], names, n=1, cutoff=CLOSE):
        return f"did you mean {close[0]}?"
    if homes:
        return f"it belongs {one_of(homes)}"
    if near := nearest(key, names):
        return f"did you mean {near}?"
    return f"must be {one_of(names)}"


# --- the schema as a tree of sections ------------------------------------------------------------


def sections_of(annotation: Any) -> tuple[type[BaseModel], ...]:
    """The sections that a field of this type holds: itself, its list entries, or the members of a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return (annotation,)
    origin = get_origin(annotation)
    if origin is Annotated:
        return sections_of(get_args(annotation)[0])
    if origin is dict:
        return sections_of(get_args(annotation)[1])
    if origin in (Union, UnionType, tuple):
        return tuple(section for member in get_args(annotation) for section in sections_of(member))
    return ()


def section_at(path: Path, root: Node, top: type[BaseModel] = Scenario) -> type[BaseModel] | None:
    """The section of the schema that a mapping at `path` is held against."""
    node: Node | None = root
    for part in path:
        node = child(node, part) if node else None
    return _of_kind(candidates_at(path, root, top), node)


def candidates_at(path: Path, root: Node, top: type[BaseModel] = Scenario) -> tuple[type[BaseModel], ...]:
    """The sections of the schema that a mapping at `path` may be held against, one for each kind."""
    node: Node | None = root
    candidates: tuple[type[BaseModel], ...] = (top,)
    keyed = False  # the next part is a key that the file chooses, as below `vary`
    for part in path:
        section = None if keyed and isinstance(part, str) else _of_kind(candidates, node)
        node = child(node, part) if node else None
        if isinstance(part, str) and not keyed:
            field = section.model_fields.get(part) if section else None
            candidates = sections_of(field.annotation) if field else ()
            keyed = field is not None and get_origin(field.annotation) is dict
        else:
            keyed = False
    return candidates


def _of_kind(candidates: Sequence[type[BaseModel]], node: Node | None) -> type[BaseModel] | None:
    if len(candidates) == 1:
        return candidates[0]
    kind = child(node, "kind") if node else None
    return next((c for c in candidates if kind and get_args(c.model_fields["kind"].annotation) == (kind.value,)), None)


def _all_fields(section: type[BaseModel], path: Path = ()) -> Iterator[tuple[Path, str]]:
    for name, field in section.model_fields.items():
        if get_origin(field.annotation) is Literal and name == "kind":
            continue
        yield path, name
        below = sections_of(field.annotation)
        for member in below if len(below) == 1 else ():
            yield from _all_fields(member, (*path, name))
