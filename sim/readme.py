"""A section of a Markdown file that a command writes, between two markers."""

from __future__ import annotations

from pathlib import Path

from sortie.scenarios.report_text import replace_section
from sortie.sim.folders import RunError


def with_section(path: Path, section: str, begin: str, end: str) -> str:
    """A Markdown file's text with another section between its markers, which the new one holds too.

    Raises:
        RunError: no such file, or one without the markers.
    """
    try:
        return replace_section(path.read_text("utf-8"), section, begin, end)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
