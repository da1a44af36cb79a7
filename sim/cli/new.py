"""`sortie new`: a scenario to begin with."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import ScenarioError, loads
from sortie.sim.cli.console import out
from sortie.sim.folders import write_text

SCHEMA = "sortie.schema.json"


def new(
    name: Annotated[
        str, typer.Argument(help="The scenario's name: small letters, digits and _. NAME.yaml is written.")
    ],
) -> None:
    """Write a commented scenario to begin with, and its JSON Schema for editors."""
    if re.fullmatch(r"[a-z0-9_]{1,64}", name) is None:
        raise ScenarioError(f"{name!r}: no name of a scenario, must be 1 to 64 small letters, digits and _")
    path = Path(f"{name}.yaml")
    if path.exists():
        raise SortieError(f"{path}: is there already, choose another name or delete it")
    text = files("sortie.scenarios").joinpath("starter.yaml").read_text("utf-8").replace("NAME", name)
    loads(text, str(path))
    schema = files("sortie.scenarios").joinpath("schema.json").read_text("utf-8")
    _ensure_ours(Path(SCHEMA))
    write_text(path, text)
    write_text(Path(SCHEMA), schema)
    out.print(f"{path} written; {SCHEMA} beside it completes and checks it in editors with a YAML language server")
    out.print(f"fly it with: sortie fly {path}", soft_wrap=True)


def _ensure_ours(path: Path) -> None:
    """Refuse a file that is not the JSON Schema of any version of Sortie, before it is replaced."""
    try:
        there = json.loads(path.read_bytes())
        ours = there["title"] == "Scenario" and "fleet" in there["properties"]
    except FileNotFoundError:
        return
    except (OSError, ValueError, TypeError, LookupError):
        ours = False
    if not ours:
        raise SortieError(f"{path}: is there already and is no JSON Schema of Sortie; move it")
