"""What each condition of a calibration sends: from whom, of when, how much and where; and whose boxes' errors are taken."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from perception_examples import capture

from research.calibrate import errors
from research.calibrate.plan import (
    AGES_S,
    BUDGETS,
    MANNERS,
    DetectorJob,
    conditions,
    moment,
    scene_seed,
    street_conditions,
)
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc

PLACES = ((0.0, 0.0), (30.0, 5.0), (-11.0, 2.0), (4.0, -50.0), (18.0, 40.0))
YAW = 0.7
NOW = [capture(x, y, yaw=YAW, drone=k, est=(x + 9, y - 9, 70.0, YAW + 2)) for k, (x, y) in enumerate(PLACES)]
OLD = {age: [c._replace(t_s=c.t_s - age) for c in NOW] for age in AGES_S}
DISC = Disc(5.0, 6.0, 32.0)


def told(jobs: Any) -> dict[str, DetectorJob]:
    several = list(jobs)
    out = {j.condition: j for j in several}
    assert len(out) == len(several)
    return out


def shares(who: list[int], kind: str = "features", rho: float = 1.0, **other: Any) -> tuple[Share, ...]:
    of: list[Capture] = other.pop("of", NOW)
    return tuple(Share(of[k], kind, rho, other.get("roi"), other.get("weight", 1.0)) for k in who)


@pytest.mark.parametrize("ego", range(5))
def test_every_condition_sends_what_its_name_says(ego: int) -> None:
    """The disc lies 20 m ahead of where the drone truly is; near and far are by true places over ground."""
    jobs = told(conditions(ego, NOW, OLD))
    peers = [k for k in range(5) if k != ego]
    away = {k: np.hypot(PLACES[k][0] - PLACES[ego][0], PLACES[k][1] - PLACES[ego][1]) for k in peers}
    near = sorted(peers, key=away.__getitem__)
    expected: dict[str, tuple[Share, ...]] = {"alone": ()}
    expected |= {f"all-4, ρ = {rho:g}": shares(peers, rho=rho) for rho in BUDGETS}
    expected |= {f"all-4, ρ = {rho:g}, zeros": shares(peers, rho=rho) for rho in (0.01, 0.05, 0.25)}
    expected |= {f"all-4, ρ = 0.25, {age:g} s older": shares(peers, rho=0.25, of=OLD[age]) for age in (0.2, 0.4)}
    expected |= {f"nearest 2, ρ = {rho:g}": shares(near[:2], rho=rho) for rho in (0.1, 0.5)}
    expected |= {
        "all-4, ρ = 0.25, weight ½": shares(peers, rho=0.25, weight=0.5),
        "farthest 2, ρ = 0.5": shares(near[2:], rho=0.5),
        "detections": shares(peers, "detections"),
        "detections, averaged": shares(peers, "detections"),
        "tracks": shares(peers, "tracks"),
    }
    both = shares(near[:2], rho=0.1) + shares(near[2:], "detections", 0.0)
    expected |= {f"nearest 2, ρ = 0.1, boxes of the others, {rule}": both for rule in ("nms", "average")}
    for rho in (0.02, 0.25):
        job = jobs[f"all-4, ρ = {rho:g}, 32 m"]
        for s, k in zip(job.shares, peers, strict=True):
            assert (s.capture, s.representation, s.rho, s.weight) == (NOW[k], "features", rho, 1.0)
            assert s.roi == pytest.approx((PLACES[ego][0] + 20 * np.cos(YAW), PLACES[ego][1] + 20 * np.sin(YAW), 32.0))
        expected[job.condition] = job.shares
    assert {name: j.shares for name, j in jobs.items()} == expected
    for name, j in jobs.items():
        assert (j.ego, j.disc) == (NOW[ego], None)
        assert (j.unsent == "zero") == ("zeros" in name)
        assert (j.join == "average") == ("average" in name)


@pytest.mark.parametrize("ego", range(5))
def test_along_a_street_every_condition_is_judged_in_the_mission_s_disc_too(ego: int) -> None:
    jobs = told(street_conditions(ego, NOW, OLD, DISC))
    peers = [k for k in range(5) if k != ego]
    expected = {f"all-4, ρ = {rho:g}": shares(peers, rho=rho) for rho in (0.006, 0.025, 0.1, 0.35)} | {
        "alone": (),
        "all-4, ρ = 0.1, 32 m": shares(peers, rho=0.1, roi=DISC),
        "all-4, ρ = 0.1, 0.1 s older": shares(peers, rho=0.1, of=OLD[0.1]),
        "detections": shares(peers, "detections", 0.0),
        "detections, averaged": shares(peers, "detections", 0.0),
    }
    assert {name: j.shares for name, j in jobs.items()} == {f"street: {name}": s for name, s in expected.items()}
    for name, j in jobs.items():
        assert (j.ego, j.disc, j.unsent) == (NOW[ego], DISC, "masked")
        assert (j.join == "average") == ("average" in name)


@pytest.mark.parametrize("index", range(len(MANNERS)))
def test_for_a_fit_every_drone_is_alone_once_and_never_its_own_peer(index: int) -> None:
    """Three plain exchanges a drone: all others, of now, whole maps, at one budget."""
    for scene in range(6):
        jobs = moment(0, "fit", scene, index)
        alone = [j.ego.drone for j in jobs if not j.shares]
        assert sorted(alone) == list(range(5))
        for j in jobs:
            senders = [s.capture.drone for s in j.shares]
            assert j.ego.drone not in senders
            assert len(set(senders)) == len(senders)
        for j in jobs[-15:]:
            assert {s.capture.drone for s in j.shares} == set(range(5)) - {j.ego.drone}
            assert {(s.capture.t_s, s.representation, s.roi, s.weight) for s in j.shares} == {
                (j.ego.t_s, "features", None, 1.0)
            }
            assert len({s.rho for s in j.shares}) == 1
        assert [sum(j.ego.drone == k for j in jobs[-15:]) for k in range(5)] == [3] * 5


def test_held_out_fleets_have_the_defaults_errors_of_pose_in_place_and_heading() -> None:
    """0.2 m along each axis and 0.2°, with banks and nods of three degrees."""
    fleets = {j.ego for s in range(150) for j in moment(0, "held-out", s, 0) if not j.shares}
    off = np.array([np.subtract(c.est_position_m, c.position_m) for c in fleets])
    turn = np.degrees([np.angle(np.exp(1j * (c.est_yaw_rad - c.true_yaw_rad))) for c in fleets])
    assert off.std(axis=0) == pytest.approx([0.2] * 3, rel=0.2)
    assert np.std(turn) == pytest.approx(0.2, rel=0.2)


def test_towns_of_two_seeds_splits_or_indices_never_meet() -> None:
    seen = [scene_seed(seed, split, k) for seed in (0, 1) for split in ("fit", "held-out") for k in (0, 1, 99_999)]  # type: ignore[arg-type]
    assert seen == sorted(set(seen))
    assert seen[0] == 50_000_000


def test_errors_are_those_of_a_fleet_alone_over_its_own_town_at_its_own_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice over each town, once in each manner; boxes against the cars of the moment, by the poses that drones believe in."""
    made: list[Any] = []

    def scene_model(seed: int, split: str, town: int) -> Any:
        return SimpleNamespace(town=town, cars_at=lambda t_s: SimpleNamespace(table=lambda: (town, t_s)))

    class Alone:
        def __init__(self, scene: Any, config: Any, seed: int, weights: Path) -> None:
            made.append((scene.town, config.detector, seed, weights))

        def detect(self, jobs: Any) -> list[Boxes]:
            assert all(shares == () for _, shares in jobs)
            return [f"boxes of {ego.drone}" for ego, _ in jobs]  # type: ignore[misc]

    monkeypatch.setattr(errors.plan, "scene_model", scene_model)
    monkeypatch.setattr(errors, "SurrogateDetector", Alone)
    monkeypatch.setattr(errors, "errors_of", lambda boxes, pose, cars: (boxes, pose, cars))
    found = errors.moments(Path("w"), "held-out", 3)
    assert made == [(town, "surrogate", town, Path("w")) for town in range(3)]
    assert len(found) == 3 * len(MANNERS)
    for k, several in enumerate(found):
        town, manner = divmod(k, len(MANNERS))
        jobs = moment(errors.SEED, "held-out", town, manner, condition_egos=5)
        fleet = {j.ego.drone: j.ego for j in jobs if not j.shares}
        assert several == [(f"boxes of {d}", fleet[d].est_pose, (town, fleet[d].t_s)) for d in range(5)]  # type: ignore[comparison-overlap]
