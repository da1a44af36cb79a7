"""Files that come with Sortie, which scenarios and commands name without their folder; and what lies beside a network."""

from __future__ import annotations

import os
from pathlib import Path

TRACES = Path(__file__).parent / "library" / "traces"
"""The library's traces, which scenarios name by their path below it."""
NETWORKS = Path(__file__).parents[1] / "perception" / "network" / "weights"
"""The networks, and what belongs to each."""
SHIPPED_WEIGHTS = NETWORKS / "fine.safetensors"
"""The network that flies where a scenario names none."""
CALIBRATION, CODEBOOK, ERRORS = ".surrogate.safetensors", ".codebook.safetensors", ".errors.json"
"""What the names of calibrations of the surrogate, of codebooks and of the errors of boxes end in."""


def located(path: Path) -> Path:
    """The path itself where it leads to a file, else the shipped trace or network of that name where there is one."""
    # os.path: a name that is too long is no file, where pathlib raises
    return next((p for p in (path, TRACES / path, NETWORKS / path) if os.path.isfile(p)), path)


def beside(weights: Path, suffix: str) -> Path:
    """Where what belongs to a network's weights, or to a calibration, lies.

    Args: `suffix`: `CALIBRATION`, `CODEBOOK` or `ERRORS`.

    Example:
        >>> beside(Path("runs/train/disconet.safetensors"), ERRORS).as_posix()
        'runs/train/disconet.errors.json'
    """
    return weights.with_name(weights.name.removesuffix(".safetensors") + suffix)


def calibration_of(weights: Path) -> Path:
    """The surrogate's calibration that a file means: the one beside a network's weights, or the file itself.

    Example:
        >>> calibration_of(NETWORKS / "disconet.safetensors").name
        'disconet.surrogate.safetensors'
    """
    fitted = beside(located(weights), CALIBRATION)
    return fitted if os.path.isfile(fitted) else located(weights)


def companions(weights: Path) -> list[Path]:
    """The files that belong to a file of weights and that flights with it may read, named as it is."""
    fitted = beside(weights, CALIBRATION)
    found = [fitted, *(beside(of, suffix) for of in (weights, fitted) for suffix in (CODEBOOK, ERRORS))]
    return [path for path in found if os.path.isfile(located(path))]
