"""`sortie verify`: test a policy against the plane's contract, prove its invariants, save counterexamples.

`sortie overhead`: what the plane costs, in bytes and in time, by the size of the fleet.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from sortie.policies.contract import FleetView, Policy
from sortie.policies.registry import resolve
from sortie.policies.verification.conformance import VIEWS, Check, conform, failing
from sortie.policies.verification.invariants import Invariant, InvariantError, parse
from sortie.policies.verification.proof import BUDGET_S, DRONES, PLANE, ProofVerdict, prove
from sortie.policies.verification.properties import PROMISES
from sortie.policies.verification.subject import OWN_INVARIANTS, own_invariants
from sortie.policies.verification.views import to_json
from sortie.scenarios.plugins.user_calls import DECISION_S, watched
from sortie.scenarios.reading.load import dump, loads
from sortie.scenarios.schema import PolicySection, Scenario
from sortie.sim.check.counterexample import raised_ages, replay_scenario, shows_in_flight, slug, unused
from sortie.sim.cli.console import bars, err, out
from sortie.sim.cli.options import split_policies
from sortie.sim.folders import RunError, write_text
from sortie.sim.studies.overhead import SCENARIO, SECONDS, host_s, measure
from sortie.sim.studies.plane_cost import machine

COLOURS = {
    "holds": "green", "fails": "red", "proved": "green", "proved over the reals": "green", "refuted": "red",
    "searched": "yellow", "drawn": "yellow",
}  # fmt: skip


def verify(
    policy: Annotated[str, typer.Argument(help="A policy's name, name(key=value), or path/to/file.py:function.")],
    invariants: Annotated[
        Path | None,
        typer.Option(
            help="A file of invariants, one per line; default: those in the policy's file, or those that a registered policy promises."
        ),
    ] = None,
    drones: Annotated[int, typer.Option(help="Largest fleet that proofs search.", min=1, max=8)] = DRONES,
    budget: Annotated[
        float,
        typer.Option(help="Time for the search of all properties together, s; what it covered is printed.", min=0),
    ] = BUDGET_S,
    views: Annotated[int, typer.Option(help="Number of random views that the kit tries.", min=10)] = VIEWS,
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for counterexamples.")] = Path("runs/verify"),
) -> None:
    """Try a policy on random views, prove its properties, and save a counterexample of each that fails.

    Each verdict says what it covers: *proved* for all views of fleets up to a size, *proved over the reals*, *searched*,
    or *drawn* views alone. Exit code 1 if a rule fails or a property is refuted. A counterexample is a view as JSON, and a scenario that
    shows it to the policy in flight: `sortie check` on it fails until the policy is mended.
    """
    section = _section(policy)
    decide = resolve(section.name, section.params)
    rules = _invariants(section.name, decide, invariants)
    _ensure_own(out_dir / slug(policy))
    with watched(DECISION_S):
        broken = _try(policy, section, decide, rules, drones, budget, views, out_dir)
    if broken:
        err.print(f"[red]{broken} {'do' if broken > 1 else 'does'} not hold[/red]")
        raise typer.Exit(1)


def overhead(
    policies: Annotated[
        str, typer.Option(help="Policies, separated by commas: worked,best-2(received_budget=0.1).")
    ] = "worked",
    drones: Annotated[str, typer.Option(help="Fleet sizes, separated by commas.")] = "5,25,100",
    seconds: Annotated[float, typer.Option(help="Length of each flight, s, without a detector.", min=1)] = SECONDS,
) -> None:
    """Measure the cost of the context plane by fleet size: context and data bytes, and CPU time of a decision."""
    try:
        sizes = [int(n) for n in drones.split(",")]
    except ValueError as error:
        raise RunError(f"--drones {drones!r}, must be whole numbers with commas, as in 5,25,100") from error
    columns = (
        "policy",
        "drones",
        "context KB/s",
        "data MB/s",
        "context share",
        "decides in ms, median",
        "99th percentile",
    )
    table = Table(*columns, title=f"{SCENARIO}, {seconds:g} s")
    for name in split_policies(policies):
        for n in sizes:
            with bars() as bar:
                row = measure(name, n, seconds, progress=bar(f"{name}, {n} drones", seconds))
            table.add_row(
                escape(row.policy), f"{n}", f"{row.context_bytes_per_s / 1e3:.1f}", f"{row.data_bytes_per_s / 1e6:.1f}",
                f"{row.context_share:.2%}", f"{row.p50_ms:.4f}", f"{row.p99_ms:.4f}",
            )  # fmt: skip
    out.print(table)
    out.print(
        f"{machine()}; a million additions in a plain loop take {host_s():.3f} s of CPU time here", soft_wrap=True
    )


def _try(
    policy: str,
    section: PolicySection,
    decide: Policy,
    rules: Sequence[Invariant],
    drones: int,
    budget: float,
    views: int,
    kept: Path,
) -> int:
    """Print and keep what the kit and the proofs say; how many rules and properties are broken."""
    table = Table("rule", "verdict", "what", title=f"{escape(policy)}: the conformance kit, {views} drawn views")
    checks = conform(decide, count=views)
    for check in checks:
        table.add_row(check.name, _verdict("holds" if check.holds else "fails"), escape(check.what))
    out.print(table)
    table = Table("property", "verdict", "what", title=f"{escape(policy)}: proofs")
    verdicts = prove(decide, rules, max_drones=drones, budget_s=budget)
    for verdict in verdicts:
        table.add_row(escape(verdict.name), _verdict(verdict.outcome), escape(verdict.what))
    out.print(table)
    if not rules:
        out.print("No invariants: the plane's rules alone were checked. --invariants FILE names some.", soft_wrap=True)
    else:
        out.print(
            "This judges what the policy decides. Staleness rules and damping come after it; a flight with the same lines in "
            "`policy.invariants` judges what the gates enforce.",
            soft_wrap=True,
        )
    _keep(kept / slug(policy), _counterexamples(decide, section, checks, verdicts))
    return len(failing(checks)) + sum(v.outcome == "refuted" for v in verdicts)


def _verdict(word: str) -> str:
    return f"[{COLOURS[word]}]{word}[/{COLOURS[word]}]"


def _section(policy: str) -> PolicySection:
    """`name(key=value, …)` as a scenario's section, parsed and checked as one is."""
    name, bracket, rest = policy.partition("(")
    if bracket and not rest.endswith(")"):
        raise RunError(f"policy {policy!r}: the bracket is not closed, as in best-2(received_budget=0.1)")
    params = [f"policy.params.{p.strip()}" for p in rest[:-1].split(",") if p.strip()]
    return loads("name: verify", overrides=[f"policy.name={name.strip()}", *params]).policy


def _invariants(name: str, decide: Policy, file: Path | None) -> tuple[Invariant, ...]:
    """From the file named, or the policy's own file, or what a registered policy promises."""
    own = own_invariants(decide) if ":" in name else PROMISES.get(name)
    source = f"{name}: {OWN_INVARIANTS}" if file is None else str(file)
    if file is None and not isinstance(own, str | None):
        raise RunError(f"{source} is of type {type(own).__name__}, must be text")
    try:
        return parse(str(own or "") if file is None else file.read_text("utf-8"))
    except OSError as error:
        raise RunError(f"{file}: {error.strerror}") from error
    except InvariantError as error:
        raise RunError(f"{source}, {error}") from error


def _counterexamples(
    decide: Policy, section: PolicySection, checks: Sequence[Check], verdicts: Sequence[ProofVerdict]
) -> Iterator[tuple[str, FleetView, Scenario]]:
    """Of everything that failed and has one: what failed, the view and the scenario."""
    shown = functools.partial(replay_scenario, policy=section.name, params=section.params)
    aged = PLANE[1]
    for check in checks:
        view = check.counterexample
        if view is not None:
            raised = raised_ages(decide, view) if check.name == "age-monotone" else None
            yield check.name, view, shown(check.name, check.what, view=view, raised_age_s=raised)
    for v in verdicts:
        view = v.counterexample
        if view is not None:
            invariant = "" if v.name in {p.name for p in PLANE} else v.name
            older = (v.raised_age_s or raised_ages(decide, view)) if v.name == aged.name else None
            yield v.name, view, shown(v.name, v.what, view=view, invariant=invariant, raised_age_s=older)


def _ensure_own(folder: Path) -> None:
    """Refuse a folder that holds something else than counterexamples, before they are replaced by new ones."""
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        view = file.with_suffix(".json")  # a scenario lies beside its view
        if (
            file.suffix not in (".json", ".yaml")
            or not view.is_file()
            or '"ego": ' not in view.read_text("utf-8", "replace")[:20]
        ):
            raise RunError(f"{folder}: holds {file.name}, which is no counterexample; name another --out or move it")


def _keep(folder: Path, found: Iterable[tuple[str, FleetView, Scenario]]) -> None:
    """Write each view, and its scenario where the fault shows in flight."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, view, scenario in found:
        path = unused(folder, scenario.name)
        write_text(path.with_suffix(".json"), to_json(view))
        out.print(f"counterexample of [bold]{escape(name)}[/bold]: {path}.json", soft_wrap=True)
        if shows_in_flight(scenario):
            write_text(path.with_suffix(".yaml"), dump(scenario))
            out.print(f"  fails until the policy is mended: sortie check {path}.yaml", soft_wrap=True)
