"""`sortie compare`: several policies on one scenario, or over a set of conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
    same_command,
    split_policies,
)
from sortie.sim.experiment.compare import MOST_SEEDS, Flown, chosen_seeds, in_town_of, kept_text
from sortie.sim.experiment.comparison_text import BEGIN, END, comparison_markdown
from sortie.sim.folders import RunError, ensure_files, write_text
from sortie.sim.readme import with_section
from sortie.sim.results.blocks import GENERATOR
from sortie.sim.results.run_files import RECORDING_MARK

PRECISE = ("metric", "pilot", "most_seeds")
"""Options that go with --half-width."""
OF_ONE = ("seeds", "own_fusion", "recording", "report", "readme", "half_width", "workers", "kept", *PRECISE)
"""Options that do not go with a set of conditions."""
OUTPUTS = ("out_file", "recording", "report", "readme", "kept", "workers", "replace")

Metric = Annotated[str | None, typer.Option(help="With --half-width: ap50.full_scene (the default) or ap50.mission.")]
Readme = Annotated[Path | None, typer.Option(help="Write the comparison between the markers of this Markdown file.")]
Recording = Annotated[
    Path | None, typer.Option(help="Save the first seed's sorties side by side as a Rerun recording.")
]
Report = Annotated[Path | None, typer.Option(help="Write the comparison as one self-contained HTML page here.")]
Workers = Annotated[int, typer.Option(help="Number of processes that fly; with --half-width one.", min=1)]


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
    metric: Metric = None,
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
    own_fusion: Annotated[
        bool,
        typer.Option(
            "--own-fusion",
            help="Fly each prior method that was published with a fusion of its own with that fusion, and with its network.",
        ),
    ] = False,
    by_torch: Annotated[
        bool, typer.Option("--by-torch", help="With conditions: fly with the surrogate, score with the torch detector.")
    ] = False,
    workers: Workers = 1,
    kept: Annotated[
        Path | None,
        typer.Option(
            help="The file to which finished flights are written. Default: flights.sqlite in your cache folder."
        ),
    ] = None,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write the outcomes as JSON here.")] = None,
    recording: Recording = None,
    report: Report = None,
    readme: Readme = None,
    replace: ReplaceOption = False,
) -> None:
    """Fly a scenario or a set of conditions under several policies with equal seeds and draws, and print the comparison.

    A file of --out, --report or --recording that `sortie compare` did not write needs --replace.
    """
    conditions = load_conditions(scenario)
    if conditions is not None:
        refuse(context, ("seed",), "a scenario, not with a set of conditions: its file has its seeds")
        refuse(context, OF_ONE, "a scenario, not with a set of conditions")
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
        how = {"half_width": half_width, "metric": metric, "pilot": pilot, "most_seeds": most_seeds}
        with stages() as bar:
            compared = sortie.compare(
                scenario,
                labels,
                [*(set_ or []), *first],
                own_fusion=own_fusion,
                progress=lambda stage, done, of: bar(stage, done, round(of)),
                kept=kept,
                **how,  # type: ignore[arg-type]
            )
    else:
        refuse(context, PRECISE, "--half-width")
        chosen = chosen_seeds(base, seed, seeds)
        with bars() as several:
            each = {label: several(label, len(chosen) * base.duration_s) for label in labels}
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
    flown = Flown(compared.sorties, compared.gains)
    if out_file is not None:
        write_text(out_file, kept_text(flown, compared.precision))
        print_written("kept in", out_file)
    if report is not None:
        compared.report(report)
        print_written("kept in", report)
    if readme is not None:
        section = comparison_markdown(flown, same_command(context, OUTPUTS), compared.precision)
        write_text(readme, with_section(readme, section, BEGIN, END))
        print_written("the comparison in", readme, " written")
    if recording is not None:
        compared.save_recording(recording)
        print_written("kept in", recording, f", see it with: rerun {recording}")
