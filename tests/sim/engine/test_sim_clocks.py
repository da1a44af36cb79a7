"""Clocks in flight: what a wrong one does, how ages are corrected, and which events say so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.fleet.clock import Oscillator
from sortie.fleet.plane import DroneStatus
from sortie.scenarios.schema import ClockDrift, ClockSkew, GnssLoss
from sortie.sim.engine.own_state import OwnState
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord

FLOWN = ("duration_s=16", "perception.detector=none")


def events(record: SortieRecord, kind: str) -> list[dict[str, Any]]:
    return [e for e in record.tables["events"].to_pylist() if e["kind"] == kind]


def ages_s(record: SortieRecord, since_s: float) -> np.ndarray:
    ages = record.tables["ages"]
    return np.array(ages["age_s"])[np.array(ages["t_s"]) > since_s]


def links_at_the_end(record: SortieRecord) -> dict[tuple[int, int], str]:
    return {(d["drone"], d["peer"]): d["link"] for d in record.tables["directives"].to_pylist()}


@pytest.mark.parametrize("skew_s", [-0.25, 0.25, -3.0, 3.0])
def test_a_wrong_clock_leaves_no_link_slow(skew_s: float) -> None:
    """A clock off by 0.25 s held all links of its drone at 2 Hz, for good and without an event."""
    perfect = run_sortie(example(*FLOWN))
    record = run_sortie(example(*FLOWN, f"events=[{{kind: clock_skew, at_s: 2, drone: 1, skew_s: {skew_s}}}]"))
    assert set(links_at_the_end(record).values()) == {"fresh"}
    late, truth = ages_s(record, 6.0), ages_s(perfect, 6.0)
    assert np.abs(late.mean() - truth.mean()) < 0.05
    assert np.percentile(late, 99) < np.percentile(truth, 99) + 0.06, "half the spread of delays"
    told = [e for e in events(record, "clock") if e["drone"] == 1 and "fleet's" in e["text"]]
    (event,) = told
    assert ("ahead of" if skew_s > 0 else "behind") in event["text"]
    assert event["t_s"] < 5.0


def test_an_event_says_that_a_clock_put_a_drone_out_of_the_plane() -> None:
    """Until its offset is found out, a drone with a clock that is behind looks stale to all others."""
    record = run_sortie(example(*FLOWN, "events=[{kind: clock_skew, at_s: 2, drone: 1, skew_s: -0.5}]"))
    stale = {e["drone"]: e["text"] for e in events(record, "clock") if "link to 1 degraded" in e["text"]}
    assert set(stale) == {0, 2, 3, 4}
    assert all("a clock is wrong, or it waited for the channel" in text for text in stale.values())
    assert {d["link"] for d in record.tables["directives"].to_pylist() if d["peer"] == 1 and d["t_s"] > 2} >= {
        "degraded"
    }


def test_without_gnss_clocks_drift_and_come_back() -> None:
    crystal = ("fleet.clock.drift_ppm=40000", "fleet.clock.drift_growth_ppm_per_min=0")
    record = run_sortie(example(*FLOWN, *crystal, "events=[{kind: gnss_loss, at_s: 2, until_s: 12}]"))
    off_s = {
        (d["drone"], round(d["t_s"])): d["stamp_ns"] * 1e-9 - d["t_s"] for d in record.tables["descriptors"].to_pylist()
    }
    assert abs(off_s[2, 1]) < 0.02
    assert abs(off_s[2, 15]) < 0.02
    spread = [np.ptp([off_s[i, t_s] for i in range(5)]) for t_s in (4, 11)]
    assert spread[1] > 3 * spread[0]
    assert len(events(record, "gnss_loss")) == len(events(record, "gnss_back")) == 5
    late = ages_s(record, 4.0)
    assert np.median(late) < 0.2
    assert late.max() < 1.0


def test_a_drifting_clock_stays_in_the_plane() -> None:
    """2 % fast: after 10 s it is off by two degrading ages' worth."""
    record = run_sortie(example(*FLOWN, "events=[{kind: clock_drift, at_s: 2, drone: 1, drift_ppm: -50000}]"))
    assert set(links_at_the_end(record).values()) == {"fresh"}
    assert any("behind" in e["text"] for e in events(record, "clock") if e["drone"] == 1)


def test_a_wrong_clock_makes_payloads_old_until_it_is_found_out() -> None:
    """Scores are of what was fused: a payload that looks older than `max_age_s` by its stamp is left out."""
    scored = ("duration_s=8", "perception.detector=surrogate", "perception.sample_rate_hz=10", "policy.name=all-4")
    quiet = ("policy.params={received_budget: 0.02}", "perception.max_age_s=0.5")
    skew = "events=[{kind: clock_skew, at_s: 3, drone: 1, skew_s: -1}]"
    record = run_sortie(example(*scored, *quiet, skew))
    fused = {(f["t_s"], f["drone"]): f["peers"] for f in record.tables["fusions"].to_pylist()}
    with_1 = [t_s for (t_s, drone), peers in fused.items() if drone == 0 and 1 in peers]
    gap = [t_s for (t_s, drone) in fused if drone == 0 and 3.3 < t_s < 3.9]
    assert gap
    assert not set(gap) & set(with_1)
    assert {round(t_s) for t_s in with_1} >= {2, 5, 6, 7}
    ages = [a for f in record.tables["fusions"].to_pylist() for a in f["ages_s"]]
    assert min(ages) >= 0.0
    assert max(ages) < 0.6, "the record has true ages"


BEFORE = (
    GnssLoss(kind="gnss_loss", at_s=0.0),
    ClockDrift(kind="clock_drift", at_s=0.0, drone=0, drift_ppm=300.0),
    ClockSkew(kind="clock_skew", at_s=0.0, drone=0, skew_s=-2.0),
)


@pytest.mark.parametrize("first", [BEFORE[0], BEFORE[2]])
@pytest.mark.parametrize("second", [BEFORE[0], BEFORE[2]])
def test_a_clock_that_follows_gnss_again_has_its_constant_error_alone(first: Any, second: Any) -> None:
    """After the last of all losses: no drift is left, and no growth of one."""
    status = DroneStatus()
    own = OwnState(status, Oscillator(0.03, 20.0, 600.0), gnss=True)
    own.begin(first, 0, 10.0)
    own.begin(second, 1, 40.0)
    own.begin(BEFORE[0], 2, 70.0)
    losses = [index for index, event in enumerate((first, second, BEFORE[0])) if isinstance(event, GnssLoss)]
    told = []
    for index in losses:
        own.read(100.0 + index)
        assert status.clock_skew_s != pytest.approx(0.03, abs=1e-4)
        told.append(own.end(BEFORE[0], index, 100.0 + index).kind)
    assert told == ["gnss_loss"] * (len(losses) - 1) + ["gnss_back"]
    for t_s in (130.0, 200.0, 4000.0):
        own.read(t_s)
        assert status.clock_skew_s == pytest.approx(0.03, abs=1e-12)


@pytest.mark.parametrize(("gnss", "drifts_at_s"), [(False, None), (True, 10.0), (False, 10.0), (True, 70.0)])
def test_the_end_of_a_loss_leaves_a_clock_alone_that_does_not_follow_gnss(
    gnss: bool, drifts_at_s: float | None
) -> None:
    """Because it never did, or because it was set drifting before the loss or during it."""
    errors_s = []
    for ends in (False, True):
        status = DroneStatus()
        own = OwnState(status, Oscillator(0.03, 20.0, 600.0), gnss=gnss)
        for t_s in (10.0, 40.0, 70.0):
            if t_s == drifts_at_s:
                own.begin(BEFORE[1], 0, t_s)
            if t_s == 40.0:
                own.begin(BEFORE[0], 1, t_s)
        if ends:
            assert own.end(BEFORE[0], 1, 100.0) == ("gnss_back", "GNSS is back: the clock does not follow it")
        own.read(400.0)
        errors_s.append(status.clock_skew_s)
    assert errors_s[0] == pytest.approx(errors_s[1])


def test_a_clock_without_gnss_drifts_by_a_rate_that_grows() -> None:
    """From the moment of the loss on, by its own oscillator; one that an event sets going does not grow."""
    status = DroneStatus()
    own = OwnState(status, Oscillator(0.5, 20.0, 60.0), gnss=True)
    own.begin(BEFORE[0], 0, 100.0)
    own.read(220.0)
    assert status.clock_skew_s == pytest.approx(0.5 + (20.0 + 60.0 * 2.0 / 2) * 1e-6 * 120.0)
    own.begin(BEFORE[1], 1, 220.0)
    since = status.clock_skew_s
    own.read(820.0)
    assert status.clock_skew_s == pytest.approx(since + 300e-6 * 600.0)
