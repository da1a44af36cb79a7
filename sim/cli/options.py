"""Arguments that several commands take: scenario, overrides, policy, seed, pixels of images."""

from __future__ import annotations

import shlex
from collections.abc import Collection
from enum import StrEnum
from typing import Annotated

import typer

from sortie.policies.contract import PolicyError
from sortie.scenarios.reading.call_text import split_at_commas
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.cli.console import err
from sortie.sim.folders import RunError
from sortie.sim.policy_text import policy_overrides

ScenarioArgument = Annotated[str, typer.Argument(help="A scenario file or a library scenario's name.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a field: fleet.battery.initial_soc=0.5")
]
SeedOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="Seed of every random draw; default: the scenario's.", min=0, max=2**63 - 1),
]
PolicyOption = Annotated[
    str | None, typer.Option(help="A policy's name, name(key=value), or path/to/file.py:function.")
]
ReplaceOption = Annotated[bool, typer.Option("--replace", help="Replace files that exist, whoever wrote them.")]
DeviceOption = Annotated[str | None, typer.Option(help="cpu, cuda, or auto: cuda where available; default: auto.")]
WorkersOption = Annotated[
    int | None, typer.Option(help="Number of frames evaluated in parallel; default: one per core.", min=1)
]


class ImagePx(StrEnum):
    usual = "256"
    sharp = "512"


ImagePxOption = Annotated[
    ImagePx,
    typer.Option(
        help="Pixels along a side of the ground image. 256: of 0.8 m, from pictures of 160 × 90. 512: of 0.4 m, from "
        "pictures of 320 × 180. Frames then take four times as much disk and memory: 6.3 GB for train, "
        "1.3 for test, 0.4 for validation and 0.2 for tau."
    ),
]


def loaded(scenario: str, set_: list[str] | None, policy: str | None) -> Scenario:
    """The scenario with `--set` and `--policy` applied. A policy other than its own starts from the policy's defaults."""
    overrides = list(set_ or [])
    own = load(scenario, overrides)
    if policy is None:
        return own
    flown = load(scenario, overrides + policy_overrides(policy, own.policy.name))
    if own.policy.changes and not flown.policy.changes:
        err.print(
            f"{policy} flies to the end: the changes and commands of {own.name} are its own policy's", soft_wrap=True
        )
    return flown


def same_command(context: typer.Context, leaving_out: Collection[str]) -> str:
    """The command that was given, without some of its options."""
    said = ["sortie", str(context.info_name)]
    for parameter in context.command.params:
        name, value = str(parameter.name), context.params.get(str(parameter.name))
        source = context.get_parameter_source(name)
        if name in leaving_out or source is None or source.name != "COMMANDLINE":
            continue
        if parameter.param_type_name == "argument":
            said.append(str(value))
        elif isinstance(value, bool):
            said.append(parameter.opts[0])
        else:
            for one in value if isinstance(value, list | tuple) else [value]:
                said += [parameter.opts[0], f"{one:g}" if isinstance(one, float) else str(one)]
    return shlex.join(said)


def refuse(context: typer.Context, names: Collection[str], goes_with: str) -> None:
    """Refuse options that do nothing in this call of a command.

    Args:
        context: the command's.
        names: the options, as the command's parameters are called.
        goes_with: what they do something with.

    Raises:
        RunError: one is given on the command line, naming it.
    """
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name) if parameter.name in names else None
        if source is not None and source.name == "COMMANDLINE":
            raise RunError(f"{parameter.opts[0]} goes with {goes_with}")


def split_policies(text: str) -> list[str]:
    """Policies separated by commas; commas in brackets separate parameters.

    Raises:
        PolicyError: a bracket is not closed, none is named, or one is named twice.
    """
    cleaned = split_at_commas(text)
    if cleaned is None:
        raise PolicyError(f"policies {text!r}: a bracket is not closed, as in worked,best-2(received_budget=0.1)")
    if not cleaned:
        raise PolicyError("no policy named, as in --policies worked,all-4,silence")
    if len(set(cleaned)) < len(cleaned):
        raise PolicyError(f"a policy is named twice: {', '.join(cleaned)}")
    return cleaned
