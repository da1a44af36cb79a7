"""A ranking as a table for the terminal, as JSON and as a figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from sortie.scenarios.intervals import Estimate
from sortie.scenarios.report_text import NONE, interval, listed, number, percent, size
from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.places import Standing
from sortie.sim.experiment.rank import Ranked
from sortie.sim.results.summary import Summary, titled

SHOWN = 6
"""Policies that one sentence names."""


def place_text(place: tuple[int, int]) -> str:
    """A range of places.

    Example:
        >>> place_text((3, 3)), place_text((3, 7))
        ('3', '3–7')
    """
    return f"{place[0]}" if place[0] == place[1] else f"{place[0]}–{place[1]}"


def summary(ranked: Ranked) -> Summary:
    """The ranking as it is printed: tables of 80 columns, and what they say of the policies that were asked for."""
    tables: dict[str, dict[str, Callable[[Standing], str]]] = {
        f"{ranked.suite} ({ranked.digest}), {ranked.conditions} conditions, {ranked.detector}": {
            "AP, 95 % interval": lambda r: interval(r.score.mean, r.score.low, r.score.high, lambda v: f"{v:.3f}"),
            "mission": _of("ap50.mission", number),
            "full": _of("ap50.full_scene", number),
            "HOTA": _of("tracking.hota", number),
            "failed": lambda r: f"{len(r.failed)}" if r.failed else NONE,
        },
        "mission and cost, a sortie": {
            "found": _of("mission.target_detected_share", percent),
            "seen": _of("mission.region_observed_share", percent),
            "data": _of("bytes.data_sent", size),
            "missed": _of("deadline_miss_rate", percent),
            "energy": lambda r: number(r.energy_j / 1e3, ".2f", "kJ"),
        },
        "context, rules and time, a sortie": {
            "context": _of("bytes.context_sent", size),
            "radio": _of("energy_j.radio", lambda v: f"{v:.0f} J"),
            "unsafe": _of("policies.violated_ticks", lambda v: f"{v:.0f}"),
            "verified": lambda r: ranked.verified[r.policy].text,
            "decides": lambda r: number(ranked.decision_us(r.policy), ".0f", "µs"),
        },
    }
    return Summary(*(_table(ranked, title, columns) for title, columns in tables.items()), *sentences(ranked))


def _table(ranked: Ranked, title: str, columns: Mapping[str, Callable[[Standing], str]]) -> Table:
    table = titled(title, box=SIMPLE, padding=(0, 1, 0, 0))
    table.add_column("place", no_wrap=True)
    table.add_column("policy", overflow="fold")
    for column in columns:
        table.add_column(column, no_wrap=True, justify="right")
    for row in ranked.rows:
        cells = (text(row) for text in columns.values())
        style = "bold" if row.policy in ranked.entries else ""
        table.add_row(place_text(row.place), row.policy, *cells, style=style)
    return table


def _of(name: str, text: Callable[[float], str]) -> Callable[[Standing], str]:
    """A figure's mean in words; a dash where there is none."""

    def cell(row: Standing) -> str:
        mean = row.figures[name].mean
        return NONE if math.isnan(mean) else text(mean)

    return cell


def sentences(ranked: Ranked) -> Iterator[str | Text]:
    """What the tables say of the policies that were asked for, and how far they can be trusted."""
    for policy in ranked.entries:
        row, of = ranked.row(policy), len(ranked.rows)
        yield Text.assemble((policy, "bold"), f" takes place {place_text(row.place)} of {of}.")
        against = ranked.against(policy)
        for sign, words in ((1, "better than"), (-1, "worse than"), (0, "not separated from")):
            names = [p for p, pair in against.items() if pair.sign == sign]
            if names:
                yield f"  {words} {listed(_few(names))}"
        for condition in row.failed:
            yield f"  failed in {condition}: {ranked.flights[policy][condition].error}"
        if ranked.verified[policy].broken:
            yield f"  breaks the rules {listed(ranked.verified[policy].broken)}; `sortie verify` shows why"
    yield Text(
        "AP: average precision in the mission region in conditions with one, else in the full scene; 0 where a policy "
        "failed. Intervals cover conditions, each with its own town and draws. A place is a range where the paired "
        "differences, corrected for all pairs, do not separate policies. found, seen: share of the time with boxes on the "
        "target, share of the region in view. unsafe: decisions of a sortie after which a drone with a low battery sent more than boxes, "
        "or told no peer of the target in its region. verified: what `sortie verify` finds. decides: median time of a "
        "decision on this machine.",
        "dim",
    )
    if ranked.control is not None:
        further = len(ranked.control.suite.conditions) - ranked.conditions
        yield Text(
            f"AP is by {ranked.detector}, made more precise by the surrogate: it flew the same conditions and {further} "
            "further ones of the same kind (control variates; unbiased whatever the surrogate's error). Intervals of "
            f"differences are {ranked.width:.2f} times as wide as by {ranked.detector} alone. All other figures are of the "
            f"flights by {ranked.detector}.",
            "dim",
        )
    if ranked.stored is not None:
        yield Text(f"The built-in policies were flown with Sortie {ranked.stored}; --again flies them here.", "dim")
    if ranked.stale:
        yield Text(
            f"This version, {ranked.sortie}, flies otherwise than that one: the built-in policies' results are not "
            "its own. Use --again.",
            "yellow",
        )


def plain(ranked: Ranked) -> dict[str, Any]:
    """The ranking as JSON has it: every figure with its interval, every flight, every pair of the policies asked for."""
    return {
        "suite": ranked.suite,
        "digest": ranked.digest,
        "sortie": ranked.sortie,
        "built_in_flown_with": ranked.stored or ranked.sortie,
        "built_in_stale": ranked.stale,
        "detector": ranked.detector,
        "intervals": "95 %, over conditions, each with its own town and draws",
        "asked_for": list(ranked.entries),
        "policies": [
            {
                "policy": r.policy,
                "place": list(r.place),
                "score": _estimate(r.score),
                "failed": {c: ranked.flights[r.policy][c].error for c in r.failed},
                "verified": asdict(ranked.verified[r.policy]),
                "decision_us": _known(ranked.decision_us(r.policy)),
                "figures": {name: _estimate(e) for name, e in r.figures.items()},
            }
            for r in ranked.rows
        ],
        "differences": {
            policy: {other: _estimate(pair.difference) for other, pair in ranked.against(policy).items()}
            for policy in ranked.entries
        },
        "flights": _flights(ranked.flights),
        "by_surrogate": None if ranked.control is None else _flights(ranked.control.flights),
        "width_with_surrogate": ranked.width,
    }


def _flights(flights: Mapping[str, Mapping[str, Flight]]) -> dict[str, Any]:
    return {
        p: {c: {"error": f.error, "fingerprint": f.fingerprint, "values": dict(f.values)} for c, f in of.items()}
        for p, of in flights.items()
    }


def draw(ranked: Ranked, path: Path) -> Path:
    """AP over bytes, a point a policy with its interval; the line joins those that none beats in both.

    Raises:
        ImportError: matplotlib is missing (extra `report`).
    """
    from matplotlib.figure import Figure

    from sortie.sim.experiment.figures import on_front, whiskers

    figure = Figure(figsize=(10, 6.5), dpi=120, layout="constrained")
    ax = figure.subplots()
    rows = [r for r in ranked.rows if r.figures["bytes.data_sent"].count]  # the others failed everywhere
    sent, seen = [r.figures["bytes.data_sent"].mean / 1e6 for r in rows], [r.score.mean for r in rows]
    front = on_front(sent, seen)
    colours = [
        "tab:red" if row.policy in ranked.entries else "tab:blue" if best else "0.45"
        for row, best in zip(rows, front, strict=True)
    ]
    for row, x, y, colour in zip(rows, sent, seen, colours, strict=True):
        ax.errorbar(x, y, whiskers([row.score]), fmt="none", color=colour, lw=1.2, alpha=0.35, zorder=1)
        ax.plot(x, y, "o", ms=8, color=colour, zorder=3)
    line = sorted((x, y) for x, y, best in zip(sent, seen, front, strict=True) if best)
    ax.step([x for x, _ in line], [y for _, y in line], where="post", color="tab:blue", lw=1.2, zorder=2)
    ax.set_xscale("symlog", linthresh=1)
    ax.set_xlim(-0.15, 1.5 * max([*sent, 1.0]))
    low, high = ax.get_ylim()
    heights = _spread([(y - low) / (high - low) for y in seen])
    for row, x, y, height, colour in zip(rows, sent, seen, heights, colours, strict=True):
        ax.annotate(
            f"{place_text(row.place)}  {row.policy.rpartition('/')[2]}",
            (x, y),
            (1.04, height),
            textcoords="axes fraction",
            fontsize=11,
            va="center",
            color="0.1" if colour == "0.45" else colour,
            arrowprops={"arrowstyle": "-", "color": "0.75", "lw": 0.6},
        )
    ax.set_xlabel("payload bytes sent in a sortie, MB (linear below 1)", fontsize=13)
    ax.set_ylabel("AP@0.5, mean over conditions", fontsize=13)
    ax.tick_params(labelsize=12)
    ax.set_title(f"{ranked.suite} ({ranked.digest}), {ranked.detector}: places by AP, over bytes", fontsize=14)
    ax.grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _spread(heights: Sequence[float], apart: float = 0.044) -> list[float]:
    """Heights of labels, from the top down: near those of their points, and so far apart that none covers another."""
    steps = apart * np.arange(len(heights))
    down = np.minimum.accumulate(np.array(heights) + steps) - steps
    down[-1:] = np.maximum(down[-1:], 0.0)  # what was pushed below the axes goes up again
    found: list[float] = (np.maximum.accumulate((down + steps)[::-1])[::-1] - steps).tolist()
    return found


def _few(names: Sequence[str]) -> list[str]:
    shown = [*names[:SHOWN]]
    return shown if len(names) <= SHOWN else [*shown, f"{len(names) - SHOWN} more"]


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _estimate(estimate: Estimate) -> dict[str, float | None]:
    return {name: _known(value) for name, value in asdict(estimate).items()}
