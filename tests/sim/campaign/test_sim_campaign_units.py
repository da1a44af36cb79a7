"""Means are over whole units of a campaign, the same for every policy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from campaign_examples import CAMPAIGN, Pretended, plan, rows_of

from sortie.sim.campaign.drive import run_campaign
from sortie.sim.campaign.rows import CampaignRows, read_rows
from sortie.sim.campaign.winners import other_winners, rule, winner
from sortie.sim.campaign.work import RunResult
from sortie.sim.folders import RunError


def test_a_unit_that_is_not_whole_moves_no_mean(tmp_path: Path) -> None:
    """Parts hold 30 rows, a draw at 22 grid points 44: what a campaign that was cut off has of the next draw is left out."""
    counts = ", ".join(map(str, range(1, 23)))
    text = CAMPAIGN.replace(
        "fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", f"fleet.drones: {{kind: grid, values: [{counts}]}}"
    )
    p, folder = plan(tmp_path, text.replace("replications: 2", "replications: 1")), tmp_path / "a"

    def drones(run: int) -> float:
        return float(p.varied(p.at(run).cell)["fleet.drones"])

    class Counting(Pretended):
        def results(self, code: str, tasks: object) -> object:  # type: ignore[override]
            for rows in super().results(code, tasks):  # type: ignore[arg-type]
                yield [r._replace(values=(drones(r.run), 0.0)) for r in rows]

    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, Counting(stop_after=40))  # type: ignore[arg-type]
    with pytest.raises(RunError, match="a: no draw is finished at all its grid points yet, go on with the campaign"):
        read_rows(folder)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, Counting(stop_after=70))  # type: ignore[arg-type]
    rows = read_rows(folder)
    assert (rows.all.num_rows, rows.table.num_rows) == (90, 88)
    assert rows.by_unit("bytes.data_sent") == pytest.approx(np.full((2, 2), 11.5))
    pytest.importorskip("matplotlib")
    from sortie.sim.campaign.report import write_report

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
    from sortie.sim.campaign.report import write_report

    p, folder = plan(tmp_path), tmp_path / "a"
    hard = (0, 1)

    class Picky(Pretended):
        def results(self, code: str, tasks: object) -> object:  # type: ignore[override]
            for rows in super().results(code, tasks):  # type: ignore[arg-type]
                yield [self.one(r) for r in rows]

        def one(self, r: RunResult) -> RunResult:
            unit, policy = p.at(r.run).cell // 2, r.run % 2
            if policy == 1 and unit in hard:
                return RunResult(r.run, r.key, "failed", "ValueError: too hard", "", (None, None))
            return r._replace(values=(100.0 * (unit in hard) + policy, 0.0))

    run_campaign(p, folder, Picky())  # type: ignore[arg-type]
    rows = read_rows(folder)
    assert rows.by_unit("bytes.data_sent").mean(axis=0).tolist() == [0.0, 1.0]
    assert winner(rows, "bytes.data_sent") == "worked"
    said = "2 of the draws are left out of all means, where all runs of a policy at a grid point failed (best-2(received_budget=0.1) 2): policies are"
    assert said in write_report(folder).read_text()


MISSES = CAMPAIGN.replace("metrics: [bytes.data_sent, energy_j.total]", "metrics: [deadline_miss_rate]").replace(
    "policies: [", "policies: [silence, "
)


def test_a_policy_that_sends_nothing_where_it_is_easy_loses_nothing_by_it(tmp_path: Path) -> None:
    """It misses 0.02 less wherever it sends; `silence` never sends, and takes nothing from the others."""
    from sortie.sim.campaign.report import _lines

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
    told = "\n".join(_lines(rows, tmp_path, {"varied.png": False, "pareto.png": False}))
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


def test_a_rule_is_between_the_policies_that_have_values(tmp_path: Path) -> None:
    def misses(fields: dict[str, float], policy: int) -> float | None:
        return None if policy == 0 else 0.2 + 0.1 * ((fields["fleet.battery.initial_soc"] > 0.6) == (policy == 1))

    found = rule(rows_of(tmp_path, MISSES, misses, "deadline_miss_rate"), "deadline_miss_rate")
    assert found is not None
    assert (found.below, found.above) == ("worked", "best-2(received_budget=0.1)")


def test_policies_that_never_have_a_value_in_the_same_scene_are_not_compared(tmp_path: Path) -> None:
    from sortie.sim.campaign.report import _lines

    def misses(fields: dict[str, float], policy: int) -> float | None:
        return 0.5 if (fields["fleet.battery.initial_soc"] < 0.6) == (policy == 1) else None

    rows = rows_of(tmp_path, MISSES, misses, "deadline_miss_rate")
    told = "\n".join(_lines(rows, tmp_path, {"varied.png": False, "pareto.png": False}))
    assert "No scene can be compared by deadline_miss_rate: left out of what follows." in told
    assert "## Where the winner changes" not in told


def test_a_policy_that_never_finishes_takes_no_other_with_it(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from sortie.sim.campaign.report import write_report

    p, folder = plan(tmp_path), tmp_path / "a"

    class Broken(Pretended):
        def results(self, code: str, tasks: object) -> object:  # type: ignore[override]
            for rows in super().results(code, tasks):  # type: ignore[arg-type]
                yield [
                    RunResult(r.run, r.key, "failed", "ValueError: broken", "", (None, None)) if r.run % 2 else r
                    for r in rows
                ]

    run_campaign(p, folder, Broken())  # type: ignore[arg-type]
    assert np.isnan(read_rows(folder).by_unit("bytes.data_sent")).tolist() == [[False, True]] * 6
    assert "No run of best-2(received_budget=0.1) finished." in write_report(folder).read_text()
