"""`python -m research`: the commands of the laboratory."""

from __future__ import annotations

import typer

from research.benchmark import command as bench
from research.calibrate.command import calibrate
from research.flip import command as flip
from research.learn.command import learn
from research.overhead.command import overhead
from research.paper.command import paper
from research.train import fit_command
from research.train.command import train
from research.uav3d.command import from_uav3d
from sortie.sim.cli.app import Commands, run

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Research with Sortie: train and calibrate detectors, measure the paper's claims, run the studies.",
)
app.add_typer(bench.app, name="bench")
app.add_typer(flip.study, name="study")
app.add_typer(fit_command.app, name="fit")
app.command("train")(train)
app.command("calibrate")(calibrate)
app.command("paper")(paper)
app.command("learn")(learn)
app.command("overhead")(overhead)
app.command("from-uav3d")(from_uav3d)

if __name__ == "__main__":
    run(app, "python -m research")
