"""Comparisons to a half-width: what is planned from the rows, what is flown, and what goes on after an interruption."""

from __future__ import annotations

import functools
import math
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sortie
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.compare import BY_BOTH, Contender, compare
from sortie.sim.experiment.detectors import fly_with_draws
from sortie.sim.experiment.half_width import FURTHER, Row, Settings, fly_surrogate, gains_between, with_detector
from sortie.sim.experiment.kept_comparison import compare_to, kept
from sortie.sim.results.accuracy import both_matched
from sortie.sim.studies import kept_comparison, multifidelity

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


def row(by: str, seed: int, gain: float | None, processor_s: float = 1.0) -> Row:
    return Row(by, seed, {"silence": {METRIC: gain, "ap50.mission": None}}, processor_s, {"worked": {}, "silence": {}})


def world(correlation: float, deviation: float = 0.02) -> tuple[list[float], list[float], list[float]]:
    """Gains of 400 seeds by torch and by the surrogate, and of 400 further seeds by the surrogate."""
    z = np.random.default_rng(4).normal(size=(800, 2))
    torch = correlation * z[:, 0] + math.sqrt(1 - correlation**2) * z[:, 1]
    return (deviation * torch[:400]).tolist(), z[:400, 0].tolist(), z[400:, 0].tolist()


def test_the_first_draw_is_the_sortie_and_others_differ() -> None:
    """Also of a flight in which a drone is lost."""
    scenario = contenders(EVENTFUL)[0].scenario
    first, second = fly_with_draws(scenario, None, 3, 2)
    recorded = both_matched(run_sortie(scenario, None, 3))
    for area in ("full_scene", "mission"):
        assert first[area].keys() == recorded[area].keys() == second[area].keys()
        for key, found in first[area].items():
            assert np.array_equal(found.score, recorded[area][key].score)
            assert found.truths == second[area][key].truths
        assert any(not np.array_equal(first[area][k].score, second[area][k].score) for k in first[area])


def test_another_draw_answers_the_same_moments(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the flight's own draw in its place, it is the recorded sortie again, with a drone that was lost."""
    made = half_width.fly_with_draws.__globals__["SurrogateDetector"]
    monkeypatch.setitem(half_width.fly_with_draws.__globals__, "SurrogateDetector", _SameDraw(made))
    first, again = fly_with_draws(contenders(EVENTFUL)[0].scenario, None, 3, 2)
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
    monkeypatch.setattr(
        multifidelity, "fly_with_draws", lambda scenario, *rest: [scenario.policy.name + d for d in "ab"]
    )
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

    def by_torch(contenders: Sequence[Contender], seed: int) -> Row:
        assert {c.scenario.perception.detector for c in contenders} == {"torch"}
        flown.append(("torch", seed))
        return row("torch", seed, torch[seed], 15.0)

    def by_surrogate(contenders: Sequence[Contender], seed: int) -> Row:
        assert {c.scenario.perception.detector for c in contenders} == {"surrogate"}
        flown.append(("surrogate", seed))
        return row("surrogate", seed, further[seed - FURTHER - 1] if seed > FURTHER else cheap[seed])

    monkeypatch.setattr(half_width, "fly_torch", by_torch)
    monkeypatch.setattr(half_width, "fly_surrogate", by_surrogate)
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
    found = compare_to(contenders(), Settings(0.004, most=16), path).precision
    assert (found.paired, found.reached, torch()) == (16, False, 16), "24 were planned"
    assert compare_to(contenders(), Settings(0.004, most=12), path).precision.paired == torch() == 16
    assert compare_to(contenders(), Settings(0.004, most=24), path).precision.paired == 24
    assert len(set(flights)) == len(flights), "nothing is flown twice"


def test_files_of_others_are_refused_and_stay_as_they_are(flights: list[tuple[str, int]], tmp_path: Path) -> None:
    ours, text, other = (tmp_path / name for name in ("c.sqlite", "text", "campaign.sqlite"))
    compare_to(contenders(), Settings(0.02), ours)
    text.write_text("no database at all, but long enough to be read as one" * 20)
    with sqlite3.connect(other) as db:
        db.execute("CREATE TABLE rows (run INTEGER)")
    for path, asked, words in (
        (ours, EVENTFUL, "holds a comparison of other policies, another scenario"),
        (text, SHORT, r"text: no comparison there \(file is not a database\)"),
        (other, SHORT, r"campaign\.sqlite: no comparison there \(it has other tables\)"),
    ):
        before = path.read_bytes()
        with pytest.raises(sortie.SortieError, match=words):
            compare_to(contenders(asked), Settings(0.02), path)
        assert path.read_bytes() == before


def test_a_damaged_row_names_its_file(tmp_path: Path) -> None:
    for number, content in enumerate(("{cut", '{"x": 1}', "[1]")):
        path = tmp_path / f"{number}.sqlite"
        with kept(path, "a") as (_, db):
            db.execute("INSERT INTO flown VALUES ('row', ?)", (content,))
        with pytest.raises(sortie.SortieError, match=r"\d\.sqlite: a row is damaged \("):
            kept(path, "a").__enter__()


def test_another_version_policy_or_pilot_is_another_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    base = contenders()
    known = {kept_comparison.identity(base, 12), kept_comparison.identity(base, 8)}
    known.add(kept_comparison.identity([base[0], base[1]._replace(function=mine)], 12))
    known.add(kept_comparison.identity(base[::-1], 12))
    known.add(kept_comparison.identity(contenders({**SHORT, "seed": 2}), 12))
    monkeypatch.setattr(kept_comparison, "codes_here", lambda: ("0.2.0", "0.2.0 torch 2.14"))
    known.add(kept_comparison.identity(base, 12))
    assert len(known) == 6


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


def identified(policy: Any) -> str:
    scenario = contenders()[0].scenario
    return kept_comparison.identity([Contender("mine", scenario), Contender("yours", scenario, policy)], 12)


def test_functions_of_other_names_or_bound_values_are_other_comparisons() -> None:
    policies = [mine, others, *(functools.partial(mine, x=x) for x in (0.1, 0.5, "0.1", None))]
    assert len({identified(policy) for policy in policies}) == len(policies)
    assert identified(functools.partial(mine, x=0.1)) == identified(functools.partial(mine, x=0.1))


def test_a_policy_that_its_name_and_its_file_do_not_decide_is_not_kept() -> None:
    nameless = (lambda view: [], Held(), Held().__call__, functools.wraps(mine)(lambda view: []), np.sin, typed_in())
    bound = (functools.partial(mine, x=np.zeros(2)), functools.partial(Held(), x=1))
    for policy in (*nameless, *bound):
        with pytest.raises(
            sortie.SortieError, match=r"policy yours, .*: must be a function at the top of a file, or a"
        ):
            identified(policy)


def test_a_changed_file_of_ones_own_is_another_comparison(tmp_path: Path) -> None:
    own, known = tmp_path / "mine.py", set()
    for text in ("first", "second"):
        own.write_text(f"def decide(view):\n    return []  # {text}\n")
        mine = sortie.load("track_target", {**SHORT, "policy.name": f"{own}:decide", "policy.params": {}})
        known.add(kept_comparison.identity([Contender("mine", mine)], 12))
    assert len(known) == 2


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
