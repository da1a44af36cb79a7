"""Which fields of a scenario name files, and where those are looked for."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sortie.scenarios.schema import Scenario
from sortie.scenarios.traces import located

FIELDS = ("fleet.trace", "radio.trace", "perception.weights", "perception.recording", "perception.recorded_fusion")
"""Fields that name a file; so do the weights of a make, and a policy's name, those of its changes and those of makes where
they are `file.py:function`."""


def named_files(sections: dict[str, Any]) -> list[str]:
    """Every file that a scenario's plain sections name, as it is written there."""
    return [_split(holder[key])[0] for holder, key in _places(sections)]


def with_files(sections: dict[str, Any], place: Callable[[str], str]) -> dict[str, Any]:
    """The sections with every file's name replaced by what `place` makes of it."""
    changed = copy.deepcopy(sections)
    for holder, key in _places(changed):
        file, function = _split(holder[key])
        holder[key] = place(file) + function
    return changed


def found_beside(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario with files that are not where they are named, but lie so beside `folder`, named there."""
    sections = scenario.model_dump(mode="json", exclude_none=True)
    changed = with_files(sections, lambda name: placed(name, folder))
    return scenario if changed == sections else Scenario.model_validate_json(json.dumps(changed), strict=True)


def placed(name: str, folder: Path) -> str:
    """A file's name as it is where that leads to a file or a folder (a shipped trace among them), else below `folder`."""
    here = located(Path(name))
    return name if here.exists() or not (folder / name).exists() else str(folder / name)


def _places(sections: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """Where files are named: the section and its key."""
    for field in FIELDS:
        room, _, key = field.partition(".")
        if sections.get(room, {}).get(key) is not None:
            yield sections[room], key
    for make in sections.get("fleet", {}).get("makes", ()):
        if make.get("weights") is not None:
            yield make, "weights"
        if ":" in (make.get("policy") or ""):
            yield make, "policy"
    policy = sections.get("policy", {})
    for named in (policy, *policy.get("changes", ())):
        if ":" in named.get("name", ""):
            yield named, "name"


def _split(text: str) -> tuple[str, str]:
    """`file.py:function` as the file, and the rest with its colon; anything else is a file alone."""
    file, colon, function = text.rpartition(":")
    return (file, colon + function) if colon and function.isidentifier() else (text, "")
