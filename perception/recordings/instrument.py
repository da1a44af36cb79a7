"""A recording as instrument and frames of the evaluation: every condition of the paper on another model. Free of torch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sortie.perception.evaluation.condition import FULL_SHARING, SINGLE, CellsBy, Sharing
from sortie.perception.evaluation.contract import Exchange, FleetFrames
from sortie.perception.evaluation.evaluate import FLOOR, evaluate
from sortie.perception.evaluation.matched import Evaluation
from sortie.perception.recordings.exchange import Fuse, Sent, fused, fusion_hash, received_boxes
from sortie.perception.recordings.recording import Floats, Ints, Recording, RecordingError, open_recording
from sortie.scenarios.plugins.reference import resolve


@dataclass(frozen=True, slots=True)
class RecordedFrames:
    """Frames of a recording as the evaluation reads them (`contract.FleetFrames`)."""

    true_pose: Floats
    est_pose: Floats
    cars: Floats
    scene: Ints
    index: Ints
    """[n] which recorded frame each is."""

    def __len__(self) -> int:
        return len(self.index)


def frames_of(recording: Recording, which: Sequence[int] | None = None) -> RecordedFrames:
    """The recording's frames, or some of them."""
    index = np.arange(len(recording)) if which is None else np.asarray(which, np.int64)
    truths = [recording.truth(int(f)) for f in index]
    cars = np.full((len(index), max(map(len, truths), default=0), 5), np.nan)
    for row, there in zip(cars, truths, strict=True):
        row[: len(there)] = there
    return RecordedFrames(recording.pose[index], recording.est_pose[index], cars, recording.scene[index], index)


class RecordedInstrument:
    """A recording, and the fusion that the user brought or the object-level stand-in (`exchange`).

    Args:
        recording: of square features whose side is a multiple of 64.
        fusion: `path/to/file.py:function` (`exchange.Fuse`); None takes the stand-in, to which an unsent cell is
            nothing, counted as zeros or not.

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
        """What was recorded of one frame.

        Raises:
            TypeError: frames that are not of a recording.
        """
        if not isinstance(frames, RecordedFrames):
            raise TypeError(f"frames are {type(frames).__name__}, must be frames_of(recording)")
        return RecordedView(self._recording, self._fuse, int(frames.index[frame]))


@dataclass(frozen=True, slots=True)
class RecordedView:
    """One recorded frame (`contract.FrameView`)."""

    recording: Recording
    fuse: Fuse | None
    frame: int

    def rank(self, by: CellsBy) -> NDArray[np.floating]:
        """[drones, 64, 64]"""
        return np.stack([self.recording.rank(self.frame, i, by) for i in range(self.recording.drones)])

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """Each ego's boxes before suppression."""
        found = [self._boxes(e) for e in exchanges]
        return [boxes[boxes[:, 5] >= floor] for boxes in found]

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
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()


def evaluate_recording(
    path: Path,
    conditions: Sequence[Sharing] | None = None,
    *,
    fusion: str | None = None,
    floor: float = FLOOR,
    store: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """A recording under some conditions: by default single, full sharing, and every peer at the paper's budgets.

    Bytes are those of the recording's features: cells × C × 2.

    Raises:
        RecordingError: a recording that is broken or cannot be exchanged.
    """
    recording = open_recording(path)
    peers = f"all-{recording.drones - 1}"
    if conditions is None:
        conditions = [
            SINGLE,
            *(Sharing(budget, peers) for budget in (0.01, 0.02, 0.05, 0.1, 0.25, 1.0) if recording.drones > 1),
        ]
    found = evaluate(
        RecordedInstrument(recording, fusion), frames_of(recording), conditions,
        egos=recording.drones, floor=floor, store=store, progress=progress,
    )  # fmt: skip
    return with_bytes(found, recording)


def with_bytes(evaluation: Evaluation, recording: Recording) -> Evaluation:
    """The same with payloads of the recording's own cells."""
    return replace(evaluation, payload_bytes={c: n * recording.cell_bytes for c, n in evaluation.cells.items()})


__all__ = [
    "FULL_SHARING", "RecordedFrames", "RecordedInstrument", "content_hash", "evaluate_recording", "frames_of", "with_bytes",
]  # fmt: skip
