"""The surrogate as a sortie's detector: nothing is rendered, and many moments are computed at once. Free of torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from sortie.perception import budget
from sortie.perception.errors import InputError
from sortie.perception.geometry import FULL
from sortie.perception.joining import EgoSources, joined_many, source_of
from sortie.perception.lateness import weighed
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.draws import Drawn, DrawSource
from sortie.perception.surrogate.exchange import (
    NO_PEER,
    FeatureShares,
    Led,
    alarm_covariates,
    covariates,
    lead_of,
    mean_shift,
    pair,
    received_only,
)
from sortie.perception.surrogate.features import CaptureColumns, Eyes, Ints, Looks, axes, off_axes, square, turned
from sortie.perception.surrogate.hashing import mixed, uniform
from sortie.perception.surrogate.model import SHIPPED, SQUARE, Parameters, load, rank_covariates
from sortie.perception.surrogate.shared_false_positives import SharedFalsePositives
from sortie.perception.types import Boxes, Capture, Share
from sortie.perception.uncertainty import BoxErrors, load_errors
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception
from sortie.scenarios.shipped import ERRORS, beside, calibration_of

Job = tuple[Capture, Sequence[Share]]
BATCH = 400
"""Jobs worked out together; memory grows with it."""


@dataclass(frozen=True, slots=True)
class BoxColumns:
    """Boxes of many jobs: those of job k are rows `first[k]` to `first[k + 1]`, best first."""

    first: NDArray[np.int64]
    boxes: Boxes

    def __iter__(self) -> Iterator[Boxes]:
        for a, b in zip(self.first[:-1].tolist(), self.first[1:].tolist(), strict=True):
            yield self.boxes.take(slice(a, b))


class SurrogateDetector:
    """The fitted model over one scene.

    Args:
        scene: what there is to see.
        config: the scenario's `perception` section.
        seed, replication: key its draws. The draws for a drone, a moment and a car do not depend on what was sent, so
            policies flown on one seed get the same draws.
        weights: a calibration's file, or a network's with its calibration beside it; None takes the shipped one.

    Raises:
        InputError: a calibration that is missing or broken, or of another fusion than `perception.fusion`.
    """

    name = "surrogate"
    """As `perception.detector` names it."""

    def __init__(
        self, scene: SceneModel, config: Perception, seed: int, weights: Path | None = None, replication: int = 0
    ) -> None:
        path = SHIPPED if weights is None else calibration_of(weights)
        self._set(scene, config, load(path), seed, replication, scene.config.seed, path)

    @classmethod
    def of(
        cls, scene: SceneModel, config: Perception, parameters: Parameters, draw: int, eyes: Eyes | None = None
    ) -> SurrogateDetector:
        """The same from parameters in memory, for one of many draws of everything: of what is the town's as well, which is
        the same for all sorties over it. `eyes` are the scene's, where they are at hand."""
        made = cls.__new__(cls)
        seed, town = scene.config.seed, scene.config.seed + (draw << 40)
        made._set(scene, config, parameters, seed, draw, town, SHIPPED, eyes)
        return made

    def _set(
        self,
        scene: SceneModel,
        config: Perception,
        parameters: Parameters,
        seed: int,
        replication: int,
        town: int,
        path: Path,
        eyes: Eyes | None = None,
    ) -> None:
        fitted = str(parameters.card["fusion"])
        if config.fusion not in (fitted, "none"):
            raise InputError(
                f"{path}: calibrated for fusion {fitted!r}, perception.fusion is {config.fusion!r}, must be that or 'none'"
            )
        self.parameters, self.calibration, self._path = parameters, parameters.id, path
        self._scene, self._config = scene, config
        self._eyes = eyes or Eyes(scene)
        self._draw_source = DrawSource(seed, replication, town, self._eyes.traffic.identity, parameters.alike)
        self._shared = SharedFalsePositives(town)
        threshold, found, false_positives = parameters.boxes
        at = max(config.score_threshold, float(threshold[0]))
        self._found_alone, self._alarms_alone = (float(np.interp(at, threshold, y)) for y in (found, false_positives))
        """Of a drone alone: the share of the cars that it finds, and its number of false positives."""

    @cached_property
    def box_errors(self) -> BoxErrors:
        """How uncertain the boxes of a drone alone are.

        Raises:
            InputError: nobody fitted it for this calibration.
        """
        return load_errors(beside(self._path, ERRORS), self._path.name)

    @cached_property
    def _own_errors(self) -> BoxErrors | None:
        """How uncertain an ego's own boxes are; None where nobody fitted it: they count with the usual one of their class."""
        return self.box_errors if beside(self._path, ERRORS).is_file() else None

    def detect(self, jobs: Sequence[Job]) -> list[Boxes]:
        """Each ego's boxes from its own look and the shares it received, ENU, best first."""
        return list(self.detect_many([jobs]))

    def detect_many(self, moments: Sequence[Sequence[Job]]) -> BoxColumns:
        """The same for many moments at once, job after job; a moment's jobs are those of one instant."""
        jobs = [
            (ego, weighed(ego, shares) if self._config.fusion != "none" else (), {e.drone: e for e, _ in moment})
            for moment in moments
            for ego, shares in moment
        ]
        parts = [self._detect(jobs[a : a + BATCH]) for a in range(0, len(jobs), BATCH)]
        return _joined(parts)

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The cars inside the ego's square at `t_s`, about its true position and heading at capture."""
        return self.truth_many([t_s], [ego]).boxes

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> BoxColumns:
        """The same for many moments at once."""
        parts = [self._truth(t_s[a : a + BATCH], egos[a : a + BATCH]) for a in range(0, len(egos), BATCH)]
        return _joined(parts)

    def _truth(self, t_s: Sequence[float], egos: Sequence[Capture]) -> BoxColumns:
        """As `ground_truth`, but in float32: at the square's edge, within a hundredth of a millimetre, the two may differ."""
        looks = self._eyes.look(replace(CaptureColumns.of(egos), t_s=np.asarray(t_s, float)), bare=True)
        traffic, car = self._eyes.traffic, looks.car
        boxes = Boxes(looks.world_m, traffic.size_m[car], looks.yaw_rad, np.ones(len(car)), traffic.ids[car])
        return BoxColumns(looks.first, boxes.single())

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """The number of detections that the drone would send: the torch detector's average there."""
        half = FULL.half_extent_m
        x, y, radius = (*capture.position_m[:2], 2 * half / np.sqrt(np.pi)) if roi is None else roi
        if roi is not None and np.hypot(x - capture.position_m[0], y - capture.position_m[1]) + radius > half:
            # a disc that leaves the drone's square, or may: what lies beyond is not seen
            looks = self._eyes.look(CaptureColumns.of([capture]), bare=True)
            cars = int(np.count_nonzero(np.hypot(*(looks.world_m - (x, y)).T) <= radius))
            part = budget.cells_sent(1.0, roi, *capture.est_pose) / budget.CELLS
        else:
            cars = self._scene.cars_near(capture.t_s, x, y, radius)
            part = np.pi * radius**2 / (2 * half) ** 2
        return min(round(cars * self._found_alone + part * self._alarms_alone), budget.MOST_BOXES)

    def camera_views(self, capture: Capture) -> NDArray[np.uint8]:
        """There are none.

        Raises:
            InputError: always.
        """
        raise InputError("the surrogate renders nothing: fly with perception.detector = torch to see camera views")

    # --- one batch ---------------------------------------------------------------------------------

    def _detect(self, jobs: Sequence[tuple[Capture, Sequence[Share], dict[int, Capture]]]) -> BoxColumns:
        if any(s.representation == "codes" and s.weight > 0.0 for _, shares, _ in jobs for s in shares):
            raise InputError(
                f"the surrogate cannot estimate what codes do: {self.calibration} was calibrated without them. "
                "Set perception.detector to torch, or let policies send features"
            )
        late = {s.capture: None for _, shares, _ in jobs for s in shares if s.is_detected and s.weight > 0.0}
        leads = {m: lead for m, (ego, shares, _) in enumerate(jobs) if not ego.looked and (lead := lead_of(shares))}
        queries: list[Job] = [(ego, shares) for ego, shares, _ in jobs]
        for m, lead in leads.items():
            rest = [s for s in queries[m][1] if s is not lead]
            laid = lead.capture if self._config.motion_compensation else _believed_now(lead.capture, jobs[m][2])
            queries[m] = laid, [s._replace(weight=s.weight / lead.weight) for s in rest]
        queries += [(c, ()) for c in late]
        seen = [c for ego, shares in queries for c in (ego, *(s.capture for s in shares if s.is_map))]
        captures = list(dict.fromkeys([*seen, *(s.capture for s in leads.values())]))
        column = {c: i for i, c in enumerate(captures)}
        fleet = CaptureColumns.of(captures)
        looks = self._eyes.look(fleet)
        draws = self._draw_source.of(captures, looks)
        p = self.parameters
        confidence = p.confidence(looks.covariates, draws.look)
        lies = None
        if not self._config.motion_compensation:
            nows = [now for _, _, now in jobs] + [{}] * len(late)
            lies = [
                [now.get(s.capture.drone, s.capture).est_pose for s in shares]
                for (_, shares), now in zip(queries, nows, strict=True)
            ]
        exchange = FeatureShares.of(queries, column, lies)
        led = None
        if leads:
            led = Led(list(leads), FeatureShares.of([(s.capture, [s]) for s in leads.values()], column))
        fused = self._fuse(exchange, looks, fleet, confidence, draws, led)
        blind = [m for m, (ego, _, _) in enumerate(jobs) if not ego.looked]
        if not blind and all(s.is_map or s.weight <= 0.0 for _, shares, _ in jobs for s in shares):
            return fused
        boxes = list(fused)
        for m in blind:
            ego, shares, _ = jobs[m]
            boxes[m] = received_only(boxes[m], ego, shares) if m in leads else Boxes.empty()
        alone = dict(zip(late, boxes[len(jobs) :], strict=True))
        with_maps = (exchange.arrived[: len(jobs)].sum(axis=1) > 0).tolist()
        sources = []
        for m, (own, (ego, shares, _), f) in enumerate(zip(boxes, jobs, with_maps, strict=False)):
            others = [
                source_of(
                    s,
                    alone.get(s.capture) if s.is_detected else None,
                    self.box_errors if s.representation == "uncertain_boxes" and s.errors is None else None,
                )
                for s in shares
                if not s.is_map and s.weight > 0.0
            ]
            of = EgoSources.of(ego, shares, own, f or m in leads, others)
            exact = any(s.covariance_m2 is not None for s in others)
            sources.append(of._replace(errors=self._own_errors) if exact else of)
        out = joined_many(sources, self._config.join)
        return BoxColumns(np.cumsum([0, *(len(b) for b in out)]), Boxes.join(out))

    def _fuse(
        self,
        exchange: FeatureShares,
        looks: Looks,
        fleet: CaptureColumns,
        confidence: NDArray[np.float32],
        draws: Drawn,
        led: Led | None = None,
    ) -> BoxColumns:
        p, config = self.parameters, self._config
        pairs = pair(exchange, looks, fleet)
        zeros = np.full(len(exchange.ego), config.unsent_cells == "zero")
        cars = np.diff(looks.first)[looks.capture]
        ranks = p.rank(rank_covariates(looks.covariates, confidence, cars), draws.rank)
        rank = ranks[pairs.peer]
        sent = exchange.sent(pairs, rank)
        own = confidence[pairs.look]
        if led is not None:
            came = led.came(pairs, looks, fleet, ranks)
            own = np.where(came, own, np.float32(NO_PEER))
        x = covariates(pairs, exchange, looks, confidence, sent, rank, zeros[pairs.row], own)
        score = p.find(x, draws.find[pairs.look])
        if led is not None:
            score = np.where(came | sent.any(axis=1), score, np.float32(0.0))
        here = np.flatnonzero(score >= max(p.floor, config.score_threshold))
        look, row, x, score = pairs.look[here], pairs.row[here], x[here], score[here]
        at = looks.xy_m[look]
        heading = looks.yaw_rad[look] - fleet.yaw_rad[exchange.ego[row]]
        angle, hand = axes(heading, at)
        offset_draw = draws.offset_draw[look].copy()
        along = np.where(angle == heading, 1.0, -1.0)  # what lies to one side of a car does so for all who look
        offset_draw[:, 1:] *= np.stack([along, along * hand, hand], axis=1)
        off, follow = p.place(np.concatenate([x, score[:, None]], axis=1), draws.residual[look], offset_draw)
        at = (
            at
            + off_axes(off[:, :2].astype(np.float64), angle, hand)
            + mean_shift(pairs, exchange, sent, here) * follow[:, None]
        )
        size = self._eyes.traffic.seen_size_m[looks.car[look]] * np.exp(off[:, 3:5])
        yaw = heading + hand * off[:, 2]
        also = self._alarms(exchange, looks, fleet, zeros, draws)
        row, score = np.concatenate([row, also.job]), np.concatenate([score, also.drawn[:, 5]])
        at, size = np.concatenate([at, also.drawn[:, :2]]), np.concatenate([size, also.drawn[:, 2:4]])
        yaw = np.concatenate([yaw, also.drawn[:, 4]])
        order = np.argsort(row - score, kind="stable")  # `best_first` in a sixth of its time, as scores lie in (0, 1]
        row, at, size, yaw, score = row[order], at[order], size[order], yaw[order], score[order]
        x_m, y_m, turn = fleet.est[exchange.ego[row]].T
        xy = turned(at, turn) + np.stack([x_m, y_m], axis=1)
        first = np.searchsorted(row, np.arange(len(exchange.ego) + 1))
        return BoxColumns(first, Boxes(xy, size, yaw + turn, score).single())

    def _alarms(
        self, exchange: FeatureShares, looks: Looks, fleet: CaptureColumns, zeros: NDArray[np.bool_], draws: Drawn
    ) -> _Alarms:
        """False positives: a drone's own, and those that others may share. One drawn at a rate is also drawn at a higher one."""
        p, ego = self.parameters, exchange.ego
        rate = p.alarm_rates(alarm_covariates(exchange, looks, fleet, zeros, self._scene.config))
        job, band, k = np.nonzero(
            draws.alarm_at[ego, : rate.shape[1]] < ((1.0 - p.shared_false_positives[0]) * rate)[:, :, None]
        )
        own = _Alarms(job, self._pooled(fleet.yaw_rad[ego[job]], band, draws.alarm_which[ego[job], band, k]))
        seen = self._seen(rate, ego, fleet, draws)
        job, drawn = np.concatenate([own.job, seen.job]), np.concatenate([own.drawn, seen.drawn])
        loud = drawn[:, 5] >= self._config.score_threshold
        return _Alarms(job[loud], drawn[loud])

    def _seen(self, rate: NDArray[np.float32], ego: Ints, fleet: CaptureColumns, draws: Drawn) -> _Alarms:
        """Shared false positives, at `rate` [m, bands] of all.

        Their things stand in the town for every drone. Each drone draws for itself whether it has one, its score and its place.
        """
        part, chance, spread_m, spread_rad = self.parameters.shared_false_positives.astype(np.float64)
        expected = rate.sum(axis=1, dtype=np.float64) * part / chance
        things = self._shared.about(fleet, float(expected.max(initial=0.0)))
        thing_draws = mixed(draws.moment[:, None] ^ things.key)
        seen = things.there & (uniform(thing_draws, 0) < chance)
        job, thing = np.nonzero(seen[ego] & (things.rarity < expected[:, None]))
        capture, own = ego[job], thing_draws[ego[job], thing]
        over = np.cumsum(rate[job], axis=1) > (uniform(own, 1) * rate[job].sum(axis=1))[:, None]
        band = np.where(over.any(axis=1), over.argmax(axis=1), rate.shape[1] - 1)
        drawn = self._pooled(fleet.yaw_rad[capture], band, uniform(own, 2))
        off = np.stack([ndtri(uniform(own, k)) for k in (3, 4, 5)], axis=1)
        away = turned(things.xy_m[thing] - fleet.position_m[capture, :2], -fleet.yaw_rad[capture])
        drawn[:, :2] = away * fleet.stretch[capture, None] + spread_m * off[:, :2]
        drawn[:, 4] = things.yaw_rad[thing] - fleet.yaw_rad[capture] + spread_rad * off[:, 2]
        return _Alarms(job, drawn)

    def _pooled(self, yaw_rad: Floats, band: NDArray[np.intp], draws: NDArray[np.floating]) -> Floats:
        """False positives [a, 6] that the torch detector had in the given bands, by drones turned to the streets as these are.

        `draws` [a] uniform.
        """
        pool = self.parameters.alarm_pool
        which = np.minimum((draws * pool.shape[2]).astype(np.intp), pool.shape[2] - 1)
        out: Floats = pool[(square(yaw_rad) > SQUARE).astype(np.intp), band, which].astype(np.float64)
        return out


@dataclass(frozen=True, slots=True)
class _Alarms:
    """`job` [a] and `drawn` [a, 6] as `ALARM_COLUMNS`."""

    job: NDArray[np.intp]
    drawn: Floats


def _believed_now(capture: Capture, now: dict[int, Capture]) -> Capture:
    """A capture placed where its drone is now, if it is among these."""
    x, y, yaw = now.get(capture.drone, capture).est_pose
    return capture._replace(est_position_m=(x, y, capture.est_position_m[2]), est_yaw_rad=yaw)


def _joined(parts: Sequence[BoxColumns]) -> BoxColumns:
    counts = np.concatenate([np.zeros(1, np.int64), *(np.diff(p.first) for p in parts)])
    return BoxColumns(np.cumsum(counts), Boxes.join([p.boxes for p in parts]))
