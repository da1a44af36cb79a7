"""`sortie check`: compare scenarios with their own expectations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

import sortie
from sortie.scenarios.errors import SortieError
from sortie.scenarios.exit_codes import FAILED
from sortie.scenarios.reading.campaign import read_any
from sortie.scenarios.reading.load import ScenarioError, campaigns, condition_sets, library
from sortie.sim.check.junit import Suite, junit
from sortie.sim.cli import tables
from sortie.sim.cli.console import bars, line_printer, out, print_failure
from sortie.sim.cli.options import SetOption, refuse
from sortie.sim.folders import ensure_files, write_text


def check(
    context: typer.Context,
    scenarios: Annotated[list[str], typer.Argument(help="Scenario files, names or folders; all: the whole library.")],
    set_: SetOption = None,
    syntax: Annotated[
        bool,
        typer.Option(
            "--syntax",
            help="Fly nothing: print everything that is wrong with the files of scenarios, campaigns and condition sets.",
        ),
    ] = False,
    update: Annotated[
        bool, typer.Option("--update", help="Write NAME.golden.json beside each scenario instead of comparing with it.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="List every figure that differs from a golden outcome.")
    ] = False,
    junit_file: Annotated[
        Path | None, typer.Option("--junit", help="Write the verdicts as JUnit XML too, for build servers.")
    ] = None,
) -> None:
    """Fly scenarios and test the expectations that they state. Exit code 1 if one fails."""
    from sortie.sim.check.checking import flights
    from sortie.sim.check.discovery import scenario_files
    from sortie.sim.engine.needs import Forecast

    if syntax:
        refuse(context, ("update", "junit_file"), "flights, not with --syntax")
        return _check_syntax([*library(), *campaigns(), *condition_sets()] if scenarios == ["all"] else scenarios, set_)

    names = list(library()) if scenarios == ["all"] else [file for name in scenarios for file in scenario_files(name)]
    loaded = [(name, sortie.load(name, set_ or [])) for name in names]  # all of them, before the first one flies
    ensure_files(junit_file)
    failed, suites = 0, list[Suite]()
    for name, flown in loaded:
        try:
            with bars() as bar:
                several = flights(flown)
                watch = Forecast(
                    flown, line_printer(flown.name), bar(flown.name, flown.duration_s * several), flights=several
                )
                (checked,) = sortie.check(name, set_ or [], update=update, progress=watch)
        except SortieError as error:
            _write_junit(junit_file, [*suites, Suite(name, None, str(error))])
            raise
        suites.append(Suite(name, checked))
        failed += len(checked.failed)
        out.print(tables.verdict_table(flown.name, checked.verdicts))
        for verdict in checked.failed if verbose else ():
            out.print(verdict.whole, soft_wrap=True, highlight=False)
        if checked.written:
            out.print(checked.written, soft_wrap=True)
        for command in dict.fromkeys(map(checked.replay, checked.failed)):
            out.print(f"see it with: {command}", soft_wrap=True)
    _write_junit(junit_file, suites)
    if failed:
        print_failure(f"{failed} expectation{'s' if failed > 1 else ''} failed")
        raise typer.Exit(FAILED)


def _write_junit(file: Path | None, suites: Sequence[Suite]) -> None:
    if file is not None:
        write_text(file, junit(suites))


def _check_syntax(files: list[str], overrides: list[str] | None) -> None:
    """Print everything that is wrong with files, a line each. Exit code 1 if anything is."""
    from sortie.sim.check.named import not_there

    issues: list[str] = []
    for file in files:
        try:
            scenario = read_any(file, overrides or ())
        except ScenarioError as error:
            issues += error.issues
        else:
            issues += [f"{file}: {issue}" for issue in (() if scenario is None else not_there(scenario))]
    for issue in issues:
        out.print(issue, soft_wrap=True, highlight=False)
    if issues:
        print_failure(f"{len(issues)} thing{'s are' if len(issues) > 1 else ' is'} wrong")
        raise typer.Exit(FAILED)
    out.print(f"{len(files)} file{'s' if len(files) > 1 else ''} read, nothing is wrong")
