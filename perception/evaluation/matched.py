"""The results of an evaluation: matched detections per ego and frame under every condition; Parquet. Free of torch."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sortie.perception.code_digest import boxes_digest
from sortie.perception.errors import InputError
from sortie.perception.evaluation.condition import Sharing
from sortie.perception.files import replacing
from sortie.perception.joining import NMS_IOU
from sortie.perception.metrics.ap import CONVENTIONS, Matched, average_precision
from sortie.scenarios.regular import regular

Region = Literal["full", "mission", "ego"]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
FLOOR = 0.01


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings that the results depend on, beside instrument, frames and condition."""

    egos: int = 5
    """The first so many drones of a frame are egos."""
    floor: float = FLOOR
    """The lowest score that is kept."""
    convention: str = "rotated"
    """A name of `ap.CONVENTIONS`."""
    seed: int = 0
    """Of the mission's targets and of random peers."""
    nms_iou: float = NMS_IOU


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame under some conditions."""

    target: tuple[float, float]
    """Centre of the mission's disc; NaN where there is none."""
    units: Mapping[tuple[Sharing, Region], Sequence[Matched]]
    """One for each ego."""
    cost: Mapping[Sharing, Sequence[tuple[int, int, int]]]
    """Cells shared to each ego, their bytes, and the bytes that say which cells they are."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """n frames × `egos` under every condition. A unit is one ego of one frame, frame by frame."""

    conditions: tuple[Sharing, ...]
    regions: tuple[Region, ...]
    settings: Settings
    scene: Ints
    """[n]"""
    target: Floats
    """[n, 2] centre of the mission's disc; NaN where the frame has none and does not count for the mission."""
    units: Mapping[tuple[Sharing, Region], Sequence[Matched]]
    """One `Matched` per unit [n · egos]."""
    cells: Mapping[Sharing, Ints]
    """[n · egos] cells shared to the unit, in all."""
    payload_bytes: Mapping[Sharing, Ints]
    """[n · egos] cells × 80 × 2."""
    index_bytes: Mapping[Sharing, Ints]
    """[n · egos] which cells they are, counted apart."""

    def at(self, tau: float) -> Evaluation:
        """The same with every box below `tau` gone.

        Raises:
            InputError: below the floor, where boxes were not kept.
        """
        if not tau >= self.settings.floor:  # NaN is neither
            raise InputError(f"tau is {tau}, must be at least the floor {self.settings.floor}")
        cut = {key: [m.at(tau) for m in several] for key, several in self.units.items()}
        return replace(self, units=cut, settings=replace(self.settings, floor=tau))

    def counts(self, region: Region) -> NDArray[np.bool_]:
        """[n · egos]: the units that count in a region; for the mission those of frames that have a target."""
        every = np.ones(len(self.scene), bool) if region != "mission" else ~np.isnan(self.target[:, 0])
        return np.repeat(every, self.settings.egos)

    def matched(self, condition: Sharing, region: Region = "full") -> list[Matched]:
        """The units that count, in order."""
        several = self.units[condition, region]
        return [several[i] for i in np.flatnonzero(self.counts(region)).tolist()]

    def groups(self, region: Region = "full", by: Literal["frame", "scene"] = "frame") -> Ints:
        """A label for each unit of `matched`: units of one frame, or of one scene, stand or fall together in a bootstrap."""
        label = np.arange(len(self.scene)) if by == "frame" else self.scene
        return np.repeat(label, self.settings.egos)[self.counts(region)]

    def ap(self, condition: Sharing, region: Region = "full") -> float:
        """AP@0.5 over the units that count, in the convention of the settings."""
        return average_precision(self.matched(condition, region), CONVENTIONS[self.settings.convention])

    def save(self, path: Path) -> None:
        """Write everything as one Parquet file, under a temporary name first."""
        facts = {
            "settings": asdict(self.settings), "regions": self.regions, "scene": self.scene.tolist(),
            "conditions": [c.label for c in self.conditions],
        }  # fmt: skip
        write_frames(path, {f"{f:06d}": self._frame(f) for f in range(len(self.scene))}, facts)

    @classmethod
    def load(cls, path: Path) -> Evaluation:
        """What `save` wrote.

        Raises:
            InputError: no such file, or not one of these; the message names it.
        """
        try:
            results, facts = read_frames(path)
            frames = [results[f"{f:06d}"] for f in range(len(facts["scene"]))]
            conditions = [Sharing.parse(label) for label in facts["conditions"]]
            return assemble(frames, conditions, facts["regions"], Settings(**facts["settings"]), facts["scene"])
        except (OSError, pa.ArrowInvalid, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not an evaluation of this project ({error!r})") from None

    def _frame(self, f: int) -> FrameResult:
        these = slice(f * self.settings.egos, (f + 1) * self.settings.egos)
        costs = (self.cells, self.payload_bytes, self.index_bytes)
        return FrameResult(
            (float(self.target[f, 0]), float(self.target[f, 1])),
            {key: several[these] for key, several in self.units.items()},
            {c: list(zip(*(cost[c][these].tolist() for cost in costs), strict=True)) for c in self.conditions},
        )


def assemble(
    frames: Sequence[FrameResult],
    conditions: Sequence[Sharing],
    regions: Sequence[Region],
    settings: Settings,
    scene: Sequence[int] | Ints,
    computed_as: Mapping[Sharing, Sharing] | None = None,
) -> Evaluation:
    """Frames in order as one evaluation; `computed_as` says under which equal condition a condition was evaluated."""
    source = {c: c for c in conditions} | dict(computed_as or {})
    cost = {
        c: np.array([ego for frame in frames for ego in frame.cost[source[c]]], np.int64).reshape(-1, 3)
        for c in conditions
    }
    return Evaluation(
        tuple(conditions), tuple(regions), settings, np.asarray(scene, np.int64),
        np.array([frame.target for frame in frames], np.float64).reshape(-1, 2),
        {(c, r): [m for frame in frames for m in frame.units[source[c], r]] for c in conditions for r in regions},
        *({c: rows[:, i] for c, rows in cost.items()} for i in range(3)),
    )  # fmt: skip


class MatchedStore:
    """Finished frames of one instrument under one set of settings, by one version of the code, in a folder of Parquet parts.

    A later evaluation takes from it what it needs, whichever conditions and frames the earlier ones were about.
    """

    def __init__(self, folder: Path, fingerprint: str, settings: Settings, regions: Sequence[Region]) -> None:
        what = json.dumps([boxes_digest(), fingerprint, asdict(settings), sorted(regions)])
        self._folder = folder / hashlib.blake2b(what.encode(), digest_size=8).hexdigest()
        self._done: dict[str, FrameResult] = {}
        for part in sorted(self._folder.glob("*.parquet")):
            try:
                found, _ = read_frames(part)
            except (OSError, pa.ArrowInvalid, KeyError, ValueError) as error:
                raise InputError(f"{part}: not part of an evaluation ({error!r}); remove it to go on") from None
            for key, result in found.items():
                self._done[key] = _joined(self._done.get(key), result)
        self._new: dict[str, FrameResult] = {}

    def get(self, key: str) -> FrameResult | None:
        """What is known of a frame."""
        return self._done.get(key)

    def add(self, key: str, result: FrameResult) -> FrameResult:
        """Keep what was newly found of a frame, on disk with the next `flush`; all that is known of it."""
        self._new[key] = result
        self._done[key] = _joined(self._done.get(key), result)
        return self._done[key]

    def flush(self) -> None:
        """Write what is new as one more part."""
        if self._new:
            name = hashlib.blake2b("".join(sorted(self._new)).encode() + os.urandom(8), digest_size=8).hexdigest()
            write_frames(self._folder / f"{name}.parquet", self._new, {})
            self._new = {}


def _joined(old: FrameResult | None, new: FrameResult) -> FrameResult:
    if old is None:
        return new
    return FrameResult(new.target, {**old.units, **new.units}, {**old.cost, **new.cost})


def _to_table(frames: Mapping[str, FrameResult], facts: Mapping[str, Any]) -> pa.Table:
    """One row per frame, condition, region and ego."""
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    units: list[Matched] = []
    for key, frame in frames.items():
        for (condition, region), several in frame.units.items():
            for ego, (unit, cost) in enumerate(zip(several, frame.cost[condition], strict=True)):
                row = (key, condition.label, region, ego, *frame.target, *cost, unit.truths)
                for column, value in zip(columns.values(), row, strict=True):
                    column.append(value)
                units.append(unit)
    ends = np.cumsum([0, *(len(u.score) for u in units)]).astype(np.int32)
    arrays = [pa.array(values, kind) for values, kind in zip(columns.values(), _COLUMNS.values(), strict=True)]
    for values, kind in (([u.score for u in units], np.float32), ([u.hit for u in units], np.bool_)):
        flat = np.concatenate([np.zeros(0, kind), *values]).astype(kind)
        arrays.append(pa.ListArray.from_arrays(pa.array(ends), pa.array(flat)))
    return pa.Table.from_arrays(arrays, [*_COLUMNS, "score", "hit"]).replace_schema_metadata(
        {"sortie": json.dumps(dict(facts))}
    )


_COLUMNS = {
    "frame": pa.string(), "condition": pa.string(), "region": pa.string(), "ego": pa.int16(),
    "target_x_m": pa.float64(), "target_y_m": pa.float64(), "cells": pa.int32(), "payload_bytes": pa.int32(),
    "index_bytes": pa.int32(), "truths": pa.int32(),
}  # fmt: skip


def _from_table(table: pa.Table) -> dict[str, FrameResult]:
    rows = [table.column(name).to_pylist() for name in _COLUMNS]
    lists = [table.column(name).combine_chunks() for name in ("score", "hit")]
    score = lists[0].values.to_numpy().astype(np.float64)
    hit = lists[1].values.to_numpy(zero_copy_only=False)
    ends = lists[0].offsets.to_numpy()
    out: dict[str, FrameResult] = {}
    known: dict[str, Sharing] = {}
    for n, (key, label, region, ego, x, y, cells, payload, index, truths) in enumerate(zip(*rows, strict=True)):
        condition = known.get(label) or known.setdefault(label, Sharing.parse(label))
        frame: Any = out.get(key) or out.setdefault(key, FrameResult((x, y), {}, {}))
        here = slice(ends[n], ends[n + 1])
        units = frame.units.setdefault((condition, region), [])
        units.append(Matched(score[here], hit[here], truths))
        cost = frame.cost.setdefault(condition, [])
        if len(cost) == ego:  # repeated for each region
            cost.append((cells, payload, index))
    return out


def write_frames(path: Path, frames: Mapping[str, FrameResult], facts: Mapping[str, Any]) -> None:
    """Some frames by key, and facts about them as JSON, as one Parquet file; under a temporary name first."""
    with replacing(path) as part:
        pq.write_table(_to_table(frames, facts), part, compression="zstd")


def read_frames(path: Path) -> tuple[dict[str, FrameResult], dict[str, Any]]:
    """What `write_frames` wrote.

    Raises:
        Exception: OSError, pyarrow.ArrowInvalid, KeyError or ValueError where it is not such a file.
    """
    table = pq.read_table(regular(path))
    return _from_table(table), json.loads(table.schema.metadata[b"sortie"])
