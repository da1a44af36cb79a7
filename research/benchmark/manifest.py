"""`manifest.json` of a benchmark: every parameter, every scene, and hashes of the files' content.

Hashes are of arrays, not of files, so that another zip library does not make the same data look different. Free of torch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from research.benchmark.difficulty import Split
from sortie.perception.files import read_npz
from sortie.scenarios.errors import SortieError
from sortie.scenarios.replacing import replacing

MANIFEST = "manifest.json"
COLUMNS = ("images", "true_pose", "est_pose", "cars")
"""Arrays of a scene's file."""


class BenchmarkError(SortieError):
    """A benchmark on disk is missing, broken or changed; the message names the file."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a scene's file.

    Raises:
        BenchmarkError: it cannot be read.
    """
    try:
        arrays = read_npz(path)
        return {name: arrays[name] for name in COLUMNS}
    except Exception as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from error


def content_hash(path: Path) -> str:
    """SHA-256 of a scene file's arrays: names, types, shapes and values, in order.

    Raises:
        BenchmarkError: the file cannot be read.
    """
    digest = hashlib.sha256()
    for name, array in read_arrays(path).items():
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read(folder: Path) -> dict[str, Any]:
    """The manifest in a benchmark's folder.

    Raises:
        BenchmarkError: there is none, or it is not one.
    """
    path = folder / MANIFEST
    try:
        data = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise BenchmarkError(f"{path}: missing, make the benchmark with python -m research bench make") from None
    except (OSError, ValueError) as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from error
    if not isinstance(data, dict) or not {"format", "key", "benchmark", "splits"} <= data.keys():
        raise BenchmarkError(f"{path}: not a benchmark's manifest, format, key, benchmark or splits is missing")
    return data


def listed(folder: Path, split: Split) -> set[str]:
    """Names of the split's files that the manifest has; none where there is no manifest yet."""
    if not (folder / MANIFEST).exists():
        return set()
    return set(read(folder)["splits"].get(split, {}))


def add(
    folder: Path, header: Mapping[str, Any], split: Split, entries: Sequence[tuple[str, Mapping[str, Any]]]
) -> None:
    """Write the manifest with a split's files (name, what it holds) added; others' entries stay as they are.

    Two runs that add at the same moment may lose one's entries; the next `make_split` puts them back.
    """
    splits: dict[str, dict[str, Any]] = read(folder)["splits"] if (folder / MANIFEST).exists() else {}
    splits[split] = dict(sorted({**splits.get(split, {}), **dict(entries)}.items()))
    known = [s for s in get_args(Split) if s in splits]
    data = {
        **header,
        "made_with": {name: version(name) for name in ("sortie-sim", "numpy", "torch")},
        "splits": {s: splits[s] for s in known},
    }
    with replacing(folder / MANIFEST) as part:
        part.write_text(json.dumps(data, indent=1) + "\n", "utf-8")


def problems(folder: Path, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """The problems of a benchmark's files, one line each that names the file; empty where all agree with the manifest.

    Raises:
        BenchmarkError: no readable manifest.
    """
    splits = read(folder)["splits"]
    named = {f"{split}/{name}": entry for split, files in splits.items() for name, entry in files.items()}
    there = {p.relative_to(folder).as_posix() for p in folder.glob("*/scene_*.npz") if ".part" not in p.suffixes}
    found = [f"{name}: not in the manifest" for name in sorted(there - named.keys())]
    for done, (name, entry) in enumerate(sorted(named.items()), 1):
        if name not in there:
            found.append(f"{name}: missing")
        else:
            try:
                if content_hash(folder / name) != entry["sha256"]:
                    found.append(f"{name}: holds other data than the manifest says")
            except BenchmarkError as error:
                found.append(f"{name}: {str(error).partition(': ')[2]}")
        if progress is not None:
            progress(done, len(named))
    return found
