"""Fusion and scoring: at each scored frame every receiver fuses what it holds, and its boxes are written down."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
import simpy

from fleet.agent import Agent, Received
from perception.detectors import DetectsAhead, DetectsMany
from perception.types import Boxes, Capture, Share
from scenarios.schema import Scenario
from sim.record import REPRESENTATIONS, Recorder


class Detector(Protocol):
    """What a sortie needs of a detector."""

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]: ...
    def truth(self, t_s: float, ego: Capture) -> Boxes: ...


def scored(frame: int, rate_hz: float, sample_rate_hz: float) -> bool:
    """Whether a frame is scored, so that `sample_rate_hz` of them are in the mean; the first one is."""
    share = min(1.0, sample_rate_hz / rate_hz)
    return math.floor(frame * share + 1e-9) > math.floor((frame - 1) * share + 1e-9)


def as_share(received: Received, trust: float = 1.0) -> Share:
    """A held payload as the detector takes it, from a sender that its receiver trusts so far."""
    payload, roi = received.payload, received.payload.roi
    disc = None if roi is None else (roi.x_m, roi.y_m, roi.radius_m)
    name, weight = REPRESENTATIONS[payload.representation], payload.fusion_weight * trust
    return Share(received.capture, name, payload.rho, disc, weight, received.missing)


Moment = tuple[float, list[tuple[Capture, list[Share]]]]
"""When, and each ego with what it holds."""


class Scorer:
    """Runs the detector over the fleet at the scored frames' fusion times.

    A detector that takes many moments together is asked when `flush` is called, any other at the moment itself; one that
    works in the background may take until the next moment.
    """

    def __init__(
        self,
        env: simpy.Environment,
        scenario: Scenario,
        detector: Detector,
        agents: Sequence[Agent],
        recorder: Recorder,
    ) -> None:
        self._env, self._scenario, self._detector = env, scenario, detector
        # asked once: what a protocol asks of a class takes longer to find out than a fusion takes
        self._many = detector if isinstance(detector, DetectsMany) else None
        self._ahead = detector if isinstance(detector, DetectsAhead) else None
        self._agents, self._recorder = agents, recorder
        self._waiting: list[Moment] = []
        self._begun: list[Callable[[], list[Boxes]]] = []
        recorder.unfold |= {"detections": _unfold_detections, "truths": _unfold_truths}

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
            (a.latest, [as_share(r, a.trust_in(r.capture.drone)) for r in received])
            for a, received in zip(egos, held, strict=True)
            if a.latest is not None
        ]
        self._waiting.append((now_s, jobs))
        if self._ahead is not None:
            self._begun.append(self._ahead.begin(jobs))
            self.flush(but=1)
        elif self._many is None:
            self.flush()

    def flush(self, but: int = 0) -> None:
        """Write down what the moments since the last call come to, but the latest so many."""
        n = len(self._waiting) - but
        waiting, self._waiting = self._waiting[:n], self._waiting[n:]
        begun, self._begun = self._begun[:n], self._begun[n:]
        asked = [(t_s, ego, shares) for t_s, jobs in waiting for ego, shares in jobs]
        if not asked:
            return
        rows, detector = self._recorder.rows, self._detector
        found: Iterable[Boxes]
        truths: Iterable[Boxes]
        if self._many is not None:
            found = self._many.detect_many([jobs for _, jobs in waiting])
            truths = self._many.truth_many([t_s for t_s, _, _ in asked], [ego for _, ego, _ in asked])
        else:
            ready = begun or [partial(detector.detect, jobs) for _, jobs in waiting]
            found = (boxes for wait in ready for boxes in wait())
            truths = (detector.truth(t_s, ego) for t_s, ego, _ in asked)
        for (now_s, ego, shares), boxes, truth in zip(asked, found, truths, strict=True):
            rows["detections"].append((now_s, ego.drone, boxes))
            rows["truths"].append((now_s, ego.drone, truth))
            rows["fusions"].append(
                (
                    now_s, ego.drone, [s.capture.drone for s in shares], [s.representation for s in shares],
                    [now_s - s.capture.t_s for s in shares], [s.weight for s in shares], len(boxes), len(truth),
                )
            )  # fmt: skip

    def _fresh(self, agent: Agent, now_s: float) -> list[Received]:
        """What the agent holds that is young enough, by ascending peer."""
        limit_s = self._scenario.perception.max_age_s + 1e-9
        return [agent.held[p] for p in sorted(agent.held) if now_s - agent.held[p].capture.t_s <= limit_s]


def _unfold_detections(rows: Sequence[tuple[Any, ...]]) -> Sequence[Any]:
    """A fusion's boxes stand in one row."""
    t_s, drones, several = zip(*rows, strict=True)
    boxes, counts = Boxes.join(several), [len(b) for b in several]
    values = boxes.xy_m[:, 0], boxes.xy_m[:, 1], boxes.size_m[:, 0], boxes.size_m[:, 1], boxes.yaw_rad, boxes.score
    return [np.repeat(t_s, counts), np.repeat(drones, counts), *(v.astype(np.float64) for v in values)]


def _unfold_truths(rows: Sequence[tuple[Any, ...]]) -> Sequence[Any]:
    return _unfold_detections(rows)[:-1]
