"""Loss curves and validation AP of a training run, as a Rerun recording."""

from __future__ import annotations

from pathlib import Path

import rerun as rr

STEP = "step"


class TrainingLog:
    """Scalars of one run in a file that any Rerun viewer opens, also while it grows."""

    def __init__(self, path: Path, name: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._recording = rr.RecordingStream("sortie_training", recording_id=name)
        self._recording.save(path)

    def log(self, step: int, values: dict[str, float]) -> None:
        """One row: values by entity path."""
        self._recording.set_time(STEP, sequence=step)
        for name, value in values.items():
            self._recording.log(name, rr.Scalars(value))

    def close(self) -> None:
        """Write what is left."""
        self._recording.flush()
        self._recording.disconnect()
