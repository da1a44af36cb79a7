"""Exit codes of the `sortie` command. `docs/site/command_line.md` explains them; nothing else defines one."""

from __future__ import annotations

import signal

FAILED = 1
"""An expectation, a proof, a comparison or a run fails. The command itself worked."""
USER = 2
"""Something that the user can put right: an option, a file, a field, a missing extra, or the user's own code."""
DEFECT = 70
"""A defect of Sortie. A traceback comes before it."""
INTERRUPTED = 128 + signal.SIGINT
"""Ctrl-C."""
ENDED = 128 + signal.SIGTERM
"""SIGTERM."""
