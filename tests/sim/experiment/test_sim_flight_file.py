"""Flights that are kept: what is found again, and what is flown again."""

from __future__ import annotations

import json
import multiprocessing
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.perception.metrics.ap import Matched
from sortie.sim.experiment import flight_file
from sortie.sim.experiment.flight import MATCHED, OUTCOME, Flight, Task, task_of
from sortie.sim.experiment.flight_file import FlightFile, fly_all, users_file
from sortie.sim.experiment.pools import Landed
from sortie.sim.folders import RunError
from sortie.sim.identity import file_digest

MATCHES = [
    {
        "full_scene": {
            (0.1 + k, 2): Matched(np.array([0.1 * k, 1 / 3][:k]), np.array([True, False][:k]), 7 - k) for k in range(3)
        },
        "mission": {},
    }
    for _ in range(2)
]
VALUES = {OUTCOME: {"a": [1, None, "x"], "b": 1 / 3}, "ap50.mission": None, "bytes.data_sent": 0.1 + 0.2}


def task(**how: object) -> Task:
    return task_of(example("perception.detector=none"), tuple(VALUES), **how)  # type: ignore[arg-type]


class Counts:
    """A pool that answers at once, and counts."""

    def __init__(self, error: str = "") -> None:
        self.flown, self.error = list[int](), error

    def rows(self, tasks: object) -> object:
        for one in tasks:  # type: ignore[attr-defined]
            self.flown.append(one.seed)
            values = {name: None if self.error else VALUES.get(name, 5.0) for name in one.figures}
            landed: Landed = [(one, Flight(self.error, "print", values, one.key, one.files))]
            yield landed


def test_a_row_comes_back_as_it_was(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.write_text("1")
    one = task(seed=3)
    row = Flight("", "print", {**VALUES, MATCHED: MATCHES}, one.key, {str(data): file_digest(data)})
    with closing(FlightFile(tmp_path / "a")) as file:
        file.add([(one, row)])
        back = file.find(one)
        assert back is not None
        assert {**back.values, MATCHED: 0} == {**row.values, MATCHED: 0}
        assert (back.fingerprint, back.files, back.key) == (row.fingerprint, row.files, row.key)
        for before, after in zip(MATCHES, back.values[MATCHED], strict=True):
            for area, fusions in before.items():
                assert list(after[area]) == list(fusions)
                for key, m in fusions.items():
                    assert np.array_equal(after[area][key].score, m.score)
                    assert np.array_equal(after[area][key].hit, m.hit)
                    assert after[area][key].truths == m.truths
        for other in (task(seed=4), task(seed=3, replication=1), task(seed=3, seen_by="surrogate draws 8")):
            assert file.find(other) is None
        data.write_text("2")
        assert file.find(one) is None, "what it read is not there any more"


def test_a_figure_that_is_not_there_means_a_new_flight_and_what_was_known_stays(tmp_path: Path) -> None:
    pool, kept = Counts(), tmp_path / "a"
    asked = [replace(task(seed=seed), figures=figures) for seed, figures in ((1, ("x",)), (1, ("y",)), (2, ("x",)))]
    for figures, flown in ((("x",), [1, 2]), (("y",), [1, 2]), (("x", "y"), []), (("x", "z"), [1, 2])):
        pool.flown.clear()
        rows = fly_all([replace(one, figures=figures) for one in asked[1:]], pool, kept)  # type: ignore[arg-type]
        assert pool.flown == flown, figures
        assert [set(row.values) >= set(figures) for row in rows] == [True, True]


def test_failed_flights_fly_again_and_do_not_take_the_place_of_others(tmp_path: Path) -> None:
    kept, good, bad = tmp_path / "a", Counts(), Counts("boom")
    assert fly_all([task()], bad, kept)[0].error == "boom"  # type: ignore[arg-type]
    assert fly_all([task()], good, kept)[0].error == ""  # type: ignore[arg-type]
    with closing(FlightFile(kept)) as file:
        one = task()
        file.add([(one, Flight("boom", "", dict.fromkeys(one.figures), one.key))])
        assert file.find(one) is not None
    assert fly_all([task()], bad, kept)[0].error == ""  # type: ignore[arg-type]
    assert (bad.flown, good.flown) == ([1], [1])


def test_what_is_taken_from_a_file_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = tmp_path / "a"
    with caplog.at_level("INFO", "sortie"):
        for said in ([], [f"flights that were flown before are taken from {kept}"]):
            fly_all([task()], Counts(), kept)  # type: ignore[arg-type]
            assert caplog.messages == said


def test_flights_of_a_group_fly_together_or_not_at_all(tmp_path: Path) -> None:
    kept, pool = tmp_path / "a", Counts()
    group = [task(seed=seed, group="g") for seed in (1, 2)]
    fly_all(group[:1], pool, kept)  # type: ignore[arg-type]
    fly_all(group, pool, kept)  # type: ignore[arg-type]
    assert pool.flown == [1, 1, 2]
    fly_all(group, pool, kept)  # type: ignore[arg-type]
    assert pool.flown == [1, 1, 2]


def test_the_users_file_forgets_other_versions_and_may_be_switched_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert users_file() is None, "the suite keeps nothing"
    monkeypatch.delenv("SORTIE_FLIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = users_file()
    assert file == tmp_path / "sortie" / "flights.sqlite"
    pool, ours = Counts(), task()
    other = replace(ours, code="0.2.0+0")
    fly_all([other], pool, file)  # type: ignore[arg-type]
    fly_all([ours], pool, file)  # type: ignore[arg-type]
    with closing(FlightFile(file)) as opened:
        assert (opened.find(other), opened.find(ours) is None) == (None, False)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert users_file() is None, "nowhere to keep them: they fly"


def test_a_function_is_flown_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = list[Task]()
    monkeypatch.setattr("sortie.sim.experiment.pools.fly", lambda one, *_: flown.append(one) or Flight("", "", {}))
    for _ in range(2):
        fly_all([task(function=lambda view: [])], None, tmp_path / "a")
    assert len(flown) == 2


def _write(path: Path, first: int) -> None:
    with closing(FlightFile(path)) as file:
        for seed in range(first, first + 20):
            one = task(seed=seed)
            file.add([(one, Flight("", "", VALUES, one.key))])


def test_several_who_use_one_file_wait_for_each_other(tmp_path: Path) -> None:
    path = tmp_path / "a"
    others = [multiprocessing.get_context("fork").Process(target=_write, args=(path, first)) for first in (0, 100, 200)]
    for one in others:
        one.start()
    for one in others:
        one.join()
        assert one.exitcode == 0
    with closing(FlightFile(path)) as file:
        assert all(file.find(task(seed=first + k)) is not None for first in (0, 100, 200) for k in range(20))


def test_the_users_file_stops_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    """Nobody asked for it; a file that was named must be usable."""
    path = tmp_path / "a"
    path.write_text("no database at all, but long enough to be read as one" * 20)
    with pytest.raises(RunError, match=r"a: is broken .*; remove it to fly again, if it is Sortie's"):
        fly_all([task()], Counts(), path)  # type: ignore[arg-type]
    monkeypatch.setenv("SORTIE_FLIGHTS", str(path))
    assert fly_all([task()], Counts(), path)[0].error == ""  # type: ignore[arg-type]
    assert caplog.messages[-1].endswith("; flights are not kept")
    with pytest.raises(RunError, match="is a folder, must be a file"):
        FlightFile(tmp_path)


def test_what_is_damaged_is_one_line(tmp_path: Path) -> None:
    one = task()
    for number, change in enumerate(("figures = '['", "files = '[1]'", "matched = x'00'", "figures = x'ff'")):
        path = tmp_path / f"{number}"
        with closing(FlightFile(path)) as file:
            file.add([(one, Flight("", "", VALUES, one.key))])
            with file.db:
                file.db.execute(f"UPDATE flights SET {change}")  # noqa: S608
            with pytest.raises(RunError, match=rf"{number}: is broken \(.*\); remove it to fly again"):
                file.find(one)
    assert json.loads(json.dumps(VALUES)) == VALUES
    assert flight_file.changed({str(tmp_path / "gone"): "0"}) == [str(tmp_path / "gone")]
