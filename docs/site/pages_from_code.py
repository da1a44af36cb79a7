"""The site's reference pages as Markdown, made from the code. Free of Sphinx, so that tests read them without it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from fields_page import fields_markdown

import sortie
from sortie.scenarios.reading.load import campaigns, condition_sets, library
from sortie.scenarios.report_text import table
from sortie.sim.cli.app import app as command_line

API = {
    "Load and fly": ("load", "fly", "open_run", "Run", "Scenario"),
    "Compare and check": ("compare", "Comparison", "check", "replay", "Replay", "rank", "Ranking"),
    "Campaigns": ("campaign", "open_campaign", "CampaignResult"),
    "Reinforcement learning": ("env",),
    "What a policy reads": ("Policy", "FleetView", "Descriptor", "LinkState", "TaskPhase"),
    "What a policy returns": ("Directive", "Representation", "Disc", "Reposition"),
    "Decorators of policies": ("looks_from", "boxes_across_networks"),
    "Errors": ("SortieError", "ScenarioError", "PolicyError", "RunError"),
}
"""The sections of the page of the Python API."""


def api_markdown() -> str:
    """Every public name but the version, with its docstring."""
    lines = []
    for title, names in API.items():
        lines += [f"## {title}", ""]
        for name in names:
            lines += ["```{eval-rst}", *_documented(name), "```", ""]
    return "\n".join(lines)


def _documented(name: str) -> list[str]:
    thing = getattr(sortie, name)
    if not inspect.isclass(thing):
        return [f".. auto{'function' if inspect.isfunction(thing) else 'data'}:: sortie.{name}"]
    if issubclass(thing, Exception):
        return [f".. autoexception:: sortie.{name}"]
    if name == "Scenario":
        return [f".. autoclass:: sortie.{name}", "", "   Its fields are those of a YAML file: :doc:`fields`."]
    members = ["   :special-members: __call__"] if name == "Policy" else ["   :members:", "   :undoc-members:"]
    return [f".. autoclass:: sortie.{name}", *members]


def fields_with_headings() -> str:
    """The tables of a scenario's fields, each below a heading that can be linked to and found."""
    return re.sub(r"^\*\*(.+)\*\*$", r"## \1", fields_markdown(), flags=re.MULTILINE)


def commands_markdown() -> str:
    """Every command with its usage, arguments and options."""
    root: Any = typer.main.get_command(command_line)
    return "\n".join(_commands(root, root.make_context("sortie", [], resilient_parsing=True)))


def _commands(group: Any, context: Any) -> Iterator[str]:
    for name, command in group.commands.items():
        if command.hidden:
            continue
        inner = type(context)(command, info_name=name, parent=context)
        yield from _command(command, inner)
        if hasattr(command, "commands"):
            yield from _commands(command, inner)


def _command(command: Any, context: Any) -> Iterator[str]:
    usage = [piece.strip("{}").upper() for piece in command.collect_usage_pieces(context)]
    yield from (f"## {context.command_path}", "", _prose(command.help), "")
    yield from ("```sh", " ".join([context.command_path, *usage]), "```", "")
    records = [record for param in command.get_params(context) if (record := param.get_help_record(context))]
    rows = [(f"`{names}`", _cell(what)) for names, what in records if names != "--help"]
    if rows:
        yield from (*table(("argument or option", "meaning"), rows), "")


def _prose(text: str) -> str:
    """A help text as Markdown: its options as code, its other signs as they stand."""
    parts = re.split(r"(`[^`]*`|(?<![\w-])--[a-z][a-z0-9-]*)", inspect.cleandoc(text))
    for i, part in enumerate(parts):
        if part.startswith("--"):
            parts[i] = f"`{part}`"
        elif not part.startswith("`"):
            parts[i] = re.sub(r"[<*_]", r"\\\g<0>", part)
    return "".join(parts)


def _cell(text: str) -> str:
    return _prose(text).replace("|", "\\|").replace("\n", " ")


def library_markdown() -> str:
    """Every file of the library, whole."""
    kinds: dict[str, Mapping[str, Path]] = {
        "Scenarios": library(),
        "Campaigns": campaigns(),
        "Sets of conditions": condition_sets(),
    }
    lines = []
    for title, files in kinds.items():
        lines += [f"## {title}", ""]
        for name, path in files.items():
            lines += [
                f"### {name}",
                "",
                f"```{{literalinclude}} /scenarios/library/{path.name}",
                ":language: yaml",
                "```",
            ]
            lines.append("")
    return "\n".join(lines)


PAGES = {
    "sortie-api": api_markdown,
    "sortie-fields": fields_with_headings,
    "sortie-commands": commands_markdown,
    "sortie-library": library_markdown,
}
"""The directive that a page names, and what makes its text."""
