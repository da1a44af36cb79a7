"""What campaigns cost: the line through measured costs, and the table's rows."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from research.validation import campaign_scale
from research.validation.campaign_scale import QUANTITIES, Cost, MadeUp, fit, table
from sortie.scenarios.reading.campaign import load_campaign
from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.plan import make_plan

RUNS = (100, 300, 1000)
FLOWN = [Cost(n, True, 10 + 0.1 * n, 2 + 0.03 * n, 1 + 0.002 * n, 3e8 + 1000 * n, 2e4 + 350 * n) for n in RUNS]


def test_a_line_comes_back_and_says_how_far_it_is_off() -> None:
    line = fit(RUNS, [2 + 0.03 * n for n in RUNS])
    assert (line.a, line.b) == pytest.approx((2, 0.03))
    assert line.worst == pytest.approx(0, abs=1e-9)
    assert line.at(1_000_000) == pytest.approx(30_002)
    off = fit([100, 300, 1000], [5, 11, 64])
    assert off.worst == pytest.approx(max(abs(1 - off.at(n) / y) for n, y in zip(RUNS, (5, 11, 64), strict=True)))
    assert off.worst > 0.1


def test_costs_that_fall_give_a_line_that_does_not_fall() -> None:
    line = fit(RUNS, [3.0, 2.9, 2.8])
    assert line.b == 0
    assert line.a == pytest.approx(2.9, rel=0.01)


def test_the_table_tells_measured_rows_from_those_of_the_line() -> None:
    made = table(FLOWN, dataclasses.replace(FLOWN[-1], runs=100_000, flown=False, driver_cpu_s=150.0))
    how = [row[1] for row in made.rows]
    assert how[:6] == [*["flown"] * 3, "rows without flights", "by the line", "by the line"]
    assert list(made.rows[3]) == [100_000, "rows without flights", None, None, 150.0, FLOWN[-1].driver_peak_b, FLOWN[-1].store_b]  # fmt: skip
    assert made.rows[5][0] == 1_000_000
    assert made.rows[5][2:] == pytest.approx([100_010, 30_002, 2_001, 1.3e9, 350_020_000])
    text = made.markdown().splitlines()
    assert "| 1,000,000 | by the line | 100,010.0 s | 30,002.0 s | 2,001.0 s | 1,300.00 MB | 350.02 MB |" in text
    assert "| – | the line: each run | 100 ms | 30 ms | 2 ms | 1,000 B | 350 B |" in text
    assert len(made.columns) == 2 + len(QUANTITIES)


def test_made_up_rows_are_a_campaign_s(tmp_path: Path) -> None:
    """As many as there are runs, none failed, in batches that are no larger than a cluster's."""
    (tmp_path / "base.yaml").write_text(campaign_scale.BASE)
    (file := tmp_path / "scale.yaml").write_text(campaign_scale.CAMPAIGN.format(draws=210))
    plan, sizes = make_plan(load_campaign(str(file))), list[int]()

    class Watched(MadeUp):
        def rows(self, tasks):  # type: ignore[no-untyped-def]
            for rows in super().rows(tasks):
                sizes.append(len(rows))
                yield rows

    done = run_campaign(plan, tmp_path / "out", Watched())
    assert (done.finished, done.failed, sizes) == (420, 0, [200, 200, 20])
