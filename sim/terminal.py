"""The terminal as Sortie writes to it: brackets are brackets, and control characters are escaped, whoever wrote them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from sortie.scenarios.report_text import visible


class Terminal(Console):
    """A console that prints text as it is. Styles come from `rich.text.Text`, never from markup in a text."""

    def __init__(self, **options: Any) -> None:
        """Args: `options` as of `rich.console.Console`."""
        super().__init__(markup=False, emoji=False, **options)  # `mine.py:link:` is a file's name

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """What is printed, piece by piece; everything passes here."""
        return harmless(super().render(renderable, options))


def harmless(segments: Iterable[Segment]) -> Iterator[Segment]:
    """Pieces of output with control characters of their texts escaped; what moves the cursor of a bar stays."""
    for text, style, control in segments:
        yield Segment(text if control else visible(text), style, control)
