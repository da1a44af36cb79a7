"""The surrogate as a sortie uses it: the torch detector's interface, nothing rendered, many moments at once. Free of torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from sortie.perception import budget
from sortie.perception.errors import InputError
from sortie.perception.geometry import FULL
from sortie.perception.joining import Heard, joined_many, told
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.draws import Drawn, Luck
from sortie.perception.surrogate.exchange import FeatureShares, alarm_covariates, covariates, mean_shift, pair
from sortie.perception.surrogate.features import CaptureColumns, Eyes, Ints, Looks, axes, off_axes, square, turned
from sortie.perception.surrogate.hashing import mixed, uniform
from sortie.perception.surrogate.model import SHIPPED, SQUARE, Parameters, load, rank_covariates
from sortie.perception.surrogate.shared_false_positives import Mirages
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception

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
        seed, replication: key its draws. A car's luck at a drone and a moment does not depend on what was sent, so
            that policies flown on one seed meet the same luck.
        weights: a calibration's file; None takes the shipped one.

    Raises:
        InputError: a calibration that is missing or broken, or of another fusion than `perception.fusion`.
    """

    def __init__(
        self, scene: SceneModel, config: Perception, seed: int, weights: Path | None = None, replication: int = 0
    ) -> None:
        path = SHIPPED if weights is None else weights
        self._set(scene, config, load(path), seed, replication, scene.config.seed, str(path))

    @classmethod
    def of(
        cls, scene: SceneModel, config: Perception, parameters: Parameters, draw: int, eyes: Eyes | None = None
    ) -> SurrogateDetector:
        """The same from parameters in memory, for one of many draws of everything: of what is the town's as well, which is
        the same for all sorties over it. `eyes` are the scene's, where they are at hand."""
        made = cls.__new__(cls)
        seed, town = scene.config.seed, scene.config.seed + (draw << 40)
        made._set(scene, config, parameters, seed, draw, town, "the calibration", eyes)
        return made

    def _set(
        self,
        scene: SceneModel,
        config: Perception,
        parameters: Parameters,
        seed: int,
        replication: int,
        town: int,
        name: str,
        eyes: Eyes | None = None,
    ) -> None:
        fitted = str(parameters.card["fusion"])
        if config.fusion not in (fitted, "none"):
            raise InputError(
                f"{name}: calibrated for fusion {fitted!r}, perception.fusion is {config.fusion!r}, must be that or 'none'"
            )
        self.parameters, self.calibration = parameters, parameters.id
        self._scene, self._config = scene, config
        self._eyes = eyes or Eyes(scene)
        self._luck = Luck(seed, replication, town, self._eyes.traffic.count, parameters.alike)
        self._mirages = Mirages(town)
        threshold, found, alarms = parameters.boxes
        at = max(config.score_threshold, float(threshold[0]))
        self._found, self._alarms_alone = (float(np.interp(at, threshold, y)) for y in (found, alarms))
        """Of a drone alone: the part of the cars that it finds, and how many boxes of nothing."""

    def detect(self, jobs: Sequence[Job]) -> list[Boxes]:
        """Each ego's boxes from its own look and what it was sent, ENU, best first."""
        return list(self.detect_many([jobs]))

    def detect_many(self, moments: Sequence[Sequence[Job]]) -> BoxColumns:
        """The same for many moments at once, job after job; a moment's jobs are those of one instant."""
        jobs = [
            (ego, shares if self._config.fusion != "none" else (), {e.drone: e for e, _ in moment})
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
        boxes = Boxes(looks.world_m, self._eyes.traffic.size_m[looks.car], looks.yaw_rad, np.ones(len(looks.car)))
        return BoxColumns(looks.first, boxes.single())

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """How many detections the drone would send, as many as the detector has there on average."""
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
        return round(cars * self._found + part * self._alarms_alone)

    def camera_views(self, capture: Capture) -> NDArray[np.uint8]:
        """There are none.

        Raises:
            InputError: always.
        """
        raise InputError("the surrogate renders nothing: fly with perception.detector = torch to see camera views")

    # --- one batch ---------------------------------------------------------------------------------

    def _detect(self, jobs: Sequence[tuple[Capture, Sequence[Share], dict[int, Capture]]]) -> BoxColumns:
        asked = [(ego, shares) for ego, shares, _ in jobs]
        late = {s.capture: None for _, shares in asked for s in shares if not s.is_map and s.weight > 0.0}
        captures = list(dict.fromkeys(c for ego, shares in asked for c in (ego, *(s.capture for s in shares))))
        column = {c: i for i, c in enumerate(captures)}
        fleet = CaptureColumns.of(captures)
        looks = self._eyes.look(fleet)
        luck = self._luck.of(captures, looks)
        p = self.parameters
        confidence = p.confidence(looks.covariates, luck.look)
        asked += [(c, ()) for c in late]
        lies = None
        if not self._config.motion_compensation:
            lies = [[now.get(s.capture.drone, s.capture).est_pose for s in shares] for _, shares, now in jobs]
            lies += [[] for _ in late]
        exchange = FeatureShares.of(asked, column, lies)
        found = self._fuse(exchange, looks, fleet, confidence, luck)
        if not late:
            return found
        boxes = list(found)
        alone = dict(zip(late, boxes[len(jobs) :], strict=True))
        fused = (exchange.arrived[: len(jobs)].sum(axis=1) > 0).tolist()
        heard = []
        for own, (ego, shares, _), f in zip(boxes, jobs, fused, strict=False):
            others = [told(s, alone[s.capture]) for s in shares if not s.is_map and s.weight > 0.0]
            heard.append(Heard(ego.est_pose, own, f, others))
        out = joined_many(heard, self._config.join)
        return BoxColumns(np.cumsum([0, *(len(b) for b in out)]), Boxes.join(out))

    def _fuse(
        self, exchange: FeatureShares, looks: Looks, fleet: CaptureColumns, confidence: NDArray[np.float32], luck: Drawn
    ) -> BoxColumns:
        p, config = self.parameters, self._config
        pairs = pair(exchange, looks, fleet)
        zeros = np.full(len(exchange.ego), config.unsent_cells == "zero")
        cars = np.diff(looks.first)[looks.capture]
        rank = p.rank(rank_covariates(looks.covariates, confidence, cars), luck.rank, config.cells_by)[pairs.peer]
        everything = exchange.cells >= exchange.allowed
        sent = pairs.aimed & (
            (rank < (exchange.cells / np.maximum(exchange.allowed, 1.0))[pairs.row]) | everything[pairs.row]
        )
        exchange.drop_missing(sent, rank, pairs.row)
        x = covariates(pairs, exchange, looks, confidence, sent, rank, zeros[pairs.row])
        score = p.find(x, luck.find[pairs.look])
        here = np.flatnonzero(score >= max(p.floor, config.score_threshold))
        look, row, x, score = pairs.look[here], pairs.row[here], x[here], score[here]
        at, own = looks.xy_m[look], exchange.ego[row]
        heading = looks.yaw_rad[look] - fleet.yaw_rad[own]
        angle, hand = axes(heading, at)
        thrown = luck.thrown[look].copy()
        along = np.where(angle == heading, 1.0, -1.0)  # what lies to one side of a car does so for all who look
        thrown[:, 1:] *= np.stack([along, along * hand, hand], axis=1)
        off, follow = p.place(np.concatenate([x, score[:, None]], axis=1), luck.residual[look], thrown)
        at = (
            at
            + off_axes(off[:, :2].astype(np.float64), angle, hand)
            + mean_shift(pairs, exchange, sent, here) * follow[:, None]
        )
        size = self._eyes.traffic.size_m[looks.car[look]] * np.exp(off[:, 3:5])
        yaw = heading + hand * off[:, 2]
        also = self._alarms(exchange, looks, fleet, zeros, luck)
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
        self, exchange: FeatureShares, looks: Looks, fleet: CaptureColumns, zeros: NDArray[np.bool_], luck: Drawn
    ) -> _Alarms:
        """False alarms: a drone's own, and those of things that others may see as well. One that comes at a rate also comes at
        a higher one."""
        p, ego = self.parameters, exchange.ego
        rate = p.alarm_rates(alarm_covariates(exchange, looks, fleet, zeros, self._scene.config))
        job, band, k = np.nonzero(luck.alarm_at[ego, : rate.shape[1]] < ((1.0 - p.mirages[0]) * rate)[:, :, None])
        own = _Alarms(job, self._pooled(fleet.yaw_rad[ego[job]], band, luck.alarm_which[ego[job], band, k]))
        seen = self._seen(rate, ego, fleet, luck)
        job, drawn = np.concatenate([own.job, seen.job]), np.concatenate([own.drawn, seen.drawn])
        loud = drawn[:, 5] >= self._config.score_threshold
        return _Alarms(job[loud], drawn[loud])

    def _seen(self, rate: NDArray[np.float32], ego: Ints, fleet: CaptureColumns, luck: Drawn) -> _Alarms:
        """Alarms of things in the town, at `rate` [m, bands] of all alarms. They are there for everybody; whether a drone takes
        one for a car, how surely and where exactly, is its own affair."""
        part, chance, spread_m, spread_rad = self.parameters.mirages.astype(np.float64)
        expected = rate.sum(axis=1, dtype=np.float64) * part / chance
        things = self._mirages.about(fleet, float(expected.max(initial=0.0)))
        luck_of = mixed(luck.moment[:, None] ^ things.word)
        seen = things.there & (uniform(luck_of, 0) < chance)
        job, thing = np.nonzero(seen[ego] & (things.rarity < expected[:, None]))
        capture, own = ego[job], luck_of[ego[job], thing]
        over = np.cumsum(rate[job], axis=1) > (uniform(own, 1) * rate[job].sum(axis=1))[:, None]
        band = np.where(over.any(axis=1), over.argmax(axis=1), rate.shape[1] - 1)
        drawn = self._pooled(fleet.yaw_rad[capture], band, uniform(own, 2))
        off = np.stack([ndtri(uniform(own, k)) for k in (3, 4, 5)], axis=1)
        away = turned(things.xy_m[thing] - fleet.position_m[capture, :2], -fleet.yaw_rad[capture])
        drawn[:, :2] = away * fleet.stretch[capture, None] + spread_m * off[:, :2]
        drawn[:, 4] = things.yaw_rad[thing] - fleet.yaw_rad[capture] + spread_rad * off[:, 2]
        return _Alarms(job, drawn)

    def _pooled(self, yaw_rad: Floats, band: NDArray[np.intp], luck: NDArray[np.floating]) -> Floats:
        """Alarms [a, 6] that the detector had, of the given bands, by drones that flew along a street or askew, as these do;
        `luck` [a] uniform."""
        pool = self.parameters.alarm_pool
        which = np.minimum((luck * pool.shape[2]).astype(np.intp), pool.shape[2] - 1)
        out: Floats = pool[(square(yaw_rad) > SQUARE).astype(np.intp), band, which].astype(np.float64)
        return out


@dataclass(frozen=True, slots=True)
class _Alarms:
    """`job` [a] and `drawn` [a, 6] as `ALARM_COLUMNS`."""

    job: NDArray[np.intp]
    drawn: Floats


def _joined(parts: Sequence[BoxColumns]) -> BoxColumns:
    counts = np.concatenate([np.zeros(1, np.int64), *(np.diff(p.first) for p in parts)])
    return BoxColumns(np.cumsum(counts), Boxes.join([p.boxes for p in parts]))
