"""When accuracy is scored: evenly over each period, at no rate's beat, the same for all policies."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

pytestmark = pytest.mark.slow

SEEING = ("perception.detector=surrogate", "perception.max_age_s=2", "duration_s=20", "mission={}")
SETTLED_S = 2.0


def boxes_at(rate_hz: float, view: FleetView) -> list[Directive]:
    return [
        Directive(view.ego, p, Representation.DETECTIONS, 0.0, None, rate_hz, deadline_s=0.5, reason="x")
        for p in view.peers
    ]


def mean_age_over_time_s(record: SortieRecord) -> float:
    """The mean age of the newest payload at each receiver, over all links and the time from `SETTLED_S` on: exact, as age
    grows as time does between two arrivals."""
    sent = record.tables["transmissions"].filter(pc.equal(record.tables["transmissions"]["status"], "delivered"))
    rows = sent.select(["drone", "peer", "captured_s", "t_done_s"]).to_pylist()
    end_s, area, time_s = record.scenario.duration_s, 0.0, 0.0
    for link in {(r["drone"], r["peer"]) for r in rows}:
        got = sorted((r["t_done_s"], r["captured_s"]) for r in rows if (r["drone"], r["peer"]) == link)
        done = np.clip([t for t, _ in got] + [end_s], SETTLED_S, end_s)
        captured = np.maximum.accumulate([c for _, c in got])
        begin, end = done[:-1] - captured, done[1:] - captured
        area += float(((begin + end) / 2 * np.diff(done)).sum())
        time_s += float(np.diff(done).sum())
    return area / time_s


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 2.5, 5.0, 10.0])
def test_the_age_at_fusion_is_its_mean_over_time(rate_hz: float) -> None:
    """Frames are scored 95 ms after their begin, so the mean may be off by what a link takes, and no more than 15 ms.

    Sixty of its periods, so that the scored frames meet their phases alike: at 1 Hz they come 11 ms late on average in 20 s,
    which leaves the links nothing, and 1 ms early in 60 s.
    """
    record = run_sortie(example(*SEEING, f"duration_s={max(20.0, 60.0 / rate_hz)}"), partial(boxes_at, rate_hz))
    at_fusion = outcome(record)["data_age_mean_s"]
    assert at_fusion == pytest.approx(mean_age_over_time_s(record), abs=0.015)


@pytest.mark.parametrize("sample_hz", [0.5, 2.0, 3.0, 5.0, 7.0, 10.0])
def test_one_frame_of_each_period_is_scored(sample_hz: float) -> None:
    scenario = example(f"perception.sample_rate_hz={sample_hz}", "duration_s=41.3")
    frames, periods = scenario.scored_frames, scenario.scoring_periods
    assert len(frames) == len(periods) == pytest.approx(41.3 * sample_hz, abs=1.0)
    assert frames[0] == 0
    assert all(frame in period for frame, period in zip(frames, periods, strict=True))
    assert [f for period in periods for f in period] == list(range(scenario.frames))
    assert sum(max(0, f) for f in np.diff(frames)) == frames[-1]  # ascending


def test_scored_frames_meet_every_phase_of_every_rate_alike() -> None:
    frames = np.array(example("duration_s=60").scored_frames)
    for every in (2, 4, 5, 10, 20):
        counts = np.bincount(frames % every, minlength=every)
        assert counts.min() >= 0.6 * len(frames) / every
        assert counts.max() <= 1.5 * len(frames) / every


def test_all_policies_are_scored_at_the_same_times() -> None:
    silence, boxes = (
        run_sortie(example(*SEEING, "duration_s=4"), p).tables["fusions"]["t_s"].to_pylist()
        for p in (lambda view: [], partial(boxes_at, 2.0))
    )
    assert silence == boxes
