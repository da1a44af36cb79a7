"""Fusion and scoring: at each scored frame drones fuse the payloads that they hold, and their boxes are recorded.

In a large fleet drones take turns at it (`taking_turns`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import simpy

from sortie.fleet.agent import Agent
from sortie.perception.classes import vehicle_classes
from sortie.perception.detectors import Detector, DetectsAhead, DetectsMany
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.fusing import Fusing, Job, is_flying, of_vehicles, ready
from sortie.sim.engine.people import People
from sortie.sim.engine.tracking import Captures
from sortie.sim.results.record import Recorder

NOBODY = Boxes.empty()
WAITING_EGOS = 1024
"""A detector that takes many moments together runs at the latest when so many egos wait."""


class Ego(NamedTuple):
    """One drone at one moment that is scored."""

    here: Capture
    """Where it is."""
    job: Job | None
    """What it fuses; None where its own capture is too old and nothing fresh was received, so that it detects nothing."""
    flying: bool = True
    """False for a drone that left the air: it fuses nothing, and the cars about its place in the plan are recorded."""
    people: Boxes = NOBODY
    """The people that it knows of after sharing, from its thermal camera and its peers'."""


Moment = tuple[float, list[Ego]]
"""When, and every ego."""


def taking_turns(scenario: Scenario, seed: int, replication: int) -> Iterator[list[int]]:
    """Which drones are scored at each scored moment, by ascending drone: all, or as many as `perception.egos` says.

    They take turns in one random order. Every drone has the same chance at each moment, so what is found, missed and false
    is estimated without bias. Each is scored equally often, so the estimate is more precise than by drones that are drawn
    once, or anew at each moment. The order depends on nothing that flies: policies are scored by the same drones at the
    same moments.
    """
    drones, count = scenario.scorable_drones, scenario.scored_drones
    if scenario.takes_turns:
        drones = stream(seed, replication, (), "scored drones").permutation(drones).tolist()
    for k in range(len(scenario.scored_frames)):
        yield sorted(drones[i % len(drones)] for i in range(k * count, (k + 1) * count))


def jobs_of(moment: Moment) -> list[Job]:
    """The detector's jobs at a moment."""
    return [ego.job for ego in moment[1] if ego.job is not None]


class Scorer:
    """Runs the detector over the drones that are scored at the scored frames' fusion times.

    A detector that takes many moments together runs when enough of them wait. Any other runs at the moment itself. One that
    works in the background has time until the next moment.
    """

    def __init__(
        self,
        env: simpy.Environment,
        scenario: Scenario,
        detector: Detector,
        agents: Sequence[Agent],
        recorder: Recorder,
        captures: Captures,
        fusing: Fusing,
        people: People,
        turns: Iterable[Sequence[int]],
    ) -> None:
        """Args:
        captures: where drones are, or would be had they not left the air.
        fusing: what a drone fuses.
        people: finds, joins and records people; the detector has vehicles alone.
        turns: which drones are scored at each scored moment, ascending.
        """
        self._env, self._scenario, self._detector = env, scenario, detector
        # here and not in each call: a check against a protocol takes longer than a fusion
        self._many = detector if isinstance(detector, DetectsMany) else None
        self._ahead = detector if isinstance(detector, DetectsAhead) else None
        self._agents, self._recorder, self._captures, self._fusing = agents, recorder, captures, fusing
        self._people, self._has_trucks = people, scenario.perception.scene.trucks > 0.0
        self._turns = turns
        self._waiting: list[Moment] = []
        self._begun: list[Callable[[], list[Boxes]]] = []
        recorder.unfold |= {
            "detections": partial(unfold_detections, classes=recorder.classes),
            "truths": partial(_unfold_truths, classes=recorder.classes),
        }

    def start(self) -> None:
        """Begin the process; call once."""
        self._env.process(self._run())

    def _run(self) -> Generator[simpy.Event, Any, None]:
        env, scenario = self._env, self._scenario
        delay_s = scenario.perception.fusion_delay_s
        for frame, drones in zip(scenario.scored_frames, self._turns, strict=True):
            yield env.timeout(max(0.0, frame * scenario.frame_s + delay_s - env.now))
            self._score(frame, [self._agents[drone] for drone in drones])

    def _score(self, frame: int, agents: Sequence[Agent]) -> None:
        now_s = self._env.now
        moment: Moment = now_s, []
        for agent in agents:
            if not is_flying(agent, frame, self._scenario.frame_s):
                moment[1].append(Ego(self._captures.capture(agent.drone, frame), None, flying=False))
            elif (here := ready(agent)) is not None:
                shares = self._fusing.shares(agent, now_s)
                job = self._fusing.job(agent, here, [of_vehicles(s) for s in shares], now_s)
                moment[1].append(Ego(here, job, people=self._people.known(here, shares, now_s)))
        self._waiting.append(moment)
        if self._ahead is not None:
            self._begun.append(self._ahead.begin(jobs_of(moment)))
            self.flush(but=1)
        elif self._many is None or sum(len(egos) for _, egos in self._waiting) >= WAITING_EGOS:
            self.flush()

    def flush(self, but: int = 0) -> None:
        """Record the results of the moments since the last call, except the latest `but`."""
        n = len(self._waiting) - but
        waiting, self._waiting = self._waiting[:n], self._waiting[n:]
        begun, self._begun = self._begun[:n], self._begun[n:]
        egos_scored = [(t_s, ego) for t_s, egos in waiting for ego in egos]
        if not egos_scored:
            return
        rows, detector = self._recorder.rows, self._detector
        detections: Iterable[Boxes]
        truths: Iterable[Boxes]
        if self._many is not None:
            detections = self._many.detect_many([jobs_of(moment) for moment in waiting])
            truths = self._many.truth_many([t_s for t_s, _ in egos_scored], [ego.here for _, ego in egos_scored])
        else:
            computed = begun or [partial(detector.detect, jobs_of(moment)) for moment in waiting]
            detections = (boxes for wait in computed for boxes in wait())
            truths = (detector.truth(t_s, ego.here) for t_s, ego in egos_scored)
        each = iter(detections)
        for (now_s, ego), truth in zip(egos_scored, truths, strict=True):
            boxes, shares = (Boxes.empty(), []) if ego.job is None else (next(each), ego.job[1])
            drone = ego.here.drone
            boxes = Boxes.join([boxes, ego.people]) if len(ego.people) else boxes
            truth = self._with_classes(truth, now_s, ego.here)
            rows["truths"].append((now_s, drone, truth))
            if not ego.flying:
                continue
            rows["detections"].append((now_s, drone, boxes))
            shares = [s for s in shares if s.boxes is None]  # boxes that came with a map are no payload of their own
            rows["fusions"].append(
                (
                    now_s,
                    drone,
                    [s.capture.drone for s in shares],
                    [s.representation for s in shares],
                    [now_s - s.capture.t_s for s in shares],
                    [s.weight for s in shares],
                    len(boxes),
                    len(truth),
                )
            )

    def _with_classes(self, truth: Boxes, t_s: float, here: Capture) -> Boxes:
        """The vehicles about an ego with their classes, and the people there."""
        if self._has_trucks:
            truth = replace(truth, kind=vehicle_classes(truth.size_m[:, 0]))
        people = self._people.truth(t_s, here)
        return Boxes.join([truth, people]) if len(people) else truth


def unfold_detections(rows: Sequence[tuple[Any, ...]], *, classes: bool) -> Sequence[Any]:
    """Columns of the table; each row gathered holds all boxes of a fusion."""
    columns, boxes = _unfold_boxes(rows)
    return [*columns, boxes.score.astype(np.float64), *([boxes.kind] if classes else [])]


def _unfold_boxes(rows: Sequence[tuple[Any, ...]]) -> tuple[list[Any], Boxes]:
    """The columns that both tables of boxes have, and the boxes."""
    t_s, drones, several = zip(*rows, strict=True)
    boxes, counts = Boxes.join(several), [len(b) for b in several]
    values = boxes.xy_m[:, 0], boxes.xy_m[:, 1], boxes.size_m[:, 0], boxes.size_m[:, 1], boxes.yaw_rad
    return [np.repeat(t_s, counts), np.repeat(drones, counts), *(v.astype(np.float64) for v in values)], boxes


def _unfold_truths(rows: Sequence[tuple[Any, ...]], *, classes: bool) -> Sequence[Any]:
    columns, boxes = _unfold_boxes(rows)
    return [*columns, boxes.car, *([boxes.kind] if classes else [])]
