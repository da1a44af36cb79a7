"""`sortie verify`: test a policy against the plane's contract, prove its invariants, save counterexamples."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

import sortie
from sortie.policies.contract import FleetView, Policy
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import Invariant, InvariantError, parse
from sortie.policies.verification.invariants.promises import PROMISES
from sortie.policies.verification.kit.conformance import VIEWS, Check, conform, failing
from sortie.policies.verification.kit.single_view import PLANE
from sortie.policies.verification.kit.views import LARGEST, to_json
from sortie.policies.verification.proof.proof import DRONES, PLANE_CELLS, RULE_CELLS, ProofVerdict, prove
from sortie.policies.verification.shield import check_shieldable
from sortie.policies.verification.subject import OWN_INVARIANTS, own_invariants
from sortie.scenarios.exit_codes import FAILED
from sortie.scenarios.plugins.reference import Params
from sortie.scenarios.reading.load import build, dump, loads
from sortie.scenarios.regular import regular
from sortie.scenarios.schema import PolicySection, Scenario
from sortie.sim.check.counterexample import raised_ages, replay_scenario, shows_in_flight, slug, unused
from sortie.sim.check.kits import KITS
from sortie.sim.check.kits import verify as verify_model
from sortie.sim.check.over_time import COURSES, Subject, TimeVerdict, judge_over_time
from sortie.sim.cli.console import out, print_failure, print_written
from sortie.sim.cli.options import refuse
from sortie.sim.folders import RunError, ensure_files, write_text
from sortie.sim.policy_text import name_and_params

Kept = tuple[str, FleetView | None, Scenario]
"""What failed, a view that shows it if one alone does, and a scenario that flies it."""
WRITTEN = "# A counterexample, written by sortie verify.\n"
FOR_POLICIES = ("invariants", "drones", "budget", "views", "scenario", "courses", "flights", "out_dir")
COLOURS = {
    "holds": "green",
    "fails": "red",
    "unusual": "yellow",
    "not tried enough": "yellow",
    "proved": "green",
    "refuted": "red",
    "tried": "yellow",
}


def verify(
    context: typer.Context,
    model: Annotated[
        list[str],
        typer.Argument(
            metavar="[KIND] REF",
            help=f"A kind of model, by default policy (others: {', '.join(KITS)}), and a name, name(key=value), or path/to/file.py:Name.",
        ),
    ],
    invariants: Annotated[
        Path | None,
        typer.Option(
            help="A file of invariants, one per line; default: those in the policy's file, or those that a registered policy promises."
        ),
    ] = None,
    drones: Annotated[
        int,
        typer.Option(
            help=f"Largest fleet that proofs search. Drawn views go up to {LARGEST:,} drones whatever this is.",
            min=1,
            max=8,
        ),
    ] = DRONES,
    budget: Annotated[
        int | None,
        typer.Option(
            help=f"Cells of views that the proofs of all properties together may visit; default: {PLANE_CELLS:,}, and {RULE_CELLS:,} for each invariant.",
            min=0,
        ),
    ] = None,
    views: Annotated[int, typer.Option(help="Number of random views that the kit tries.", min=10)] = VIEWS,
    scenario: Annotated[
        str | None,
        typer.Option(help="For lines about time: its dwell time, ages and shield apply, and it is flown too."),
    ] = None,
    courses: Annotated[
        int, typer.Option(help="Number of drawn courses of views for each line about time.", min=1)
    ] = COURSES,
    flights: Annotated[int, typer.Option(help="Number of flights of the scenario for each of them.", min=0)] = 10,
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for counterexamples.")] = Path("runs/verify"),
) -> None:
    """Test a policy or another model against the rules of its kind. Exit code 1 if a rule fails.

    The options are for policies. A policy is tested on random views, and the command tries to prove its properties
    (*invariants*). A property is *proved* for all views of fleets up to a size, *refuted* by a view, or *tried* on so many
    views. The exit code is also 1 if a property is refuted.

    Invariants about time (`within 0.5 s: …`, `climbs_in(dwell) <= 1`) are tested on sequences of views. What counts is
    what the gates enforce, after staleness rules and damping.

    A counterexample is written as a view (JSON). If the policy fails on it in flight too, and all ids of its drones are
    below 200, it is also written as a scenario. `sortie check` on this scenario fails until the policy is corrected.
    """
    kind, reference = model if len(model) == 2 else ("policy", model[0])
    if len(model) > 2 or (model[0] in KITS and len(model) == 1):
        raise RunError(f"verify {' '.join(model)}, must be [KIND] REF, as in: sortie verify link houses.py:Blocked")
    if kind != "policy":
        refuse(context, FOR_POLICIES, "policies")
        return _verify_model(kind, reference)
    policy, section = reference, _section(reference)
    flown = None if scenario is None else sortie.load(scenario)
    decide = resolve(section.name, section.params)
    rules = _invariants(section.name, decide, invariants)
    _ensure_own(out_dir / slug(policy))
    over_time = [rule for rule in rules if rule.over_time]
    if flown is not None and flown.policy.shield:
        _ensure_shieldable(flown, over_time)
    broken, kept = _try(
        policy, section, decide, [r for r in rules if not r.over_time], drones, budget, views, bool(over_time)
    )
    if over_time:
        subject = Subject(decide, section.name, section.params)
        verdicts = judge_over_time(
            subject,
            over_time,
            drones=drones,
            scenario=flown,
            courses=courses,
            flights=flights,
        )
        out.print(_verdicts(f"{policy}: over time, as the gates enforce it", verdicts))
        broken += sum(v.outcome == "refuted" for v in verdicts)
        kept += [(v.name, v.view, v.scenario) for v in verdicts if v.scenario is not None]
    _keep(out_dir / slug(policy), kept)
    if broken:
        print_failure(f"{broken} {'do' if broken > 1 else 'does'} not hold")
        raise typer.Exit(FAILED)


def _verify_model(kind: str, reference: str) -> None:
    """Print what a kind's kit says of a model. Exit code 1 if a rule fails."""
    name, params = _called(reference, kind)
    table = Table("rule", "verdict", "what", title=f"{reference}: the conformance kit of kind {kind}")
    checks = verify_model(kind, name, params)
    for check in checks:
        table.add_row(check.name, _verdict(check.verdict), check.what)
    out.print(table)
    broken = len(failing(checks))
    if broken:
        print_failure(f"{broken} {'do' if broken > 1 else 'does'} not hold")
        raise typer.Exit(FAILED)


def _try(
    policy: str,
    section: PolicySection,
    decide: Policy,
    rules: Sequence[Invariant],
    drones: int,
    budget: int | None,
    views: int,
    has_more: bool,
) -> tuple[int, list[Kept]]:
    """Print what the kit and the proofs say; how many rules and properties are broken, and what shows it."""
    table = Table("rule", "verdict", "what", title=f"{policy}: the conformance kit, {views} drawn views")
    checks = conform(decide, count=views)
    for check in checks:
        table.add_row(check.name, _verdict(check.verdict), check.what)
    out.print(table)
    verdicts = prove(decide, rules, max_drones=drones, cells=budget)
    out.print(_verdicts(f"{policy}: proofs", verdicts))
    if not rules and not has_more:
        out.print("No invariants: the plane's rules alone were checked. --invariants FILE names some.", soft_wrap=True)
    elif rules:
        out.print(
            "This judges what the policy decides. Staleness rules and damping come after it; a flight with the same lines in "
            "`policy.invariants` judges what the gates enforce.",
            soft_wrap=True,
        )
    kept = list(_counterexamples(decide, section, checks, verdicts))
    return len(failing(checks)) + sum(v.outcome == "refuted" for v in verdicts), kept


def _verdicts(title: str, verdicts: Sequence[ProofVerdict | TimeVerdict]) -> Table:
    table = Table("property", "verdict", "what", title=title)
    for verdict in verdicts:
        table.add_row(verdict.name, _verdict(verdict.outcome), verdict.what)
    return table


def _verdict(word: str) -> Text:
    return Text(word, COLOURS[word])


def _section(policy: str) -> PolicySection:
    """`name(key=value, …)` as a scenario's section, parsed and checked as one is."""
    name, params = _called(policy, "policy")
    return build({"name": "verify", "policy": {"name": name, "params": dict(params)}}).policy


def _called(reference: str, kind: str) -> tuple[str, Params]:
    """`name(key=value, …)` as the name and its parameters, written as in YAML."""
    name, params = name_and_params(reference, kind)
    overrides = [f"policy.params.{p}" for p in params or ()]
    return name, loads("name: verify", overrides=overrides).policy.params


def _invariants(name: str, decide: Policy, file: Path | None) -> tuple[Invariant, ...]:
    """From the file named, or the policy's own file, or what a registered policy promises."""
    own = own_invariants(decide) if ":" in name else PROMISES.get(name, "")
    source = f"{name}: {OWN_INVARIANTS}" if file is None else str(file)
    if file is None and not isinstance(own, str):
        raise RunError(f"{source} is of type {type(own).__name__}, must be text")
    try:
        return parse(str(own) if file is None else regular(file).read_text("utf-8-sig"))
    except OSError as error:
        raise RunError(f"{file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RunError(f"{file}: byte 0x{error.object[error.start]:02x} is not UTF-8 text") from None
    except InvariantError as error:
        raise RunError(f"{source}, {error}") from error


def _ensure_shieldable(scenario: Scenario, over_time: Sequence[Invariant]) -> None:
    """Refuse a scenario with a shield for a line about time that no shield can keep."""
    for rule in over_time:
        try:
            check_shieldable([rule])
        except InvariantError:
            raise RunError(
                f"policy.shield of {scenario.name} is true, must be false for {rule.text!r}: no shield can keep such a line"
            ) from None


def _counterexamples(
    decide: Policy, section: PolicySection, checks: Sequence[Check], verdicts: Sequence[ProofVerdict]
) -> Iterator[Kept]:
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
    """Refuse a folder that cannot be made, or holds something else than counterexamples, which new ones replace."""
    ensure_files(folder / "counterexample.json")
    for file in sorted(folder.iterdir()) if folder.is_dir() else ():
        begin = file.read_text("utf-8", "replace")[:100] if file.suffix in (".json", ".yaml") else ""
        if not (begin.startswith(WRITTEN) if file.suffix == ".yaml" else '"ego": ' in begin[:20]):
            raise RunError(f"{folder}: holds {file.name}, which is no counterexample; name another --out or move it")


def _keep(folder: Path, found: Iterable[Kept]) -> None:
    """Write each view, and its scenario where the fault shows in flight."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, view, scenario in found:
        path = unused(folder, scenario.name)
        if view is not None:
            write_text(path.with_suffix(".json"), to_json(view))
        print_written("counterexample of", name, "" if view is None else f": {path}.json")
        if shows_in_flight(scenario):
            write_text(path.with_suffix(".yaml"), WRITTEN + dump(scenario))
            out.print(f"  fails until the policy is mended: sortie check {path}.yaml", soft_wrap=True)
