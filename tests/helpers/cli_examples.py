"""The `sortie` command in this process, for tests of what it says and returns."""

from __future__ import annotations

import sys

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
