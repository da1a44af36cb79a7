"""`sortie compare`: several policies on one scenario, or over a set of conditions."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

import sortie
from sortie.policies.registry import POLICIES
from sortie.scenarios.reading.load import load_conditions
from sortie.sim.cli.conditions import compare_conditions
from sortie.sim.cli.console import bars, out, print_written, stages
from sortie.sim.cli.options import (
    ReplaceOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    loaded,
    refuse,
    split_policies,
)
from sortie.sim.experiment.compare import MOST_SEEDS, Flown, chosen_seeds, in_town_of
from sortie.sim.experiment.comparison_text import BEGIN, END, compare_command, comparison_markdown
from sortie.sim.folders import RunError, ensure_files, write_text
from sortie.sim.readme import with_section
from sortie.sim.results.html_page import GENERATOR
from sortie.sim.results.run_files import RECORDING_MARK

PRECISE = ("metric", "pilot", "most_seeds")
"""Options that go with --half-width."""


def compare(
    context: typer.Context,
    scenario: ScenarioArgument,
    policies: Annotated[
        str,
        typer.Option(
            help="Policies separated by commas: worked,best-2(received_budget=0.1),silence. With conditions, `all` means every policy."
        ),
    ],
    seed: SeedOption = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            help="Fly this many seeds, beginning with --seed or the scenario's, each in its own town. Default: 8 with "
            "the surrogate and no --seed, else 1.",
            min=1,
            max=MOST_SEEDS,
        ),
    ] = None,
    set_: SetOption = None,
    own_fusion: Annotated[
        bool,
        typer.Option(
            "--own-fusion",
            help="Fly each prior method that was published with a fusion of its own with that fusion, and with its network.",
        ),
    ] = False,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write the outcomes as JSON here.")] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Save the first seed's sorties side by side as a Rerun recording.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write the comparison as one self-contained HTML page here.")
    ] = None,
    readme: Annotated[
        Path | None, typer.Option(help="Write the comparison between the markers of this Markdown file.")
    ] = None,
    half_width: Annotated[
        float | None,
        typer.Option(
            help="Fly with the torch detector until the 95 % intervals of all gains in --metric reach at most this far to each "
            "side: 0.01 is one AP point. Sorties of the surrogate, which are cheap, serve as control variates to save torch "
            "sorties. The same command goes on after an interruption.",
            min=0.0,
            max=1.0,
        ),
    ] = None,
    metric: Annotated[
        str | None, typer.Option(help="With --half-width: ap50.full_scene (the default) or ap50.mission.")
    ] = None,
    pilot: Annotated[
        int | None,
        typer.Option(
            help="With --half-width: seeds flown by both detectors before the rest is planned. Default: 12.", min=4
        ),
    ] = None,
    most_seeds: Annotated[
        int | None,
        typer.Option(
            help="With --half-width: seeds flown by the torch detector at most. Default: 200.", min=4, max=MOST_SEEDS
        ),
    ] = None,
    workers: Annotated[int, typer.Option(help="Number of processes that fly; with --half-width one.", min=1)] = 1,
    kept: Annotated[
        Path | None,
        typer.Option(
            help="The file to which finished flights are written. Default: flights.sqlite in your cache folder."
        ),
    ] = None,
    by_torch: Annotated[
        bool, typer.Option("--by-torch", help="With conditions: fly with the surrogate, score with the torch detector.")
    ] = False,
    replace: ReplaceOption = False,
) -> None:
    """Fly a scenario or a set of conditions under several policies with equal seeds and draws, and print the comparison.

    A file of --out, --report or --recording that `sortie compare` did not write needs --replace.
    """
    conditions = load_conditions(scenario)
    if conditions is not None:
        one = ("seeds", "own_fusion", "recording", "report", "readme", "half_width", "workers", "kept", *PRECISE)
        refuse(context, ("seed",), "a scenario, not with a set of conditions: its file has its seeds")
        refuse(context, one, "a scenario, not with a set of conditions")
        named = list(POLICIES) if policies == "all" else split_policies(policies)
        return compare_conditions(conditions, named, set_ or [], out_file, by_torch=by_torch, replace=replace)
    if by_torch:
        raise RunError(f"--by-torch goes with a set of conditions; for {scenario}: --set perception.detector=torch")
    labels = split_policies(policies)
    base = [loaded(scenario, set_, label) for label in labels][0]  # noqa: RUF015  every policy's notes are printed
    for file, mark in ((out_file, '{\n  "gains": ['), (recording, RECORDING_MARK), (report, GENERATOR)):
        ensure_files(file, replace=replace, mark=mark)
    ensure_files(out_file, recording, report, kept)
    if readme is not None:
        with_section(readme, BEGIN + END, BEGIN, END)  # its errors come before the flights
    if half_width is not None:
        if seeds is not None or recording is not None:
            raise RunError(f"--{'recording' if seeds is None else 'seeds'} does not go with --half-width")
        first = []
        if seed is not None:  # in the town that a comparison of several seeds gives it
            first = [f"seed={seed}", f"perception.scene.seed={in_town_of(base, seed).perception.scene.seed}"]
        with stages() as stage_bar:
            compared = sortie.compare(
                scenario,
                labels,
                [*(set_ or []), *first],
                own_fusion=own_fusion,
                progress=lambda stage, done, of: stage_bar(stage, done, round(of)),
                half_width=half_width,
                metric=metric,
                pilot=pilot,
                most_seeds=most_seeds,
                kept=kept,
            )
    else:
        refuse(context, PRECISE, "--half-width")
        chosen = chosen_seeds(base, seed, seeds)
        with bars() as bar:
            each = {label: bar(label, len(chosen) * base.duration_s) for label in labels}
            compared = sortie.compare(
                scenario,
                labels,
                set_ or [],
                seeds=chosen,
                own_fusion=own_fusion,
                workers=workers,
                kept=kept,
                progress=lambda label, at, t_s: each[label](chosen.index(at) * base.duration_s + t_s),
            )
    out.print(compared.summary())
    if out_file is not None:
        write_text(out_file, json.dumps(_plain(compared), indent=2, allow_nan=False) + "\n")
        print_written("kept in", out_file)
    if report is not None:
        compared.report(report)
        print_written("kept in", report)
    if readme is not None:
        command = compare_command(
            scenario,
            policies,
            seed,
            seeds,
            set_ or [],
            own_fusion=own_fusion,
            half_width=half_width,
            metric=metric,
            pilot=pilot,
            most_seeds=most_seeds,
        )
        section = comparison_markdown(Flown(compared.sorties, compared.gains), command, compared.precision)
        write_text(readme, with_section(readme, section, BEGIN, END))
        print_written("the comparison in", readme, " written")
    if recording is not None:
        compared.save_recording(recording)
        print_written("kept in", recording, f", see it with: rerun {recording}")


def _plain(compared: sortie.Comparison) -> dict[str, Any]:
    """What `--out` holds."""
    sorties = [
        {"policy": s.policy, "seed": s.seed, "town_seed": s.town_seed, "gain_over_first": s.gain, "outcome": s.outcome}
        for s in compared.sorties
    ]
    gains = _without_nan([asdict(gain) for gain in compared.gains])  # NaN: no interval
    plain: dict[str, Any] = {"gains": gains, "sorties": sorties}
    return plain if compared.precision is None else {**plain, "precision": _without_nan(asdict(compared.precision))}


def _without_nan(value: Any) -> Any:
    """As JSON has it, which has no NaN."""
    if isinstance(value, dict):
        return {key: _without_nan(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    return None if value != value else value
