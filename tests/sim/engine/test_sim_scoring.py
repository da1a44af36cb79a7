"""Scoring: when accuracy is sampled, what a drone fuses and whose cars count, by made-up drones and detectors."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
import simpy
from agent_rig import capture
from fusing_rig import Mind, Seer, agent
from recorded import recorded
from sim_examples import example

from sortie.perception.motion import Tracks
from sortie.perception.types import Boxes, Capture, Share
from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.sim.engine.fusing import Fusing
from sortie.sim.engine.scoring import Scorer
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import Recorder, SortieRecord

# --- one frame, by hand --------------------------------------------------------------------------


class Nobody:
    """Stands for the people: one is known of, and none is there."""

    def known(self, here: Capture, shares: Sequence[Share], now_s: float) -> Boxes:
        return Boxes(np.full((1, 2), 7.0), np.ones((1, 2)), np.zeros(1), np.ones(1), kind=np.full(1, 2, np.int8))

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return Boxes.empty()


def _scored(agents: Sequence[Any], *sets: str, own: Any = None) -> tuple[Seer, Recorder]:
    """Score the frame of 1 s, at 1.1 s."""
    perception = "perception={detector: surrogate, max_age_s: 0.5, fusion_delay_s: 0.1, compute_delay_s: 0.05}"
    scenario = example(perception, "fleet.drones=6", *sets)
    env, seer, recorder = simpy.Environment(), Seer(), Recorder()
    env.run(until=1.1)
    planned = SimpleNamespace(capture=lambda drone, frame: capture(drone, 1000.0 + frame))
    fusing: Any = Fusing(scenario, SimpleNamespace(tracks=own))  # type: ignore[arg-type]
    scorer = Scorer(env, scenario, seer, agents, recorder, planned, fusing, Nobody(), [])  # type: ignore[arg-type]
    scorer._score(10, agents)
    return seer, recorder


def test_a_drone_fuses_what_it_takes_to_be_fresh_by_ascending_peer_and_weighs_it_by_its_trust() -> None:
    """How old a payload is the drone judges itself: by the sender's clock, corrected as far as it knows."""
    mind = Mind([(4, 0.9, 0.5, 0.5, {}), (1, 0.2, 0.3, 1.0, {}), (3, 0.9, 0.51, 1.0, {})])
    seer, recorder = _scored([agent(0, 1.0, 0.9, mind)])
    here, shares = seer.jobs[0]
    assert here == capture(0, 0.9)
    assert [(s.capture.drone, s.weight, s.age_s, s.missing) for s in shares] == [
        (1, 0.5, 0.3, (3,)),
        (4, 0.25, 0.5, (3,)),
    ]
    ((t_s, drone, peers, rungs, ages_s, weights, found, there),) = recorder.rows["fusions"]
    assert (t_s, drone, peers, rungs, weights) == (1.1, 0, [1, 4], ["features"] * 2, [0.5, 0.25])
    assert ages_s == pytest.approx([0.9, 0.2]), "true ages"
    assert (found, there) == (2, 2), "a box and a person"


def test_own_tracks_move_boxes_that_come_late_and_nothing_else() -> None:
    own = Tracks.empty()
    boxes = {"representation": Representation.DETECTIONS}
    mind = Mind([(1, 1.0, 0.1, 1.0, {}), (2, 1.0, 0.1, 1.0, boxes)])
    asked: list[int] = []
    seer, _ = _scored([agent(3, 1.0, 1.0, mind)], own=lambda drone: asked.append(drone) or own)
    assert [s.tracks is own for s in seer.jobs[3][1]] == [False, True]
    assert asked == [3]


@pytest.mark.parametrize(
    ("latest_s", "peers", "fuses"),
    [
        (0.46, [], "own"),  # 0.5 s, and the 0.15 s that any capture takes to be fused
        (0.44, [], "nothing"),
        (0.44, [1], "peers alone"),
        (None, [1], "never looked"),
    ],
)
def test_a_look_that_is_too_old_is_left_out_and_the_drone_is_where_it_is(
    latest_s: float | None, peers: list[int], fuses: str
) -> None:
    mind = Mind([(p, 1.0, 0.1, 1.0, {}) for p in peers])
    seer, recorder = _scored([agent(0, 1.0, latest_s, mind)])
    if fuses == "own":
        assert seer.jobs[0][0] == capture(0, 0.46)
    elif fuses == "peers alone":
        assert seer.jobs[0][0] == capture(0, 1.0)._replace(looked=False)
    else:
        assert not seer.jobs
    assert len(recorder.rows["fusions"]) == (fuses != "never looked"), "who has never looked is not scored yet"
    if fuses == "nothing":
        assert recorder.rows["fusions"][0][6] == 1, "the person alone"


def test_a_slow_computer_s_look_and_one_that_events_slow_may_be_older() -> None:
    """By 0.2 s; and by 0.36 s and 0.4 s, two events together: the look is as old as it must be, and not too old."""
    slow = "fleet.makes=[{name: a, drones: [2], compute_delay_s: 0.2}]"
    seer, _ = _scored([agent(d, 1.0, 0.35, Mind()) for d in (0, 2)], slow)
    assert seer.jobs.keys() == {2}
    agents = [agent(d, 1.0, -0.3, Mind()) for d in (0, 1, 2)]
    agents[1].status.slower_s, agents[2].status.slower_s = {0: 0.36}, {0: 0.36, 1: 0.4}
    seer, _ = _scored(agents)
    assert seer.jobs.keys() == {2}


def test_who_is_gone_or_has_just_come_back_is_scored_where_it_would_be() -> None:
    """A drone that came back has not sensed since the frame before; one that cannot look needs no look."""
    agents = [
        agent(0, 1.0, 1.0, Mind(), airborne=False),
        agent(1, 0.8, 0.8, Mind()),
        agent(2, 0.9, 0.9, Mind()),
        agent(3, 1.0, None, Mind([(1, 1.0, 0.1, 1.0, {})]), looks=False),
        agent(4, 1.0, None, Mind()),
    ]
    seer, recorder = _scored(agents)
    assert seer.jobs.keys() == {2, 3}
    assert [row[1] for row in recorder.rows["truths"]] == [0, 1, 2, 3]
    assert [row[1] for row in recorder.rows["fusions"]] == [2, 3]


def test_a_detector_of_many_moments_waits_until_there_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    class All(Seer):
        calibration = "made up"

        def detect_many(self, moments: Sequence[Any]) -> list[Boxes]:
            return [boxes for moment in moments for boxes in self.detect(moment)]

        def truth_many(self, t_s: Any, egos: Any) -> list[Boxes]:
            return [self.truth(t, e) for t, e in zip(t_s, egos, strict=True)]

    monkeypatch.setattr("sortie.sim.engine.scoring.WAITING_EGOS", 5)
    env, recorder = simpy.Environment(), Recorder()
    agents = [agent(d, 0.0, 0.0, Mind()) for d in (0, 1)]
    scenario = example("perception={detector: surrogate}", "fleet.drones=2")
    fusing = Fusing(scenario, None)  # type: ignore[arg-type]
    scorer = Scorer(env, scenario, All(), agents, recorder, None, fusing, Nobody(), [])  # type: ignore[arg-type]
    rows = []
    for _ in range(4):
        scorer._score(0, agents)
        rows.append(len(recorder.rows["fusions"]))
    scorer.flush()
    assert [*rows, len(recorder.rows["fusions"])] == [0, 0, 6, 6, 8]


# --- in flight -----------------------------------------------------------------------------------


class Asked:
    """A detector that finds nothing and keeps what it was asked."""

    def __init__(self) -> None:
        self.truths: list[tuple[float, Capture]] = []

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        return [Boxes.empty() for _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        self.truths.append((t_s, ego))
        return Boxes.empty()

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        return 2


class AskedMany(Asked):
    calibration = "none"

    def detect_many(self, moments: Sequence[Sequence[Any]]) -> list[Boxes]:
        return [Boxes.empty() for moment in moments for _ in moment]

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> list[Boxes]:
        return [self.truth(t, ego) for t, ego in zip(t_s, egos, strict=True)]


class AskedAhead(Asked):
    def begin(self, jobs: Sequence[Any]) -> Any:
        return lambda: self.detect(jobs)


@pytest.mark.parametrize("kind", [Asked, AskedMany, AskedAhead])
def test_truth_is_asked_for_at_the_time_of_scoring_and_the_pose_of_the_capture(kind: type[Asked]) -> None:
    """Short flights of their own, with detectors that keep what they were asked."""

    def to_all(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, Representation.FEATURES, 0.02, None, 10.0, reason="all") for p in view.peers]

    detector = kind()
    lost = "events=[{kind: drone_lost, at_s: 1, drone: 2}]"
    sets = ("duration_s=2", "fleet.drones=3", "mission.phases=[{}]", "perception.fusion_delay_s=0.07", lost)
    scenario = example(*sets)
    record = run_sortie(scenario, to_all, detector_of=lambda *_: detector)
    wanted = [frame * 0.1 + 0.07 for frame in scenario.scored_frames]
    assert [t for t, _ in detector.truths] == pytest.approx(np.repeat(wanted, 3))
    for t_s, ego in detector.truths:
        assert ego.t_s == pytest.approx(t_s - 0.07)
    late = [r["drone"] for r in record.tables["fusions"].to_pylist() if r["t_s"] > 1.0]
    assert set(late) == {0, 1}


def test_what_is_fused_had_arrived_and_its_age_is_true() -> None:
    record = recorded("surrogate")
    done_s = {
        (row["peer"], row["drone"], round(row["captured_s"], 6)): row["t_done_s"]
        for row in record.tables["transmissions"].to_pylist()
    }
    fused = 0
    for row in record.tables["fusions"].to_pylist():
        for peer, age_s in zip(row["peers"], row["ages_s"], strict=True):
            assert done_s[row["drone"], peer, round(row["t_s"] - age_s, 6)] <= row["t_s"]
            assert age_s <= record.scenario.perception.max_age_s + 1e-9
            fused += 1
    assert fused > 30


# --- when ----------------------------------------------------------------------------------------


def test_one_frame_of_each_period_is_scored_and_every_phase_of_every_rate_is_met_alike() -> None:
    for sample_hz in (0.5, 2.0, 3.0, 7.0, 10.0):
        scenario = example(f"perception.sample_rate_hz={sample_hz}", "duration_s=41.3")
        frames, periods = scenario.scored_frames, scenario.scoring_periods
        assert len(frames) == len(periods) == pytest.approx(41.3 * sample_hz, abs=1.0)
        assert frames[0] == 0
        assert all(frame in period for frame, period in zip(frames, periods, strict=True))
        assert [f for period in periods for f in period] == list(range(scenario.frames))
        assert frames == sorted(frames)
    scored = np.array(example("duration_s=60").scored_frames)
    for every in (2, 4, 5, 10, 20):
        counts = np.bincount(scored % every, minlength=every)
        assert counts.min() >= 0.6 * len(scored) / every
        assert counts.max() <= 1.5 * len(scored) / every


SETTLED_S = 2.0


def mean_age_over_time_s(record: SortieRecord) -> float:
    """The mean age of the newest payload at each receiver, over all links and the time from `SETTLED_S` on.

    It is exact, as age grows as time does between two arrivals.
    """
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


@pytest.mark.slow
def test_the_age_at_fusion_is_its_mean_over_time() -> None:
    """Frames are scored 95 ms after their begin, so the mean may be off by what a link takes, and no more than 15 ms.

    Sixty of its periods, so that the scored frames meet their phases alike.
    """
    for rate_hz in (1.0, 2.5, 10.0):

        def boxes(view: FleetView, rate_hz: float = rate_hz) -> list[Directive]:
            kind = {"representation": Representation.DETECTIONS, "rate_hz": rate_hz, "deadline_s": 0.5}
            return [Directive(view.ego, p, reason="x", **kind) for p in view.peers]  # type: ignore[arg-type]

        seeing = ("perception={detector: surrogate, max_age_s: 2}", "mission={}")
        record = run_sortie(example(*seeing, f"duration_s={max(20.0, 60.0 / rate_hz)}"), boxes)
        assert outcome(record)["data_age_mean_s"] == pytest.approx(mean_age_over_time_s(record), abs=0.015)
