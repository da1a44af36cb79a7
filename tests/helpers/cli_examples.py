"""The `sortie` command in this process, for tests of what it says and returns."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from sortie.scenarios.errors import SortieError
from sortie.sim.cli.app import main


def command(*arguments: object, run: Callable[[], None] = main) -> int:
    """The command's exit code; `run` is the program, `sortie` by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sortie", *map(str, arguments)])
        try:
            run()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def run_line(text: str) -> int:
    """The exit code of a command line, written as in a shell and without `sortie`."""
    return command(*shlex.split(text))


def refused(folder: Path, table: Sequence[tuple[str, str]], capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """The command lines that were not refused in one line with these words, exit code 2 and nothing written."""
    wrong, before = {}, sorted(folder.iterdir())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line, words in table:
            code, printed = run_line(line), capsys.readouterr()
            one_line = printed.err.startswith("error: ") and printed.err.count("\n") == 1
            if code != 2 or printed.out or not one_line or words not in printed.err:
                wrong[line] = f"{code}: {printed.out}{printed.err}"
    left = sorted(set(folder.iterdir()) - set(before))
    assert not left, f"left behind: {left}"
    return wrong


def refusal(
    folder: Path, arguments: Sequence[object], capsys: pytest.CaptureFixture[str], run: Callable[[], None] = main
) -> str:
    """The one line with which the command refuses, with exit code 2 and nothing written in `folder`."""
    before = sorted(folder.iterdir())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert command(*arguments, run=run) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    left = sorted(set(folder.iterdir()) - set(before))
    assert not left, f"left behind: {left}"
    return printed.err


class Seen:
    """A function that keeps what it was called with, and gives `answer` or stops the command."""

    def __init__(self, answer: Any = None) -> None:
        self.calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
        self.answer = answer

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.calls.append((args, {name: value for name, value in kwargs.items() if name not in ("progress", "notice")}))
        if self.answer is None:
            raise SortieError("seen")
        return self.answer

    @property
    def args(self) -> tuple[Any, ...]:
        return self.calls[-1][0]

    @property
    def kwargs(self) -> dict[str, Any]:
        return self.calls[-1][1]


def table_rows(text: str) -> list[list[str]]:
    """The cells of every line of a printed table, also of one without a frame."""
    lines = (line.strip("│┃ ").replace("┃", "│") for line in text.splitlines())
    return [
        [cell.strip() for cell in (line.split("│") if "│" in line else re.split(r"\s{2,}", line))] for line in lines
    ]
