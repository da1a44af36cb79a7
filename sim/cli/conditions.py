"""`sortie compare` over a set of conditions."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from sortie.scenarios.report_text import number, percent, points, size
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.cli.console import bars, out, print_written
from sortie.sim.experiment.conditions import FIXED, Cell, best_fixed, fly_conditions, summarise
from sortie.sim.experiment.flight_file import users_file
from sortie.sim.folders import ensure_files, write_text


def compare_conditions(
    conditions: ConditionSet,
    policies: Sequence[str],
    sets: Sequence[str],
    out_file: Path | None,
    *,
    by_torch: bool = False,
    replace: bool = False,
) -> None:
    """Fly every policy in every condition, print AP by condition and the sums, keep both as JSON."""
    ensure_files(out_file, replace=replace, mark='{\n "summary": [')
    conditions = conditions.model_copy(update={"set": (*conditions.set, *sets)})
    with bars() as bar:
        each = {p: bar(p, len(conditions.conditions) * max(1, len(conditions.seeds))) for p in policies}
        cells = fly_conditions(
            conditions, policies, progress=lambda p, k: each[p](k), by_torch=by_torch, kept=users_file()
        )
    for table in _by_condition(conditions, policies, cells, out.width):
        out.print(table)
    if blind := list(dict.fromkeys(c.condition for c in cells if math.isnan(c.ap))):
        out.print(f"no car was to be seen in {', '.join(blind)}: no accuracy counts what was flown there")
    if gone := {
        c.condition: min(d.flown_share for d in cells if d.condition == c.condition)
        for c in cells
        if c.flown_share < 1.0
    }:
        least = ", ".join(f"{name} ({percent(share)} of drone-seconds flown)" for name, share in gone.items())
        out.print(f"not all drones flew all the time in {least}: AP is of those that fly")
    rows = summarise(cells)
    fixed = best_fixed(rows)
    flown = [p for p in policies if p in FIXED]
    oracle = "oracle" if flown else fixed
    table = _figures(
        "all conditions",
        "policy",
        "AP",
        f"over {fixed}, 95 %",
        f"of {oracle}",
        "data",
        "kJ",
        "missed",
    )
    for r in rows:
        gain = "–" if r.policy == fixed else points(r.gain, "+.1f")
        table.add_row(
            r.policy,
            f"{r.ap:.3f}",
            gain,
            "–" if r.of_oracle is None else f"{r.of_oracle:.0%}",
            size(r.data_bytes),
            f"{r.energy_j / 1e3:.1f}",
            "–" if r.miss_rate is None else f"{r.miss_rate:.1%}",
        )
    out.print(table)
    best = f", the best of {', '.join(flown)} (they follow one rule in every condition)" if flown else ""
    share = (
        "of oracle: share of the AP that the best of these in each condition would reach"
        if flown
        else f"of {fixed}: share of its AP"
    )
    out.print(
        f"over {fixed}: AP points over {fixed}{best}, and the interval of their mean over conditions; {share}; data and "
        "energy of a sortie; missed: payloads past their deadline",
        style="dim",
    )
    if out_file is not None:
        found = {
            "summary": [{**asdict(r), "gain": [_known(g) for g in r.gain]} for r in rows],
            "cells": [{**asdict(c), "ap": _known(c.ap)} for c in cells],
        }
        write_text(out_file, json.dumps(found, indent=1) + "\n")
        print_written("kept in", out_file)


def _known(figure: float) -> float | None:
    """As JSON has it, which has no NaN."""
    return None if math.isnan(figure) else figure


def _by_condition(
    conditions: ConditionSet, policies: Sequence[str], cells: Sequence[Cell], width: int
) -> Iterator[Table]:
    """AP of every policy in every condition, in as many tables as the terminal is too narrow for one."""
    at = {(c.policy, c.condition): c.ap for c in cells}
    left = width - max(len(c.name) for c in conditions.conditions) - 12
    rest = list(policies)
    while rest:
        few = [rest.pop(0)]
        while rest and sum(max(len(p), 5) + 2 for p in (*few, rest[0])) <= left:
            few.append(rest.pop(0))
        table = _figures("AP@0.5; of the mission where the fleet tracks", "condition", "budget", *few)
        for c in conditions.conditions:
            best = max(at[p, c.name] for p in policies)
            figures = ((number(at[p, c.name]), at[p, c.name] == best) for p in few)
            table.add_row(c.name, f"{c.budget:g}", *(Text(a, "bold" if is_ else "") for a, is_ in figures))
        yield table


def _figures(title: str, *columns: str) -> Table:
    """A narrow table whose figures stay whole; names in the first column may take several lines."""
    table = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0))
    for k, column in enumerate(columns):
        table.add_column(column, no_wrap=k > 0, overflow="ellipsis" if k else "fold")
    return table
