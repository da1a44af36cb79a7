"""The error that everything a user can put right derives from."""

from __future__ import annotations

from sortie.scenarios.report_text import visible

MOST_CHARACTERS = 2000
"""A longer message is cut: names and values in it may be those of a damaged file."""


class SortieError(ValueError):
    """Something that a user can put right: one line that names the place, the value and what is allowed.

    It is one line whatever a broken file holds: control characters and odd spaces are escaped.
    """

    def __init__(self, line: object = "") -> None:
        super().__init__(one_line(line))


def one_line(text: object) -> str:
    """Text with its control characters and odd spaces escaped, and cut where it is very long."""
    escaped = visible(str(text)).replace("\n", "\\n")
    return escaped if len(escaped) <= MOST_CHARACTERS else escaped[: MOST_CHARACTERS - 1] + "…"
