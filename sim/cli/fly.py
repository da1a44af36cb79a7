"""`sortie fly`: one sortie, or one run of a campaign again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

import sortie
from sortie.sim.cli import tables
from sortie.sim.cli.campaign import again
from sortie.sim.cli.console import bars, out
from sortie.sim.cli.options import PolicyOption, SeedOption, SetOption, loaded
from sortie.sim.cli.view import view
from sortie.sim.engine.watchers import Watcher, Watchers
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder


def fly(
    scenario: Annotated[
        str | None, typer.Argument(help="A scenario file, or a library scenario's name; none with --from-campaign.")
    ] = None,
    policy: PolicyOption = None,
    seed: SeedOption = None,
    set_: SetOption = None,
    replication: Annotated[
        int | None, typer.Option(help="Another draw of everything random, as sortie check's replications.", min=0)
    ] = None,
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
        flown, seed, number, expected = again(campaign, run, (scenario, policy, seed, set_, replication))
    else:
        flown, number, expected = loaded(_named(scenario), set_, policy), replication or 0, None
    path = out_dir or run_folder.default_path(flown, seed, number)
    run_folder.ensure_writable(path)
    with _watching(live, mavlink, pace, mavlink_key) as watchers, _profiled(profile) as report, bars() as bar:
        ticker = bar(flown.name, flown.duration_s)
        flight = sortie.fly(flown, seed=seed, replication=number, progress=ticker, observer=watchers or None)
    instead = run_folder.in_place_of(path, flight.fingerprint)
    flight.save(path, recording=recording)
    out.print(tables.outcome_table(flight.outcome))
    out.print(tables.transitions_table(flight.outcome))
    report(flight.outcome)
    see = f", see it with: sortie view {path}" if recording else ""
    out.print(f"kept in [bold]{path}[/bold]{escape(instead)}{see}", soft_wrap=True)
    if expected is not None:
        same = "is" if flight.fingerprint[:16] == expected else "[red]is not[/red]"
        out.print(f"the record {same} the campaign's")
    if view_:
        view(path)


def _watching(live: bool, mavlink: str | None, pace: float, key: Path | None) -> Watchers:
    """Who watches a sortie while it flies; imported here, since a viewer costs a third of a second."""
    if key is not None and mavlink is None:
        raise RunError("--mavlink-key without --mavlink: there is nothing to sign")
    watchers: list[Watcher] = []
    if live:
        from sortie.sim.playback.viewer import LiveViewer

        watchers.append(LiveViewer())
    if mavlink is not None:
        from sortie.sim.export.telemetry import MavlinkEndpoint, read_key

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
