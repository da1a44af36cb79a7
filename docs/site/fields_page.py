"""The schema for people and editors: the tables of `scenarios/README.md` and `scenarios/schema.json`, both made from the schema.

`python docs/site/fields_page.py` writes them anew; a test holds them to the schema.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sortie.scenarios.reading.explain import sections_of
from sortie.scenarios.report_text import replace_section, table
from sortie.scenarios.schema import Scenario, json_schema
from sortie.scenarios.schema.base import ModelName, PresetSection

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"
BEGIN, END = "<!-- fields:begin -->", "<!-- fields:end -->"
_SIGNS = {Ge: ("ge", "≥"), Gt: ("gt", ">"), Le: ("le", "≤"), Lt: ("lt", "<")}
_NAMES = {float: "number", int: "whole number", bool: "true, false", str: "text", NoneType: "nothing"}


def schema_text() -> str:
    """schema.json as it should stand."""
    return json.dumps(json_schema(), indent=1, ensure_ascii=False) + "\n"


def readme_text(old: str) -> str:
    """The README with its tables made anew; the rest stays."""
    return replace_section(old, f"{BEGIN}\n\n{fields_markdown()}\n{END}", BEGIN, END)


def fields_markdown() -> str:
    """One table a section: field, values, default, meaning."""
    lines: list[str] = []
    for path, section in _sections(Scenario, ""):
        rows = [
            (f"`{name}`", _values(field), _default(field), field.description or "Which event.")
            for name, field in section.model_fields.items()
            if not sections_of(field.annotation) or field.description
        ]
        lines += [f"**{path or 'top level'}**", "", *table(("field", "values", "default", "meaning"), rows), ""]
    return "\n".join(lines)


def _sections(section: type[BaseModel], path: str) -> Iterator[tuple[str, type[BaseModel]]]:
    yield path, section
    for name, field in section.model_fields.items():
        members = sections_of(field.annotation)
        if path == "fleet.makes[]" or (path == "fleet.groups[]" and name in ("formation", "route")):
            continue  # its sections stand in place of the fleet's, which are listed above
        for member in members:
            listed = "[]" if "tuple" in str(field.annotation) else ""
            kind = f" of kind {get_args(member.model_fields['kind'].annotation)[0]}" if len(members) > 1 else ""
            yield from _sections(member, f"{path}.{name}{listed}{kind}".lstrip("."))


def _values(field: FieldInfo) -> str:
    if names := _model_names(field.metadata):
        return names
    bounds = _bounds(field.metadata)
    return _type(field.annotation) + (f", {bounds}" if bounds else "")


def _model_names(metadata: list[Any] | tuple[Any, ...]) -> str:
    """The values of a field that names a model which can be replaced from outside."""
    known = next((item.builtin for item in metadata if isinstance(item, ModelName)), None)
    return "" if known is None else ", ".join([*(f"`{name}`" for name in known), "`path/to/file.py:Name`, a plug-in"])


def _bounds(metadata: list[Any] | tuple[Any, ...]) -> str:
    found = []
    for item in metadata:
        for part in getattr(item, "metadata", [item]):  # a FieldInfo inside Annotated holds its own list
            if type(part) in _SIGNS:
                key, sign = _SIGNS[type(part)]
                bound = getattr(part, key)
                found.append(f"{sign} {'2⁶³' if bound == 2**63 else f'{bound:g}'}")
    return ", ".join(found)


def _type(annotation: Any) -> str:
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        if names := _model_names(args[1:]):
            return names
        bounds = _bounds(args[1:])
        return _type(args[0]) + (f", {bounds}" if bounds else "")
    if origin is Literal:
        return ", ".join(f"`{arg}`" for arg in args)
    if sections := sections_of(annotation):
        if issubclass(sections[0], PresetSection):
            return f"{', '.join(f'`{name}`' for name in sections[0].presets)} or section"
        return "list of sections" if origin is tuple else "section"
    if origin is tuple:
        inner = "; ".join(dict.fromkeys(_type(arg) for arg in args if arg is not Ellipsis))
        return f"list of ({inner})" if Ellipsis in args else f"{len(args)} × {inner}"
    if origin in (Union, UnionType):
        return " or ".join(_type(arg) for arg in args if arg is not NoneType)
    if origin is dict:
        return f"names, each with {_type(args[1])}"
    return _NAMES[annotation]


def _default(field: FieldInfo) -> str:
    if field.default is PydanticUndefined:
        return "must be given"
    if field.default is None:
        return "–"
    if isinstance(field.default, BaseModel) or (field.default and sections_of(field.annotation)):
        return "its defaults"
    if isinstance(field.default, tuple | dict | str) and not field.default:
        return "none"
    text = f"{field.default:g}" if isinstance(field.default, float) else json.dumps(field.default)
    return text.strip('"')


def write() -> None:
    """Write schema.json and the README's tables anew."""
    readme = SCENARIOS / "README.md"
    for path, text in ((SCENARIOS / "schema.json", schema_text()), (readme, readme_text(readme.read_text("utf-8")))):
        fresh = path.with_name(f".{path.name}.new")
        fresh.write_text(text, "utf-8")
        fresh.replace(path)


if __name__ == "__main__":
    write()
