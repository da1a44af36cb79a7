"""Fusion and scoring: at each scored frame every receiver fuses what it holds, and its boxes are written down."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import Any, Protocol

import simpy

from fleet.agent import Agent, Received
from perception.types import Boxes, Capture, Share
from scenarios.schema import Scenario
from sim.record import Recorder


class Detector(Protocol):
    """What a sortie needs of a detector."""

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]: ...
    def truth(self, t_s: float, ego: Capture) -> Boxes: ...


def scored(frame: int, rate_hz: float, sample_rate_hz: float) -> bool:
    """Whether a frame is scored, so that `sample_rate_hz` of them are in the mean; the first one is."""
    share = min(1.0, sample_rate_hz / rate_hz)
    return math.floor(frame * share + 1e-9) > math.floor((frame - 1) * share + 1e-9)


def as_share(received: Received) -> Share:
    """A held payload as the detector takes it."""
    payload, roi = received.payload, received.payload.roi
    disc = None if roi is None else (roi.x_m, roi.y_m, roi.radius_m)
    return Share(received.capture, payload.representation.name.lower(), payload.rho, disc, payload.fusion_weight)


class Scorer:
    """Runs the detector over the fleet at the scored frames' fusion times."""

    def __init__(
        self,
        env: simpy.Environment,
        scenario: Scenario,
        detector: Detector,
        agents: Sequence[Agent],
        recorder: Recorder,
    ) -> None:
        self._env, self._scenario, self._detector = env, scenario, detector
        self._agents, self._recorder = agents, recorder

    def start(self) -> None:
        """Begin the process; call once."""
        self._env.process(self._run())

    def _run(self) -> Generator[simpy.Event, Any, None]:
        env, scenario = self._env, self._scenario
        delay_s = scenario.perception.fusion_delay_s
        for frame in range(scenario.frames):
            if scored(frame, scenario.context.rate_hz, scenario.perception.sample_rate_hz):
                yield env.timeout(max(0.0, frame * scenario.frame_s + delay_s - env.now))
                self._score()

    def _score(self) -> None:
        now_s = self._env.now
        egos = [a for a in self._agents if a.airborne and a.latest is not None]
        held = [self._fresh(a, now_s) for a in egos]
        jobs = [
            (a.latest, [as_share(r) for r in received])
            for a, received in zip(egos, held, strict=True)
            if a.latest is not None
        ]
        rows = self._recorder.rows
        for (ego, _), received, boxes in zip(jobs, held, self._detector.detect(jobs), strict=True):
            truth = self._detector.truth(now_s, ego)
            rows["detections"].extend((now_s, ego.drone, *row) for row in _rows(boxes, with_score=True))
            rows["truths"].extend((now_s, ego.drone, *row) for row in _rows(truth, with_score=False))
            rows["fusions"].append(
                (
                    now_s, ego.drone, [r.capture.drone for r in received],
                    [r.payload.representation.name.lower() for r in received],
                    [now_s - r.capture.t_s for r in received], len(boxes), len(truth),
                )
            )  # fmt: skip

    def _fresh(self, agent: Agent, now_s: float) -> list[Received]:
        """What the agent holds that is young enough, by ascending peer."""
        limit_s = self._scenario.perception.max_age_s + 1e-9
        return [agent.held[p] for p in sorted(agent.held) if now_s - agent.held[p].capture.t_s <= limit_s]


def _rows(boxes: Boxes, *, with_score: bool) -> list[tuple[float, ...]]:
    columns = [boxes.xy_m[:, 0], boxes.xy_m[:, 1], boxes.size_m[:, 0], boxes.size_m[:, 1], boxes.yaw_rad]
    if with_score:
        columns.append(boxes.score)
    return list(zip(*(c.tolist() for c in columns), strict=True))
