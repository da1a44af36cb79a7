"""Drones that lie, in flight: they are found out, lose weight and say, and honest fleets are left alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.policies.registry import resolve, within_budget
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.policy_text import policy_overrides
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SEARCH = "mission.phases=[{at_s: 0, phase: search}]"


def lie(about: str = "coverage", claim: str = "much", until_s: str = "") -> str:
    return f"events=[{{kind: lie, at_s: 1, drone: 1, about: {about}, claim: {claim}{until_s}}}]"


def flown(*overrides: str, policy: str = "who2com-style") -> SortieRecord:
    settings = (f"policy.name={policy}", f"policy.params={within_budget(resolve(policy), 0.05)}", SEARCH)
    return run_sortie(example(*settings, *overrides))


def links(record: SortieRecord, since_s: float) -> set[tuple[int, int]]:
    """Who sent features to whom."""
    sent = record.tables["transmissions"].to_pylist()
    return {(t["drone"], t["peer"]) for t in sent if t["t_sent_s"] >= since_s and t["representation"] == "features"}


def test_a_liar_takes_everyones_place_until_it_is_found_out() -> None:
    """Under the stand-in for Who2com each drone is served by one other. All believe that drone 1 is it, which serves where it truly is."""
    honest, fooled, trusting = (
        flown(*more, "duration_s=10") for more in ((), (lie(), "context.trust=false"), (lie(),))
    )  # fmt: skip
    assert {sender for sender, peer in links(fooled, 5.0) if peer != 1} == {1}
    assert {sender for sender, peer in links(honest, 5.0) if peer != 1} == {1, 2, 3, 4}
    assert {sender for sender, peer in links(trusting, 5.0) if peer != 1} >= {2, 3, 4}
    served = [sum(r.tables["transmissions"]["cells"].to_pylist()) for r in (honest, fooled)]
    assert served[1] < 0.8 * served[0]


def test_a_liar_loses_its_fusion_weight() -> None:
    record = flown(lie(), "duration_s=12", "perception.detector=surrogate", policy="all-4")
    late = [f for f in record.tables["fusions"].to_pylist() if f["t_s"] > 9.0 and f["drone"] != 1]
    weights = [dict(zip(f["peers"], f["weights"], strict=True)) for f in late]
    assert all(w[1] == 0.0 for w in weights)
    assert all(w[p] == 1.0 for w in weights for p in w if p != 1)


@pytest.mark.parametrize("about", ["coverage", "goodput", "battery"])
@pytest.mark.parametrize("claim", ["much", "little"])
def test_a_lie_stands_in_the_descriptors(about: str, claim: str) -> None:
    honest, lying = (r.tables["descriptors"].to_pylist() for r in (flown(), flown(lie(about, claim))))
    field = {"coverage": "coverage_grid", "goodput": "goodput_mbps", "battery": "soc"}[about]
    said = [d for d in lying if d["drone"] == 1 and d["t_s"] >= 1.0]
    truth = [d for d in honest if d["drone"] == 1 and d["t_s"] >= 1.0]
    assert len({str(d[field]) for d in said}) == 1
    assert all(d[field] != t[field] for d, t in zip(said, truth, strict=True))


def test_trust_comes_back_after_the_lie() -> None:
    record = flown(lie(until_s=", until_s: 4"), "duration_s=15")
    last = {(r["drone"], r["peer"]): r["trust"] for r in record.tables["trust"].to_pylist()}
    assert last == {(i, 1): 1.0 for i in (0, 2, 3, 4)}
    assert outcome(record)["distrusted_by"] == {"1": 4}


@pytest.mark.parametrize("policy", ["worked", "all-4", "deputies", "where2comm-style"])
def test_honest_fleets_doubt_nobody_and_fly_as_without_trust(policy: str) -> None:
    """With a jammer, a lost drone, a battery fault and links that break: none of it is a lie."""
    events = (
        "events=[{kind: jam, at_s: 5, position_m: [-180, 0, 60], power_dbm: 0, until_s: 10},"
        "{kind: link_drop, at_s: 12, drone: 2, loss_db: 40, until_s: 18},"
        "{kind: battery_fault, at_s: 8, drone: 3, lost_fraction: 0.4}, {kind: drone_lost, at_s: 20, drone: 4}]"
    )
    trusting, without = (
        run_sortie(
            load("track_target", ["perception.detector=none", "duration_s=30", f"context.trust={on}", events]), policy
        )
        for on in ("true", "false")
    )
    assert outcome(trusting)["distrusted_by"] == {}
    assert trusting.fingerprint == without.fingerprint


@pytest.mark.parametrize("rate_hz", [0.5, 1, 2, 5])
def test_honest_fleets_doubt_nobody_at_any_rate_of_the_plane(rate_hz: float) -> None:
    """A claim that is a second old says nothing of what came since."""
    asked = ["perception.detector=none", "duration_s=20", f"context.rate_hz={rate_hz}", "fleet.drones=4"]
    for seed in (1, 2, 3):
        record = run_sortie(
            load("track_target", [*asked, *policy_overrides("all-4(received_budget=0.02)", "worked")]), None, seed
        )
        assert record.tables["transmissions"].num_rows > 50
        assert outcome(record)["distrusted_by"] == {}


def test_honest_fleets_doubt_nobody_at_the_edge_of_range() -> None:
    """There a payload that is lost brings its sender's estimate to nothing, beside those that came before it."""
    weak = [
        "radio.tx_power_dbm=-8", "radio.preamble_detection_dbm=-95", "fleet.formation.spacing_m=60", "perception.detector=none",
        "duration_s=20",
    ]  # fmt: skip
    lost = 0
    for seed in (1, 2):
        record = run_sortie(
            load("track_target", [*weak, *policy_overrides("all-4(received_budget=0.02)", "worked")]), None, seed
        )
        lost += record.tables["transmissions"]["status"].to_pylist().count("lost")
        assert outcome(record)["distrusted_by"] == {}
    assert lost > 100


def test_who_claims_more_than_a_full_channel_carries_is_found_out() -> None:
    """There a payload is on its way whenever a claim is made; none of them could make it true."""
    full = ["radio.bandwidth_mhz=20", "perception.detector=none", "duration_s=30"]
    much = "events=[{kind: lie, at_s: 5, drone: 2, about: goodput, claim: much}]"
    record = run_sortie(
        load("track_target", [*full, much, *policy_overrides("all-4(received_budget=0.1)", "worked")]), None, 1
    )
    assert outcome(record)["distrusted_by"] == {"2": 4}


def test_honest_fleets_doubt_nobody_where_slow_descriptors_are_lost() -> None:
    """One each ten seconds, of which links of 200 m lose some: a charge does not stand still because nobody tells it."""
    slow = ["context.rate_hz=1", "context.publish_every=10", "radio.tx_power_dbm=0", "fleet.formation.spacing_m=200"]
    slow.append("radio.preamble_detection_dbm=-95")
    asked = ["perception.detector=none", "duration_s=60", "events=[]", "fleet.formation.shape=line", *slow]
    lost = 0
    for seed in range(1, 7):
        record = run_sortie(
            load("track_target", [*asked, *policy_overrides("all-4(received_budget=0.02)", "worked")]), None, seed
        )
        lost += sum(age_s > 20 for age_s in record.tables["ages"]["age_s"].to_pylist())
        assert outcome(record)["distrusted_by"] == {}
    assert lost > 100


def test_honest_traces_are_not_doubted(tmp_path: Path) -> None:
    """A charge in whole percents, and links that carry more than the channel's own frames could."""
    drones, links = tmp_path / "drones.csv", tmp_path / "links.csv"
    drones.write_text(
        "t_s,drone,soc\n"
        + "".join(f"{25 * k},1,{0.9 - k / 100:.2f}\n{25 * k + 24.9},1,{0.9 - k / 100:.2f}\n" for k in range(3))
    )
    links.write_text("t_s,sender,receiver,goodput_mbps\n0,0,1,2000\n0,1,0,2000\n")
    asked = [
        "perception.detector=none",
        "duration_s=60",
        "policy.hysteresis=0",
        "fleet.drones=4",
        f"fleet.trace={drones}",
        f"radio.trace={links}",
    ]
    record = run_sortie(load("track_target", asked))
    told = record.tables["descriptors"].filter(pc.equal(record.tables["descriptors"]["drone"], 1))
    assert set(np.round(told["soc"].to_numpy(), 4)) == {0.9, 0.89, 0.88}
    assert max(map(max, told["goodput_mbps"].to_pylist())) > 700  # the channel's fastest frames have 600
    assert outcome(record)["distrusted_by"] == {}
