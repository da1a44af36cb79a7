"""Which files are scenarios with something to check."""

from __future__ import annotations

import re
from pathlib import Path

from sortie.scenarios.reading.load import library
from sortie.sim.check.golden import golden_path
from sortie.sim.folders import RunError

MAX_BYTES = 1_000_000
_NAME = re.compile(r"""^(["']?)name\1\s*:""", re.MULTILINE)
_EXPECTS = re.compile(r"""^(["']?)expect(_decisions)?\1\s*:""", re.MULTILINE)
_FLOW = re.compile(r"(\s|#[^\n]*\n|---(?=\s))*\{")
"""How a file begins that is one section in braces."""
_FLOW_NAMED = re.compile(_FLOW.pattern + r"""\s*(["']?)name\2\s*:""")
_FLOW_EXPECTS = re.compile(r"""[{,]\s*(["']?)expect(_decisions)?\1\s*:""")


def scenario_files(place: str | Path) -> list[str]:
    """What `place` names: itself, or, where it is a folder, every scenario file below it that expects something.

    Raises:
        RunError: a folder without any.
    """
    folder = Path(place)
    if str(place) in library() or not folder.is_dir():
        return [str(place)]
    found = sorted(str(path) for path in folder.rglob("*.y*ml") if is_scenario(path))
    if not found:
        raise RunError(f"{folder}: no scenario below it expects anything")
    return found


def is_scenario(path: Path) -> bool:
    """Whether a file is a scenario that expects something; other YAML files are nobody's business here."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES).decode("utf-8", "replace")
    except OSError:
        return False
    text = text.removeprefix("\ufeff")
    golden = golden_path(path).is_file()
    if _FLOW.match(text):
        return (golden or bool(_FLOW_EXPECTS.search(text))) and _is_flow_scenario(text, golden=golden)
    return bool(_NAME.search(text) and (golden or _EXPECTS.search(text)))


def _is_flow_scenario(text: str, *, golden: bool) -> bool:
    """Which keys stand on top only the reader can tell; a file that it cannot read is a scenario's if it begins as one."""
    from sortie.scenarios.reading.load import ScenarioError, tree
    from sortie.scenarios.reading.nodes import child

    try:
        root = tree(text, "")
    except ScenarioError:
        return bool(_FLOW_NAMED.match(text))
    expects = golden or any(child(root, key) is not None for key in ("expect", "expect_decisions"))
    return expects and child(root, "name") is not None
