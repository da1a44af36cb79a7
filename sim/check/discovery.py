"""Which files are scenarios with something to check."""

from __future__ import annotations

from pathlib import Path

from sortie.scenarios.reading.top_keys import top_keys
from sortie.scenarios.regular import regular
from sortie.sim.check.golden import golden_path
from sortie.sim.folders import RunError

MAX_BYTES = 1_000_000


def scenario_files(place: str | Path) -> list[str]:
    """What `place` names: itself, or, where it is a folder, every scenario file below it that expects something.

    Raises:
        RunError: a folder without any.
    """
    from sortie.scenarios.reading.load import library  # heavy, and not needed for `is_scenario`

    folder = Path(place)
    if str(place) in library() or not folder.is_dir():
        return [str(place)]
    files = sorted(str(path) for path in folder.rglob("*.y*ml") if is_scenario(path))
    if not files:
        raise RunError(f"{folder}: no scenario below it expects anything")
    return files


def is_scenario(path: Path) -> bool:
    """Whether a file is a scenario to check. Most YAML files of other projects are ruled out by two words.

    The copy of a scenario in a run's folder says what was flown there; it is not to be flown again.
    """
    if path.with_name("record.json").is_file() and path.with_name("outcome.json").is_file():
        return False
    try:
        with regular(path).open("rb") as file:
            data = file.read(MAX_BYTES)
    except OSError:
        return False
    golden = golden_path(path).is_file()
    if b"name" not in data or not (golden or b"expect" in data):
        return False
    keys = top_keys(data.decode("utf-8-sig", "replace"))
    return "name" in keys and (golden or not keys.isdisjoint({"expect", "expect_decisions"}))
