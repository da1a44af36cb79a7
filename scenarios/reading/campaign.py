"""A campaign file in, a `Study` out: the campaign, its base scenario, and everything varied held against the schema.

What is wrong is told as for scenarios, in one line with the campaign file's own place, before anything is flown.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sortie.scenarios.reading.files import found_beside
from sortie.scenarios.reading.load import (
    base_path,
    campaigns,
    load,
    load_conditions,
    read,
    shortened,
    tree,
    validated,
)
from sortie.scenarios.reading.nodes import MAX_DEPTH, Node, ScenarioError, as_node, assign, child, dotted, plain
from sortie.scenarios.reading.strict_yaml import read_scalar
from sortie.scenarios.remarks import unread
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.campaign import (
    Campaign,
    Choice,
    Column,
    Grid,
    Integers,
    Linspace,
    Normal,
    Spread,
    Triangular,
    Uniform,
)
from sortie.scenarios.tables import TableError, read_table

_LOG = logging.getLogger("sortie")


@dataclass(frozen=True, slots=True)
class Study:
    """A campaign as read."""

    campaign: Campaign
    base: Scenario
    """With `set` put in, and without its own expectations."""
    columns: dict[str, tuple[Any, ...]]
    """By varied field: the values of a file's column."""
    folder: Path
    """Where it lies: files that its policies are in are looked for there too."""
    root: Node
    """The file's own tree."""
    drones: int
    """At most so many in a run."""
    phases: int
    """At most so many in a run's mission, whether they begin before its end or not."""

    def where(self, *path: str | int) -> str:
        """`FILE:LINE: a.b` of a field of the campaign's file; the line of what is above a field that is left out."""
        node = self.root
        for part in path:
            node = child(node, part) or node
        return f"{node.where}: {dotted(path)}"


def load_campaign(path_or_name: str | Path) -> Study:
    """Read a campaign from a file, or from the library by its bare name.

    Raises:
        ScenarioError: one line that says which file, line and field, what is wrong and the bound; also of the base.
    """
    text, source = read(path_or_name, campaigns())
    root = tree(text, source)
    if isinstance(root.value, dict) and "campaign" not in root.value and "name" in root.value:
        raise ScenarioError(f"{source}: is a scenario, a campaign begins with `campaign: its_name` and names its base")
    campaign = validated(root, Campaign)
    here = Path(source).parent
    base = load(base_path(campaign.base, here, root))
    written = child(root, "set") or root
    sections = base.model_dump(mode="json", exclude_none=True) | {"expect": [], "expect_decisions": []}
    resolved = whole = as_node(
        sections, written.source, written.line
    )  # what set breaks elsewhere in the base is told there
    for name, node in _section(root, "set").items():
        resolved = _put(resolved, name, _relined(node))
    base = found_beside(validated(shortened(resolved, whole), Scenario), here)
    columns: dict[str, tuple[Any, ...]] = {}
    varied = _section(root, "vary")
    for name, spread in campaign.vary.items():
        if isinstance(spread, Column):
            columns[name] = _column(spread, here, varied[name])
    _check_lengths(campaign, columns, varied)
    sections = base.model_dump(mode="json", exclude_none=True)
    drones, phases = base.fleet.drones, len(base.mission.phases)
    for name, spread in campaign.vary.items():
        at, flat = varied[name], set[str | None]()
        resolved = as_node(sections, at.source, at.line)
        for row, value in enumerate(extremes(spread, columns.get(name, ())), 1):
            try:
                made = validated(_put(resolved, name, as_node(value, at.source, at.line)), Scenario)
            except ScenarioError as error:
                if not isinstance(spread, Column):
                    raise
                raise ScenarioError(f"{error} ({spread.file}: {spread.column} in row {row})") from None
            drones, phases = max(drones, made.fleet.drones), max(phases, len(made.mission.phases))
            flat.add(unread(made, name, set(campaign.vary)))
        if None not in flat and flat:
            _LOG.warning("%s: vary.%s: %s", at.where, name, flat.pop())
    return Study(campaign, base, columns, here, root, drones, phases)


def read_any(path_or_name: str | Path, overrides: Sequence[str] = ()) -> Scenario | None:
    """Read a scenario, a campaign or a set of conditions, whichever the file is, to see whether it can be read.

    Of a set of conditions, the scenario of every condition is read.

    Returns:
        The scenario, or a campaign's base; None for a set of conditions.

    Raises:
        ScenarioError: with everything that is wrong in `issues`.
    """
    text, source = read(path_or_name)
    root = tree(text, source)
    if child(root, "campaign") is not None:
        return load_campaign(path_or_name).base
    if child(root, "conditions") is not None and child(root, "name") is None:
        _check_conditions(path_or_name, source, overrides)
        return None
    return load(path_or_name, overrides)


def _check_conditions(path_or_name: str | Path, source: str, overrides: Sequence[str]) -> None:
    """Raises ScenarioError with what is wrong with the scenarios of all conditions, each thing at the first of them."""
    conditions = load_conditions(path_or_name)
    assert conditions is not None  # noqa: S101 (the caller looked)
    found: dict[str, str] = {}
    for condition in conditions.conditions:
        try:
            load(conditions.base, [*conditions.set, *overrides, *condition.set])
        except ScenarioError as error:
            for issue in error.issues:
                found.setdefault(issue, f"{source}: condition {condition.name}: {issue}")
    if found:
        first, *others = found.values()
        raise ScenarioError(first, [first, *others])


def _relined(node: Node) -> Node:
    return as_node(plain(node), node.source, node.line)


def _section(root: Node, name: str) -> dict[str, Node]:
    node = root.value.get(name) if isinstance(root.value, dict) else None
    return dict(node.value) if node is not None and isinstance(node.value, dict) else {}


def _put(root: Node, name: str, new: Node) -> Node:
    """`assign`, with a path that leads nowhere told at the line that names it."""
    parts = name.split(".")
    if len(parts) > MAX_DEPTH:
        raise ScenarioError(f"{new.where}: {len(parts)} levels deep, must be at most {MAX_DEPTH}")
    try:
        return assign(root, parts, new)
    except ScenarioError as error:
        raise ScenarioError(f"{new.where}{str(error).removeprefix(new.source)}") from None


def extremes(spread: Spread, column: tuple[Any, ...]) -> Iterator[Any]:
    """The values that a spread can take, or its ends; of one without ends its middle alone."""
    if isinstance(spread, Uniform | Triangular | Integers):
        yield from (spread.low, spread.high)
    elif isinstance(spread, Linspace):
        yield from (whole(end) for end in (spread.low, spread.high))
    elif isinstance(spread, Choice | Grid):
        yield from spread.values
    elif isinstance(spread, Column):
        yield from column
    elif isinstance(spread, Normal):
        yield from (end for end in (spread.low, spread.high) if end is not None)
        if spread.low is None and spread.high is None:
            yield spread.mean
    else:
        yield spread.median


def whole(value: float) -> float | int:
    """A whole number as one, so that it does where the schema asks for one (it does for a number as well)."""
    return int(value) if value == int(value) else value


def _column(spread: Column, here: Path, node: Node) -> tuple[Any, ...]:
    path = here / spread.file
    at = f"{node.where}: {path}"
    try:
        table = read_table(path, [spread.column])
    except TableError as error:
        raise ScenarioError(f"{node.where}: {error}") from None
    if spread.column not in table.columns:
        raise ScenarioError(f"{at}: no column {spread.column}, it has {', '.join(table.names) or 'nothing'}")
    cells = table.columns[spread.column].to_pylist()
    if not cells:
        raise ScenarioError(f"{at}: column {spread.column} has no rows, must have at least one")
    return tuple(_value(cell, table.decimal_comma) for cell in cells)


def _value(cell: Any, decimal_comma: bool) -> Any:
    """A text as a whole number or a number, if it is one as scenarios write them; else the cell itself."""
    if not isinstance(cell, str):
        return "" if cell is None else cell
    value, problem, doubt = read_scalar(cell.strip().replace(",", ".") if decimal_comma else cell.strip())
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and not (problem or doubt)
    return value if is_number else cell


def _check_lengths(campaign: Campaign, columns: dict[str, tuple[Any, ...]], varied: dict[str, Node]) -> None:
    first: dict[str, str] = {}
    for name, values in columns.items():
        spread = campaign.vary[name]
        assert isinstance(spread, Column)  # noqa: S101
        other = first.setdefault(spread.file, name)
        if len(columns[other]) != len(values):
            raise ScenarioError(f"{varied[name].where}: vary.{name}: {len(values)} rows, must be {len(columns[other])}")
