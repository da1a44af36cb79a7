"""The built-in policies on the newest suite of `sortie rank`: their stored results, the table and the figure of docs/results/ranking.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from research.validation.stored import ROOT, Cell, Column, Table
from sortie.policies.registry import POLICIES, resolve
from sortie.scenarios.intervals import Estimate
from sortie.sim.experiment.board import draw, place_text
from sortie.sim.experiment.places import scores
from sortie.sim.experiment.rank import SUITE, Entry, Ranked, digest_of, fly, load_suite, rank
from sortie.sim.experiment.stored import made_now, read_results, save_results
from sortie.sim.experiment.verdict import verify

KEPT = "flights.sqlite"
PICTURE = ROOT / "docs/results/ranking.png"


def measure(work: Path, workers: int = 2) -> Mapping[str, Table]:
    """Fly every built-in policy, store the results in the package, draw the figure.

    Args:
        work: folder of the flights, so that a measurement that was cut off goes on.
        workers: number of processes.
    """
    flights = fly(load_suite(SUITE), dict.fromkeys(POLICIES), workers=workers, kept=work / KEPT)
    save_results(made_now(SUITE, digest_of(SUITE), flights, {p: verify(resolve(p), 120) for p in POLICIES}))
    return tables(work)


def tables(work: Path) -> Mapping[str, Table]:
    """The tables of the stored results; draws the figure too."""
    stored = read_results(SUITE, digest_of(SUITE))
    assert stored is not None
    ranked = rank([Entry(p) for p in stored.flights], work / KEPT)
    draw(replace(ranked, entries=()), PICTURE)
    return {"ranking": accuracy(ranked), "ranking_costs": costs(ranked)}


BY_TORCH = ("boxes", "worked", "silence")
"""Policies that are ranked by torch: one of the best of the surrogate's table, the paper's, and one that sends nothing."""


def by_torch(work: Path, workers: int = 2) -> Mapping[str, Table]:
    """Policies by the neural detector, with the surrogate as control variate and by torch alone.

    Args:
        work: folder of the flights, so that a measurement that was cut off goes on.
    """
    first, *others = BY_TORCH
    both = rank([Entry(first)], work / KEPT, against=others, by_torch=True, workers=workers)
    alone = rank([Entry(first)], work / KEPT, against=others, by_torch=True, further=0, workers=workers)
    assert both.control is not None
    cheap = scores(both.control.suite, both.control.flights)
    columns = [
        Column("place"), Column("policy"), Column("AP by torch, with the surrogate", ".3f"), Column("AP by torch alone", ".3f"),
        Column("AP by the surrogate in all conditions", ".3f"),
    ]  # fmt: skip
    rows = [
        [
            place_text(r.place), f"`{r.policy}`", _interval(r.score), _interval(alone.row(r.policy).score),
            float(np.mean(cheap[r.policy].ap)),
        ]
        for r in both.rows
    ]  # fmt: skip
    further = len(both.control.suite.conditions) - both.conditions
    about = (
        f"Suite `{both.suite}`, digest `{both.digest}`, Sortie {both.sortie}. Conditions: {both.conditions} by both detectors, "
        f"{further} further ones by the surrogate. Intervals of 95 % over conditions."
    )
    differences = [
        [f"`{p.policy}` minus `{p.other}`", _interval(p.difference), _interval(q.difference),
         p.difference.half_width / q.difference.half_width]
        for p, q in zip(both.pairs, alone.pairs, strict=True)
    ]  # fmt: skip
    pair_columns = [
        Column("difference of AP"), Column("with the surrogate", "+.3f"), Column("by torch alone", "+.3f"),
        Column("relative width", ".2f"),
    ]  # fmt: skip
    together = f"Intervals are corrected for {len(both.pairs)} pairs."
    return {
        "ranking_by_torch": Table(columns, rows, about),
        "ranking_by_torch_pairs": Table(pair_columns, differences, together),
    }


def accuracy(ranked: Ranked) -> Table:
    """Places, and what the fleet sees."""
    columns = [
        Column("place"), Column("policy"), Column("AP", ".3f"), Column("mission AP", ".3f"), Column("full-scene AP", ".3f"),
        Column("HOTA", ".3f"), Column("target found", ".0f", " %", 100), Column("region seen", ".0f", " %", 100),
    ]  # fmt: skip
    rows = [
        [
            place_text(r.place), f"`{r.policy}`", _interval(r.score), *(
                _interval(r.figures[name])
                for name in ("ap50.mission", "ap50.full_scene")
            ), *(
                _known(r.figures[name].mean)
                for name in ("tracking.hota", "mission.target_detected_share", "mission.region_observed_share")
            ),
        ]
        for r in ranked.rows
    ]  # fmt: skip
    return Table(
        columns,
        rows,
        f"{_suite(ranked)} {len(ranked.rows)} of {len(POLICIES)} built-in policies. Intervals of 95 % over conditions.",
    )


def costs(ranked: Ranked) -> Table:
    """What sharing costs, and which rules are kept."""
    columns = [
        Column("policy"), Column("data", ".2f", " MB", 1e-6), Column("context", ".0f", " kB", 1e-3),
        Column("missed", ".1f", " %", 100), Column("radio", ".0f", " J"), Column("energy", ".2f", " kJ", 1e-3),
        Column("unsafe decisions", ".0f"), Column("verified"), Column("decides", ".0f", " µs"),
    ]  # fmt: skip
    rows: list[list[Cell]] = [
        [
            f"`{r.policy}`", _interval(r.figures["bytes.data_sent"]), _known(r.figures["bytes.context_sent"].mean),
            _interval(r.figures["deadline_miss_rate"]), _known(r.figures["energy_j.radio"].mean), _known(r.energy_j),
            _interval(r.figures["policies.violated_ticks"]), ranked.verified[r.policy].text,
            _known(ranked.decision_us(r.policy)),
        ]
        for r in ranked.rows
    ]  # fmt: skip
    return Table(columns, rows, f"{_suite(ranked)} Means of a sortie, with 95 % intervals over conditions.")


def _suite(ranked: Ranked) -> str:
    return f"Suite `{ranked.suite}`, digest `{ranked.digest}`, flown with Sortie {ranked.stored}."


def _known(value: float) -> Cell:
    """Nothing in place of NaN, which a policy has that failed everywhere."""
    return None if math.isnan(value) else value


def _interval(estimate: Estimate) -> Cell:
    return None if estimate.count == 0 else (estimate.mean, estimate.low, estimate.high)
