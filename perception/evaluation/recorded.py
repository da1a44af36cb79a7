"""A recording of another model in the evaluation, under every way of sharing. Free of torch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sortie.perception.evaluation.harness import FLOOR, Evaluation, FleetFrames, Ints, Settings, evaluate
from sortie.perception.evaluation.sharing import SINGLE, Exchange, Floats, Sharing
from sortie.perception.recordings.exchange import Fuse, Sent, fused, fusion_hash, received_boxes
from sortie.perception.recordings.recording import Recording, RecordingError, open_recording
from sortie.scenarios.plugins.reference import resolve

BUDGETS = (0.01, 0.02, 0.05, 0.1, 0.25, 1.0)
"""The paper's."""


def evaluate_recording(
    path: Path | str,
    conditions: Sequence[Sharing] | None = None,
    *,
    fusion: str | None = None,
    floor: float = FLOOR,
    store: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """A recording under some conditions. Every drone is an ego; bytes are those of the recording's own cells.

    Args:
        path: an npz file or a Zarr folder.
        conditions: left out, a drone alone, and all peers at the paper's budgets up to full sharing.
        fusion: `path/to/file.py:function` (`exchange.Fuse`); left out, boxes arrive with their cells.
        floor: the lowest score that is kept.
        store: a folder for finished frames, so that a later call goes on where this one ended.
        progress: called with frames done and frames in all.

    Raises:
        RecordingError: a recording that is broken or cannot be exchanged.
    """
    recording = open_recording(path)
    if conditions is None:
        everyone = [Sharing(budget, f"all-{recording.drones - 1}") for budget in BUDGETS if recording.drones > 1]
        conditions = [SINGLE, *everyone]
    return evaluate(
        RecordedInstrument(recording, fusion),
        frames_of(recording),
        conditions,
        Settings(recording.drones, floor, cell_bytes=recording.cell_bytes),
        store=store,
        progress=progress,
    )


@dataclass(frozen=True, slots=True)
class RecordedFrames:
    """Frames of a recording as the evaluation reads them (`FleetFrames`)."""

    true_pose: Floats
    est_pose: Floats
    cars: Floats
    scene: Ints
    index: Ints
    """[n] which recorded frame each is."""


def frames_of(recording: Recording, which: Sequence[int] | None = None) -> RecordedFrames:
    """The recording's frames, or some of them."""
    index = np.arange(len(recording)) if which is None else np.asarray(which, np.int64)
    truths = [recording.truth(int(f)) for f in index]
    cars = np.full((len(index), max(map(len, truths), default=0), 5), np.nan)
    for row, there in zip(cars, truths, strict=True):
        row[: len(there)] = there
    return RecordedFrames(recording.pose[index], recording.est_pose[index], cars, recording.scene[index], index)


class RecordedInstrument:
    """A recording, and the user's fusion or the object-level stand-in (`recordings.exchange`).

    Args:
        recording: of square features with a side that is a multiple of 64.
        fusion: as for `evaluate_recording`. Under the stand-in, cells that were not sent count as nothing.

    Raises:
        RecordingError: another grid, or a fusion without features.
    """

    def __init__(self, recording: Recording, fusion: str | None = None) -> None:
        self.geometry = recording.geometry
        self._recording = recording
        self._fuse: Fuse | None = None if fusion is None else resolve("recorded_fusion", fusion)
        if fusion is not None and "features" not in recording.large:
            raise RecordingError(f"{recording.path}: features are missing, must be there for a fusion")
        self.fingerprint = f"{content_hash(recording.path)}{fusion_hash(fusion)}"

    def look(self, frames: FleetFrames, frame: int) -> RecordedView:
        """What was recorded of one frame of `frames_of`."""
        return RecordedView(self._recording, self._fuse, int(frames.index[frame]))  # type: ignore[attr-defined]


@dataclass(frozen=True, slots=True)
class RecordedView:
    """One recorded frame (`FrameView`)."""

    recording: Recording
    fuse: Fuse | None
    frame: int

    def rank(self) -> NDArray[np.floating]:
        """[drones, 64, 64] recorded confidence."""
        return np.stack([self.recording.rank(self.frame, i) for i in range(self.recording.drones)])

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """Each ego's boxes before suppression."""
        return [boxes[boxes[:, 5] >= floor] for boxes in map(self._boxes, exchanges)]

    def _boxes(self, e: Exchange) -> Floats:
        sent = [Sent(self.frame, p, cells, self._pose(p)) for p, cells in zip(e.peers, e.sent, strict=True)]
        if self.fuse is None or not sent:
            return received_boxes(self.recording, (self.frame, e.ego), self._pose(e.ego), sent)
        return fused(self.fuse, self.recording, (self.frame, e.ego), self._pose(e.ego), sent, e.unsent)

    def _pose(self, drone: int) -> tuple[float, float, float]:
        x, y, yaw = self.recording.est_pose[self.frame, drone].tolist()
        return x, y, yaw


def content_hash(path: Path) -> str:
    """A hash of a recording's bytes, file by file."""
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            digest.update(file.relative_to(path).as_posix().encode())
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "blake2b").digest())
    return digest.hexdigest()
