"""`sortie list`: what there is to fly, and with what."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from rich.text import Text

from sortie.fleet.flight.mobility import MOBILITY
from sortie.perception.detectors import DETECTORS
from sortie.policies import registry
from sortie.policies.registry import POLICIES, missing_parts
from sortie.policies.verification.invariants.words import CONSTANTS, LINK_FUNCTIONS, TIME_WORDS, WORDS
from sortie.scenarios.plugins.reference import PluginError, installed, parameters, resolve
from sortie.scenarios.reading.files import MODELS, builtin
from sortie.scenarios.reading.load import campaigns, library, load
from sortie.scenarios.schema import KINDS as EVENTS
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.campaign import Campaign
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.cli.console import err, out

Lines = Iterator[str | Text]
KINDS = list(dict.fromkeys([*(kind for kind in MODELS.values() if kind != "recorded_fusion"), "event", "metric"]))
"""Kinds of models that can be replaced from outside."""
PLURALS = {"policies": "policy", "detectors": "detector", "fusions": "fusion"}
SCHEMAS: dict[str, type[BaseModel]] = {
    "schema": Scenario,
    "campaign_schema": Campaign,
    "conditions_schema": ConditionSet,
}
"""For editors: `sortie list schema > sortie.schema.json`, and `# yaml-language-server: $schema=sortie.schema.json` as the
first line of a file."""
ABOUT = {
    "free_space": "Friis' formula",
    "log_distance": "free space at 1 m, then a power of distance: radio.path_loss_exponent",
    "two_ray": "the direct ray and the one that the ground reflects: radio.ground_roughness_m",
    "lipo": "a lithium-polymer cell: a monotone cubic through seven published points",
    "level": "the formula for level flight, and m·g·v_z while climbing, from the fields of fleet.airframe",
    "momentum": "momentum theory with climb, gusts and acceleration, from the fields of fleet.airframe",
}
"""Built-in models that are settings of the scenario's own fields."""


def _policies() -> Lines:
    for name, function in POLICIES.items():
        missing = f" Missing: {missing_parts(name)}." if missing_parts(name) else ""
        yield _line(name, registry.parameters(function), _summary(function) + missing)


def _detectors() -> Lines:
    for name, kind in DETECTORS.items():
        yield _line(name, {}, kind.about)


def _fusions() -> Lines:
    from sortie.perception.network.fusion.registry import FUSIONS  # here: torch takes a second to import

    for name, fusion in FUSIONS.items():
        yield _line(name, {}, fusion.about)


def _mobility() -> Lines:
    yield _line("formation", {}, "slots about a point on a route: fleet.formation, fleet.route, fleet.groups")
    for name, model in MOBILITY.items():
        yield _line(name, parameters(model), _summary(model))


def _events() -> Lines:
    for name, event in EVENTS.items():
        given = {key: "…" if field.is_required() else field.default for key, field in event.model_fields.items()}
        del given["kind"]
        yield _line(name, given, "")


def _scenarios() -> Lines:
    for name, path in library().items():
        yield _line(name, {}, load(path).description)


def _campaigns() -> Lines:
    from sortie.scenarios.reading.campaign import load_campaign

    for name in campaigns():
        yield _line(name, {}, load_campaign(name).campaign.description)


def _invariants() -> Lines:
    for name, word in WORDS.items():
        yield _line(name, {}, f"{word.about}{' (of each link)' * word.of_link}\n    {word.example}")
    yield "words about time, judged in flight and over whole courses:"
    for name, (about, example) in TIME_WORDS.items():
        yield _line(name, {}, f"{about}\n    {example}")
    yield "fresh.FIELD  what the policy decides for the link if every descriptor has age 0\n    rate_hz <= fresh.rate_hz"
    yield f"functions over all links: {', '.join(LINK_FUNCTIONS)}"
    yield f"names of values: {', '.join(CONSTANTS)}"


LISTS: Mapping[str, Callable[[], Lines]] = {
    "policy": _policies,
    "detector": _detectors,
    "fusion": _fusions,
    "event": _events,
    "mobility": _mobility,
    "scenarios": _scenarios,
    "campaigns": _campaigns,
    "invariants": _invariants,
}
"""Those that know more than names."""
WHAT = f"{', '.join(KINDS)}, scenarios, campaigns, invariants"


def list_(
    what: Annotated[
        str,
        typer.Argument(help=f"What to list: {WHAT}, or a JSON Schema: {', '.join(SCHEMAS)}."),
    ],
) -> None:
    """List the models of a kind, built-in and installed, with their parameters; or scenarios and other names."""
    if what in SCHEMAS:
        out.print_json(data=SCHEMAS[what].model_json_schema())
        return
    kind = PLURALS.get(what, what)
    if kind not in (*KINDS, *LISTS):
        raise typer.BadParameter(f"{what!r}, must be {WHAT}, {', '.join(SCHEMAS)}")
    lines = [*LISTS.get(kind, lambda: _named(kind))(), *_installed(kind)]
    for line in lines:
        out.print(line, soft_wrap=True)
    if not lines:
        err.print(f"no {kind} is built in or installed; name one of your own: path/to/file.py:Name", soft_wrap=True)


def _named(kind: str) -> Lines:
    """Built-in models of which the schema has the names."""
    for name in next((builtin(field) for field, of in MODELS.items() if of == kind), ()):
        yield _line(name, {}, ABOUT.get(name, ""))


def _installed(kind: str) -> Lines:
    """The models of a kind that installed packages offer; one that does not load says why."""
    for name, entry in installed(kind).items():
        package = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
        try:
            model = resolve(kind, name)
            yield _line(name, parameters(model), f"{_summary(model)} ({package})".strip())
        except PluginError as error:
            yield _line(name, {}, f"({package}) {error}")


def _line(name: str, given: Mapping[str, object], about: str) -> Text:
    inside = ", ".join(f"{key}={value}" for key, value in given.items())
    return Text.assemble((name, "bold"), f"{f'({inside})' if inside else ''}  {about}".rstrip())


def _summary(model: Any) -> str:
    """The first line of a model's own docstring; one that its class inherits describes another class."""
    return inspect.cleandoc(inspect.unwrap(model).__doc__ or "").partition("\n")[0]
