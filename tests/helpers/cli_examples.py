"""The `sortie` command in this process, for tests of what it says and returns."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from sortie.sim.cli.app import main


def command(*arguments: object) -> int:
    """The command's exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sortie", *map(str, arguments)])
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def refusal(folder: Path, arguments: Sequence[object], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which the command refuses, with exit code 2 and nothing written in `folder`."""
    before = sorted(folder.iterdir())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert command(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert sorted(folder.iterdir()) == before, "nothing was left behind"
    return printed.err
