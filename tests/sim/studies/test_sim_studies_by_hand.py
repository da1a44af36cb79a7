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
from sortie.sim.results.views import Decision
from sortie.sim.studies import conditions
from sortie.sim.studies.conditions import Cell
from sortie.sim.studies.replay import compare
from sortie.sim.studies.replayed import NO_PEER, Difference, Replay

pytestmark = pytest.mark.slow

# --- conditions -----------------------------------------------------------------------------------------------------


def suite() -> ConditionSet:
    return ConditionSet.model_validate({
        "base": "track_target", "seeds": (3, 4), "set": ("perception.detector=surrogate", "duration_s=1", "mission.phases=[{}]"),
        "conditions": (
            {"name": "poor", "budget": 0.02, "set": ("fleet.drones=3",), "metric": "mission"},
            {"name": "rich", "budget": 0.25, "metric": "full_scene"},
        ),
    })  # fmt: skip


def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Nothing flies: a sortie finds one car of two, the surer box a hit under seed 3 alone; figures follow from the seed."""
    calls: list[tuple[Any, ...]] = []

    def run_sortie(scenario: Any, function: Any, seed: int, detector_of: Any) -> Any:
        calls.append((scenario.policy.name, scenario.policy.params, scenario.fleet.drones, seed, detector_of))
        return SimpleNamespace(seed=seed, policy=scenario.policy.name)

    def matched(made: Any, mission: bool) -> dict[tuple[float, int], Matched]:
        hits = [made.seed == 3, made.policy == "all-4"]
        return {(1.0 + mission, 0): Matched(np.array([0.9, 0.8]), np.array(hits), 2 if mission else 4)}

    def outcome(made: Any) -> dict[str, Any]:
        made_up = told_outcome(off=float(made.seed))
        return made_up | {"deadline_miss_rate": None if made.policy == "silence" else 0.1 * made.seed}

    for name, fake in (("run_sortie", run_sortie), ("matched", matched), ("outcome", outcome)):
        monkeypatch.setattr(conditions, name, fake)
    return calls


def test_every_policy_flies_every_condition_on_each_seed_within_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """AP is of both seeds' fusions together; bytes and energy are means: 22,000 B · (4 + 5) / 2, 11,600 J · 4.5."""
    calls, told = flown(monkeypatch), []
    maker = object()
    cells = conditions.fly_all(suite(), ["all-4", "silence"], progress=lambda *p: told.append(p), detector_of=maker)  # type: ignore[arg-type]
    assert [call[:4] for call in calls] == [
        ("all-4", {"received_budget": 0.02}, 3, 3), ("all-4", {"received_budget": 0.02}, 3, 4),
        ("all-4", {"received_budget": 0.25}, 5, 3), ("all-4", {"received_budget": 0.25}, 5, 4),
        ("silence", {}, 3, 3), ("silence", {}, 3, 4), ("silence", {}, 5, 3), ("silence", {}, 5, 4),
    ]  # fmt: skip
    assert {call[4] for call in calls} == {maker}
    assert told == [("all-4", 1), ("all-4", 2), ("silence", 1), ("silence", 2)]
    assert [(c.policy, c.condition) for c in cells] == [
        ("all-4", "poor"),
        ("all-4", "rich"),
        ("silence", "poor"),
        ("silence", "rich"),
    ]
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
        conditions, "outcome", lambda made: told_outcome() | {"deadline_miss_rate": 0.25 if made.seed == 3 else None}
    )
    assert [c.miss_rate for c in conditions.fly_all(suite(), ["worked"])] == [0.25, 0.25]


CELLS = [
    Cell("all-4", "poor", 0.4, 2e6, 3000.0, 0.1), Cell("all-4", "rich", 0.6, 4e6, 5000.0, 0.3),
    Cell("worked", "poor", 0.5, 1e6, 2000.0, 0.05), Cell("worked", "rich", 0.8, 3e6, 4000.0, 0.15),
    Cell("silence", "poor", 0.45, 0.0, 1000.0, None), Cell("silence", "rich", 0.3, 0.0, 1200.0, None),
]  # fmt: skip


def cells_of(table: Table) -> list[list[str]]:
    return [list(row) for row in zip(*(map(str, column.cells) for column in table.columns), strict=True)]


def test_the_command_prints_and_keeps_each_policy_s_own_figures(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Best fixed on the mean: all-4 with 0.5; of each condition 0.45 and 0.6, in the mean 0.525."""
    given: list[tuple[Any, ...]] = []

    def fly_all(asked: ConditionSet, policies: Any, *, progress: Any, detector_of: Any) -> list[Cell]:
        given.append((asked.set, tuple(policies)))
        progress("worked", 2)
        return CELLS

    shown: list[Any] = []
    monkeypatch.setattr(command, "fly_all", fly_all)
    monkeypatch.setattr(command, "out", SimpleNamespace(width=150, print=lambda what, **how: shown.append(what)))
    policies = ["all-4", "worked", "silence"]
    command.compare_conditions(suite(), policies, ["seed=9"], tmp_path / "c.json")
    assert given == [((*suite().set, "seed=9"), tuple(policies))]
    first, second = (part for part in shown if isinstance(part, Table))
    assert [str(c.header) for c in first.columns] == ["condition", "budget", *policies]
    assert cells_of(first) == [
        ["poor", "0.02", "0.400", "0.500", "0.450"], ["rich", "0.25", "0.600", "0.800", "0.300"],
    ]  # fmt: skip
    assert [str(c.header) for c in second.columns] == [
        "policy", "AP", "over all-4, 95 %", "of oracle", "data", "kJ", "missed",
    ]  # fmt: skip
    rows = cells_of(second)
    assert [row[:2] + row[3:] for row in rows] == [
        ["all-4", "0.500", "95%", "3.0 MB", "4.0", "20.0%"], ["worked", "0.650", "124%", "2.0 MB", "3.0", "10.0%"],
        ["silence", "0.375", "71%", "0 B", "1.1", "–"],
    ]  # fmt: skip
    assert rows[0][2] == "–"
    assert rows[1][2].startswith("+15.0 [")
    assert rows[2][2].startswith("-12.5 [")
    kept = json.loads((tmp_path / "c.json").read_text())
    assert [c["miss_rate"] for c in kept["cells"]] == [0.1, 0.3, 0.05, 0.15, None, None]
    assert [r["miss_rate"] for r in kept["summary"]] == [pytest.approx(0.2), pytest.approx(0.1), None]
    assert kept["cells"][3] == {
        "policy": "worked", "condition": "rich", "ap": 0.8, "data_bytes": 3e6, "energy_j": 4000.0, "miss_rate": 0.15,
        "flown_share": 1.0,
    }  # fmt: skip
    assert [(r["policy"], r["ap"], r["of_oracle"]) for r in kept["summary"]] == [
        ("all-4", pytest.approx(0.5), pytest.approx(0.5 / 0.525)), ("worked", pytest.approx(0.65), pytest.approx(0.65 / 0.525)),
        ("silence", pytest.approx(0.375), pytest.approx(0.375 / 0.525)),
    ]  # fmt: skip


def test_a_condition_without_a_car_is_named_and_kept_as_null(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And a miss rate is the mean over the conditions that have one."""
    blind = [c if c.condition == "rich" else Cell(c.policy, "poor", math.nan, 1.0, 2.0, 0.3) for c in CELLS]
    shown: list[Any] = []
    monkeypatch.setattr(command, "fly_all", lambda *a, **k: blind)
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
    assert link.flown == (
        "representation features, rho 0.25, roi (1.0, 2.0) m, 3.0 m, rate_hz 10, deadline_s 0.2, fusion_weight 0.5, duty_percent 90"
    )
    assert link.replayed == (
        "representation detections, rho 0, roi everywhere, rate_hz 5, deadline_s 0.3, fusion_weight 1, duty_percent 100"
    )
    assert (link.flown_reason, link.replayed_reason) == ("in flight", "now")
    assert (looks.peer, looks.fields, looks.flown, looks.replayed) == (
        NO_PEER,
        ("viewpoint",),
        "(4.0, 5.0) m",
        "its slot",
    )
    assert looks.flown_reason == "from there"
    missing = list(compare(decision._replace(viewpoint=None), 7, again[:1], None))
    assert [d.peer for d in missing] == [1, 2]
    assert missing[1].replayed_reason == "the policy gave no directive"


def difference(t_s: float, drone: int, decision: int, peer: int, *fields: str, reason: str = "r") -> Difference:
    return Difference(t_s, drone, decision, peer, fields, "rate_hz 10", "rate_hz 5", reason, f"{reason} now")


def replayed() -> Replay:
    """Forty decisions on 80 links: a span of three on 0→1, one beside it on 0→2, and one where drone 1 looks."""
    return Replay("worked", "boxes", 40, 80, (
        difference(0.1, 0, 1, 1, "rate_hz"), difference(0.1, 0, 1, 2, "rate_hz"), difference(0.2, 0, 2, 1, "rate_hz"),
        difference(0.3, 0, 3, 1, "rate_hz"), difference(0.5, 0, 5, 1, "rate_hz"), difference(0.6, 0, 6, 1, "rho", "rate_hz", reason="s"),
        difference(0.7, 1, 7, NO_PEER, "viewpoint", reason="s"),
    ))  # fmt: skip


def test_differences_that_follow_one_another_are_one_span() -> None:
    assert [(s.begin.t_s, s.begin.drone, s.begin.peer, s.end_s, s.decisions) for s in replayed().spans] == [
        (0.1, 0, 1, 0.3, 3), (0.1, 0, 2, 0.1, 1), (0.5, 0, 1, 0.5, 1), (0.6, 0, 1, 0.6, 1), (0.7, 1, NO_PEER, 0.7, 1),
    ]  # fmt: skip


def test_a_replay_s_tables_count_decisions_links_fields_and_reasons() -> None:
    """Six of forty decisions differ (0 in five of its own, 1 in one), six of eighty links."""
    total, _, why, first = replayed().summary()._parts
    assert isinstance(total, Table)
    assert cells_of(total) == [
        ["decisions", "40, for 80 links in all"], ["decisions that differ", "6 (15.0 %)"], ["links that differ", "6 (7.5 %)"],
        ["  in rate_hz", "6"], ["  in rho", "1"], ["  in viewpoint", "1"],
    ]  # fmt: skip
    assert isinstance(why, Table)
    assert cells_of(why) == [["5", "0→1  0→2", "r", "r now"], ["2", "0→1  1 looks", "s", "s now"]]
    assert isinstance(first, Table)
    assert [row[:3] for row in cells_of(first)] == [
        ["0.1", "0.3", "0→1"], ["0.1", "0.1", "0→2"], ["0.5", "0.5", "0→1"], ["0.6", "0.6", "0→1"], ["0.7", "0.7", "1 looks"],
    ]  # fmt: skip
    assert cells_of(first)[0][3:] == ["rate_hz 10; r", "rate_hz 5; r now"]


def test_the_csv_of_a_replay_has_each_value_in_its_column(tmp_path: Path) -> None:
    with replayed().save(tmp_path / "d.csv").open() as file:
        read = list(csv.DictReader(file))
    assert read[5] == {
        "t_s": "0.6", "drone": "0", "decision": "6", "peer": "1", "fields": "rho rate_hz", "flown": "rate_hz 10", "replayed": "rate_hz 5",
        "flown_reason": "s", "replayed_reason": "s now",
    }  # fmt: skip
    assert [(r["drone"], r["decision"], r["peer"]) for r in read][-1] == ("1", "7", "-1")
    assert Replay("a", "b", 4, 8, ()).table.num_rows == 0
