"""Clocks: what an own clock shows after events, and what wrong clocks do in flight."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from recorded import recorded
from sim_examples import example

from sortie.fleet.clock import DroneClock, Oscillator
from sortie.fleet.plane import DroneStatus
from sortie.scenarios.schema import Event, Lasting
from sortie.scenarios.schema.events.clocks import ClockDrift, ClockSkew, GnssLoss
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.live.events import LiveFleet
from sortie.sim.results.record import SortieRecord

LOSS = GnssLoss(kind="gnss_loss", at_s=0.0)
DRIFT = ClockDrift(kind="clock_drift", at_s=0.0, drone=0, drift_ppm=300.0)
SKEW = ClockSkew(kind="clock_skew", at_s=0.0, drone=0, skew_s=-2.0)


class Clock:
    """A drone's own clock, and by how much it is wrong."""

    def __init__(self, oscillator: Oscillator, *, gnss: bool = True) -> None:
        self.status = DroneStatus()
        self.own = DroneClock(self.status, oscillator, gnss=gnss)
        self.told: list[str] = []

    def error_s(self, now_s: float) -> float:
        self.own.read(now_s)
        return self.status.clock_skew_s

    def begin(self, event: Event, index: int, now_s: float) -> None:
        event.begin(LiveFleet(now_s, index, 0, self.own, self.status, self.told.append))  # type: ignore[arg-type]

    def end(self, event: Lasting, index: int, now_s: float) -> str:
        event.end(LiveFleet(now_s, index, 0, self.own, self.status, self.told.append), lasts=False)  # type: ignore[arg-type]
        return self.told[-1]


# --- one clock, by hand --------------------------------------------------------------------------


@pytest.mark.parametrize("gnss", [True, False])
def test_a_clock_drifts_at_the_rate_of_its_event_and_jumps_to_the_offset_of_its_event(gnss: bool) -> None:
    """Whatever its oscillator does of itself; before and after it goes on without a jump. It follows GNSS no more."""
    clock = Clock(Oscillator(0.3, 50.0, 900.0), gnss=gnss)
    of_itself = clock.error_s(60.0)
    assert of_itself == pytest.approx(0.3 if gnss else 0.3 + (50.0 + 450.0) * 60e-6)
    clock.begin(DRIFT.model_copy(update={"drift_ppm": -200.0}), 0, 60.0)
    for later_s in (0.0, 10.0, 400.0):
        assert clock.error_s(60.0 + later_s) == pytest.approx(of_itself - 200e-6 * later_s)
    clock.begin(SKEW.model_copy(update={"skew_s": 2.0}), 1, 500.0)
    for later_s in (0.0, 100.0):  # the rate stays
        assert clock.error_s(500.0 + later_s) == pytest.approx(2.0 - 200e-6 * later_s)
    before = clock.error_s(700.0)
    clock.begin(LOSS, 2, 700.0)
    assert clock.error_s(760.0) == pytest.approx(before - 200e-6 * 60.0)
    clock.end(LOSS, 2, 760.0)
    assert clock.error_s(900.0) == pytest.approx(before - 200e-6 * 200.0)


def test_a_clock_without_gnss_drifts_by_a_rate_that_grows() -> None:
    """From the moment of the loss on, by its own oscillator; one that an event sets going does not grow."""
    clock = Clock(Oscillator(0.5, 20.0, 60.0))
    clock.begin(LOSS, 0, 100.0)
    assert clock.error_s(220.0) == pytest.approx(0.5 + (20.0 + 60.0 * 2.0 / 2) * 1e-6 * 120.0)
    clock.begin(DRIFT, 1, 220.0)
    since = clock.error_s(220.0)
    assert clock.error_s(820.0) == pytest.approx(since + 300e-6 * 600.0)


def test_a_clock_that_follows_gnss_again_has_its_constant_error_alone() -> None:
    """After the last of all losses: no drift is left, and no growth of one."""
    for first, second in product((LOSS, SKEW), repeat=2):
        clock = Clock(Oscillator(0.03, 20.0, 600.0))
        for index, (event, at_s) in enumerate(((first, 10.0), (second, 40.0), (LOSS, 70.0))):
            clock.begin(event, index, at_s)
        losses = [index for index, event in enumerate((first, second, LOSS)) if isinstance(event, GnssLoss)]
        told = []
        for index in losses:
            assert clock.error_s(100.0 + index) != pytest.approx(0.03, abs=1e-4)
            told.append(clock.end(LOSS, index, 100.0 + index))
        assert told == ["still no GNSS: another loss lasts"] * (len(losses) - 1) + ["the clock follows GNSS again"]
        for t_s in (130.0, 200.0, 4000.0):
            assert clock.error_s(t_s) == pytest.approx(0.03, abs=1e-12)


def test_the_end_of_a_loss_leaves_a_clock_alone_that_does_not_follow_gnss() -> None:
    """Because it never did, or because it was set drifting before the loss or during it."""
    for gnss, drifts_at_s in ((False, None), (True, 10.0), (False, 10.0), (True, 70.0)):
        errors_s = []
        for ends in (False, True):
            clock = Clock(Oscillator(0.03, 20.0, 600.0), gnss=gnss)
            for t_s in (10.0, 40.0, 70.0):
                if t_s == drifts_at_s:
                    clock.begin(DRIFT, 0, t_s)
                if t_s == 40.0:
                    clock.begin(LOSS, 1, t_s)
            if ends:
                assert clock.end(LOSS, 1, 100.0) == "GNSS is back: the clock does not follow it"
            errors_s.append(clock.error_s(400.0))
        assert errors_s[0] == pytest.approx(errors_s[1])


# --- in flight -----------------------------------------------------------------------------------


def links_at_the_end(record: SortieRecord) -> set[str]:
    last = {(d["drone"], d["peer"]): d["link"] for d in record.tables["directives"].to_pylist()}
    return set(last.values())


def ages_s(record: SortieRecord, since_s: float) -> np.ndarray:
    ages = record.tables["ages"]
    return np.array(ages["age_s"])[np.array(ages["t_s"]) > since_s]


def test_wrong_clocks_leave_no_link_slow() -> None:
    """A flight of its own: a clock off by 0.25 s once held all links of its drone at 2 Hz, without an event."""
    skews = {1: -0.25, 2: 0.25, 3: 3.0}
    events = [f"{{kind: clock_skew, at_s: 2, drone: {d}, skew_s: {s}}}" for d, s in skews.items()]
    events.append("{kind: clock_drift, at_s: 2, drone: 4, drift_ppm: -50000}")  # after 10 s off by two degrading ages
    record = run_sortie(example("duration_s=12", f"events=[{', '.join(events)}]"))
    assert links_at_the_end(record) == {"fresh"}
    late, truth = ages_s(record, 6.0), ages_s(recorded("base"), 1.0)
    assert np.abs(late.mean() - truth.mean()) < 0.05
    assert np.percentile(late, 99) < np.percentile(truth, 99) + 0.06, "half the spread of delays"
    found = [e for e in record.tables["events"].to_pylist() if e["kind"] == "clock" and "fleet's" in e["text"]]
    for drone, skew_s in skews.items():
        (event,) = [e for e in found if e["drone"] == drone]
        assert ("ahead of" if skew_s > 0 else "behind") in event["text"]
        assert event["t_s"] < 5.0
    assert any("behind" in e["text"] for e in found if e["drone"] == 4)


def test_an_event_says_that_a_clock_put_a_drone_out_of_the_plane() -> None:
    """Until its offset is found out, a drone with a clock that is behind looks stale to all others."""
    record = recorded("faults")
    clock = [e for e in record.tables["events"].to_pylist() if e["kind"] == "clock" and "link to 4" in e["text"]]
    assert {e["drone"] for e in clock} >= {1, 2}
    assert all("degraded" in e["text"] for e in clock)
    assert all("a clock is wrong, or it waited for the channel" in e["text"] for e in clock)
    links = [d for d in record.tables["directives"].to_pylist() if d["peer"] == 4 and 5.5 < d["t_s"] < 6]
    assert "degraded" in {d["link"] for d in links}


def test_without_gnss_clocks_drift_and_come_back() -> None:
    """A flight of its own, with crystals that drift fast."""
    crystal = ("fleet.clock.drift_ppm=40000", "fleet.clock.drift_growth_ppm_per_min=0")
    record = run_sortie(example("duration_s=10", *crystal, "events=[{kind: gnss_loss, at_s: 1, until_s: 8}]"))
    rows = record.tables["descriptors"].to_pylist()
    off_s = {(d["drone"], round(d["t_s"])): d["stamp_ns"] * 1e-9 - d["t_s"] for d in rows}
    assert abs(off_s[2, 0]) < 0.02
    assert abs(off_s[2, 9]) < 0.02
    spread = [np.ptp([off_s[i, t_s] for i in range(5)]) for t_s in (2, 7)]
    assert spread[1] > 3 * spread[0]
    kinds = record.tables["events"]["kind"].to_pylist()
    assert kinds.count("gnss_loss") == kinds.count("gnss_back") == 5
    late = ages_s(record, 3.0)
    assert np.median(late) < 0.2
    assert late.max() < 1.0


def test_a_wrong_clock_makes_payloads_old_until_it_is_found_out() -> None:
    """A flight of its own, scored often: a payload that looks older than `max_age_s` by its stamp is left out."""
    scored = "perception={detector: surrogate, sample_rate_hz: 10, max_age_s: 0.5}"
    quiet = ("duration_s=6", "policy={name: all-4, params: {received_budget: 0.02}}", "fleet.drones=3")
    skew = "events=[{kind: clock_skew, at_s: 2, drone: 1, skew_s: -1}]"
    fusions = run_sortie(example(scored, *quiet, skew)).tables["fusions"].to_pylist()
    of_0 = {f["t_s"]: f["peers"] for f in fusions if f["drone"] == 0}
    gap = [1 in peers for t_s, peers in of_0.items() if 2.3 < t_s < 2.9]
    assert gap
    assert not any(gap)
    assert {round(t_s) for t_s, peers in of_0.items() if 1 in peers} >= {1, 4, 5}
    ages = [a for f in fusions for a in f["ages_s"]]
    assert 0.0 <= min(ages) < max(ages) < 0.6, "the record has true ages"
