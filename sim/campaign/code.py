"""Which code a run is of: a digest of the sources, shipped weights and libraries that decide what comes out."""

from __future__ import annotations

import functools
import hashlib
from fnmatch import fnmatch
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from sortie.sim.engine.sortie import VERSION

ROOT = Path(__file__).resolve().parent.parent.parent
ROOMS = ("scenarios", "radio", "policies", "perception", "fleet", "sim")
SUFFIXES = (".py", ".json", ".safetensors")
"""Sources, and what is learned and shipped beside them."""
LIBRARIES = ("numpy", "scipy", "simpy", "networkx", "numba", "torch")
LOOKS = (
    "sim/cli/*", "sim/playback/*", "sim/cli/tables.py", "sim/check/plugin.py", "sim/cli/console.py",
    "sim/check/expectations.py", "sim/check/golden.py", "sim/studies/compare.py", "sim/studies/paper.py", "sim/campaign/*.py", "perception/study/*",
    "scenarios/library/*", "scenarios/schema.json",
)  # fmt: skip
"""Only look at runs, drive them, or reach them in their tasks: a change there leaves results as they are."""
DECIDES = ("sim/campaign/work.py", "sim/campaign/plan.py", "sim/campaign/spread.py")
"""The exceptions: these say what is flown, and how."""


@functools.cache
def code_version() -> str:
    """The version and 16 hex digits of SHA-256 over the rooms' sources and weights and the versions of the libraries beneath."""
    digest = hashlib.sha256()
    for room in ROOMS:
        for path in sorted(p for p in (ROOT / room).rglob("*") if p.suffix in SUFFIXES):
            name = path.relative_to(ROOT).as_posix()
            if name in DECIDES or not any(fnmatch(name, look) for look in LOOKS):
                digest.update(f"{name}\0".encode())
                digest.update(path.read_bytes())
    for library in LIBRARIES:
        digest.update(f"{library}={_version(library)}\0".encode())
    return f"{VERSION}+{digest.hexdigest()[:16]}"


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hex.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"
