"""Errors that a user can put right; the command line prints them in one line."""

from __future__ import annotations

from sortie.scenarios.errors import SortieError


class InputError(SortieError):
    """A wrong file or setting; the message names it, its value and what is allowed."""
