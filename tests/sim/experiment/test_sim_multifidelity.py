"""Comparisons to a half-width: what is planned from the rows, what is flown, and what goes on after an interruption."""

from __future__ import annotations

import functools
import json
import math
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sortie
from sortie.perception.metrics.ap import Matched
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment import detectors, half_width, pools
from sortie.sim.experiment.compare import BY_BOTH, Contender, compare
from sortie.sim.experiment.flight import MATCHED, OUTCOME, PROCESSOR_S, Flight, Task, fly, task_of
from sortie.sim.experiment.half_width import FURTHER, Settings, compare_to, fly_surrogate, gains_between, with_detector
from sortie.sim.results.accuracy import Both, both_matched

pytestmark = pytest.mark.slow

METRIC = "ap50.full_scene"
SHORT = {
    "duration_s": 3,
    "perception.detector": "surrogate",
    "mission.phases": [{"at_s": 0, "phase": "track", "region": {"radius_m": 32}}],
}
EVENTFUL = {**SHORT, "events": [{"kind": "drone_lost", "at_s": 1, "drone": 2}]}


def contenders(settings: dict[str, object] = SHORT) -> list[Contender]:
    return [
        Contender(name, sortie.load("track_target", {**settings, "policy.name": name, "policy.params": {}}))
        for name in ("worked", "silence")
    ]


def world(correlation: float, deviation: float = 0.02) -> tuple[list[float], list[float], list[float]]:
    """Gains of 400 seeds by torch and by the surrogate, and of 400 further seeds by the surrogate."""
    z = np.random.default_rng(4).normal(size=(800, 2))
    torch = correlation * z[:, 0] + math.sqrt(1 - correlation**2) * z[:, 1]
    return (deviation * torch[:400]).tolist(), z[:400, 0].tolist(), z[400:, 0].tolist()


def draws(scenario: sortie.Scenario) -> list[Both]:
    """The matched boxes of two draws on one flight."""
    found: list[Both] = fly(task_of(scenario, (MATCHED,), seed=3, seen_by=f"{detectors.DRAWS} 2")).values[MATCHED]
    return found


def test_the_first_draw_is_the_sortie_and_others_differ() -> None:
    """Also of a flight in which a drone is lost."""
    scenario = contenders(EVENTFUL)[0].scenario
    first, second = draws(scenario)
    recorded = both_matched(run_sortie(scenario, None, 3))
    for area in ("full_scene", "mission"):
        assert first[area].keys() == recorded[area].keys() == second[area].keys()
        for key, found in first[area].items():
            assert np.array_equal(found.score, recorded[area][key].score)
            assert found.truths == second[area][key].truths
        assert any(not np.array_equal(first[area][k].score, second[area][k].score) for k in first[area])


def test_another_draw_answers_the_same_moments(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the flight's own draw in its place, it is the recorded sortie again, with a drone that was lost."""
    monkeypatch.setattr(detectors, "SurrogateDetector", _SameDraw(detectors.SurrogateDetector))
    first, again = draws(contenders(EVENTFUL)[0].scenario)
    for area, matches in first.items():
        assert matches.keys() == again[area].keys()
        assert all(np.array_equal(m.score, again[area][k].score) for k, m in matches.items())
        assert all(np.array_equal(m.hit, again[area][k].hit) for k, m in matches.items())


class _SameDraw:
    """Makes surrogates that ignore the replication."""

    def __init__(self, made: object) -> None:
        self._made, self.name = made, "surrogate"

    def __call__(self, *args: object) -> object:
        return self._made(*args[:-1], 0)  # type: ignore[operator]


def test_gains_are_those_of_a_plain_comparison() -> None:
    """The same seed, town, draws and fusions; with one draw of the boxes they are equal."""
    both = contenders()
    plain = compare(both, [5, 6]).sorties
    for seed, of_sortie in ((5, plain[1]), (6, plain[3])):
        gains = fly_surrogate(both, seed, draws=1).gains["silence"]
        assert gains == {f"ap50.{area}": gain for area, gain in of_sortie.gain.items()}


def test_a_gain_is_the_mean_over_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    both = contenders()
    rows = [[Flight("", "", {MATCHED: [c.label + d for d in "ab"], PROCESSOR_S: 1.0}) for c in both]]
    monkeypatch.setattr(half_width, "fly_all", lambda tasks, kept: rows[0])
    values = {("workeda", "silencea"): 0.1, ("workedb", "silenceb"): 0.4}

    def gains(policies: Sequence[str], matched: Sequence[object]) -> dict[str, dict[str, float | None]]:
        return {"silence": {METRIC: values[tuple(matched)], "ap50.mission": None}}  # type: ignore[index]

    monkeypatch.setattr(half_width, "gains_between", gains)
    assert fly_surrogate(both, 1, draws=2).gains == {"silence": {METRIC: pytest.approx(0.25), "ap50.mission": None}}


def test_fusions_that_one_policy_alone_made_do_not_count() -> None:
    both = [both_matched(run_sortie(c.scenario, None, 3)) for c in contenders(SHORT)]
    last = max(both[0]["full_scene"])
    shorter = [{a: {k: m for k, m in both[0][a].items() if k != last} for a in both[0]}, both[1]]
    equal = [{a: {k: m for k, m in b[a].items() if k != last} for a in b} for b in both]
    assert gains_between(["worked", "silence"], shorter) == gains_between(["worked", "silence"], equal)


# --- whole comparisons, in which the surrogate stands for torch --------------------------------------


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """What is flown, by detector and seed; gains are those of a world with a correlation of 0.95."""
    torch, cheap, further = world(0.95)
    flown: list[tuple[str, int]] = []

    def fly(task: Task, *_: object) -> Flight:
        scenario, seed = json.loads(task.scenario), task.seed
        detector, policy = scenario["perception"]["detector"], scenario["policy"]["name"]
        assert detector == ("torch" if task.group else "surrogate")
        gain = torch[seed] if detector == "torch" else further[seed - FURTHER - 1] if seed > FURTHER else cheap[seed]
        if policy == "silence":
            flown.append((detector, seed))
        boxes = Matched(np.array([gain if policy == "silence" else 0.0]), np.array([True]), 1)
        took_s = 0.0 if policy == "worked" else 15.0 if detector == "torch" else 1.0
        values = {MATCHED: [{"full_scene": {(0.0, 0): boxes}, "mission": {}}], OUTCOME: {}, PROCESSOR_S: took_s}
        return Flight("", "", values, task.key)

    def gains(policies: Sequence[str], matched: Sequence[Both]) -> dict[str, dict[str, float | None]]:
        return {"silence": {METRIC: float(matched[1]["full_scene"][0.0, 0].score[0]), "ap50.mission": None}}

    monkeypatch.setattr(pools, "fly", fly)
    monkeypatch.setattr(half_width, "gains_between", gains)
    return flown


class Killed(Exception):
    """Ends a comparison at once."""


def test_a_killed_comparison_goes_on_where_it_was(flights: list[tuple[str, int]], tmp_path: Path) -> None:
    settings = Settings(0.01)
    whole = compare_to(contenders(), settings, None)
    everything = list(flights)
    assert {g.over for g in whole.gains} == {BY_BOTH}
    for at in (1, 13, 40):
        flights.clear()

        def kill(stage: str, done: int, of: float, at: int = at) -> None:
            if len(flights) >= at:
                raise Killed

        with pytest.raises(Killed):
            compare_to(contenders(), settings, tmp_path / f"{at}.sqlite", kill)
        again = compare_to(contenders(), settings, tmp_path / f"{at}.sqlite")
        assert (again.gains, again.sorties, again.precision) == (whole.gains, whole.sorties, whole.precision)
        assert flights == everything, "nothing is flown twice"


def test_a_comparison_that_goes_on_flies_no_more_than_the_seeds_asked_now(
    flights: list[tuple[str, int]], tmp_path: Path
) -> None:
    path, narrow = tmp_path / "c.sqlite", Settings(0.004)

    def torch() -> int:
        return sum(by == "torch" for by, _ in flights)

    def kill(stage: str, done: int, of: float) -> None:
        if torch() == 14:
            raise Killed

    with pytest.raises(Killed):
        compare_to(contenders(), narrow, path, kill)
    for most, flown in ((16, 16), (12, 16), (24, 24)):  # 24 were planned
        found = compare_to(contenders(), Settings(0.004, most=most), path).precision
        assert (found.paired, found.reached, torch()) == (most, most == 24, flown)
    assert len(set(flights)) == len(flights), "nothing is flown twice"


def test_files_of_others_are_refused_and_stay_as_they_are(flights: list[tuple[str, int]], tmp_path: Path) -> None:
    text, other = (tmp_path / name for name in ("text", "other.sqlite"))
    text.write_text("no database at all, but long enough to be read as one" * 20)
    with sqlite3.connect(other) as db:
        db.execute("CREATE TABLE theirs (run INTEGER)")
    for path, words in (
        (text, r"text: is broken \(file is not a database\); remove it to fly again"),
        (other, r"other\.sqlite: holds the table theirs of somebody else; name another file"),
    ):
        before = path.read_bytes()
        with pytest.raises(sortie.SortieError, match=words):
            compare_to(contenders(), Settings(0.02), path)
        assert path.read_bytes() == before


def mine(view: sortie.FleetView, *, x: object = 0) -> list[sortie.Directive]:
    return []


def others(view: sortie.FleetView) -> list[sortie.Directive]:
    return []


class Held:
    """A policy that is an object."""

    def __call__(self, view: sortie.FleetView) -> list[sortie.Directive]:
        return []


def typed_in() -> Any:
    space: dict[str, Any] = {"__name__": "typed_in"}
    exec("def decide(view):\n    return []\n", space)  # noqa: S102 - as it is typed into an interpreter
    return space["decide"]


def task(policy: Any) -> Task:
    return task_of(contenders()[0].scenario, (MATCHED,), function=policy, named=True)


def test_functions_of_other_names_or_bound_values_are_other_flights() -> None:
    policies = [None, mine, others, *(functools.partial(mine, x=x) for x in (0.1, 0.5, "0.1", None))]
    assert len({task(policy).key for policy in policies}) == len(policies)
    assert task(functools.partial(mine, x=0.1)).key == task(functools.partial(mine, x=0.1)).key
    assert list(task(mine).files) == [__file__]


def test_a_policy_that_its_name_and_its_file_do_not_decide_is_not_kept() -> None:
    nameless = (lambda view: [], Held(), Held().__call__, functools.wraps(mine)(lambda view: []), np.sin, typed_in())
    bound = (functools.partial(mine, x=np.zeros(2)), functools.partial(Held(), x=1))
    for policy in (*nameless, *bound):
        with pytest.raises(sortie.SortieError, match=r"policy .*: must be a function at the top of a file, or a"):
            task(policy)
        assert not task_of(contenders()[0].scenario, (MATCHED,), function=policy).is_kept


def test_what_the_surrogate_cannot_fly_is_refused_before_torch_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(half_width, "fly_torch", lambda *args: pytest.fail("torch flew"))
    for field, value, words in (
        ("fusion", "late", r"calibrated for fusion 'disconet', perception\.fusion is 'late'"),
        ("match_poses", True, "match_poses: true, must be false where a drone's detector is surrogate"),
    ):
        both = contenders({**SHORT, "perception.detector": "torch", f"perception.{field}": value})
        with pytest.raises(sortie.SortieError, match=words):
            compare_to(both, Settings(0.01), None)


def test_weights_belong_to_one_detector() -> None:
    one = contenders({**SHORT, "perception.detector": "torch", "perception.weights": "some.safetensors"})[0]
    assert with_detector(one, "torch") is one
    cheap = with_detector(one, "surrogate").scenario.perception
    assert (cheap.detector, cheap.weights) == ("surrogate", None)
