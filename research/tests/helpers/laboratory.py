"""The commands of the laboratory in this process, for tests of what they print and return."""

from __future__ import annotations

from functools import partial

import cli_examples

from research.__main__ import app
from sortie.sim.cli.app import run

_main = partial(run, app, "python -m research")
command = partial(cli_examples.command, run=_main)
"""A command's exit code."""
refusal = partial(cli_examples.refusal, run=_main)
"""The one line with which a command refuses."""
