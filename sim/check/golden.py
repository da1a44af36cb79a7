"""Golden outcomes: `NAME.golden.json` beside `NAME.yaml` holds a scenario's outcome; only `--update` renews it."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sortie.sim.folders import RunError, write_text
from sortie.sim.results.outcome import is_number, leaves
from sortie.sim.results.outcome_fields import WALL

LEFT_OUT = ("fingerprint", "version", "own_files", *WALL)
"""Wall clock, and what changes with every release."""
RELATIVE, ABSOLUTE = 1e-6, 1e-9
"""Tolerances of a new file; edit them there. Other processors round a network's output differently."""


def golden_path(scenario: Path) -> Path:
    """Where a scenario file's golden outcome stands."""
    return scenario.with_name(f"{scenario.stem}.golden.json")


def figures(result: dict[str, Any]) -> dict[str, Any]:
    """An outcome as flat dotted figures, without what golden outcomes leave out; null where there is none."""
    return dict(leaves({k: v for k, v in result.items() if k not in LEFT_OUT}))


def with_relative_files(folder: Path, result: dict[str, Any], files: Iterable[str]) -> dict[str, Any]:
    """The outcome with its scenario's files named from `folder`: it is the same wherever a project lies or is flown from."""
    names = {name: Path(os.path.relpath(name, folder)).as_posix() for name in files if Path(name).exists()}
    if not names:
        return result
    any_file = re.compile("|".join(re.escape(name) for name in sorted(names, key=len, reverse=True)))

    def renamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {renamed(key): renamed(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [renamed(inner) for inner in value]
        return any_file.sub(lambda match: names[match[0]], value) if isinstance(value, str) else value

    return {key: renamed(value) for key, value in result.items()}


def write_golden(path: Path, result: dict[str, Any]) -> str:
    """Write an outcome as the golden one; tolerances of an older file stay, and a broken one is replaced.

    Returns:
        What was written, in words.

    Raises:
        RunError: the disk refuses.
    """
    tolerance, instead = {"relative": RELATIVE, "absolute": ABSOLUTE}, ""
    if path.is_file():
        try:
            tolerance = _read(path)["tolerance"]
        except RunError as error:
            instead = f", in place of a broken file ({str(error).removeprefix(f'{path}: ')})"
    write_text(path, json.dumps({"tolerance": tolerance, "outcome": figures(result)}, indent=1) + "\n")
    return f"golden outcome written: {path}{instead}"


def differences(path: Path, result: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Figures that differ from the golden ones: expected and actual, by dotted name.

    Raises:
        RunError: no golden outcome there, or a broken one.
    """
    golden = _read(path)
    relative, absolute = golden["tolerance"]["relative"], golden["tolerance"]["absolute"]
    expected, got = golden["outcome"], figures(result)

    def same(a: Any, b: Any) -> bool:
        numbers = is_number(a) and is_number(b)
        return math.isclose(a, b, rel_tol=relative, abs_tol=absolute) if numbers else bool(a == b)

    names = {**expected, **got}
    return {
        n: (expected.get(n, "nothing"), got.get(n, "nothing"))
        for n in names
        if n not in expected or n not in got or not same(expected[n], got[n])
    }


def told(moved: dict[str, tuple[Any, Any]]) -> tuple[str, str]:
    """Differences in words: by sections of the outcome, the largest relative change first.

    A figure that stands in two places, as a charge in `battery` and `drones`, is told once.

    Returns:
        A line that names how many figures of each section moved, and the one that moved most; and a line for each figure.
    """
    sections: dict[str, dict[str, tuple[Any, Any]]] = {}
    known: set[tuple[Any, Any]] = set()
    for name, change in sorted(moved.items(), key=lambda item: -_relative(*item[1])):
        if change in known and all(isinstance(value, float) for value in change):
            continue
        known.add(change)
        sections.setdefault(name.partition(".")[0], {})[name] = change
    lines = [f"{name}: {_arrow(*change)}" for each in sections.values() for name, change in each.items()]
    heads = []
    for section, each in sections.items():
        name, change = next(iter(each.items()))
        heads.append(f"{section} ({len(each)}): {name.removeprefix(f'{section}.')} {_arrow(*change)}")
    return f"{len(moved)} moved; of each section the most: {'; '.join(heads)}", "\n".join(lines)


def _relative(was: Any, now: Any) -> float:
    """By what part of the larger one two figures differ; 1 where they are no numbers."""
    if not (is_number(was) and is_number(now)):
        return 1.0
    largest = max(abs(was), abs(now))
    return abs(now - was) / largest if largest else 0.0


def _arrow(was: Any, now: Any) -> str:
    before, after = (f"{value:.6g}" if isinstance(value, float) else str(value) for value in (was, now))
    return f"{before} → {after}"


def _read(path: Path) -> dict[str, Any]:
    try:
        golden: Any = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: no golden outcome: {error}") from None
    for name in ("tolerance", "outcome"):
        if not isinstance(golden, dict) or not isinstance(golden.get(name), dict):
            raise RunError(f"{path}: no golden outcome: {name} must be an object")
    for name in ("relative", "absolute"):
        value = golden["tolerance"].get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
            raise RunError(f"{path}: no golden outcome: tolerance.{name}: {value!r}, must be a number ≥ 0")
    return dict(golden)
