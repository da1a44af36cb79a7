"""The error that everything a user can put right derives from."""

from __future__ import annotations


class SortieError(ValueError):
    """Something that a user can put right: one line that names the place, the value and what is allowed."""
