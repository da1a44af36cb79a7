"""When a campaign stops: `stop_when` with each of its options, whole units, and what a driver says of its progress."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
from campaign_examples import failed, plan, pretend

from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.schema.campaign import StopWhen
from sortie.sim.experiment.drive import Progress, Stop, _drive
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.store import CampaignStore
from sortie.sim.results.outcome import possible

AP = "ap50.mission"
Values = list[list[list[float | None]]]
"""By policy, unit and replication."""
WIDE: Values = [[[0.4, 0.6], [0.5, 0.7], [0.6, 0.8]], [[0.5, 0.5], [0.5, 0.52], [0.51, 0.53]]]
"""Means 0.5, 0.6, 0.7 and 0.5, 0.51, 0.52."""


def stop(runs: int, policies: int = 2, **options: Any) -> Stop:
    asked = StopWhen(metric=AP, **({"half_width": 0.1, "at_least": 3} | options))
    campaign = SimpleNamespace(stop_when=asked)
    return Stop(SimpleNamespace(campaign=campaign, policies=["a", "b", "c"][:policies], runs=runs))


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


def test_it_stops_where_the_widest_interval_at_its_level_is_narrow_enough() -> None:
    """The second policy's is narrower."""
    for level in (0.9, 0.99):
        wanted = width([0.5, 0.6, 0.7], level)
        assert stop(12, half_width=wanted * 1.0001, confidence=level).enough(table(WIDE))
        assert not stop(12, half_width=wanted * 0.9999, confidence=level).enough(table(WIDE))


def test_a_unit_counts_once_it_is_whole() -> None:
    """The third unit is whole with the next row of another, or with the last row of the campaign."""
    assert stop(12, half_width=1.0).enough(table(WIDE))
    assert not stop(16, half_width=1.0).enough(table(WIDE)), "more of the third unit may come"
    longer: Values = [[*policy, [0.5, 0.5]] for policy in WIDE]
    judged = stop(16, half_width=1.0)
    assert not judged.enough(table(longer, 0, 12))
    assert judged.enough(table(longer, 12))
    assert not stop(12, half_width=1.0, at_least=4).enough(table(WIDE))


def test_a_policy_that_lacks_values_has_fewer_units_and_every_policy_must_be_known() -> None:
    lacking: Values = [WIDE[0], [[0.5, 0.5], [None, None], [0.51, None]]]
    assert not stop(12, half_width=1.0).enough(table(lacking))
    assert stop(12, half_width=1.0, at_least=2).enough(table(lacking))
    three: Values = [[[0.4], [0.6], [0.8]], [[0.5], [0.7], [0.91]], [[0.1], [0.6], [0.9]]]
    assert not stop(9, 3, half_width=0.1, difference=True).enough(table(three))
    assert stop(6, 2, half_width=0.1, difference=True).enough(table(three[:2]))


def test_differences_are_of_one_unit_and_of_the_scenes_that_both_policies_have() -> None:
    """The second policy is 0.1, 0.11 and 0.12 below the first, whose own means are far apart."""
    below: Values = [[[0.4], [0.6], [0.8]], [[0.3], [0.49], [0.68]]]
    gaps: Values = [[[0.4, 0.0], [0.9, 0.6], [0.8, None]], [[0.3, None], [None, 0.49], [0.68, 0.1]]]
    wanted = width([-0.1, -0.11, -0.12], 0.95, difference=True)
    assert wanted < 0.03
    for values, runs in ((below, 6), (gaps, 12)):
        assert stop(runs, half_width=wanted * 1.0001, difference=True).enough(table(values))
        assert not stop(runs, half_width=wanted * 0.9999, difference=True).enough(table(values))
    assert not stop(6, half_width=wanted * 1.0001).enough(table(below))


def test_values_that_are_all_equal_end_a_campaign_from_thirty_units_on() -> None:
    for difference in (False, True):
        for units, enough in ((2, False), (29, False), (30, True)):
            equal: Values = [[[0.5]] * units] * 2
            judged = stop(2 * units, half_width=0.1, at_least=2, difference=difference)
            assert judged.enough(table(equal)) == enough


def test_speed_and_time_left_are_of_what_this_driver_flew() -> None:
    made = Progress(finished=30, of=100, failed=2, flown=10, seconds=20.0)
    assert (made.per_second, made.left_s) == (0.5, 140.0)
    assert Progress(30, 100, 0, 0, 20.0).left_s == math.inf
    assert Progress(30, 100, 0, 10, 0.0).per_second == 0.0


class Pool:
    """Gives some rows at a time."""

    def __init__(self, at_once: int = 2) -> None:
        self.at_once = at_once

    def rows(self, tasks: Iterator[Task]) -> Iterator[list[tuple[Task, Flight]]]:
        landed = [(task, Flight("", "", {"": 0.5})) for task in tasks]
        for k in range(0, len(landed), self.at_once):
            yield landed[k : k + self.at_once]


class Store:
    """Four parts of two runs, one unit each; the first part is there from the begin."""

    parts, failed = 4, 0

    def __init__(self) -> None:
        self.finished, self.dropped = 2, []

    def is_done(self, part: int) -> bool:
        return self.finished >= 2 * (part + 1)

    def missing(self, stop: int) -> Iterator[Any]:
        return iter(range(2, stop))

    def add(self, landed: list[tuple[Task, Flight]]) -> None:
        self.finished += len(landed)

    def runs_of(self, part: int) -> range:
        return range(2 * part, 2 * part + 2)

    def part(self, part: int) -> pa.Table:
        return table([[[0.5], [0.51], [0.52], [0.53]]] * 2, 2 * part, 2 * part + 2)

    def drop_after(self, part: int) -> None:
        self.dropped.append(part)


def stopping(at_least: int) -> SimpleNamespace:
    """The plan of eight runs that may stop early."""
    campaign = SimpleNamespace(stop_when=StopWhen(metric=AP, half_width=0.2, at_least=at_least))
    return SimpleNamespace(campaign=campaign, policies=["a", "b"], runs=8, by_torch=False)


def test_a_driver_tells_all_that_it_flew_and_no_more_than_it_keeps() -> None:
    """Of two units it is known with the third part, in which the third unit begins; runs beyond it are dropped."""
    early, full = [(2, 8, 0), (4, 8, 2)], [(2, 8, 0), (4, 8, 2), (6, 8, 4), (8, 8, 6)]
    for at_least, at_once, steps, last, dropped in (
        (2, 2, early, (6, 6, 4), [2]),
        (2, 6, [(2, 8, 0)], (6, 6, 4), [2]),
        (9, 2, full, (8, 8, 6), []),
    ):
        store, told = Store(), list[Progress]()
        done = _drive(stopping(at_least), store, Pool(at_once), 8, told.append)
        assert [(p.finished, p.of, p.flown) for p in told] == steps
        assert ((done.finished, done.of, done.flown), store.dropped) == (last, dropped)


def test_failed_runs_that_are_dropped_are_counted_no_more(tmp_path: Path) -> None:
    p = plan(tmp_path)
    store = CampaignStore(tmp_path / "c", p)
    assert (p.runs, p.shard, store.parts) == (48, 30, 2)
    tasks = [p.task(run) for run in range(48)]
    store.add([(t, failed(t) if t.number in (5, 29, 30, 40) else pretend(t)) for t in tasks])
    assert (store.finished, store.failed, store.count()) == (48, 4, (48, 4))
    store.drop_after(0)
    assert (store.failed, store.count()) == (2, (30, 2))
    assert store.row(29) is not None
    assert store.row(30) is None
    store.close()
