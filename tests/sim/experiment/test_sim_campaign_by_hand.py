"""A campaign of twelve runs with figures worked out by hand: its report, its figures, and a row of its table."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from campaign_examples import plan, report_lines

from sortie.sim.experiment import figures, report
from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.plan import CampaignPlan
from sortie.sim.experiment.rows import CampaignRows
from sortie.sim.experiment.store import CampaignStore, columns
from sortie.sim.results.blocks import markdown

TEXT = """
campaign: by_hand
base: base.yaml
vary:
  fleet.formation.spacing_m: {kind: grid, values: [20, 40]}
replications: 3
policies: [worked, silence]
metrics: [bytes.data_sent, ap50.mission, energy_j.total]
seed: 5
"""
SPACING = "fleet.formation.spacing_m"
T95 = 4.302652729  # Student's, two degrees of freedom


def values(spacing_m: float, replication: int, policy: int) -> dict[str, float]:
    """Means of replications: `worked` sends 1300, 1400 and 1500 B, `silence` 2300, 2500 and 2700 B, and so on."""
    return {
        "bytes.data_sent": 1000.0 * (1 + policy) + 10 * spacing_m + 100 * replication * (1 + policy),
        "ap50.mission": (0.5 if policy == 0 else 0.28 + 0.01 * spacing_m) + 0.01 * replication,
        "energy_j.total": 7.0 + policy,
    }


def rows(tmp_path: Path, failed: dict[int, str] | None = None) -> CampaignRows:
    """All runs; those in `failed` have an error in place of values."""
    p, failed = plan(tmp_path, TEXT), failed or {}
    table: dict[str, list[Any]] = {}
    for run in range(p.runs):
        at = p.at(run)
        fields = p.varied(at.cell)
        row = {
            **at._asdict(),
            "policy": p.policies[at.policy],
            "seed": 90 + run,
            "error": failed.get(run, ""),
            **fields,
        }
        row["status"] = "failed" if run in failed else "done"
        made = values(fields[SPACING], at.replication, at.policy)
        row |= dict.fromkeys(made) if run in failed else made
        for name, value in row.items():
            table.setdefault(name, []).append(value)
    kinds = columns(p)
    made_table = pa.table({name: pa.array(v, kinds[name]) if name in kinds else v for name, v in table.items()})
    policy = np.array([p.at(run).policy for run in range(p.runs)])
    return CampaignRows(p, made_table, made_table["unit"].to_numpy(), policy)


def told(flown: CampaignRows, tmp_path: Path) -> str:
    return "\n".join(report_lines(flown, tmp_path))


def amount(mean: float, step: float) -> str:
    """Of three values a step apart: Student's interval on a logarithmic scale, in thousands."""
    off = T95 * step / math.sqrt(3) / mean
    return f"{mean / 1e3:.4g} k [{mean * math.exp(-off) / 1e3:.4g} k, {mean * math.exp(off) / 1e3:.4g} k]"


def share(mean: float, step: float = 0.01) -> str:
    """Of three shares a step apart, on the logistic scale."""
    off, at = T95 * step / math.sqrt(3) / (mean * (1 - mean)), math.log(mean / (1 - mean))
    low, high = (1 / (1 + math.exp(-v)) for v in (at - off, at + off))
    return f"{mean:.4g} [{low:.4g}, {high:.4g}]"


def test_the_report_s_tables_have_each_policy_s_means_in_its_column(tmp_path: Path) -> None:
    """Differences: 1000, 1100 and 1200 B; 0.08 of AP in each replication; 1 J. In parts, one spacing's runs alone."""
    text = told(rows(tmp_path), tmp_path)
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    apart = f"+1.1 k [{1.1 - T95 * 0.1 / math.sqrt(3):.4g} k, {1.1 + T95 * 0.1 / math.sqrt(3):.4g} k] ×5"
    assert lines == [
        "| metric | worked | silence |",
        f"| bytes.data_sent | {amount(1400, 100)} | {amount(2500, 200)} |",
        f"| ap50.mission | {share(0.51)} | {share(0.59)} |",
        "| energy_j.total | 7 (all equal) | 8 (all equal) |",
        "| metric | silence |",
        f"| bytes.data_sent | {apart} |",
        "| ap50.mission | +0.08 (all equal) |",
        "| energy_j.total | +1 (all equal) |",
        "| ap50.mission | part | worked | silence |",
        f"| {SPACING} | 20 | {share(0.51)} | {share(0.49)} |",
        f"| {SPACING} | 40 | {share(0.51)} | {share(0.69)} |",
    ]
    assert "- ap50.mission against bytes.data_sent: no policy is better in both than worked, silence" in text
    assert "- ap50.mission against energy_j.total: no policy is better in both than worked, silence" in text
    assert "**ap50.mission**: silence has the best mean over everything." in text
    assert f"- {SPACING} 20: worked, surely: +0.02" in text
    assert f"- {SPACING} 40" not in text


def test_failed_runs_are_counted_listed_and_taken_out_with_their_replication(tmp_path: Path) -> None:
    """Run 4 is `worked` in the second replication: what is left are 1300 and 1500 B, and 2300 and 2700 B."""
    flown = rows(tmp_path, {4: "ValueError: planted"})
    text = told(flown, tmp_path)
    assert "12 of 12 runs: 3 replications × 2 grid points × 2 policies on the same draws; 1 failed." in text
    assert (
        "1 of the replications is left out of all means, where all runs of a policy at a grid point failed (worked 1)"
        in text
    )
    assert (
        f"- run 4 (worked, seed 94): ValueError: planted  \n  `sortie fly --from-campaign {tmp_path} --run 4`" in text
    )
    assert flown.by_unit("bytes.data_sent").tolist() == [[1300.0, 2300.0], [1500.0, 2700.0]]


def test_of_many_failures_the_first_twenty_are_listed(tmp_path: Path) -> None:
    p = plan(tmp_path, TEXT.replace("replications: 3", "replications: 6"))
    for count in (20, 21, 24):
        table = pa.table(
            {
                "run": list(range(24)),
                "policy": ["worked"] * 24,
                "seed": list(range(24)),
                "error": [f"e{k}" for k in range(24)],
                "status": ["failed"] * count + ["done"] * (24 - count),
            }
        )
        flown = CampaignRows(p, table, np.zeros(24, np.int64), np.zeros(24, np.int64))
        lines = markdown(report._failed(flown, tmp_path)).splitlines()
        assert [line.split(" ")[2] for line in lines if line.startswith("- run")] == [str(k) for k in range(20)]
        assert (f"The first 20 of {count}; the table's column `error` has all." in lines) == (count > 20)


class Drawn:
    """Keeps figures in place of files."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from matplotlib.figure import Figure

        self.figures: list[Any] = []
        monkeypatch.setattr(Figure, "savefig", lambda figure, path: self.figures.append(figure))

    def bars(self, row: int, column: int) -> dict[str, Any]:
        """The error bars of a panel, by label: places and means."""
        axes = self.figures[-1].axes[row * self.columns + column]
        found = {}
        for bar in axes.containers:
            line = bar.lines[0]
            found[bar.get_label()] = np.column_stack(line.get_data()).tolist()
        return found

    columns = 1


def test_each_panel_draws_its_metric_over_its_field_a_line_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = Drawn(monkeypatch)
    assert figures.draw_varied(rows(tmp_path), tmp_path / "varied.png")
    aside = figures.APART * 20 / 2
    panels = (
        ("bytes.data_sent, MB", (0.0013, 0.0015), (0.0024, 0.0026)),
        ("ap50.mission", (0.51, 0.51), (0.49, 0.69)),
        ("energy.total, kJ", (0.007, 0.007), (0.008, 0.008)),
    )
    for k, (metric, worked, silence) in enumerate(panels):
        assert drawn.figures[0].axes[k].get_ylabel() == metric
        assert drawn.bars(k, 0) == {
            "worked": [[20 - aside, pytest.approx(worked[0])], [40 - aside, pytest.approx(worked[1])]],
            "silence": [[20 + aside, pytest.approx(silence[0])], [40 + aside, pytest.approx(silence[1])]],
        }
    assert drawn.figures[0].axes[2].get_xlabel() == SPACING


def test_each_panel_draws_accuracy_over_its_cost_a_point_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = Drawn(monkeypatch)
    drawn.columns = 2
    assert figures.draw_pareto(rows(tmp_path), tmp_path / "pareto.png")
    for column, (price, worked, silence) in enumerate(
        (("bytes.data_sent, MB", 0.0014, 0.0025), ("energy.total, kJ", 0.007, 0.008))
    ):
        axes = drawn.figures[0].axes[column]
        assert (axes.get_xlabel(), axes.get_ylabel()) == (price, "ap50.mission")
        wanted = {"worked": [[pytest.approx(worked), pytest.approx(0.51)]]}
        wanted |= {"silence": [[pytest.approx(silence), pytest.approx(0.59)]]}
        assert drawn.bars(0, column) == wanted


def test_a_row_of_the_table_is_its_run_s_own(tmp_path: Path) -> None:
    more = "  radio.path_loss: {kind: grid, values: [two_ray, free_space]}\n"
    more += "  context.trust: {kind: grid, values: [true, false]}\n"
    p: CampaignPlan = plan(tmp_path, TEXT.replace("replications:", more + "replications:"))
    store, asked_of = CampaignStore(tmp_path / "a", p), tuple(p.campaign.metrics)
    schema = store.schema
    assert schema.field(SPACING).type == pa.float64()
    assert schema.field("radio.path_loss").type == schema.field("context.trust").type == pa.string()
    seen = set()
    for run in range(p.runs):
        at = p.at(run)
        task = p.task(run)
        found = dict(zip(asked_of, (1.0 + run, None, 3.0), strict=True))
        store.add([(task, Flight("", f"print{run}", found, f"key{run}"))])
        made = store.row(run)
        fields = p.varied(at.cell)
        place = {"run": run, "unit": at.unit, "cell": at.cell, "replication": at.replication}
        chosen = {"policy": p.policies[run % 2], "seed": p.seed(at.cell)}
        result = {"status": "done", "error": "", "fingerprint": f"print{run}", "key": f"key{run}"}
        metrics = {"bytes.data_sent": 1.0 + run, "ap50.mission": None, "energy_j.total": 3.0}
        varied = {**fields, "context.trust": json.dumps(fields["context.trust"])}
        assert made == {**place, **chosen, **result, **varied, **metrics}
        section = json.loads(task.scenario)
        assert section["fleet"]["formation"]["spacing_m"] == fields[SPACING]
        assert section["radio"]["path_loss"] == fields["radio.path_loss"]
        assert section["context"]["trust"] == fields["context.trust"]
        assert section["policy"]["name"] == ("worked", "silence")[at.policy]
        assert (task.seed, task.replication) == (p.seed(at.cell), at.replication)
        assert list(task.figures) == ["bytes.data_sent", "ap50.mission", "energy_j.total"]
        seen.add((at.cell % len(p.grid), at.replication, at.policy))
    assert len(seen) == p.runs == 8 * 3 * 2
    store.close()
    store = CampaignStore(tmp_path / "b", p)
    store.add([(p.task(3), Flight("boom", "", dict.fromkeys(asked_of), "k"))])
    failed = store.row(3)
    store.close()
    assert failed is not None
    assert (failed["status"], failed["error"], failed["energy_j.total"]) == ("failed", "boom", None)
