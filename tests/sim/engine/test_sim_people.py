"""People, thermal cameras, and the paper's property: never drop detection sharing while a human is in the region."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sim_examples import example

from sortie.policies.verification.invariants import parse
from sortie.policies.verification.proof import prove
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

PROPERTY = "when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)"
QUICK = ("perception.detector=none", "expect=[]")
FAULT = """
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import nothing

def tired(view):
    '''The worked policy, but silent below 44.5 % charge.'''
    if view.me.battery_soc < 0.445:
        return [nothing(view.ego, p, "saves energy") for p in view.peers]
    return worked(view)
"""


def crossing(*overrides: str, policy: str | None = None) -> SortieRecord:
    return run_sortie(load("person_crossing", overrides=[*QUICK, *overrides]), policy)


@pytest.fixture(scope="module")
def kept() -> SortieRecord:
    return crossing()


def test_the_property_is_kept_with_the_shield_and_dwelling_breaks_it_without(kept: SortieRecord) -> None:
    told = outcome(kept)
    assert told["policies"]["invariant_violations"] == 0
    assert told["policies"]["shield_interventions"] >= 1
    bare = outcome(crossing("policy.shield=false"))["policies"]
    assert bare["violations_by_cause"] == {"policy": 0, "staleness": 0, "damping": 1, "no_peer": 0}


def test_a_planted_policy_breaks_the_property_and_its_proof(tmp_path: Path) -> None:
    path = tmp_path / "tired.py"
    path.write_text(FAULT)
    told = outcome(crossing("policy.shield=false", policy=f"{path}:tired"))
    assert told["policies"]["violations_by_cause"]["policy"] >= 3, "every drone"
    texts = [e["text"] for e in told["events"] if e["kind"] == "violation"]
    assert f"{PROPERTY}: broken by policy" in texts
    shielded = outcome(crossing(policy=f"{path}:tired"))["policies"]
    assert shielded["invariant_violations"] == 0, "the shield keeps it over any policy"


@pytest.mark.parametrize(("body", "outcome_"), [("worked(view)", "proved"), ("tired(view)", "refuted")])
def test_sortie_verify_can_prove_the_property(body: str, outcome_: str) -> None:
    space: dict[str, object] = {}
    exec(FAULT, space)  # noqa: S102 (the planted policy above)
    policy = space[body.partition("(")[0]]
    (verdict,) = [v for v in prove(policy, parse(PROPERTY), max_drones=2) if v.name == PROPERTY]  # type: ignore[arg-type]
    assert verdict.outcome == outcome_


def test_what_drones_know_comes_from_their_cameras_alone(kept: SortieRecord) -> None:
    """Without cameras nobody knows of the person, though the truth is the same."""
    blind = crossing("perception.thermal=null")
    assert blind.tables["alerts"].num_rows == blind.tables["sightings"].num_rows == 0
    there, unseen = outcome(kept)["people"], outcome(blind)["people"]
    assert unseen["in_region_drone_s"] == there["in_region_drone_s"] > 40
    assert unseen["unknown_share"] == 1.0
    assert 0 < there["unknown_share"] < 0.05
    assert unseen["ap_2m"] is None
    flags = {(r["drone"], bool(r["novelty_flags"] & 4)) for r in kept.tables["descriptors"].to_pylist()}
    assert {(d, True) for d in range(3)} <= flags


def test_a_drone_whose_camera_sees_nobody_hears_it_from_its_peers() -> None:
    """Two of the drones are too far from the region for their cameras; they know a frame or two after the third."""
    apart = crossing("fleet.formation={shape: line, spacing_m: 100, altitude_m: 60}", "events=[]")
    (seer,) = {r["drone"] for r in apart.tables["sightings"].to_pylist()}
    alerts = {r["drone"]: r["t_s"] for r in reversed(apart.tables["alerts"].to_pylist()) if r["known"]}
    assert set(alerts) == {0, 1, 2}
    assert all(0 < alerts[drone] - alerts[seer] < 0.3 for drone in {0, 1, 2} - {seer})


def test_draws_do_not_depend_on_what_is_sent(kept: SortieRecord) -> None:
    silent = crossing("policy.shield=false", policy="silence")
    assert silent.tables["sightings"].equals(kept.tables["sightings"])
    other = run_sortie(load("person_crossing", overrides=list(QUICK)), seed=2)
    assert not other.tables["sightings"].equals(kept.tables["sightings"])


def test_unknown_time_is_what_alerts_and_truth_say(kept: SortieRecord) -> None:
    """Counted again, one frame after the other, for the drone that knew first."""
    people = np.array([(r["t_s"], r["x_m"], r["y_m"]) for r in kept.tables["people"].to_pylist()])
    inside = people[np.hypot(people[:, 1] - 13, people[:, 2]) <= 10, 0]
    unknown = 0
    for drone in range(3):
        changes = [(r["t_s"], r["known"]) for r in kept.tables["alerts"].to_pylist() if r["drone"] == drone]
        for t_s in inside:
            known = [k for at, k in changes if at <= t_s + 0.09]
            unknown += not (known and known[-1])
    assert outcome(kept)["people"]["unknown_share"] == pytest.approx(unknown / (3 * len(inside)))


def test_without_people_nothing_changes() -> None:
    told = outcome(run_sortie(example()))["people"]
    assert set(told.values()) == {None}
