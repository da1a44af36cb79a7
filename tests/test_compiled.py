"""The compiled install (`make compiled`): its radio is machine code, and its records equal the interpreted ones."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HOME = ROOT / ".venv-compiled"
PYTHON = HOME / "bin" / "python"
CASES = (
    ["perception.detector=none", "duration_s=10"],
    ["perception.detector=surrogate", "duration_s=5"],
    ["perception.detector=none", "duration_s=5", "radio.rate_control=minstrel", "radio.relay_max_hops=2", "radio.rts=true"],
    ["perception.detector=none", "duration_s=2", "fleet.drones=40", "mission.phases=[{at_s: 0, phase: search}]",
     "fleet.formation={shape: grid, spacing_m: 20, altitude_m: 60}"],
)  # fmt: skip
FLIGHTS = """
import json, sys
import sortie
from sortie.scenarios.code_digest import sources_digest
from sortie.sim.identity import compiled_modules
cases = json.loads(sys.argv[1])
runs = [sortie.fly(sortie.load("track_target", case)).fingerprint for case in cases]
sources = sources_digest(("fleet", "perception", "policies", "radio", "scenarios", "sim"), ())
print(json.dumps([sources, compiled_modules(), runs]))
"""


def flown(python: Path | str) -> tuple[str, list[str], list[str]]:
    """The digest of the sources of an interpreter's Sortie, its compiled modules, and the fingerprints of its flights."""
    # from a folder without sources, which would be imported in place of the installed package
    done = subprocess.run(
        [python, "-c", FLIGHTS, json.dumps(CASES)], capture_output=True, text=True, check=True, cwd=HOME
    )  # fmt: skip
    sources, modules, fingerprints = json.loads(done.stdout.splitlines()[-1])
    return sources, modules, fingerprints


@pytest.mark.skipif(not PYTHON.exists(), reason="`make compiled` was not run, which needs a C compiler")
def test_the_compiled_radio_makes_equal_records() -> None:
    built_of, compiled, there = flown(PYTHON)
    sources, plain, here = flown(sys.executable)
    if built_of != sources:
        pytest.skip("`make compiled` was run with other sources")
    assert "sortie.radio.mac.medium" in compiled
    assert plain == []
    assert len(set(here)) == len(CASES)
    assert there == here


def test_the_build_takes_the_mypy_that_lint_takes() -> None:
    pinned = [line.split("#")[0].strip() for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()]
    assert re.search(r'^MYPY = "(.+)"$', (ROOT / "setup.py").read_text("utf-8"), re.M)[1] in pinned  # type: ignore[index]


@pytest.mark.parametrize(
    ("command", "more", "said"),
    [
        ("editable_wheel", {}, "SORTIE_COMPILE=1 does not work with an editable install"),
        (
            "bdist_wheel",
            {"CC": "no-such-compiler"},
            "SORTIE_COMPILE=1 needs a C compiler, but `no-such-compiler` is not",
        ),
    ],
)
def test_a_build_that_cannot_compile_says_why_in_one_line(command: str, more: dict[str, str], said: str) -> None:
    done = subprocess.run(
        [sys.executable, "setup.py", command],
        capture_output=True, text=True, cwd=ROOT, env={**os.environ, **more, "SORTIE_COMPILE": "1"},
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == 1
