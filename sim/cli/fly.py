"""`sortie fly`: fly one sortie, or one run of a campaign again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

import sortie
from sortie.scenarios.errors import SortieError
from sortie.scenarios.exit_codes import FAILED
from sortie.scenarios.schema import Scenario
from sortie.sim.cli import tables
from sortie.sim.cli.console import bars, err, line_printer, out, print_failure, print_written
from sortie.sim.cli.options import PolicyOption, SeedOption, SetOption, loaded, refuse
from sortie.sim.cli.view import view
from sortie.sim.engine.needs import Forecast, ensure_room, needs
from sortie.sim.engine.watchers import Watcher, Watchers
from sortie.sim.folders import RunError
from sortie.sim.policy_text import flown_by
from sortie.sim.results import run_folder
from sortie.sim.results.run_files import RECORDING
from sortie.sim.studies.beside import Beside, worth


def fly(
    context: typer.Context,
    scenario: Annotated[
        str | None,
        typer.Argument(help="A scenario file or a library scenario's name; leave it out with --from-campaign."),
    ] = None,
    policy: PolicyOption = None,
    over: Annotated[
        str | None,
        typer.Option(
            help="Fly the same draws by this policy too, on another core, and print the difference: --over silence says "
            "what sharing is worth."
        ),
    ] = None,
    seed: SeedOption = None,
    set_: SetOption = None,
    replication: Annotated[
        int | None,
        typer.Option(help="Number of the repetition; each has other random draws under the same seed.", min=0),
    ] = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="The run's folder; default: below runs/.")] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the run in the folder, even if it is another one.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Fly even if the sortie needs more memory or disk than is free.")
    ] = False,
    live: Annotated[bool, typer.Option("--live", help="Show the sortie in a Rerun viewer while it flies.")] = False,
    view_: Annotated[bool, typer.Option("--view", help="Open the recording in the viewer afterwards.")] = False,
    mavlink: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Publish each drone as a MAVLink vehicle while it flies: udpout:127.0.0.1:14550"
        ),
    ] = None,
    pace: Annotated[
        float,
        typer.Option(
            help="With --mavlink: simulated seconds per wall-clock second, 0.001 to 1000; 0: as fast as possible."
        ),
    ] = 1.0,
    mavlink_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="With --mavlink: sign messages with the key in this file (32 bytes or 64 hex digits)."
        ),
    ] = None,
    recording: Annotated[
        bool | None,
        typer.Option(
            "--recording/--no-recording",
            help="Save the Rerun recording, sortie.rrd. Without this option it is saved if Rerun is installed.",
        ),
    ] = None,
    profile: Annotated[bool, typer.Option("--profile", help="Print how the wall-clock time was spent.")] = False,
    campaign: Annotated[
        Path | None,
        typer.Option("--from-campaign", metavar="DIR", help="Fly one run of this campaign again; name it with --run."),
    ] = None,
    run: Annotated[
        int | None,
        typer.Option("--run", help="With --from-campaign: the run's number, from the table's column `run`.", min=0),
    ] = None,
) -> None:
    """Fly one sortie, print its outcome and save the run."""
    if mavlink is None:
        refuse(context, ("pace", "mavlink_key"), "--mavlink")
    if campaign is not None or run is not None:
        flown, seed, number, expected = _again(campaign, run, (scenario, policy, seed, set_, replication))
    else:
        flown, number, expected = loaded(_named(scenario), set_, policy), replication or 0, None
    if out_dir is not None:
        run_folder.ensure_usable(out_dir, flown, flown.seed if seed is None else seed, number, replace=replace)
    other = None if over is None else flown_by(flown, over)
    if other is not None and other.policy == flown.policy:
        out.print(f"{flown.name} flies {over} itself: there is nothing to compare it with")
        other = None
    need = needs(flown)
    if words := ensure_room(flown, need, out_dir or Path("runs/run"), force=force):
        line_printer(flown.name)(words)
    if view_ or recording:
        import_module("sortie.sim.playback.recording")  # a missing Rerun is reported before the flight
    with _watching(live, mavlink, pace, mavlink_key) as watchers, _profiled(profile) as report, bars() as bar:
        ticker = Forecast(flown, line_printer(flown.name), bar(flown.name, flown.duration_s), memory=need.memory)
        beside = None if other is None else Beside(other, seed, number, bar(f"{flown.name}, {over}", flown.duration_s))
        flight = sortie.fly(flown, seed=seed, replication=number, progress=ticker, observer=watchers or None)
    note = ""
    try:
        path = flight.save(out_dir, recording=recording, replace=replace)
    except run_folder.OtherRunError:  # flown by other code: what was flown now is kept too
        path, note = flight.save(recording=recording), f", as {out_dir} holds another run"
    out.print(flight.summary())
    out.print(flight.decisions())
    report(flight.outcome)
    recorded = (path / RECORDING).is_file()
    see = f", see it with: sortie view {path}" if recorded else ""
    print_written("kept in", path, f"{note}{see}")
    if not recorded and recording is None:
        out.print("without a recording, as Rerun is missing: pip install 'sortie-sim[view]'")
    if beside is not None and over is not None:
        try:
            theirs = beside.record()
        except SortieError as error:  # the first flight is kept and printed
            print_failure(f"{over} did not fly to its end: {error}")
            raise typer.Exit(FAILED) from None
        out.print(worth(over, flight.record, theirs, str(scenario or flown.name)), soft_wrap=True, highlight=False)
    if expected is not None:
        same = flight.fingerprint[:16] == expected
        out.print(f"the record is{'' if same else ' not'} the campaign's", style=None if same else "red")
    if view_:
        view(path)


def _watching(live: bool, mavlink: str | None, pace: float, key: Path | None) -> Watchers:
    """The observers of a sortie. They are imported here because a viewer takes a third of a second to load."""
    watchers: list[Watcher] = []
    if live:
        from sortie.sim.playback.viewer import LiveViewer

        watchers.append(LiveViewer())
    if mavlink is not None:
        from sortie.sim.export.endpoint import read_key
        from sortie.sim.export.telemetry import MavlinkEndpoint

        watchers.append(MavlinkEndpoint(mavlink, pace or None, key=None if key is None else read_key(key)))
    return Watchers(watchers)


def _named(scenario: str | None) -> str:
    if scenario is None:
        raise RunError("no scenario named, as in: sortie fly track_target")
    return scenario


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


def _again(folder: Path | None, run: int | None, others: tuple[object, ...]) -> tuple[Scenario, int, int, str | None]:
    """A campaign's run for `sortie fly`: scenario, seed, replication, and the fingerprint it had.

    Raises:
        RunError: half of the two options, others beside them, no such run, or code that is not the campaign's.
    """
    from sortie.sim.experiment.flight import scenario_of_task
    from sortie.sim.experiment.rows import find_row
    from sortie.sim.folders import RunError
    from sortie.sim.identity import codes_here

    if folder is None or run is None:
        raise RunError("--from-campaign DIR and --run ID go together")
    if any(other is not None and other != [] for other in others):
        raise RunError("--from-campaign: the run has its own scenario, policy, seed and settings; name nothing else")
    plan, row = find_row(folder, run)
    if plan.code not in (here := codes_here()):
        here_is = f"this is Sortie {here[' torch ' in plan.code]}, the campaign was flown with {plan.code}"
        err.print(here_is, style="yellow", soft_wrap=True)
    if row is None:
        err.print(f"the campaign has not flown run {run} yet: there is no record to compare with")
    elif row["status"] == "failed":
        err.print(f"in the campaign run {run} failed: {row['error']}", soft_wrap=True)
    task = plan.task(run)
    return scenario_of_task(task), task.seed, task.replication, (row or {}).get("fingerprint") or None
