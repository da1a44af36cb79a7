"""Comparisons to a half-width: what is planned from the rows, what is flown, and what goes on after an interruption."""

from __future__ import annotations

import functools
import itertools
import math
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sortie
from sortie.perception.errors import InputError
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import both_matched
from sortie.sim.studies import kept_comparison, multifidelity
from sortie.sim.studies.compare import BY_BOTH, Contender, compare
from sortie.sim.studies.comparison_text import compare_command, precision_lines
from sortie.sim.studies.kept_comparison import compare_to, keep, kept
from sortie.sim.studies.multifidelity import (
    FURTHER,
    Batch,
    Flown,
    Row,
    Settings,
    fly_surrogate,
    gains_between,
    next_batch,
    precision_of,
    run,
    with_detector,
)
from sortie.sim.studies.surrogate_draws import fly_with_draws

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


def flown_to(batch: Batch, correlation: float, plans: Sequence[Batch]) -> Flown:
    """Everything of a batch, in a world."""
    torch, cheap, further = world(correlation)
    flown = Flown(plans=list(plans))
    for seed in range(batch.paired):
        flown.add(row("torch", seed, torch[seed], 15.0))
        if batch.control:
            flown.add(row("surrogate", seed, cheap[seed]))
    for k in range(batch.further):
        flown.add(row("surrogate", FURTHER + k, further[k]))
    return flown


def planned(correlation: float, settings: Settings) -> list[Batch]:
    plans: list[Batch] = []
    while True:
        flown = flown_to(plans[-1], correlation, plans) if plans else Flown()
        batch = next_batch(flown, ["silence"], settings)
        if batch is None:
            return plans
        plans.append(batch)


def test_a_correlated_surrogate_takes_the_place_of_torch() -> None:
    settings = Settings(0.01)
    with_it, without = planned(0.95, settings), planned(0.0, settings)
    assert with_it[0] == without[0] == Batch(12, 0, control=True, cost_ratio=pytest.approx(math.nan, nan_ok=True))
    assert all(b.control for b in with_it)
    assert not any(b.control for b in without[1:])
    assert all(b.further == 0 for b in without)
    assert with_it[-1].paired < 0.6 * without[-1].paired
    for plans in (with_it, without):
        flown = flown_to(plans[-1], 0.95 if plans is with_it else 0.0, plans)
        found = precision_of(flown, ["silence"], settings, "torch")
        assert found.reached
        assert found.contrasts[0].half_width <= 0.01
        for before, after in itertools.pairwise(plans):
            assert before.paired <= after.paired <= 2 * before.paired
            assert after.paired % 4 == 0
            assert before != after


@pytest.mark.parametrize("correlation", [0.0, 0.95])
def test_a_batch_at_most_doubles_what_a_plan_stands_on(correlation: float) -> None:
    assert [b.paired for b in planned(correlation, Settings(0.003))][:2] == [12, 24]


def test_a_useless_surrogate_is_named_and_left_out() -> None:
    settings = Settings(0.01)
    plans = planned(0.0, settings)
    flown = flown_to(plans[-1], 0.0, plans)
    for seed, gain in enumerate(world(0.0)[1][:12]):
        flown.add(row("surrogate", seed, gain))
    found = precision_of(flown, ["silence"], settings, "torch")
    assert (found.control, found.further, found.contrasts[0].coefficient) == (False, 0, 0.0)
    told = "\n".join(name + text for name, text in precision_lines(found))
    assert "the surrogate was not used" in told
    assert found.cost_ratio == pytest.approx((len(flown.torch) * 15 + 12) / (15 * len(flown.torch)), rel=0.15)


def test_a_comparison_stops_when_its_seeds_are_used_up() -> None:
    settings = Settings(0.0001, most=22)
    plans = planned(0.5, settings)
    assert plans[-1].paired == 22
    found = precision_of(flown_to(plans[-1], 0.5, plans), ["silence"], settings, "torch")
    assert not found.reached
    assert "not reached, as the seeds were used up: --most-seeds" in "\n".join(
        name + text for name, text in precision_lines(found)
    )


def equal(seeds: int, plans: Sequence[Batch]) -> Flown:
    flown = Flown(plans=list(plans))
    for seed in range(seeds):
        flown.add(row("torch", seed, 0.0, 15.0))
        if seed < 12:
            flown.add(row("surrogate", seed, 0.0))
    return flown


def test_gains_that_are_all_equal_count_as_known_from_thirty_seeds_on() -> None:
    plans: list[Batch] = []
    while batch := next_batch(equal(plans[-1].paired, plans) if plans else Flown(), ["silence"], Settings(0.01)):
        plans.append(batch)
    assert plans[0].paired == 12
    assert 30 <= plans[-1].paired < 36, "policies that decide alike do not fly to the end"
    found = precision_of(equal(plans[-1].paired, plans), ["silence"], Settings(0.01), "torch")
    assert found.reached
    told = "".join(next(iter(precision_lines(found))))
    assert f": none, as the gains are all equal in {plans[-1].paired} seeds, 1 asked, reached; " in told


def test_gains_that_are_all_equal_in_a_few_seeds_reach_no_half_width() -> None:
    settings = Settings(0.01, most=20)
    found = precision_of(equal(20, [Batch(20, 0, control=False)]), ["silence"], settings, "torch")
    assert not found.reached
    assert "all equal in 20 seeds, 1 asked, not reached" in next(iter(precision_lines(found))).text


def test_seeds_without_a_gain_count_nowhere() -> None:
    flown = Flown(plans=[Batch(12, 0, True), Batch(12, 3, True)])
    for seed in range(6):
        flown.add(row("torch", seed, None if seed == 1 else float(seed)))
        flown.add(row("surrogate", seed, None if seed == 2 else float(seed)))
    for k, gain in enumerate((1.0, None, 3.0)):
        flown.add(row("surrogate", FURTHER + k, gain))
    found = flown.estimate("silence", METRIC, control=True)
    assert found.estimate.count == 4
    assert found.estimate.mean == pytest.approx((0 + 3 + 4 + 5 + 1 + 3) / 6), "equal gains: the mean of all with one"
    assert flown.estimate("silence", METRIC, control=False).estimate.mean == pytest.approx((0 + 2 + 3 + 4 + 5) / 5)


def test_nothing_can_be_planned_without_gains() -> None:
    flown = Flown(plans=[Batch(12, 0, True)])
    for seed in range(12):
        flown.add(row("torch", seed, None))
        flown.add(row("surrogate", seed, None))
    with pytest.raises(sortie.SortieError, match=r"ap50\.full_scene: fewer than two of 12 seeds have a gain"):
        next_batch(flown, ["silence"], Settings(0.01))


@pytest.mark.parametrize("settings", [SHORT, EVENTFUL], ids=["all fly", "one is lost"])
def test_the_first_draw_is_the_sortie_and_others_differ(settings: dict[str, object]) -> None:
    scenario = contenders(settings)[0].scenario
    first, second = fly_with_draws(scenario, None, 3, 2)
    recorded = both_matched(run_sortie(scenario, None, 3))
    for area in ("full_scene", "mission"):
        assert first[area].keys() == recorded[area].keys() == second[area].keys()
        assert all(
            np.array_equal(first[area][k].score, recorded[area][k].score)
            and first[area][k].truths == second[area][k].truths
            for k in first[area]
        )
        assert any(not np.array_equal(first[area][k].score, second[area][k].score) for k in first[area])


def test_another_draw_answers_the_same_moments(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the flight's own draw in its place, it is the recorded sortie again, with a drone that was lost."""
    made = multifidelity.fly_with_draws.__globals__["SurrogateDetector"]
    monkeypatch.setitem(multifidelity.fly_with_draws.__globals__, "SurrogateDetector", _SameDraw(made))
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

    monkeypatch.setattr(multifidelity, "gains_between", gains)
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

    monkeypatch.setattr(multifidelity, "fly_torch", by_torch)
    monkeypatch.setattr(multifidelity, "fly_surrogate", by_surrogate)
    return flown


class Killed(Exception):
    """Ends a comparison at once."""


@pytest.mark.parametrize("at", [1, 7, 13, 20, 40])
def test_a_killed_comparison_goes_on_where_it_was(at: int, flights: list[tuple[str, int]], tmp_path: Path) -> None:
    settings = Settings(0.01)
    whole = compare_to(contenders(), settings, None)
    everything = list(flights)
    flights.clear()

    def kill(stage: str, done: int, of: float) -> None:
        if len(flights) >= at:
            raise Killed

    with pytest.raises(Killed):
        compare_to(contenders(), settings, tmp_path / "c.sqlite", kill)
    again = compare_to(contenders(), settings, tmp_path / "c.sqlite")
    assert (again.gains, again.sorties) == (whole.gains, whole.sorties)
    assert again.precision == whole.precision
    assert flights == everything, "nothing is flown twice"
    assert {g.over for g in again.gains} == {BY_BOTH}


def test_a_narrower_half_width_goes_on_and_a_wider_one_flies_nothing(
    flights: list[tuple[str, int]], tmp_path: Path
) -> None:
    first = compare_to(contenders(), Settings(0.015), tmp_path / "c.sqlite")
    before = len(flights)
    narrower = compare_to(contenders(), Settings(0.008), tmp_path / "c.sqlite")
    assert narrower.precision.paired > first.precision.paired
    assert len(set(flights)) == len(flights) > before
    count = len(flights)
    assert compare_to(contenders(), Settings(0.02), tmp_path / "c.sqlite").precision.reached
    assert len(flights) == count


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


def test_the_command_that_gives_the_comparison_again_has_its_pilot_and_its_most_seeds() -> None:
    told = compare_command(
        "track_target", "worked,silence", 4, None, [], own_fusion=False, half_width=0.02, pilot=8, most_seeds=90
    )
    assert told == (
        "sortie compare track_target --policies worked,silence --seed 4 --half-width 0.02 --pilot 8 --most-seeds 90"
    )


def test_files_of_others_are_refused(flights: list[tuple[str, int]], tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite"
    compare_to(contenders(), Settings(0.02), path)
    with pytest.raises(sortie.SortieError, match="holds a comparison of other policies, another scenario"):
        compare_to(contenders(EVENTFUL), Settings(0.02), path)
    (tmp_path / "text").write_text("no database at all, but long enough to be read as one" * 20)
    with pytest.raises(sortie.SortieError, match=r"text: no comparison there \(file is not a database\)"):
        compare_to(contenders(), Settings(0.02), tmp_path / "text")


def test_a_database_of_something_else_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "campaign.sqlite"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE rows (run INTEGER)")
    before = path.read_bytes()
    with pytest.raises(sortie.SortieError, match=r"campaign\.sqlite: no comparison there \(it has other tables\)"):
        kept(path, "a").__enter__()
    assert path.read_bytes() == before


@pytest.mark.parametrize("content", ["{cut", '{"x": 1}', "[1]"])
def test_a_damaged_row_names_its_file(content: str, tmp_path: Path) -> None:
    with kept(tmp_path / "c.sqlite", "a") as (_, db):
        db.execute("INSERT INTO flown VALUES ('row', ?)", (content,))
    with pytest.raises(sortie.SortieError, match=r"c\.sqlite: a row is damaged \("):
        kept(tmp_path / "c.sqlite", "a").__enter__()


def test_what_is_kept_is_on_disk_at_once(tmp_path: Path) -> None:
    """A copy of the file at this moment, as after a power cut, holds the row."""
    with kept(tmp_path / "c.sqlite", "a") as (_, db):
        keep(db, row("surrogate", 4, None))
        (tmp_path / "copy.sqlite").write_bytes((tmp_path / "c.sqlite").read_bytes())
    with sqlite3.connect(tmp_path / "copy.sqlite") as db:
        assert len(db.execute("SELECT * FROM flown").fetchall()) == 1


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


@pytest.mark.parametrize(
    "policy",
    [
        lambda view: [], Held(), Held().__call__, functools.wraps(mine)(lambda view: []), np.sin, typed_in(),
        functools.partial(mine, x=np.zeros(2)), functools.partial(Held(), x=1),
    ],
)  # fmt: skip
def test_a_policy_that_its_name_and_its_file_do_not_decide_is_not_kept(policy: Any) -> None:
    with pytest.raises(sortie.SortieError, match=r"policy yours, .*: must be a function at the top of a file, or a .*"):
        identified(policy)


def test_a_changed_file_of_ones_own_is_another_comparison(tmp_path: Path) -> None:
    own, known = tmp_path / "mine.py", set()
    for text in ("first", "second"):
        own.write_text(f"def decide(view):\n    return []  # {text}\n")
        mine = sortie.load("track_target", {**SHORT, "policy.name": f"{own}:decide", "policy.params": {}})
        known.add(kept_comparison.identity([Contender("mine", mine)], 12))
    assert len(known) == 2


def test_without_torch_the_first_seed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    cheap: list[int] = []

    def missing(contenders: Sequence[Contender], seed: int) -> Row:
        raise InputError("perception.detector is torch, which is not installed: pip install 'sortie-sim[torch]'")

    def by_surrogate(contenders: Sequence[Contender], seed: int) -> Row:
        cheap.append(seed)
        return row("surrogate", seed, 0.0)

    monkeypatch.setattr(multifidelity, "fly_torch", missing)
    monkeypatch.setattr(multifidelity, "fly_surrogate", by_surrogate)
    with pytest.raises(sortie.SortieError, match="torch, which is not installed"):
        compare_to(contenders(), Settings(0.01), None)
    assert len(cheap) == 1


def test_a_fusion_that_the_surrogate_does_not_know_is_refused_before_torch_flies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(multifidelity, "fly_torch", lambda *args: pytest.fail("torch flew"))
    with pytest.raises(sortie.SortieError, match=r"calibrated for fusion 'disconet', perception\.fusion is 'late'"):
        compare_to(
            contenders({**SHORT, "perception.fusion": "late", "perception.detector": "torch"}), Settings(0.01), None
        )


def test_weights_belong_to_one_detector() -> None:
    one = contenders({**SHORT, "perception.detector": "torch", "perception.weights": "some.safetensors"})[0]
    assert with_detector(one, "torch") is one
    cheap = with_detector(one, "surrogate").scenario.perception
    assert (cheap.detector, cheap.weights) == ("surrogate", None)


def test_progress_ends_each_stage(flights: list[tuple[str, int]]) -> None:
    seen: dict[str, tuple[int, float]] = {}
    flown = Flown()
    torch = [with_detector(c, "torch") for c in contenders()]
    run(torch, Settings(0.01), flown, lambda item: None, lambda stage, done, of: seen.update({stage: (done, of)}))
    assert all(done == of for done, of in seen.values())
    assert list(seen)[:3] == [
        "batch 1: paired seeds",
        "batch 2: paired seeds",
        "batch 2: further seeds by the surrogate",
    ]


def test_a_scenario_that_the_surrogate_cannot_fly_is_refused_before_it_stands_in() -> None:
    one = contenders({**SHORT, "perception.detector": "torch", "perception.match_poses": True})[0]
    with pytest.raises(
        sortie.SortieError, match="match_poses: true, must be false where a drone's detector is surrogate"
    ):
        with_detector(one, "surrogate")
