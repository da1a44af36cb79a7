"""How often links flap in `paper_replay_contention`, and what damping makes of it (`make figures FIGURE=replay_contention`).

The conditions were written down before the measurement: seeds 1 to 5, no detector, the scenario as it stands but for the
dwell time and the number of missed periods after which a link is degraded. Counted is what happens between 25 s, when all
links carry features even with the longest dwell time, and 60 s, when drone 2's links fade. There the story asks for 12
changes (10 by the phase, 2 by charge). Every other change comes from contention or from drones that sway in the wind.
"""

from __future__ import annotations

from collections.abc import Sequence

from research.validation.stored import Cell, Column, Table
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.transitions import transitions

SEEDS = range(1, 6)
DWELL_S = (0.0, 1.0, 2.0, 5.0, 10.0)
MISSED_PERIODS = (3, 5, 8)
CONDITIONS = [(3, dwell_s) for dwell_s in DWELL_S] + [(missed, 2.0) for missed in MISSED_PERIODS[1:]]
BEGIN_S, END_S = 25.0, 60.0


def counts(record: SortieRecord) -> tuple[int, int, int, float]:
    """Between `BEGIN_S` and `END_S`: changes, steps down for age and for goodput, and the share of time with features.

    The share is of the time in which links carry anything.
    """
    carried: dict[tuple[int, int], str] = {}
    since_s: dict[tuple[int, int], float] = {}
    changes, aged, slow, features_s, all_s = 0, 0, 0, 0.0, 0.0

    def spend(link: tuple[int, int], until_s: float) -> None:
        nonlocal features_s, all_s
        lasted_s = max(0.0, min(until_s, END_S) - max(since_s.get(link, 0.0), BEGIN_S))
        all_s += lasted_s * (carried.get(link, "nothing") != "nothing")
        features_s += lasted_s * carried.get(link, "nothing").startswith("features")

    for change in transitions(record.tables["directives"], {}):
        t_s, reason = change["t_s"], change["reason"]
        for peer in change["peers"]:
            link = (change["drone"], peer)
            spend(link, t_s)
            carried[link], since_s[link] = change["to"], t_s
            if BEGIN_S <= t_s < END_S:
                changes += 1
                aged += reason.startswith(("degraded", "detached"))
                slow += reason.startswith("goodput") and change["from"].startswith("features")
    for link in carried:
        spend(link, END_S)
    return changes, aged, slow, features_s / all_s


def table(seeds: Sequence[int] = SEEDS) -> Table:
    """A row a condition, means over the seeds."""
    columns = [
        Column("missed periods"), Column("dwell time", "g", " s"), Column("changes", ".0f"),
        Column("down for age", ".0f"), Column("down for goodput", ".0f"), Column("link-time with features", ".0f", " %", 100),
    ]  # fmt: skip
    rows: list[list[Cell]] = []
    for missed, dwell_s in CONDITIONS:
        bare = ["perception.detector=none", f"policy.dwell_s={dwell_s}", f"context.degraded_after_periods={missed}"]
        flown = [
            counts(run_sortie(load("paper_replay_contention", [*bare, f"seed={seed}", f"duration_s={END_S}"])))
            for seed in seeds
        ]
        rows.append([missed, dwell_s, *(sum(each) / len(flown) for each in zip(*flown, strict=True))])
    about = f"`paper_replay_contention`, {BEGIN_S:g} to {END_S:g} s, means over seeds {seeds[0]} to {seeds[-1]}."
    return Table(columns, rows, about)
