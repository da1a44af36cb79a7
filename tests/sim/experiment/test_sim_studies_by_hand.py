"""Policies over conditions, and decisions made again: every figure by hand, in its own row and column."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from policies_examples import fleet_of
from record_by_hand import told_outcome
from rich.table import Table

from sortie.perception.metrics.ap import Matched
from sortie.policies.contract import Directive, Disc, Reposition, Representation
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.cli import conditions as command
from sortie.sim.experiment import conditions, flight
from sortie.sim.experiment.conditions import Cell
from sortie.sim.results.views import Decision
from sortie.sim.studies.replay import compare
from sortie.sim.studies.replayed import NO_PEER, Difference, Replay

# --- conditions -----------------------------------------------------------------------------------------------------


def suite() -> ConditionSet:
    poor = {"name": "poor", "budget": 0.02, "set": ("fleet.drones=3",), "metric": "mission"}
    rich = {"name": "rich", "budget": 0.25, "metric": "full_scene"}
    sets = ("perception.detector=surrogate", "duration_s=1", "mission.phases=[{}]")
    return ConditionSet.model_validate(
        {"base": "track_target", "seeds": (3, 4), "set": sets, "conditions": (poor, rich)}
    )


def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Nothing flies: of two boxes the surer one is a hit under seed 3 alone; figures follow from the seed."""
    calls: list[tuple[Any, ...]] = []

    def run_sortie(scenario: Any, function: Any, seed: int, **_: Any) -> Any:
        calls.append((scenario.policy.name, scenario.policy.params, scenario.fleet.drones, seed))
        return SimpleNamespace(seed=seed, policy=scenario.policy.name, fingerprint="")

    def both_matched(made: Any) -> dict[str, dict[tuple[float, int], Matched]]:
        hits = np.array([made.seed == 3, made.policy == "all-4"])
        score = np.array([0.9, 0.8])
        return {"full_scene": {(1.0, 0): Matched(score, hits, 4)}, "mission": {(2.0, 0): Matched(score, hits, 2)}}

    def outcome(made: Any) -> dict[str, Any]:
        made_up = told_outcome(off=float(made.seed))
        return made_up | {"deadline_miss_rate": None if made.policy == "silence" else 0.1 * made.seed}

    for name, fake in (("run_sortie", run_sortie), ("both_matched", both_matched), ("outcome", outcome)):
        monkeypatch.setattr(flight, name, fake)
    return calls


def test_every_policy_flies_every_condition_on_each_seed_within_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """AP is of both seeds' fusions together; bytes and energy are means: 22,000 B · (4 + 5) / 2, 11,600 J · 4.5."""
    calls, told = flown(monkeypatch), []
    cells = conditions.fly_conditions(suite(), ["all-4", "silence"], progress=lambda *p: told.append(p))
    assert calls == [
        (policy, {"received_budget": budget} if policy == "all-4" else {}, drones, seed)
        for policy in ("all-4", "silence")
        for drones, budget in ((3, 0.02), (5, 0.25))
        for seed in (3, 4)
    ]
    assert told == [(policy, flights) for policy in ("all-4", "silence") for flights in (1, 2, 3, 4)]
    wanted = [(policy, condition) for policy in ("all-4", "silence") for condition in ("poor", "rich")]
    assert [(c.policy, c.condition) for c in cells] == wanted
    for c in cells:
        assert (c.data_bytes, c.energy_j) == (pytest.approx(99_000.0), pytest.approx(52_200.0))
        assert c.miss_rate == (None if c.policy == "silence" else pytest.approx(0.35))
    # all-4: hit and miss at 0.9, two hits at 0.8: of four cars three. silence: hit and miss at 0.9, two misses
    # in the whole scene there are twice as many cars
    assert cells[0].ap > cells[2].ap > 0.0
    for in_disc, in_scene in ((0, 1), (2, 3)):
        assert cells[in_disc].ap == pytest.approx(2 * cells[in_scene].ap)


def test_a_miss_rate_is_the_mean_over_the_seeds_that_sent_something(monkeypatch: pytest.MonkeyPatch) -> None:
    flown(monkeypatch)
    monkeypatch.setattr(
        flight, "outcome", lambda made: told_outcome() | {"deadline_miss_rate": 0.25 if made.seed == 3 else None}
    )
    assert [c.miss_rate for c in conditions.fly_conditions(suite(), ["worked"])] == [0.25, 0.25]


CELLS = [
    Cell("all-4", "poor", 0.4, 2e6, 3000.0, 0.1),
    Cell("all-4", "rich", 0.6, 4e6, 5000.0, 0.3),
    Cell("worked", "poor", 0.5, 1e6, 2000.0, 0.05),
    Cell("worked", "rich", 0.8, 3e6, 4000.0, 0.15),
    Cell("silence", "poor", 0.45, 0.0, 1000.0, None),
    Cell("silence", "rich", 0.3, 0.0, 1200.0, None),
]


def cells_of(table: Table) -> list[list[str]]:
    return [list(row) for row in zip(*(map(str, column.cells) for column in table.columns), strict=True)]


def test_a_condition_without_a_car_is_named_and_kept_as_null(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And a miss rate is the mean over the conditions that have one."""
    blind = [c if c.condition == "rich" else Cell(c.policy, "poor", math.nan, 1.0, 2.0, 0.3) for c in CELLS]
    shown: list[Any] = []
    monkeypatch.setattr(command, "fly_conditions", lambda *a, **k: blind)
    monkeypatch.setattr(command, "out", SimpleNamespace(width=150, print=lambda what, **how: shown.append(what)))
    command.compare_conditions(suite(), ["all-4", "worked", "silence"], [], tmp_path / "c.json")
    assert any(isinstance(s, str) and s.startswith("no car was to be seen in poor:") for s in shown)
    kept = json.loads((tmp_path / "c.json").read_text())
    assert [c["ap"] for c in kept["cells"]] == [None, 0.6, None, 0.8, None, 0.3]
    assert [r["ap"] for r in kept["summary"]] == [0.6, 0.8, 0.3]
    assert [r["miss_rate"] for r in kept["summary"]] == pytest.approx([0.3, 0.225, 0.3])


# --- decisions made again -------------------------------------------------------------------------------------------


def test_each_field_of_a_directive_that_differs_is_named_with_both_values() -> None:
    view = fleet_of(3)
    flown_ = (
        Directive(0, 1, Representation.FEATURES, 0.25, Disc(1.0, 2.0, 3.0), 10.0, 0.2, 0.5, 90, "in flight"),
        Directive(0, 2, Representation.DETECTIONS, 0.0, None, 2.0, reason="same"),
    )
    again = (
        Directive(0, 1, Representation.DETECTIONS, 0.0, None, 5.0, 0.3, 1.0, 100, "now"),
        Directive(0, 2, Representation.DETECTIONS, 0.0, None, 2.0, reason="other words"),
    )
    decision = Decision(1.5, 0, "worked", view, flown_, Reposition(4.0, 5.0, reason="from there"))
    link, looks = compare(decision, 7, again, None)
    fields = ("representation", "rho", "roi", "rate_hz", "deadline_s", "fusion_weight", "duty_percent")
    assert (link.t_s, link.drone, link.decision, link.peer, link.fields) == (1.5, 0, 7, 1, fields)
    before = ("features", "0.25", "(1.0, 2.0) m, 3.0 m", "10", "0.2", "0.5", "90")
    after = ("detections", "0", "everywhere", "5", "0.3", "1", "100")
    assert link.flown == ", ".join(f"{name} {value}" for name, value in zip(fields, before, strict=True))
    assert link.replayed == ", ".join(f"{name} {value}" for name, value in zip(fields, after, strict=True))
    assert (link.flown_reason, link.replayed_reason) == ("in flight", "now")
    assert (looks.peer, looks.fields) == (NO_PEER, ("viewpoint",))
    assert (looks.flown, looks.replayed) == ("(4.0, 5.0) m", "its slot")
    assert looks.flown_reason == "from there"
    missing = list(compare(decision._replace(viewpoint=None), 7, again[:1], None))
    assert [d.peer for d in missing] == [1, 2]
    assert missing[1].replayed_reason == "the policy gave no directive"


def difference(t_s: float, drone: int, decision: int, peer: int, *fields: str, reason: str = "r") -> Difference:
    return Difference(t_s, drone, decision, peer, fields, "rate_hz 10", "rate_hz 5", reason, f"{reason} now")


def replayed() -> Replay:
    """Forty decisions on 80 links: a span of three on 0→1, one beside it on 0→2, and one where drone 1 looks."""
    first = [difference(t / 10, 0, t, peer, "rate_hz") for t, peer in ((1, 1), (1, 2), (2, 1), (3, 1), (5, 1))]
    second = difference(0.6, 0, 6, 1, "rho", "rate_hz", reason="s")
    return Replay("worked", "boxes", 40, 80, (*first, second, difference(0.7, 1, 7, NO_PEER, "viewpoint", reason="s")))


def test_differences_that_follow_one_another_are_one_span() -> None:
    assert [(s.begin.t_s, s.begin.drone, s.begin.peer, s.end_s, s.decisions) for s in replayed().spans] == [
        (0.1, 0, 1, 0.3, 3),
        (0.1, 0, 2, 0.1, 1),
        (0.5, 0, 1, 0.5, 1),
        (0.6, 0, 1, 0.6, 1),
        (0.7, 1, NO_PEER, 0.7, 1),
    ]


def test_a_replay_s_tables_count_decisions_links_fields_and_reasons() -> None:
    """Six of forty decisions differ (0 in five of its own, 1 in one), six of eighty links."""
    total, _, why, first = replayed().summary()._parts
    assert isinstance(total, Table)
    fields = [["  in rate_hz", "6"], ["  in rho", "1"], ["  in viewpoint", "1"]]
    differ = [["decisions that differ", "6 (15.0 %)"], ["links that differ", "6 (7.5 %)"]]
    assert cells_of(total) == [["decisions", "40, for 80 links in all"], *differ, *fields]
    assert isinstance(why, Table)
    assert cells_of(why) == [["5", "0→1  0→2", "r", "r now"], ["2", "0→1  1 looks", "s", "s now"]]
    assert isinstance(first, Table)
    spans = ["0.1 0.3 0→1", "0.1 0.1 0→2", "0.5 0.5 0→1", "0.6 0.6 0→1", "0.7 0.7 1 looks"]
    assert [" ".join(row[:3]) for row in cells_of(first)] == spans
    assert cells_of(first)[0][3:] == ["rate_hz 10; r", "rate_hz 5; r now"]


def test_the_csv_of_a_replay_has_each_value_in_its_column(tmp_path: Path) -> None:
    with replayed().save(tmp_path / "d.csv").open() as file:
        read = list(csv.DictReader(file))
    place = {"t_s": "0.6", "drone": "0", "decision": "6", "peer": "1", "fields": "rho rate_hz"}
    values = {"flown": "rate_hz 10", "replayed": "rate_hz 5", "flown_reason": "s", "replayed_reason": "s now"}
    assert read[5] == place | values
    assert [(r["drone"], r["decision"], r["peer"]) for r in read][-1] == ("1", "7", "-1")
    assert Replay("a", "b", 4, 8, ()).table.num_rows == 0
