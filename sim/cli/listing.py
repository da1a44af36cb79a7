"""`sortie list`: what there is to fly, and with what."""

from __future__ import annotations

from typing import Annotated

import typer
from pydantic import BaseModel
from rich.markup import escape

from sortie.perception.detectors import DETECTORS
from sortie.policies.registry import POLICIES, missing_parts, parameters
from sortie.policies.verification.invariants import CONSTANTS, LINK_FUNCTIONS, WORDS
from sortie.scenarios.plugins.reference import installed
from sortie.scenarios.reading.files import MODELS, builtin
from sortie.scenarios.reading.load import campaigns, library, load
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.campaign import Campaign
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.cli.console import out

WHAT = "policies, scenarios, campaigns, detectors, fusions, invariants, path_loss, link, power, sensor, event, metric"


SCHEMAS: dict[str, type[BaseModel]] = {
    "schema": Scenario,
    "campaign_schema": Campaign,
    "conditions_schema": ConditionSet,
}
"""For editors: `sortie list schema > sortie.schema.json`, and `# yaml-language-server: $schema=sortie.schema.json` as the
first line of a file."""


def list_(
    what: Annotated[
        str,
        typer.Argument(help=f"What to list: {WHAT}, or a JSON Schema: {', '.join(SCHEMAS)}."),
    ],
) -> None:
    """List policies, scenarios and other names that commands take."""
    if what == "policies":
        for name, function in POLICIES.items():
            defaults = ", ".join(f"{k}={v}" for k, v in parameters(function).items())
            summary = (function.__doc__ or "").strip().splitlines()[0]
            missing = f" Missing: {missing_parts(name)}." if missing_parts(name) else ""
            out.print(f"[bold]{name}[/bold]{f'({defaults})' if defaults else ''}  {summary}{missing}", soft_wrap=True)
        _installed("policy")
    elif what == "scenarios":
        for name, path in library().items():
            out.print(f"[bold]{name}[/bold]  {load(path).description}", soft_wrap=True)
    elif what == "campaigns":
        from sortie.scenarios.reading.campaign import load_campaign

        for name in campaigns():
            out.print(f"[bold]{name}[/bold]  {load_campaign(name).campaign.description}", soft_wrap=True)
    elif what == "detectors":
        for name, kind in DETECTORS.items():
            out.print(f"[bold]{name}[/bold]  {kind.about}", soft_wrap=True)
        _installed("detector")
    elif what in (*MODELS.values(), "event", "metric"):
        for name in next((builtin(field) for field, kind in MODELS.items() if kind == what), ()):
            out.print(f"[bold]{name}[/bold]", soft_wrap=True)
        _installed(what)
    elif what == "fusions":
        from sortie.perception.network.fusion.registry import FUSIONS  # here: torch takes a second to import

        for name, fusion in FUSIONS.items():
            out.print(f"[bold]{name}[/bold]  {fusion.about}", soft_wrap=True)
    elif what == "invariants":
        for name, word in WORDS.items():
            scope = " (of each link)" if word.of_link else ""
            out.print(f"[bold]{name}[/bold]  {escape(word.about)}{scope}", soft_wrap=True)
        out.print(f"functions over all links: {', '.join(LINK_FUNCTIONS)}", soft_wrap=True)
        out.print(f"names of values: {', '.join(CONSTANTS)}", soft_wrap=True)
    elif what in SCHEMAS:
        out.print_json(data=SCHEMAS[what].model_json_schema())
    else:
        raise typer.BadParameter(f"{what!r}, must be {WHAT}, {', '.join(SCHEMAS)}")


def _installed(kind: str) -> None:
    """The models of a kind that installed packages offer."""
    for name, entry in installed(kind).items():
        package = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
        out.print(f"[bold]{name}[/bold]  {escape(package)}", soft_wrap=True)
