"""What a comparison flies, which fusions it pairs, and whose gains it tells over what."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from record_by_hand import told_outcome
from sim_examples import example

from sortie.perception.metrics.ap import Matched
from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.sim.experiment import compare, flight
from sortie.sim.experiment.compare import Compared, Contender


def named(name: float, *keys: tuple[float, int]) -> dict[tuple[float, int], Matched]:
    """Fusions of a sortie, each with a score that says which it is."""
    found = np.array([True])
    return {key: Matched(np.array([name + key[0] / 100 + key[1] / 1e4]), found, 1) for key in keys}


def test_fusions_are_paired_by_time_and_drone_and_grouped_by_blocks() -> None:
    """Egos and instants of a block of 5 s stand or fall together."""
    one, other = named(10, (1.0, 0), (4.9, 1), (5.0, 0), (6.0, 2)), named(20, (4.9, 1), (1.0, 0), (5.0, 0), (5.0, 1))
    first, second, groups = compare.pair_up(one, other)
    keys = [(1.0, 0), (4.9, 1), (5.0, 0)]
    for arm, name in ((first, 10), (second, 20)):
        wanted = [name + t_s / 100 + drone / 1e4 for t_s, drone in keys]
        assert [float(m.score[0]) for m in arm] == pytest.approx(wanted)
    assert groups == [0.0, 0.0, 1.0]


def scored(*hits: bool) -> Matched:
    """A fusion with as many cars as boxes, found or not, the surest first."""
    return Matched(np.linspace(0.9, 0.5, len(hits)), np.array(hits), len(hits))


Frames = dict[tuple[str, int, bool], dict[tuple[float, int], Matched]]


def fake(monkeypatch: pytest.MonkeyPatch, frames: Frames) -> list[tuple[Any, ...]]:
    """Nothing flies: a record says who flew, and its fusions are given by policy, seed and region."""
    calls: list[tuple[Any, ...]] = []

    def run_sortie(scenario: Any, function: Any, seed: int, progress: Any, **_: Any) -> Any:
        calls.append((scenario.policy.name, function, seed, scenario.perception.scene.seed))
        progress(0.25)
        return SimpleNamespace(policy=scenario.policy.name, seed=seed, fingerprint="")

    def outcome(made: Any) -> dict[str, Any]:
        return told_outcome(off=made.seed / 10 + (0.5 if made.policy == "silence" else 0.0))

    def both_matched(made: Any) -> Any:
        return {area: frames[made.policy, made.seed, area == "mission"] for area in compare.AREAS}

    for name, fake in (("run_sortie", run_sortie), ("outcome", outcome), ("both_matched", both_matched)):
        monkeypatch.setattr(flight, name, fake)
    return calls


FRAMES = {
    # two drones at one moment, one of them also under the other policy: AP is 1 of a car found, 0 of one missed
    ("worked", 5, False): {(1.0, 0): scored(True), (1.0, 1): scored(False)},
    ("silence", 5, False): {(1.0, 0): scored(False), (2.0, 0): scored(True)},
    ("worked", 5, True): {(1.0, 0): scored(False)},
    ("silence", 5, True): {(1.0, 0): scored(True)},
    ("worked", 7, False): {(1.0, 0): scored(False)},
    ("silence", 7, False): {(1.0, 0): scored(True)},
    ("worked", 7, True): {(1.0, 0): scored(True)},
    ("silence", 7, True): {(3.0, 0): scored(True)},  # no fusion in common
}


def contenders() -> list[Contender]:
    base = example("seed=4", "perception.scene.seed=11")
    other = base.model_copy(update={"policy": base.policy.model_copy(update={"name": "silence", "params": {}})})
    return [Contender("first", base), Contender("second", other)]


def test_each_seed_has_its_town_its_first_policy_and_its_own_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    def quiet(view: Any) -> list[Any]:
        return []

    calls, told = fake(monkeypatch, FRAMES), []
    first, second = contenders()
    found = compare.compare([first, second._replace(function=quiet)], [5, 7], progress=lambda *what: told.append(what))
    assert calls == [
        (*who, seed, town) for seed, town in ((5, 12), (7, 14)) for who in (("worked", None), ("silence", quiet))
    ]
    end_s = first.scenario.duration_s
    flights = (("first", 5), ("second", 5), ("first", 7), ("second", 7))
    assert told == [(*which, t_s) for which in flights for t_s in (0.25, end_s)]
    assert [(s.policy, s.seed, s.town_seed, s.gain, s.record is not None) for s in found.sorties] == [
        ("first", 5, 12, {"full_scene": None, "mission": None}, True),
        ("second", 5, 12, {"full_scene": -1.0, "mission": 1.0}, True),
        ("first", 7, 14, {"full_scene": None, "mission": None}, False),
        ("second", 7, 14, {"full_scene": 1.0, "mission": None}, False),
    ]
    assert [s.outcome["ap50"]["full_scene"] for s in found.sorties] == pytest.approx([0.406, 0.411, 0.408, 0.413])
    gains = {g.metric: g for g in found.gains}
    assert {(g.policy, g.over) for g in found.gains} == {("second", "sorties")}
    wanted = mean_interval([-1.0, 1.0], SHARE.of_differences())
    full = gains["ap50.full_scene"]
    assert (full.gain, full.low, full.high, full.count) == pytest.approx((wanted.mean, wanted.low, wanted.high, 2))
    assert (gains["ap50.mission"].gain, gains["ap50.mission"].count) == (1.0, 1)
    for area in ("full_scene", "mission"):  # half a hundredth apart in both sorties
        blind = gains[f"ap50.grounded_blind.{area}"]
        assert (blind.gain, blind.count) == (pytest.approx(0.005), 2)


def test_one_seed_flies_in_the_scenario_s_own_town_and_its_interval_is_over_blocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = fake(monkeypatch, FRAMES)
    found = compare.compare(contenders(), [5])
    assert calls == [("worked", None, 5, 11), ("silence", None, 5, 11)]
    over = ("blocks of one sortie", 1)
    gains = [(g.metric, g.gain, g.over, g.count) for g in found.gains]
    assert gains == [("ap50.full_scene", -1.0, *over), ("ap50.mission", 1.0, *over)]
    assert all(np.isnan([g.low, g.high]).all() for g in found.gains), "one block has no interval"


def test_instants_that_follow_each_other_do_not_narrow_the_interval_of_one_sortie(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The gain changes from block to block and is the same at all instants of each: ten times as many say no more."""
    intervals = []
    for per_block in (1, 10):
        times = [5.0 * block + k / 2 for block in range(12) for k in range(per_block)]
        frames = {(t_s, 0): scored(True, t_s // 5 % 3 > 0) for t_s in times}
        arms = {("worked", 5): {key: scored(True, False) for key in frames}, ("silence", 5): frames}
        fake(monkeypatch, {(*who, mission): made for who, made in arms.items() for mission in (False, True)})
        gain = compare.compare(contenders(), [5]).gains[0]
        assert gain.count == 12
        intervals.append((gain.low, gain.gain, gain.high))
    assert intervals[0] == pytest.approx(intervals[1])
    assert intervals[0][0] < intervals[0][1] < intervals[0][2]


def test_every_policy_is_compared_with_the_first_and_not_with_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third finds what the second found: over the first that is a loss, and over the second nothing."""
    third = {key: FRAMES["silence", *key[1:]] for key in (("boxes", 5, False), ("boxes", 5, True))}
    fake(monkeypatch, FRAMES | third)
    first, second = contenders()
    policy = second.scenario.policy.model_copy(update={"name": "boxes"})
    last = Contender("third", second.scenario.model_copy(update={"policy": policy}))
    for seeds in ([5], [5, 5]):
        found = compare.compare([first, second, last], seeds)
        wanted = {"full_scene": -1.0, "mission": 1.0}
        assert [s.gain for s in found.sorties[:3]] == [{"full_scene": None, "mission": None}, wanted, wanted]
        assert [g.gain for g in found.gains if g.metric == "ap50.full_scene"] == [-1.0, -1.0]


def test_which_seeds_are_flown_when_none_are_listed() -> None:
    for detector, first, count, seeds in (
        ("surrogate", None, None, range(4, 12)),
        ("surrogate", 9, None, range(9, 10)),
        ("surrogate", None, 2, range(4, 6)),
        ("surrogate", 9, 3, range(9, 12)),
        ("torch", None, None, range(4, 5)),
        ("torch", 2, None, range(2, 3)),
    ):
        assert compare.chosen_seeds(example("seed=4", f"perception.detector={detector}"), first, count) == seeds


def _compared(policy: str, seed: int, flown_share: float, blind: float, gain: float) -> Compared:
    areas = ("full_scene", "mission")
    outcome = {"mission": {"flown_share": flown_share}, "ap50": {"grounded_blind": dict.fromkeys(areas, blind)}}
    return Compared(policy, seed, 0, outcome, dict.fromkeys(areas, gain), None)


def test_gains_over_all_drones_are_told_where_any_policy_lost_a_drone_and_are_each_sortie_s_own() -> None:
    first = [_compared("a", 1, 0.8, 0.30, 0.0), _compared("b", 1, 1.0, 0.40, 0.1)]
    second = [_compared("a", 2, 1.0, 0.60, 0.0), _compared("b", 2, 1.0, 0.62, 0.3)]
    gains = {g.metric: (g.policy, pytest.approx(g.gain), g.count) for g in compare._over_sorties([*first, *second])}
    seen = dict.fromkeys(("ap50.full_scene", "ap50.mission"), ("b", 0.2, 2))
    blind = dict.fromkeys(("ap50.grounded_blind.full_scene", "ap50.grounded_blind.mission"), ("b", 0.06, 2))
    assert gains == seen | blind
