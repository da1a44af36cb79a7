"""What a campaign's report is made of, against closed forms and planted truths."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, Pretended, failed, plan, report_lines, rows_of

from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.scenarios.report_text import prefixed
from sortie.scenarios.schema.campaign import SampledField
from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.figures import draw_pareto, draw_varied, on_front, whiskers, with_values
from sortie.sim.experiment.report import write_report
from sortie.sim.experiment.rows import CampaignRows, find_row, read_rows, short_names
from sortie.sim.experiment.sensitivity import _morris, _saltelli, sensitivity
from sortie.sim.experiment.spread import design
from sortie.sim.folders import RunError

TWO = CAMPAIGN.replace("  fleet.formation.spacing_m: {kind: grid, values: [20, 40]}\n", "").replace(
    "replications: 2", "replications: 1"
)

ONE_METRIC = TWO.replace("[bytes.data_sent, energy_j.total]", "[bytes.data_sent]")


def test_sobol_indices_of_ishigami_are_the_known_ones() -> None:
    """Ishigami and Homma 1990, a = 7, b = 0.1: S = 0.3139, 0.4424, 0; ST = 0.5576, 0.4424, 0.2437."""
    x = 2 * math.pi * design(SampledField(method="saltelli", count=2048), 3, seed=0) - math.pi
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    figures = _saltelli(3, y)
    assert figures[:, 0] == pytest.approx([0.3139, 0.4424, 0.0], abs=0.03)
    assert figures[:, 2] == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.03)
    assert np.array_equal(_saltelli(3, y), figures)  # its bootstrap draws the same each time


def test_morris_of_a_plane_is_its_slopes() -> None:
    x = design(SampledField(method="morris", count=12), 3, seed=1)
    assert x.shape == (48, 3)
    figures = _morris(x, x @ [3.0, -2.0, 0.0])
    assert figures[:, 0] == pytest.approx([3, 2, 0], abs=1e-9)
    assert figures[:, 2] == pytest.approx([0, 0, 0], abs=1e-9)


def test_the_order_of_rows_moves_no_sensitivity(tmp_path: Path) -> None:
    text = TWO.replace("{count: 6}", "{count: 8, method: saltelli}")
    rows = rows_of(tmp_path, text, lambda f, p: f["fleet.battery.initial_soc"] * (p + 1))
    found = sensitivity(rows, "bytes.data_sent", 0)
    assert found is not None
    assert found.figures[0, 2] == pytest.approx(1, abs=0.2)
    back = rows.table.take(pa.array(range(rows.table.num_rows - 1, -1, -1)))
    shuffled = CampaignRows(rows.plan, back, back["unit"].to_numpy(), rows.policy[::-1])
    again = sensitivity(shuffled, "bytes.data_sent", 0)
    assert again is not None
    assert np.array_equal(again.figures, found.figures)


@pytest.mark.parametrize(("method", "block"), [("saltelli", 4), ("morris", 3)])
def test_where_a_later_part_finished_first_sensitivity_is_of_the_complete_blocks(
    method: str, block: int, tmp_path: Path
) -> None:
    """The draws of a gap are not flown yet: it cuts into the second and the third of the eight blocks."""
    text = TWO.replace("{count: 6}", f"{{count: 8, method: {method}}}")
    text = text.replace("vary:\n", "vary:\n  fleet.formation.spacing_m: {kind: uniform, low: 20, high: 40}\n")

    def value(fields: dict[str, float], policy: int) -> float:
        return 100 * fields["fleet.battery.initial_soc"] + fields["fleet.formation.spacing_m"] ** 2

    rows = rows_of(tmp_path, text, value)

    def of_units(wanted: Callable[[np.ndarray], np.ndarray]) -> CampaignRows:
        some = wanted(rows.unit)
        return CampaignRows(rows.plan, rows.table.filter(pa.array(some)), rows.unit[some], rows.policy[some])

    gap = of_units(lambda unit: (unit < 2 * block - 1) | (unit >= 2 * block + 1))
    clean = of_units(lambda unit: (unit < block) | (unit >= 3 * block))
    found, wanted = (sensitivity(some, "bytes.data_sent", 1) for some in (gap, clean))
    assert found is not None
    assert wanted is not None
    assert found.used == wanted.used == 6 * block
    assert np.array_equal(found.figures, wanted.figures)
    whole = sensitivity(rows, "bytes.data_sent", 1)
    assert whole is not None
    assert not np.array_equal(found.figures, whole.figures)


def test_a_field_of_other_values_than_numbers_and_texts_has_its_effect(tmp_path: Path) -> None:
    text = TWO.replace("{count: 6}", "{count: 8, method: morris}")
    text = text.replace("vary:\n", "vary:\n  context.trust: {kind: choice, values: [true, false]}\n")
    rows = rows_of(tmp_path, text, lambda f, p: 3.0 * f["context.trust"])
    written = pa.array([json.dumps(value) for value in rows.table["context.trust"].to_pylist()])
    table = rows.table.drop_columns("context.trust").append_column("context.trust", written)
    found = sensitivity(replace(rows, table=table), "bytes.data_sent", 0)
    assert found is not None
    assert dict(zip(found.fields, found.figures[:, 0] > 0, strict=True)) == {
        "context.trust": True,
        "fleet.battery.initial_soc": False,
    }


def test_a_failed_run_takes_its_whole_block_with_it(tmp_path: Path) -> None:
    text = TWO.replace("{count: 6}", "{count: 8, method: saltelli}")
    calls = [0]

    def value(fields: dict[str, float], policy: int) -> float:
        calls[0] += 1
        return math.nan if calls[0] == 5 else fields["fleet.battery.initial_soc"]

    rows = rows_of(tmp_path, text, value)
    found = [sensitivity(rows, "bytes.data_sent", p) for p in (0, 1)]
    assert [f.used for f in found if f is not None] == [21, 24]


def test_the_front_holds_whom_nobody_beats() -> None:
    assert on_front([1, 2, 3, 3], [1, 3, 3, 2]) == [True, True, False, False]
    assert on_front([1, 1], [2, 2]) == [True, True]
    assert on_front([1, math.nan, 3], [1, 5, math.nan]) == [True, False, False], "without a value it stands nowhere"


def test_the_report_tells_all_of_it_and_the_same_each_time(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    p, folder = plan(tmp_path), tmp_path / "a"
    run_campaign(p, folder, Pretended(change=lambda task, row: failed(task) if task.number == 3 else row))
    text = write_report(folder).read_text()
    assert text == write_report(folder).read_text()
    for part in (
        "48 of 48 runs: 6 draws × 2 grid points × 2 replications × 2 policies on the same draws; 1 failed.",
        "- run 3 (best-2(received_budget=0.1), seed ",
        "ValueError: planted",
        f"sortie fly --from-campaign {folder} --run 3",
        "## Metrics by policy",
        "## By varied field",
        "## Sensitivity",
        "## Where the winner changes",
    ):
        assert part in text
    page = (folder / "report.html").read_text("utf-8")
    assert [f"## {heading}" for heading in re.findall("<h2>(.*)</h2>", page)] == re.findall("## .*", text)
    assert page.count("<tr>") == len(re.findall(r"^\|(?!---)", text, re.MULTILINE))
    assert page.count("data:image/png;base64,") == text.count("![") == 1
    assert (folder / "varied.png").stat().st_size > 10_000
    means = read_rows(folder).by_unit("bytes.data_sent")
    soc = [p.varied(2 * u)["fleet.battery.initial_soc"] for u in range(6)]
    assert means[:, 0] == pytest.approx([10 + s for s in soc])
    assert means[:, 1] == pytest.approx(soc)
    assert find_row(folder, 3)[1]["error"] == "ValueError: planted"
    with pytest.raises(RunError, match=r"--run 48: .* has runs 0 … 47"):
        find_row(folder, 48)
    assert pq.read_table(folder / "runs").num_rows == 48


def test_rates_stay_within_their_range_and_bytes_above_zero(tmp_path: Path) -> None:
    """Student's interval of the bare mean is [0.85, 1.06] for these misses, and begins below zero for these bytes."""
    rates, sent = iter([0.8, 1.0, 1.0, 1.0, 0.95, 0.98] * 2), iter([0.0] * 10 + [6e6, 3e6])
    metrics = "metrics: [deadline_miss_rate, bytes.data_sent]"
    text = TWO.replace("metrics: [bytes.data_sent, energy_j.total]", metrics)
    rows = rows_of(tmp_path, text, lambda fields, p: next(rates), "deadline_miss_rate")
    table = rows.table.append_column("bytes.data_sent", pa.array([next(sent) for _ in range(12)]))
    rows = CampaignRows(rows.plan, table, rows.unit, rows.policy)
    told = "\n".join(report_lines(rows, tmp_path))
    first = told.partition("Differences from")[0]
    for metric, highest in (("deadline_miss_rate", 1.0), ("bytes.data_sent", math.inf)):
        (line,) = (line for line in first.splitlines() if line.startswith(f"| {metric} |"))
        bounds = re.findall(r"\[([-\d.e]+)(?: [kMG])?, ([-\d.e]+)", line)
        assert len(bounds) == 2
        assert all(0 < float(low) < float(high) <= highest for low, high in bounds)
    e = mean_interval([0.8, 1.0, 1.0], SHARE)
    assert whiskers([e])[:, 0].tolist() == [e.mean - e.low, e.high - e.mean]


def test_of_a_metric_without_values_it_is_said_once_and_nothing_else(tmp_path: Path) -> None:
    """Warnings are errors here: no mean of nothing is taken, in words or in figures."""
    metrics = "metrics: [ap50.mission, ap50.full_scene, bytes.data_sent]"
    text = TWO.replace("metrics: [bytes.data_sent, energy_j.total]", metrics)
    rows = rows_of(tmp_path, text, lambda fields, p: 1.0 + p)
    seen = rows.table.append_column("ap50.full_scene", pa.array([0.5] * rows.table.num_rows))
    none = pa.array([None] * rows.table.num_rows, pa.float64())
    rows = CampaignRows(rows.plan, seen.append_column("ap50.mission", none), rows.unit, rows.policy)
    assert with_values(rows) == ["ap50.full_scene", "bytes.data_sent"]
    told = report_lines(rows, tmp_path)
    assert [line for line in told if "ap50.mission" in line] == [
        "| ap50.mission | – | – |",
        "No scene can be compared by ap50.mission: left out of what follows.",
    ]
    assert "- ap50.full_scene against bytes.data_sent: no policy is better in both than worked" in told
    pytest.importorskip("matplotlib")
    assert draw_varied(rows, tmp_path / "varied.png")
    assert draw_pareto(rows, tmp_path / "pareto.png")

    nothing = rows.table
    for metric in rows.plan.campaign.metrics:
        nothing = nothing.set_column(nothing.schema.get_field_index(metric), metric, none)
    rows = CampaignRows(rows.plan, nothing, rows.unit, rows.policy)
    told = report_lines(rows, tmp_path)
    assert [line for line in told if line.startswith("## ")] == ["## Metrics by policy", "## The rows"]
    assert not draw_varied(rows, tmp_path / "none.png")
    assert not draw_pareto(rows, tmp_path / "none.png")


def test_a_campaign_that_knew_enough_says_so_and_one_with_a_gap_was_not_ended_by_it(tmp_path: Path) -> None:
    """Its driver looks at parts in their order, and has not come to those behind the gap."""
    text = CAMPAIGN.replace("{count: 6}", "{count: 40}").replace(", energy_j.total]", "]")
    text += "stop_when: {metric: bytes.data_sent, half_width: 1000000, at_least: 3}\n"
    rows = rows_of(tmp_path, text, lambda fields, policy: 10.0 * fields["fleet.battery.initial_soc"] + policy)
    size = rows.plan.shard
    assert rows.table.num_rows > 3 * size

    def told_of_parts(*parts: int) -> str:
        table = pa.concat_tables([rows.table.slice(k * size, size) for k in parts])
        policy = np.concatenate([rows.policy[k * size : (k + 1) * size] for k in parts])
        return "\n".join(report_lines(CampaignRows(rows.plan, table, table["unit"].to_numpy(), policy), tmp_path))

    ended = "`stop_when` ended it: the interval of bytes.data_sent is narrow enough."
    assert ended in (enough := told_of_parts(0, 1))
    assert "the more so the smaller `at_least` is (here 3)." in enough
    assert ended not in told_of_parts(0, 2)


def test_draws_that_share_values_have_no_intervals_and_no_winners(tmp_path: Path) -> None:
    for method, why in (("morris", "Morris' levels"), ("saltelli", "Saltelli's blocks")):
        text = ONE_METRIC.replace("{count: 6}", f"{{count: 8, method: {method}}}")
        rows = rows_of(tmp_path, text, lambda fields, policy: fields["fleet.battery.initial_soc"] + policy)
        told = "\n".join(report_lines(rows, tmp_path))
        assert f"The draws are {why}" in told
        assert re.search(r"^\| bytes\.data_sent \| 0\.\d+ \| 1\.\d+ \|$", told, re.MULTILINE)
        assert "## Sensitivity" in told
        for part in ("## By varied field", "## Where the winner changes", "Differences from"):
            assert part not in told


def test_one_draw_gives_no_interval(tmp_path: Path) -> None:
    rows = rows_of(tmp_path, ONE_METRIC.replace("{count: 6}", "{count: 1}"), lambda fields, policy: policy)
    told = "\n".join(report_lines(rows, tmp_path))
    assert "1 draw × 1 replication × 2 policies" in told
    assert "One draw gives no interval: ask for more, by `sample.count`." in told


def test_a_folder_without_finished_parts_has_no_report(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_campaign(plan(tmp_path), tmp_path / "a", Pretended(stop_after=3))
    with pytest.raises(RunError, match="a: no part is finished yet, go on with the campaign"):
        read_rows(tmp_path / "a")


def test_a_metric_of_ones_own_has_a_table_by_varied_field_and_models_have_short_names(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    for name in ("own", "rain"):
        (tmp_path / f"{name}.py").write_text("def model(record):\n    return 1.0\n")
    vary = "radio.path_loss: {kind: grid, values: [two_ray, 'rain.py:model(db=3)']}"
    text = CAMPAIGN.replace("fleet.formation.spacing_m: {kind: grid, values: [20, 40]}", vary)
    text = text.replace("energy_j.total]", "metrics.own]")
    run_campaign(plan(tmp_path, text, BASE + "metrics: {own: {model: own.py:model}}\n"), tmp_path / "a", Pretended())
    told = write_report(tmp_path / "a").read_text().partition("## By varied field")[2]
    assert "| metrics.own | part |" in told
    assert "| radio.path_loss | rain.py:model(db=3) |" in told


def test_names_that_would_be_alike_stay_long_and_figures_of_an_interval_share_their_prefix() -> None:
    alike = ["/a/rain.py:Rain", "/b/rain.py:Rain"]
    assert short_names(alike) == {name: name for name in alike}
    assert short_names([*alike[:1], "level"]) == {"/a/rain.py:Rain": "rain.py:Rain", "level": "level"}
    assert prefixed(2317.0, 962.4, 3672.0) == ["2.317 k", "0.9624 k", "3.672 k"]
    assert prefixed(0.00149, 0.00078, 0.007) == ["0.00149", "0.00078", "0.007"]
    assert prefixed(math.nan, 12.0) == ["–", "12"]
