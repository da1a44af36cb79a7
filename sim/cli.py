"""The command line: fly, compare, view, check, list, train; `paper` is in a file of its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from fleet.motion import MotionError
from fleet.wire import DescriptorTooLarge
from perception.detectors import DETECTORS
from perception.errors import InputError
from policies.contract import PolicyError
from policies.registry import POLICIES, parameters
from policies.registry import own_fusion as own_fusion_of
from scenarios.load import ScenarioError, campaigns, library, load, load_contexts
from scenarios.schema import Scenario, json_schema
from scenarios.traces import TraceError
from sim import (
    cli_bench,
    cli_calibrate,
    cli_campaign,
    cli_contexts,
    cli_export,
    cli_import,
    cli_live,
    cli_paper,
    cli_recording,
    cli_report,
    cli_study,
    cli_train,
    cli_verify,
    rundir,
    tables,
)
from sim.compare import compare as compare_policies
from sim.console import bars, err, out
from sim.folders import RunError, ensure_between, ensure_files, put_between, write_text
from sim.named import policy_overrides
from sim.sortie import VERSION, run_sortie
from sim.watchers import Watcher, Watchers


class _Commands(TyperGroup):
    """Says that a command was interrupted, before typer ends it without a word."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            err.print("interrupted; what was not finished was not written")
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Fly drone fleets that share what they see, and tell what they saw and what it cost.",
)
app.add_typer(cli_bench.app, name="bench")
app.add_typer(cli_recording.app, name="recording")
app.add_typer(cli_campaign.app, name="campaign")

USER_ERRORS = (ScenarioError, PolicyError, MotionError, TraceError, DescriptorTooLarge, InputError, RunError)
"""What a user can mend: one line and exit code 2, no traceback."""

ScenarioArgument = Annotated[str, typer.Argument(help="A scenario file, or a library scenario's name.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a field: fleet.battery.initial_soc=0.5")
]
SeedOption = Annotated[int | None, typer.Option(help="Of every draw; left out, its own.", min=0, max=2**63 - 1)]
PolicyOption = Annotated[
    str | None, typer.Option(help="A policy's name, name(key=value), or path/to/file.py:function.")
]


def main() -> None:
    """The `sortie` command, once it is imported (sim.__main__)."""
    try:
        app()
    except USER_ERRORS as error:
        err.print(f"[red]error:[/red] {escape(str(error))}", soft_wrap=True)
        sys.exit(2)


@app.command()
def fly(
    scenario: Annotated[
        str | None, typer.Argument(help="A scenario file, or a library scenario's name; none with --from-campaign.")
    ] = None,
    policy: PolicyOption = None,
    seed: SeedOption = None,
    set_: SetOption = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="The run's folder; left out, under runs/.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Stream to a Rerun viewer while it flies.")] = False,
    view_: Annotated[bool, typer.Option("--view", help="Open the recording afterwards.")] = False,
    mavlink: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Be MAVLink vehicles while it flies: udpout:127.0.0.1:14550")
    ] = None,
    pace: Annotated[
        float,
        typer.Option(help="Simulated seconds in one of the wall's, with --mavlink; 0: as fast as it goes.", min=0),
    ] = 1.0,
    mavlink_key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Sign what --mavlink sends with this file's 32 B or 64 hex digits."),
    ] = None,
    recording: Annotated[bool, typer.Option(help="Save sortie.rrd.")] = True,
    profile: Annotated[bool, typer.Option("--profile", help="Tell where the wall time went.")] = False,
    campaign: Annotated[
        Path | None, typer.Option("--from-campaign", metavar="DIR", help="Fly one run of a campaign again; see --run.")
    ] = None,
    run: Annotated[int | None, typer.Option("--run", help="Its number, as in the table's column `run`.", min=0)] = None,
) -> None:
    """Fly one sortie, print its outcome, and keep the run."""
    if campaign is not None or run is not None:
        flown, seed, replication, expected = cli_campaign.again(campaign, run, (scenario, policy, seed, set_))
    else:
        flown, replication, expected = _load(_named(scenario), set_, policy), 0, None
    path = out_dir or rundir.default_path(flown, seed, replication)
    rundir.ensure_writable(path)
    with _watching(live, mavlink, pace, mavlink_key) as watchers, _profiled(profile) as report, bars() as bar:
        ticker = bar(flown.name, flown.duration_s)
        record = run_sortie(flown, None, seed, replication=replication, progress=ticker, observer=watchers or None)

    def save_recording(folder: Path) -> None:
        from sim.playback import save_rrd

        save_rrd(record, folder / rundir.RECORDING)

    instead = rundir.in_place_of(path, record.fingerprint)
    result = rundir.save(record, path, save_recording if recording else None)
    out.print(tables.outcome_table(result))
    out.print(tables.transitions_table(result))
    report(result)
    out.print(
        f"kept in [bold]{path}[/bold]{escape(instead)}" + (f", see it with: sortie view {path}" if recording else "")
    )
    if expected is not None:
        same = "is" if record.fingerprint[:16] == expected else "[red]is not[/red]"
        out.print(f"the record {same} the campaign's")
    if view_:
        view(path)


@app.command()
def compare(
    scenario: ScenarioArgument,
    policies: Annotated[
        str, typer.Option(help="Comma-separated, as in worked,best-2(rho=0.1),silence; all: every one, over contexts.")
    ],
    seed: SeedOption = None,
    set_: SetOption = None,
    own_fusion: Annotated[
        bool, typer.Option("--own-fusion", help="Prior methods fly with the fusion they were published with.")
    ] = False,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write the outcomes as JSON here.")] = None,
    recording: Annotated[Path | None, typer.Option(help="Save all of them side by side as a Rerun recording.")] = None,
    readme: Annotated[
        Path | None, typer.Option(help="A Markdown file whose section between the comparison's markers is replaced.")
    ] = None,
    by_torch: Annotated[
        bool, typer.Option("--by-torch", help="Contexts flown by the surrogate are scored by the torch detector.")
    ] = False,
) -> None:
    """Fly a scenario, or a set of contexts, under several policies, same seed and draws, and print them side by side."""
    contexts = load_contexts(scenario)
    if contexts is not None:
        cli_contexts.refuse({"seed": seed, "own-fusion": own_fusion or None, "recording": recording, "readme": readme})
        chosen = list(POLICIES) if policies == "all" else _split_policies(policies)
        return cli_contexts.compare_contexts(contexts, chosen, set_ or [], out_file, by_torch=by_torch)
    if by_torch:
        raise RunError(f"--by-torch goes with a set of contexts; for {scenario}: --set perception.detector=torch")
    flown = [(p, _load(scenario, set_, p)) for p in _split_policies(policies)]
    ensure_files(out_file, recording)
    ensure_between(readme, tables.COMPARE_BEGIN, tables.COMPARE_END)
    if own_fusion:
        flown = [(p, _with_own_fusion(s)) for p, s in flown]
    with bars() as bar:
        each = {label: bar(label, s.duration_s) for label, s in flown}
        rows = compare_policies(flown, seed, progress=lambda label, t_s: each[label](t_s))
    out.print(tables.comparison_table(rows))
    for line in tables.explanations(rows):
        out.print(line)
    if out_file is not None:
        _write_json(out_file, {r.policy: {**r.outcome, "gain_over_first": r.gain} for r in rows})
        out.print(f"kept in [bold]{out_file}[/bold]")
    if readme is not None:
        command = tables.compare_command(scenario, policies, seed, set_ or [], own_fusion=own_fusion)
        section = tables.comparison_markdown(rows, command)
        put_between(readme, section, tables.COMPARE_BEGIN, tables.COMPARE_END)
        out.print(f"the comparison in [bold]{readme}[/bold] written")
    if recording is not None:
        from sim.playback import save_comparison

        save_comparison([(r.policy, r.record) for r in rows], recording)
        out.print(f"kept in [bold]{recording}[/bold], see it with: rerun {recording}", soft_wrap=True)


@app.command()
def check(
    scenarios: Annotated[list[str], typer.Argument(help="Scenario files or names; all: the whole library.")],
    set_: SetOption = None,
    update: Annotated[
        bool, typer.Option("--update", help="Write NAME.golden.json beside each scenario instead of comparing.")
    ] = False,
) -> None:
    """Fly scenarios and hold their outcomes against their own expectations; exit code 1 if one fails."""
    from sim.checking import check_scenario, flights

    names = list(library()) if scenarios == ["all"] else scenarios
    loaded = [(name, load(name, set_ or [])) for name in names]  # all of them, before the first one flies
    failed = 0
    for name, flown in loaded:
        with bars() as bar:
            watch = bar(flown.name, flown.duration_s * flights(flown))
            checked = check_scenario(name, set_ or [], update=update, progress=watch)
        failed += len(checked.failed)
        out.print(tables.verdict_table(flown.name, checked.verdicts))
        if checked.written:
            out.print(checked.written, soft_wrap=True, markup=False)
        if checked.failed:
            out.print(f"see it with: {checked.replay}", soft_wrap=True, markup=False)
    if failed:
        err.print(f"[red]{failed} expectation{'s' if failed > 1 else ''} failed[/red]")
        raise typer.Exit(1)


@app.command()
def view(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    picture: Annotated[
        Path | None, typer.Option(help="Save a picture of the viewer here and open none; needs no screen.")
    ] = None,
    at_s: Annotated[float, typer.Option("--at", help="The picture's simulated time, s.", min=0)] = 0.0,
) -> None:
    """Open a run's recording in the Rerun viewer; it is made anew if it is missing."""
    from sim.playback import open_viewer, save_rrd

    if at_s and picture is None:
        raise RunError("--at goes with --picture: the viewer has a time line of its own")
    path = run / rundir.RECORDING
    if not path.is_file():
        save_rrd(rundir.load(run), path)
    if picture is None:
        open_viewer(path)
        return
    from sim.playback_picture import take_picture

    for complaint in take_picture(path, picture, at_s):
        err.print(complaint, soft_wrap=True)
    out.print(f"kept in [bold]{picture}[/bold]", soft_wrap=True)


@app.command("list")
def list_(
    what: Annotated[
        str, typer.Argument(help="policies, scenarios, campaigns, detectors, fusions or schema (JSON Schema).")
    ],
) -> None:
    """List what there is."""
    if what == "policies":
        for name, function in POLICIES.items():
            defaults = ", ".join(f"{k}={v}" for k, v in parameters(function).items())
            summary = (function.__doc__ or "").strip().splitlines()[0]
            out.print(f"[bold]{name}[/bold]{f'({defaults})' if defaults else ''}  {summary}", soft_wrap=True)
    elif what == "scenarios":
        for name, path in library().items():
            out.print(f"[bold]{name}[/bold]  {load(path).description}", soft_wrap=True)
    elif what == "campaigns":
        from scenarios.load_campaign import load_campaign

        for name in campaigns():
            out.print(f"[bold]{name}[/bold]  {load_campaign(name).campaign.description}", soft_wrap=True)
    elif what == "detectors":
        for name, kind in DETECTORS.items():
            out.print(f"[bold]{name}[/bold]  {kind.about}", soft_wrap=True)
    elif what == "fusions":
        from perception.fusion.registry import FUSIONS  # here: torch takes a second to import

        for name, fusion in FUSIONS.items():
            out.print(f"[bold]{name}[/bold]  {fusion.about}", soft_wrap=True)
    elif what == "schema":
        out.print_json(data=json_schema())
    else:
        raise typer.BadParameter(f"{what!r}, must be policies, scenarios, campaigns, detectors, fusions or schema")


app.command()(cli_train.train)
app.command()(cli_calibrate.calibrate)
app.add_typer(cli_study.study, name="study")
app.command()(cli_paper.paper)
app.command()(cli_contexts.learn)
app.command()(cli_verify.verify)
app.command()(cli_verify.overhead)
app.command()(cli_export.export)
app.command()(cli_report.report)
app.command("import")(cli_import.import_log)
app.command()(cli_live.live)


@app.callback(invoke_without_command=True)
def _version(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        out.print(VERSION)
        raise typer.Exit


# --- helpers -------------------------------------------------------------------------------------


def _watching(live: bool, mavlink: str | None, pace: float, key: Path | None) -> Watchers:
    """Who watches a sortie while it flies; imported here, since a viewer costs a third of a second."""
    if key is not None and mavlink is None:
        raise RunError("--mavlink-key without --mavlink: there is nothing to sign")
    watchers: list[Watcher] = []
    if live:
        from sim.playback import LiveViewer

        watchers.append(LiveViewer())
    if mavlink is not None:
        from sim.telemetry import MavlinkEndpoint, read_key

        watchers.append(MavlinkEndpoint(mavlink, pace or None, key=None if key is None else read_key(key)))
    return Watchers(watchers)


def _load(scenario: str, set_: list[str] | None, policy: str | None) -> Scenario:
    """The scenario with `--set` and the policy put in; another policy than its own starts from its own defaults."""
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


def _with_own_fusion(scenario: Scenario) -> Scenario:
    fusion = own_fusion_of(scenario.policy.name)
    if fusion is None:
        return scenario
    perception = scenario.perception.model_copy(update={"fusion": fusion})
    return scenario.model_copy(update={"perception": perception})


def _named(scenario: str | None) -> str:
    if scenario is None:
        raise RunError("no scenario named, as in: sortie fly track_target")
    return scenario


def _split_policies(text: str) -> list[str]:
    """Split at commas outside brackets."""
    names, depth = [""], 0
    for letter in text:
        depth += (letter == "(") - (letter == ")")
        if letter == "," and depth == 0:
            names.append("")
        else:
            names[-1] += letter
    cleaned = [n.strip() for n in names if n.strip()]
    if not cleaned:
        raise PolicyError("no policy named, as in --policies worked,all-4,silence")
    if len(set(cleaned)) < len(cleaned):
        raise PolicyError(f"a policy is named twice: {', '.join(cleaned)}")
    return cleaned


def _write_json(path: Path, data: Any) -> None:
    write_text(path, json.dumps(data, indent=2) + "\n")


@contextmanager
def _profiled(wanted: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Wall time by room, measured by cProfile (which itself slows the sortie down about twofold)."""
    if not wanted:
        yield lambda result: None
        return
    import cProfile

    profiler = cProfile.Profile()
    profiler.enable()
    try:
        yield lambda result: out.print(tables.profile_table(profiler, result))
    finally:
        profiler.disable()
