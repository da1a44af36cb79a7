"""Means are over whole units of a campaign, the same for every policy."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from campaign_examples import CAMPAIGN, Pretended, failed, plan, report_lines, rows_of

from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.report import write_report
from sortie.sim.experiment.rows import CampaignRows, read_rows
from sortie.sim.experiment.winners import other_winners, rule, winner
from sortie.sim.folders import RunError

AP = "ap50.mission"


def test_a_unit_that_is_not_whole_moves_no_mean(tmp_path: Path) -> None:
    """Parts hold 30 rows, a draw at 22 grid points 44: what a cut off campaign has of the next draw is left out."""
    counts = ", ".join(map(str, range(1, 23)))
    text = CAMPAIGN.replace(
        "fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", f"fleet.drones: {{kind: grid, values: [{counts}]}}"
    )
    p, folder = plan(tmp_path, text.replace("replications: 2", "replications: 1")), tmp_path / "a"

    def drones(run: int) -> float:
        return float(p.varied(p.at(run).cell)["fleet.drones"])

    def counting(stop_after: int) -> Pretended:
        def change(task: Task, row: Flight) -> Flight:
            return replace(row, values=dict(zip(task.figures, (drones(task.number), 0.0), strict=True)))

        return Pretended(stop_after=stop_after, change=change)

    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, counting(40))
    with pytest.raises(RunError, match="a: no draw is finished at all its grid points yet, go on with the campaign"):
        read_rows(folder)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, counting(70))
    rows = read_rows(folder)
    assert (rows.all.num_rows, rows.table.num_rows) == (90, 88)
    assert rows.by_unit("bytes.data_sent") == pytest.approx(np.full((2, 2), 11.5))
    pytest.importorskip("matplotlib")
    told = write_report(folder).read_text()
    assert "2 of the runs are left out of all that follows: their draw is not finished at every grid point." in told
    assert "`stop_when` ended it" not in told


def test_a_failed_grid_point_takes_its_unit_with_it(tmp_path: Path) -> None:
    """Replications stand in for one another; without any of them the mean would be of other points."""
    rows = rows_of(tmp_path, CAMPAIGN, lambda fields, policy: fields["fleet.formation.spacing_m"] + policy)
    status, values = ["done"] * 48, rows.values("bytes.data_sent")
    for run in (0, 8, 10):  # one replication of draw 0; both of draw 1 at 20 m
        status[run], values[run] = "failed", math.nan
    table = rows.table.set_column(rows.table.schema.get_field_index("status"), "status", pa.array(status))
    table = table.set_column(table.schema.get_field_index("bytes.data_sent"), "bytes.data_sent", pa.array(values))
    left = CampaignRows(rows.plan, table, rows.unit, rows.policy)
    assert left.by_unit("bytes.data_sent").tolist() == [[30, 31]] * 5, "the other policy's mean of draw 1, too"
    assert left.lost().sum(axis=0).tolist() == [1, 0]


def test_a_policy_that_fails_where_it_is_hard_gains_nothing_by_it(tmp_path: Path) -> None:
    """It does worse by 1 everywhere, and fails in the two draws where all do worst."""
    pytest.importorskip("matplotlib")
    p, folder = plan(tmp_path), tmp_path / "a"
    hard = (0, 1)

    def picky(task: Task, row: Flight) -> Flight:
        unit, policy = p.at(task.number).cell // 2, task.number % 2
        if policy == 1 and unit in hard:
            return failed(task)
        return replace(row, values=dict(zip(task.figures, (100.0 * (unit in hard) + policy, 0.0), strict=True)))

    run_campaign(p, folder, Pretended(change=picky))
    rows = read_rows(folder)
    assert rows.by_unit("bytes.data_sent").mean(axis=0).tolist() == [0.0, 1.0]
    assert winner(rows, "bytes.data_sent") == "worked"
    said = "2 of the draws are left out of all means, where all runs of a policy at a grid point failed"
    assert f"{said} (best-2(received_budget=0.1) 2): policies are" in write_report(folder).read_text()


MISSES = CAMPAIGN.replace("metrics: [bytes.data_sent, energy_j.total]", "metrics: [deadline_miss_rate]").replace(
    "policies: [", "policies: [silence, "
)


def test_a_policy_that_sends_nothing_where_it_is_easy_loses_nothing_by_it(tmp_path: Path) -> None:
    """It misses 0.02 less wherever it sends; `silence` never sends, and takes nothing from the others."""

    def misses(fields: dict[str, float], policy: int) -> float | None:
        easy = fields["fleet.battery.initial_soc"] < 0.6
        if policy == 0 or (policy == 1 and easy):
            return None
        return (0.06 if easy else 0.47) + 0.02 * policy

    text = MISSES.replace("{count: 6}", "{count: 40}").replace("replications: 2", "replications: 1")
    rows = rows_of(tmp_path, text, misses, "deadline_miss_rate")
    assert rows.by_unit("deadline_miss_rate")[:, 1:] == pytest.approx(np.array([[0.49, 0.51]] * 20))
    assert winner(rows, "deadline_miss_rate") == "worked"
    assert other_winners(rows, "deadline_miss_rate") == []
    assert rule(rows, "deadline_miss_rate") is None, "no threshold gains, and none is hidden by the silent policy"
    told = "\n".join(report_lines(rows, tmp_path))
    assert "| deadline_miss_rate (40 of 80 scenes) | – | 0.49 (all equal) | 0.51 (all equal) |" in told
    assert "A scene is one replication of a draw at a grid point." in told
    assert "| deadline_miss_rate | – | – |\n" in told, "differences from a silent policy"


def test_a_grid_point_without_a_value_of_one_policy_is_left_out_for_all(tmp_path: Path) -> None:
    """At 20 m `worked` sends nothing in half of the draws; there the others' means are of 40 m alone, too."""

    def misses(fields: dict[str, float], policy: int) -> float | None:
        hidden = fields["fleet.battery.initial_soc"] < 0.6 and fields["fleet.formation.spacing_m"] == 20
        return (
            None if policy == 0 or (policy == 1 and hidden) else fields["fleet.formation.spacing_m"] / 100 + policy / 10
        )

    rows = rows_of(tmp_path, MISSES, misses, "deadline_miss_rate")
    means = rows.by_unit("deadline_miss_rate")
    assert sorted(means[:, 1].tolist()) == pytest.approx([0.4] * 3 + [0.5] * 3)
    assert means[:, 2] == pytest.approx(means[:, 1] + 0.1)


def test_policies_that_never_have_a_value_in_the_same_scene_are_not_compared(tmp_path: Path) -> None:
    def misses(fields: dict[str, float], policy: int) -> float | None:
        return 0.5 if (fields["fleet.battery.initial_soc"] < 0.6) == (policy == 1) else None

    rows = rows_of(tmp_path, MISSES, misses, "deadline_miss_rate")
    told = "\n".join(report_lines(rows, tmp_path))
    assert "No scene can be compared by deadline_miss_rate: left out of what follows." in told
    assert "## Where the winner changes" not in told


def test_a_policy_that_never_finishes_takes_no_other_with_it(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    p, folder = plan(tmp_path), tmp_path / "a"

    run_campaign(p, folder, Pretended(change=lambda task, row: failed(task) if task.number % 2 else row))
    assert np.isnan(read_rows(folder).by_unit("bytes.data_sent")).tolist() == [[False, True]] * 6
    assert "No run of best-2(received_budget=0.1) finished." in write_report(folder).read_text()


def rows_by_hand(values: list[tuple[int, int, int, float | None]], points: int) -> CampaignRows:
    """Runs of (unit, grid point, policy, value), in their order; a run without a value has failed."""
    made = pa.Table.from_pylist(
        [
            {"unit": u, "cell": u * points + g, AP: v, "status": "done" if v is not None else "failed", "x": float(u)}
            for u, g, _, v in values
        ]
    )
    units, policies = 1 + max(v[0] for v in values), 1 + max(v[2] for v in values)
    plan = SimpleNamespace(policies=["a", "b"][:policies], grid=[{}] * points, cells=units * points, units=units)
    plan.campaign = SimpleNamespace(vary=["x"])
    return CampaignRows(plan, made, made["unit"].to_numpy(), np.array([v[2] for v in values]))  # type: ignore[arg-type]


def test_a_mean_is_over_grid_points_and_each_of_them_over_its_replications() -> None:
    """Policy a: 2 and 5. Policy b: 6 and 9, as a replication without a value of policy a counts for neither."""
    first = [(0, 0, 0, 1.0), (0, 0, 1, 4.0), (0, 0, 0, 3.0), (0, 0, 1, 8.0)]
    second = [(0, 1, 0, None), (0, 1, 1, 7.0), (0, 1, 0, 5.0), (0, 1, 1, 9.0)]
    made = rows_by_hand([*first, *second], points=2)
    assert made.by_unit(AP).tolist() == [[3.5, 7.5]]
    counted, scenes = made.counted(AP)
    assert (counted.tolist(), scenes) == ([True] * 4 + [False] * 2 + [True] * 2, 4)


def test_a_unit_is_left_out_where_a_policy_is_lost_in_the_part_that_is_looked_at() -> None:
    """In unit 1 policy b fails at the second grid point: the first point has the unit, and the whole has not."""
    runs = [(u, g, p) for u in range(2) for g in range(2) for p in range(2)]
    values = [(u, g, p, None if (u, g, p) == (1, 1, 1) else 10.0 * u + g + p / 10) for u, g, p in runs]
    made = rows_by_hand(values, points=2)
    assert made.by_unit(AP).tolist() == [[0.5, pytest.approx(0.6)]]
    first = made.table["cell"].to_numpy() % 2 == 0
    assert made.by_unit(AP, first).tolist() == [[0.0, 0.1], [10.0, 10.1]]


def test_a_part_of_a_field_holds_its_lower_end_and_stands_at_the_mean_of_its_values() -> None:
    """Nine values from 0 to 9, without 7 and with quartiles 2, 4 and 6; values of a grid are parts of their own."""
    column = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 9.0]
    made = rows_by_hand([(u, 0, 0, 0.5) for u in range(9)], points=1)
    made = replace(made, table=made.table.set_column(4, "x", pa.array(column)))
    parts = made.bins("x")
    assert [label for label, _, _ in parts] == ["0 … 2", "2 … 4", "4 … 6", "6 … 9"]
    assert [np.array(column)[mask].tolist() for _, _, mask in parts] == [[0, 1], [2, 3], [4, 5], [6, 8, 9]]
    assert [place for _, place, _ in parts] == pytest.approx([0.5, 2.5, 4.5, 23 / 3])
