"""`sortie rank`: a policy's place among all built-in ones, on a fixed suite of conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import sortie
from sortie.scenarios.exit_codes import FAILED
from sortie.sim.cli.console import out, print_failure, print_written, stages
from sortie.sim.cli.options import split_policies
from sortie.sim.experiment.rank import SUITE


def rank(
    policies: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help="The policy to rank: name, name(key=value), or path/to/file.py:function; several separated by commas.",
        ),
    ],
    suite: Annotated[str, typer.Option(help="The suite: a name of the library, or a file.")] = SUITE,
    against: Annotated[
        str | None,
        typer.Option(help="The other policies, separated by commas. Default: every built-in one with stored results."),
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Fly the other policies too, instead of taking their stored results.")
    ] = False,
    by_torch: Annotated[
        bool,
        typer.Option(
            "--by-torch",
            help="Fly every policy with the neural detector, and use the surrogate, a fast fitted model of it, to make the AP's intervals narrower; it takes minutes for each policy.",
        ),
    ] = False,
    further: Annotated[
        int | None,
        typer.Option(
            help="With --by-torch: further draws of the suite, of thirty conditions each, that only the surrogate flies; 0: torch alone. Default: 3 for a suite of the library, 0 for a file.",
            min=0,
            max=100,
        ),
    ] = None,
    workers: Annotated[int, typer.Option(help="Number of processes.", min=1)] = 1,
    out_dir: Annotated[
        Path,
        typer.Option("--out", help="Folder for ranking.json and ranking.png."),
    ] = Path("runs/rank"),
) -> None:
    """Fly a policy on a fixed, versioned suite of conditions, and print its place among all built-in policies.

    The suite has thirty conditions with different budgets, links, batteries, missions, lies and faults. The policy gets the
    budget of each condition by its parameter `received_budget`, `sent_budget` or `rho`, if it has one of them.

    A place is a range if the differences between policies are too small to tell. Flights are kept in your cache folder: after an
    interruption the same command goes on. Exit code 1 if the policy failed in a condition or breaks a rule of the plane.
    """
    with stages() as report:
        ranking = sortie.rank(
            split_policies(policies),
            suite=suite,
            against=None if against is None else split_policies(against),
            again=again,
            by_torch=by_torch,
            further=further,
            workers=workers,
            progress=report,
        )
    out.print(ranking.summary())
    ranking.save(out_dir)
    print_written("kept in", out_dir, ": ranking.json, ranking.png")
    if ranking.faults:
        for line in ranking.faults:
            print_failure(line)
        raise typer.Exit(FAILED)
