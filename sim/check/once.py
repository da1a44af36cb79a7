"""A scenario's verdicts for every worker of pytest-xdist: the first worker that needs them flies, the others read."""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sortie.sim.check.expectations import Verdict


@dataclass(frozen=True, slots=True)
class Flown:
    """What the tests of a scenario file need of its flights."""

    verdicts: tuple[Verdict, ...] = ()
    replays: tuple[str, ...] = ()
    """For each verdict: the command that shows it."""
    written: str = ""
    """A line that names the golden outcome that was written."""
    error: str = ""
    """Why there are no verdicts."""


def flown_once(folder: Path | None, scenario: Path, fly: Callable[[], Flown]) -> Flown:
    """The verdicts of a scenario, flown by one process of those that share a folder.

    Args:
        folder: of this test run, shared by its workers; None, or a folder that is not there, where nothing is shared.
        scenario: the file.
        fly: flies it.
    """
    if folder is None or not folder.is_dir():
        return fly()
    result = folder / hashlib.sha256(str(scenario).encode()).hexdigest()
    with result.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed; a worker that dies leaves it to the next
        if result.is_file():
            known = json.loads(result.read_text("utf-8"))
            verdicts = tuple(Verdict(**each) for each in known.pop("verdicts"))
            return Flown(verdicts, tuple(known.pop("replays")), **known)
        flown = fly()
        part = result.with_suffix(".part")
        part.write_text(json.dumps(dataclasses.asdict(flown)), "utf-8")
        part.rename(result)
        return flown
