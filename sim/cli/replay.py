"""`sortie replay`: decide again over the views that a run kept."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import sortie
from sortie.scenarios.exit_codes import FAILED
from sortie.sim.cli.console import out, print_failure, print_written
from sortie.sim.cli.options import PolicyOption, ReplaceOption
from sortie.sim.folders import ensure_files
from sortie.sim.studies.replayed import CSV_HEAD


def replay(
    run: Annotated[Path, typer.Argument(help="A run's folder, flown with --set record.views=true.")],
    policy: PolicyOption = None,
    expect_same: Annotated[bool, typer.Option("--expect-same", help="Exit with code 1 if a decision differs.")] = False,
    disagreement: Annotated[
        bool,
        typer.Option(
            "--disagreement", help="Measure how often two drones' views lead to different choices about a link."
        ),
    ] = False,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write every difference here, as CSV.")] = None,
    replace: ReplaceOption = False,
) -> None:
    """Repeat the decisions of a run on its recorded views, and print where they differ and why.

    Without --policy the policies that flew decide again. A different decision does not change later views.
    """
    ensure_files(out_file, replace=replace, mark=CSV_HEAD)
    replayed = sortie.replay(sortie.open_run(run), policy, disagreement=disagreement)
    out.print(replayed.summary())
    if out_file is not None:
        replayed.save(out_file)
        print_written("kept in", out_file)
    if expect_same and not replayed.same:
        print_failure(f"{len(replayed.differences)} differences")
        raise typer.Exit(FAILED)
