"""The `sortie` command: one file of this folder a command or group. An error that a user can put right is one line."""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from sortie._signals import as_usual
from sortie.scenarios.errors import SortieError
from sortie.scenarios.exit_codes import DEFECT, INTERRUPTED, USER
from sortie.sim.cli import (
    campaign,
    check,
    compare,
    export,
    fly,
    import_log,
    listing,
    live,
    new,
    rank,
    recording,
    replay,
    report,
    verify,
    view,
    worst,
)
from sortie.sim.cli.console import err, out, own_streams, print_error
from sortie.sim.identity import code_version
from sortie.sim.process import own_process
from sortie.sim.user_errors import defect, user_errors


class Commands(TyperGroup):
    """Prints that a command was interrupted, which typer alone ends silently; the user's errors become `SortieError`."""

    def invoke(self, ctx: Any) -> Any:
        try:
            as_usual()
            with user_errors(), _notes_once():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            err.print("interrupted; what was not finished was not written")
            raise typer.Exit(INTERRUPTED) from None


@contextmanager
def _notes_once() -> Iterator[None]:
    """Print each note of a command once: a scenario is read for each policy that flies it."""
    log, said, printing = logging.getLogger("sortie"), set[str](), logging.StreamHandler()

    def first(record: logging.LogRecord) -> bool:
        text = record.getMessage()
        return text not in said and not said.add(text)  # type: ignore[func-returns-value]

    level = log.level
    log.addFilter(first)
    if not log.hasHandlers():
        log.addHandler(printing)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(printing)
        log.removeFilter(first)


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Fly drone fleets that share what they see. Print what they saw and what sharing cost.",
)
app.add_typer(recording.app, name="recording")
campaign.app.command("worst")(worst.worst)
app.add_typer(campaign.app, name="campaign")
COMMANDS: dict[str, Callable[..., None]] = {
    "fly": fly.fly,
    "compare": compare.compare,
    "check": check.check,
    "view": view.view,
    "list": listing.list_,
    "new": new.new,
    "verify": verify.verify,
    "export": export.export,
    "report": report.report,
    "rank": rank.rank,
    "replay": replay.replay,
    "import": import_log.import_log,
    "live": live.live,
}
for name, command in COMMANDS.items():
    app.command(name)(command)


def main() -> None:
    """The `sortie` command, once it is imported (sortie.__main__)."""
    run(app, "sortie")


def run(commands: typer.Typer, name: str) -> None:
    """Run commands as a program of that name: an error of the user's is one line, a defect keeps its traceback."""
    own_process()
    own_streams()
    code: str | int | None = 0
    try:
        try:
            commands(prog_name=name)
        except SystemExit as ended:
            code = ended.code
        if sys.stdout is not None:
            sys.stdout.flush()
    except SortieError as error:
        print_error(error)
        code = USER
    except Exception as error:
        traceback.print_exception(error)
        err.print(defect(), soft_wrap=True)
        code = DEFECT
    sys.exit(code)


@app.callback(invoke_without_command=True)
def _version(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        out.print(code_version())
        raise typer.Exit
