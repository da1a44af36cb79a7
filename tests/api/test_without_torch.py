"""An installation without the extra `torch`: the surrogate flies, and what needs torch says so in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

BLOCKED = """
import sys


class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")


sys.meta_path.insert(0, NoTorch())
from sortie.__main__ import main

main()
"""


def _sortie(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BLOCKED, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )


def test_the_surrogate_flies_and_its_run_is_reported(tmp_path: Path) -> None:
    flown = _sortie(
        tmp_path, "fly", "track_target", "--set", "perception.detector=surrogate", "--set", "duration_s=2", "--out", "a"
    )
    assert (flown.returncode, flown.stderr) == (0, "")
    assert "AP@0.5" in flown.stdout
    assert _sortie(tmp_path, "report", "a").returncode == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ("fly", "track_target"),
            "perception.detector is torch, which is not installed: pip install 'sortie-sim[torch]', or take surrogate",
        ),
        (("paper",), "torch is missing: pip install 'sortie-sim[torch]'"),
    ],
)
def test_what_needs_torch_says_so(tmp_path: Path, words: tuple[str, ...], told: str) -> None:
    asked = _sortie(tmp_path, *words)
    assert (asked.returncode, asked.stderr) == (2, f"error: {told}\n")
