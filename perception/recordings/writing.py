"""Writing a recording: the arrays of the layout, checked first, as one npz file or one Zarr folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.perception.recordings.recording import FORMAT, Floats, RecordingError, checked, from_zarr
from sortie.scenarios.replacing import replacing


def write_recording(
    path: Path | str,
    *,
    t_s: ArrayLike,
    pose: ArrayLike,
    boxes: Sequence[Sequence[ArrayLike]],
    truth: Sequence[ArrayLike],
    cell_m: float,
    features: Iterable[ArrayLike] | None = None,
    confidence: ArrayLike | None = None,
    est_pose: ArrayLike | None = None,
    scene: ArrayLike | None = None,
) -> Path:
    """Write a recording: npz where `path` ends in .npz, else a Zarr folder. Checked first, under a temporary name first.

    Args:
        t_s, pose, est_pose, scene, cell_m, confidence: as in the layout.
        boxes: [n][drones] arrays [m, 6]; truth: [n] arrays [k, 5].
        features: n arrays [drones, C, H, W]; a generator is written to Zarr frame by frame.

    Raises:
        RecordingError: what is to be written is no recording, or a Zarr folder of that name exists.
    """
    path = Path(path)
    each = [_table(path, f"boxes of frame {f}", b, 6) for f, frame in enumerate(boxes) for b in frame]
    cars = [_table(path, f"truth of frame {f}", c, 5) for f, c in enumerate(truth)]
    small: dict[str, NDArray[Any]] = {
        "format": np.array(FORMAT),
        "cell_m": np.array(float(cell_m)),
        "t_s": np.asarray(t_s),
        "pose": np.asarray(pose),
        "boxes": np.concatenate([np.zeros((0, 6)), *each]),
        "boxes_offset": np.cumsum([0, *map(len, each)]),
        "truth": np.concatenate([np.zeros((0, 5)), *cars]),
        "truth_offset": np.cumsum([0, *map(len, cars)]),
    }
    small |= {k: np.asarray(v) for k, v in (("est_pose", est_pose), ("scene", scene)) if v is not None}
    large = {} if confidence is None else {"confidence": _halves(path, "confidence", confidence)}
    drones = checked(path, small, large).drones
    for f, frame in enumerate(boxes):  # in sum they are as many as they must be
        if len(frame) != drones:
            raise RecordingError(f"{path}: boxes of frame {f} are of {len(frame)} drones, must be of {drones}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npz":
        if features is not None:
            halves = [_halves(path, f"features of frame {f}", frame) for f, frame in enumerate(features)]
            large["features"] = np.stack(halves)
        checked(path, small, large)
        with replacing(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **small, **large)  # type: ignore[arg-type]
        return path
    _to_zarr(path, small, large, features)
    return path


def _table(path: Path, name: str, values: ArrayLike, width: int) -> Floats:
    """Rows of so many numbers; whatever is empty has none."""
    table = np.asarray(values, np.float64)
    if table.size and (table.ndim != 2 or table.shape[1] != width):
        raise RecordingError(f"{path}: {name} have shape {list(table.shape)}, must be [any, {width}]")
    return table.reshape(-1, width)


def _halves(path: Path, name: str, values: ArrayLike) -> NDArray[np.float16]:
    """As they are kept; what would be refused when it is read is refused here."""
    with np.errstate(over="ignore"):
        kept = np.asarray(values, np.float16)
    if not np.isfinite(kept).all():
        raise RecordingError(f"{path}: {name} are not finite as float16, must be within ±65504")
    return kept


def _to_zarr(
    path: Path,
    small: Mapping[str, NDArray[Any]],
    large: Mapping[str, NDArray[Any]],
    features: Iterable[ArrayLike] | None,
) -> None:
    if path.exists():
        raise RecordingError(f"{path}: exists already, a Zarr recording must be written to a new folder")
    try:
        import zarr
    except ImportError:
        raise RecordingError(
            f"{path}: Zarr needs pip install 'sortie-sim[zarr]', or a name that ends in .npz"
        ) from None
    with replacing(path, replace=False) as part:
        group = zarr.open_group(part, mode="w")
        for name, values in small.items():
            group.create_array(name, data=values)
        for name, values in large.items():
            group.create_array(name, data=values, chunks=(1, 1, *values.shape[2:]))
        n, d = small["pose"].shape[:2]
        out: Any = None
        for f, frame in enumerate(features if features is not None else ()):
            values = _halves(path, f"features of frame {f}", frame)
            if f == 0 and values.ndim == 4:
                shape, chunks = (n, *values.shape), (1, 1, *values.shape[1:])
                out = group.create_array("features", shape=shape, chunks=chunks, dtype="float16")
            if out is None or f >= n or values.shape != out.shape[1:]:
                bound = f"[{d}, C, H, W], alike in all of {n} frames"
                raise RecordingError(f"{path}: features of frame {f} have shape {list(values.shape)}, must be {bound}")
            out[f] = values
        if features is not None and (out is None or f + 1 != n):
            raise RecordingError(f"{path}: features end after {0 if out is None else f + 1} frames, must be {n}")
        checked(path, *from_zarr(part))
