"""What every run of tests sets before it begins; the suites of the product and of the laboratory import it."""

from __future__ import annotations

import functools
import os
import signal

import typer.main
import typer.testing
from hypothesis import HealthCheck, settings

# torch's threads wait in a busy loop by themselves, which takes the cores from other workers; read when torch is loaded
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# a flight that one test flew must not be another test's
os.environ["SORTIE_FLIGHTS"] = ""

# typer reads all commands of the app anew at each call in this process, which takes longer than most of the calls
typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # begun in the background: children would ignore Ctrl-C as well
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A deadline and the check of slow draws are timed assertions: they fail on a busy machine alone.
settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.register_profile("same", settings.get_profile("explore"), derandomize=True)
settings.load_profile("same")  # the same examples in each run; `make nightly` explores others
