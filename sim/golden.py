"""Golden outcomes: `NAME.golden.json` beside `NAME.yaml` holds what a scenario came to, renewed only when asked to."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from sim.folders import RunError, write_text

LEFT_OUT = ("fingerprint", "version", "wall_s", "realtime_factor", "policy_eval_us")
"""Wall clock, and what changes with every release."""
RELATIVE, ABSOLUTE = 1e-6, 1e-9
"""Tolerances of a new file; edit them there. Other processors round a network's output differently."""


def golden_path(scenario: Path) -> Path:
    """Where a scenario file's golden outcome stands."""
    return scenario.with_name(f"{scenario.stem}.golden.json")


def figures(result: dict[str, Any]) -> dict[str, Any]:
    """An outcome as flat dotted figures, without what golden outcomes leave out; null where there is none."""
    flat: dict[str, Any] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{prefix}.{key}", inner)
        elif isinstance(value, list):
            for i, inner in enumerate(value):
                walk(f"{prefix}.{i}", inner)
        else:
            flat[prefix[1:]] = value

    walk("", {k: v for k, v in result.items() if k not in LEFT_OUT})
    return flat


def write_golden(path: Path, result: dict[str, Any]) -> None:
    """Write an outcome as the golden one; tolerances of an older file stay.

    Raises:
        RunError: the disk refuses.
    """
    tolerance = {"relative": RELATIVE, "absolute": ABSOLUTE}
    if path.is_file():
        tolerance = _read(path)["tolerance"]
    write_text(path, json.dumps({"tolerance": tolerance, "outcome": figures(result)}, indent=1) + "\n")


def moved(path: Path, result: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Figures that are not the golden ones: expected and got, by dotted name.

    Raises:
        RunError: no golden outcome there, or a broken one.
    """
    golden = _read(path)
    relative, absolute = golden["tolerance"]["relative"], golden["tolerance"]["absolute"]
    expected, got = golden["outcome"], figures(result)

    def same(a: Any, b: Any) -> bool:
        numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (a, b))
        return math.isclose(a, b, rel_tol=relative, abs_tol=absolute) if numbers else a == b

    names = {**expected, **got}
    return {
        n: (expected.get(n, "nothing"), got.get(n, "nothing"))
        for n in names
        if n not in expected or n not in got or not same(expected[n], got[n])
    }


def _read(path: Path) -> dict[str, Any]:
    try:
        golden: dict[str, Any] = json.loads(path.read_text())
        tolerance = golden["tolerance"]
        if not (float(tolerance["relative"]) >= 0 and float(tolerance["absolute"]) >= 0):
            raise ValueError("tolerances must be ≥ 0")
        dict(golden["outcome"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: no golden outcome: {error}") from None
    return golden
