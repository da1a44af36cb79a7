"""The commands that pages tell, and what is wrong with them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import typer


def commands_in(page: Path, program: str) -> list[str]:
    """Every command of a program on a page: on a line of its own in an example, or as code within a sentence."""
    text = page.read_text("utf-8")
    lines = re.findall(rf"^\s*(?:\.venv/bin/)?({program} .+)$", text, re.M)
    told = (*lines, *re.findall(rf"`({program} [^`\n]+)`", text))
    return [command.replace("[", "").replace("]", "") for command in told]


def fault(app: typer.Typer, told: str, program: str = "sortie") -> str | None:
    """What is wrong with a command's name and options; what is left out is not."""
    words = shlex.split(told, comments=True)[len(program.split()) :]
    if not words or words[0] in ("…", "..."):
        return None
    command: Any = typer.main.get_command(app)
    context: Any = None
    try:
        while True:
            context = command.make_context(command.name or program, list(words), parent=context)
            words = [*context._protected_args, *context.args]  # a group may have put something before them
            if not hasattr(command, "resolve_command") or not words:
                return None
            _, command, words = command.resolve_command(context, words)
    except Exception as error:
        no_faults = ("MissingParameter", "NoArgsIsHelpError", "Exit")  # the last is that of --help
        return None if type(error).__name__ in no_faults else str(error)
