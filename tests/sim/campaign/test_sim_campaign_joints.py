"""When a campaign stops, what it says of its progress, and what its rules and means are made of, worked out by hand.

Held: `stop_when` with each of its options, units that are closed in time, counts of failed runs after a stop, the weights of
replications and grid points, the halves of a rule, the width of intervals over parts, and where a part of a field lies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from campaign_examples import plan

from sortie.scenarios.intervals import LEVEL, mean_interval
from sortie.scenarios.schema.campaign import StopWhen
from sortie.sim.campaign.drive import Progress, Stop, _drive
from sortie.sim.campaign.rows import CampaignRows
from sortie.sim.campaign.store import CampaignStore
from sortie.sim.campaign.winners import _best, _first, other_winners, rule
from sortie.sim.campaign.work import RunResult
from sortie.sim.results.outcome_fields import possible

NAN = math.nan
AP = "ap50.mission"
Values = list[list[list[float | None]]]
"""By policy, unit and replication."""
WIDE: Values = [[[0.4, 0.6], [0.5, 0.7], [0.6, 0.8]], [[0.5, 0.5], [0.5, 0.52], [0.51, 0.53]]]
"""Means 0.5, 0.6, 0.7 and 0.5, 0.51, 0.52."""


def stop(runs: int, policies: int = 2, **options: Any) -> Stop:
    asked = StopWhen(metric=AP, **({"half_width": 0.1, "at_least": 3} | options))
    campaign = SimpleNamespace(stop_when=asked)
    return Stop(SimpleNamespace(campaign=campaign, policies=["a", "b", "c"][:policies], runs=runs))  # type: ignore[arg-type]


def table(values: Values, first: int = 0, until: int | None = None) -> pa.Table:
    """The rows of these units, in the order of runs."""
    n = len(values)
    rows = [
        {"unit": u, "policy": "abc"[p], AP: values[p][u][r]}
        for u in range(len(values[0]))
        for r in range(len(values[0][u]))
        for p in range(n)
    ]
    rows = [{"run": k, **row} for k, row in enumerate(rows)][first:until]
    return pa.Table.from_pylist(
        rows, pa.schema([("run", pa.int64()), ("unit", pa.int64()), ("policy", pa.string()), (AP, pa.float64())])
    )


def width(means: list[float], level: float, *, difference: bool = False) -> float:
    within = possible(AP).of_differences() if difference else possible(AP)
    return mean_interval(means, within, level).half_width


@pytest.mark.parametrize("level", [0.9, 0.99])
def test_it_stops_where_the_widest_interval_at_its_level_is_narrow_enough(level: float) -> None:
    wanted = width([0.5, 0.6, 0.7], level)
    assert stop(12, half_width=wanted * 1.0001, confidence=level).enough(table(WIDE))
    assert not stop(12, half_width=wanted * 0.9999, confidence=level).enough(table(WIDE)), (
        "the second one's is narrower"
    )


def test_a_unit_counts_once_it_is_whole() -> None:
    """The third unit is whole with the next row of another, or with the last row of the campaign."""
    assert stop(12, half_width=1.0).enough(table(WIDE))
    assert not stop(16, half_width=1.0).enough(table(WIDE)), "more of the third unit may come"
    longer: Values = [[*policy, [0.5, 0.5]] for policy in WIDE]
    judged = stop(16, half_width=1.0)
    assert not judged.enough(table(longer, 0, 12))
    assert judged.enough(table(longer, 12))
    assert not stop(12, half_width=1.0, at_least=4).enough(table(WIDE))


def test_a_policy_that_lacks_values_has_fewer_units() -> None:
    lacking: Values = [WIDE[0], [[0.5, 0.5], [None, None], [0.51, None]]]
    assert not stop(12, half_width=1.0).enough(table(lacking))
    assert stop(12, half_width=1.0, at_least=2).enough(table(lacking))


def test_differences_are_of_one_unit_and_may_be_below_zero() -> None:
    """The second policy is 0.1, 0.11 and 0.12 below the first, whose own means are far apart."""
    below: Values = [[[0.4], [0.6], [0.8]], [[0.3], [0.49], [0.68]]]
    wanted = width([-0.1, -0.11, -0.12], 0.95, difference=True)
    assert wanted < 0.03
    assert stop(6, half_width=wanted * 1.0001, difference=True).enough(table(below))
    assert not stop(6, half_width=wanted * 0.9999, difference=True).enough(table(below))
    assert not stop(6, half_width=wanted * 1.0001).enough(table(below))


def test_differences_are_of_the_scenes_that_both_policies_have() -> None:
    """As above, beside scenes in which the second policy, or the first, has no value."""
    gaps: Values = [
        [[0.4, 0.0], [0.9, 0.6], [0.8, None]],
        [[0.3, None], [None, 0.49], [0.68, 0.1]],
    ]
    wanted = width([-0.1, -0.11, -0.12], 0.95, difference=True)
    assert stop(12, half_width=wanted * 1.0001, difference=True).enough(table(gaps))
    assert not stop(12, half_width=wanted * 0.9999, difference=True).enough(table(gaps))


def test_of_three_policies_every_difference_is_narrow_enough() -> None:
    three: Values = [[[0.4], [0.6], [0.8]], [[0.5], [0.7], [0.91]], [[0.1], [0.6], [0.9]]]
    assert not stop(9, 3, half_width=0.1, difference=True).enough(table(three))
    assert stop(6, 2, half_width=0.1, difference=True).enough(table(three[:2]))


@pytest.mark.parametrize("difference", [False, True])
def test_values_that_are_all_equal_end_a_campaign_from_thirty_units_on(difference: bool) -> None:
    def enough(units: int) -> bool:
        equal: Values = [[[0.5]] * units] * 2
        return stop(2 * units, half_width=0.1, at_least=2, difference=difference).enough(table(equal))

    assert [enough(units) for units in (2, 29, 30)] == [False, False, True]


def test_speed_and_time_left_are_of_what_this_driver_flew() -> None:
    made = Progress(finished=30, of=100, failed=2, flown=10, seconds=20.0)
    assert (made.per_second, made.left_s) == (0.5, 140.0)
    assert Progress(30, 100, 0, 0, 20.0).left_s == math.inf
    assert Progress(30, 100, 0, 10, 0.0).per_second == 0.0


class Engine:
    """Gives some results at a time."""

    workers = 1

    def __init__(self, at_once: int = 2) -> None:
        self.at_once = at_once

    def results(self, code: str, tasks: Iterator[Any]) -> Iterator[list[RunResult]]:
        runs = [RunResult(run, "", "done", "", "", (0.5,)) for run, _ in tasks]
        for k in range(0, len(runs), self.at_once):
            yield runs[k : k + self.at_once]


class Store:
    """Four parts of two runs, one unit each; the first part is there from the begin."""

    parts, failed = 4, 0

    def __init__(self) -> None:
        self.finished, self.dropped = 2, []  # type: ignore[var-annotated]

    def is_done(self, part: int) -> bool:
        return self.finished >= 2 * (part + 1)

    def missing(self) -> Iterator[int]:
        return iter(range(2, 8))

    def add(self, results: list[RunResult]) -> None:
        self.finished += len(results)

    def runs_of(self, part: int) -> range:
        return range(2 * part, 2 * part + 2)

    def part(self, part: int) -> pa.Table:
        return table([[[0.5], [0.51], [0.52], [0.53]]] * 2, 2 * part, 2 * part + 2)

    def drop_after(self, part: int) -> None:
        self.dropped.append(part)


def stopping(at_least: int) -> SimpleNamespace:
    """The plan of eight runs that may stop early."""
    campaign = SimpleNamespace(stop_when=StopWhen(metric=AP, half_width=0.2, at_least=at_least))
    return SimpleNamespace(campaign=campaign, policies=["a", "b"], runs=8, code="", task=lambda run: "", by_torch=False)


@pytest.mark.parametrize("at_least", [2, 9])
def test_a_driver_tells_all_that_it_flew_and_no_more_than_it_keeps(at_least: int) -> None:
    """Of two units it is known with the third part, in which the third unit begins."""
    store, told = Store(), list[Progress]()
    last = _drive(stopping(at_least), store, Engine(), 8, told.append)  # type: ignore[arg-type]
    known = [(p.finished, p.of, p.flown) for p in told]
    if at_least == 2:
        assert (known, store.dropped) == ([(2, 8, 0), (4, 8, 2)], [2])
        assert (last.finished, last.of, last.flown) == (6, 6, 4)
    else:
        assert (known, store.dropped) == ([(2, 8, 0), (4, 8, 2), (6, 8, 4), (8, 8, 6)], [])
        assert (last.finished, last.of, last.flown) == (8, 8, 6)


def test_what_was_flown_beyond_the_end_is_not_among_what_is_finished() -> None:
    store = Store()
    last = _drive(stopping(2), store, Engine(6), 8, lambda p: None)  # type: ignore[arg-type]
    assert (last.finished, last.of, last.flown, store.dropped) == (6, 6, 4, [2])


def test_failed_runs_that_are_dropped_are_counted_no_more(tmp_path: Path) -> None:
    p = plan(tmp_path)
    store = CampaignStore(tmp_path / "c", p)
    assert (p.runs, p.shard, store.parts) == (48, 30, 2)
    status = {run: "failed" if run in (5, 29, 30, 40) else "done" for run in range(48)}
    store.add([RunResult(run, f"{run}", what, "", "", (1.0, None)) for run, what in status.items()])
    assert (store.finished, store.failed, store.count()) == (48, 4, (48, 4))
    store.drop_after(0)
    assert (store.failed, store.count()) == (2, (30, 2))
    assert store.row(29) is not None
    assert store.row(30) is None
    store.close()


# --- rows -----------------------------------------------------------------------------------------------------------


def rows(
    values: list[tuple[int, int, int, int, float | None, str]], points: int = 1, field: dict[int, float] | None = None
) -> CampaignRows:
    """Rows of (unit, grid point, replication, policy, value, status); a field's value follows from the unit."""
    units, policies = 1 + max(v[0] for v in values), 1 + max(v[3] for v in values)
    made = pa.Table.from_pylist(
        [
            {"unit": u, "cell": u * points + g, AP: v, "status": s, "x": float(u) if field is None else field[u]}
            for u, g, _, _, v, s in values
        ]
    )
    of = SimpleNamespace(
        policies=["a", "b", "c"][:policies], grid=[{}] * points, cells=units * points, units=units, campaign=SimpleNamespace(vary=["x"])
    )  # fmt: skip
    return CampaignRows(of, made, made["unit"].to_numpy(), np.array([v[3] for v in values]))  # type: ignore[arg-type]


def test_a_mean_is_over_grid_points_and_each_of_them_over_its_replications() -> None:
    """Policy a: 2 and 5. Policy b: 6 and 9, as a replication without a value of policy a counts for neither."""
    made = rows([
        (0, 0, 0, 0, 1.0, "done"), (0, 0, 0, 1, 4.0, "done"), (0, 0, 1, 0, 3.0, "done"), (0, 0, 1, 1, 8.0, "done"),
        (0, 1, 0, 0, None, "done"), (0, 1, 0, 1, 7.0, "done"), (0, 1, 1, 0, 5.0, "done"), (0, 1, 1, 1, 9.0, "done"),
    ], points=2)  # fmt: skip
    assert made.by_unit(AP).tolist() == [[3.5, 7.5]]
    counted, scenes = made.counted(AP)
    assert (counted.tolist(), scenes) == ([True] * 4 + [False] * 2 + [True] * 2, 4)


def test_a_unit_is_left_out_where_a_policy_is_lost_in_the_part_that_is_looked_at() -> None:
    """In unit 1 policy b fails at the second grid point: the first point has the unit, and the whole has not."""
    values = [
        (
            u,
            g,
            0,
            p,
            None if (u, g, p) == (1, 1, 1) else 10.0 * u + g + p / 10,
            "failed" if (u, g, p) == (1, 1, 1) else "done",
        )
        for u in range(2)
        for g in range(2)
        for p in range(2)
    ]
    made = rows(values, points=2)
    assert made.by_unit(AP).tolist() == [[0.5, pytest.approx(0.6)]]
    first = made.table["cell"].to_numpy() % 2 == 0
    assert made.by_unit(AP, first).tolist() == [[0.0, 0.1], [10.0, 10.1]]


def test_a_failed_replication_counts_for_no_policy_and_its_unit_stays_where_another_finished() -> None:
    made = rows([
        (0, 0, 0, 0, 1.0, "done"), (0, 0, 0, 1, None, "failed"), (0, 0, 1, 0, 3.0, "done"), (0, 0, 1, 1, 5.0, "done"),
    ])  # fmt: skip
    assert made.by_unit(AP).tolist() == [[3.0, 5.0]]
    assert not made.lost().any()


def test_a_part_of_a_field_holds_its_lower_end_and_stands_at_the_mean_of_its_values() -> None:
    """Nine values from 0 to 9, without 7 and with quartiles 2, 4 and 6."""
    column = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 9.0]
    made = rows([(u, 0, 0, 0, 0.5, "done") for u in range(9)], field=dict(enumerate(column)))
    parts = made.bins("x")
    assert [label for label, _, _ in parts] == ["0 … 2", "2 … 4", "4 … 6", "6 … 9"]
    assert [np.array(column)[mask].tolist() for _, _, mask in parts] == [[0, 1], [2, 3], [4, 5], [6, 8, 9]]
    assert [place for _, place, _ in parts] == pytest.approx([0.5, 2.5, 4.5, 23 / 3])


# --- winners --------------------------------------------------------------------------------------------------------


def test_a_rule_found_on_every_second_unit_is_judged_on_the_others() -> None:
    """Policy a has 1 below 16 and 0 above, policy b the reverse; the units with an odd number have failed.

    On 0, 4, … the threshold is 14: of 2, 6, 10, 14 and so on it gets the 14 wrong. On 2, 6, … it is 16, and 0, 4, … are all
    right. Over a, the best fixed policy of either half: 0, 0, 0, −1, 1, 1, 1, 1 and 0, 0, 0, 0, 1, 1, 1, 1.
    """
    made = rows([
        (u, 0, 0, p, float((u < 16) != p) if u % 2 == 0 else None, "done" if u % 2 == 0 else "failed") for u in range(32) for p in range(2)
    ])  # fmt: skip
    found = rule(made, AP)
    assert found is not None
    assert (found.field, found.threshold, found.below, found.above) == ("x", 15.0, "a", "b")
    gains = [0.0, 0.0, 0.0, -1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    assert found.gain == mean_interval(gains, possible(AP).of_differences())


def test_a_threshold_leaves_an_eighth_on_either_side() -> None:
    """Of 32 cells b is better in the first two, or in the last four alone."""
    x = {"x": np.arange(32.0)}
    low = np.column_stack([np.zeros(32), np.where(np.arange(32) < 2, 10.0, -1.0)])
    high = np.column_stack([np.zeros(32), np.where(np.arange(32) >= 28, 1.0, -1.0)])
    assert _best(x, low) == ("x", 3.5, 1, 0)
    assert _best(x, high) == ("x", 27.5, 0, 1)


def test_the_first_is_by_the_mean_and_a_policy_without_values_is_never_first() -> None:
    assert _first(np.array([[1.0, 2.5, NAN], [1.0, 0.0, NAN]])) == 1
    assert _first(np.array([[-1.0, NAN], [-2.0, NAN]])) == 0


def test_another_winner_s_interval_is_widened_for_all_parts_and_all_others() -> None:
    """Three policies in two parts: four comparisons."""
    best = {(0, 0): 0.9, (0, 1): 0.1, (0, 2): 0.2, (1, 0): 0.5, (1, 1): 0.6, (1, 2): 0.3}
    off = (0.0, 0.01, 0.03, 0.02)
    values = [
        (u, 0, 0, p, best[u % 2, p] + (off[u // 2] if p == 1 else 0.0), "done") for u in range(8) for p in range(3)
    ]
    made = rows(values, field={u: float(u % 2) for u in range(8)})
    (found,) = other_winners(made, AP)
    assert (found.field, found.part, found.winner) == ("x", "1", "b")
    gains = [0.1 + each for each in off]
    wanted = mean_interval(gains, possible(AP).of_differences(), 1 - (1 - LEVEL) / 4)
    assert (found.gain.low, found.gain.high) == pytest.approx((wanted.low, wanted.high))
    assert found.sure
