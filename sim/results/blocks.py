"""A report as a list of blocks, and its two writers: Markdown, and one self-contained HTML page without a script.

Paragraphs and items may have `code`, **bold** and *emphasis* as in Markdown; all other texts are shown as they are.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sortie.scenarios import report_text
from sortie.scenarios.report_text import visible
from sortie.sim.user_errors import missing

GENERATOR = '<meta name="generator" content="Sortie">'
"""In the head of each page that Sortie writes."""
_MARKS = re.compile(r"`(?P<code>[^`]+)`|\*\*(?P<b>.+?)\*\*|(?<!\w)\*(?P<em>\w[^*]*)\*(?!\w)")


@dataclass(frozen=True, slots=True)
class Heading:
    text: str
    level: int = 2
    """1 is the report's title, the first block of a page."""


@dataclass(frozen=True, slots=True)
class Paragraph:
    text: str = ""
    """Without a text, one more empty line in Markdown."""


@dataclass(frozen=True, slots=True)
class Items:
    items: Sequence[str]
    lead: str = ""
    """Sentences right above the list."""


@dataclass(frozen=True, slots=True)
class Table:
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    colours: Sequence[str] = ()
    """On a page, a colour for each row's last cell; rows without one stand out from the others."""


@dataclass(frozen=True, slots=True)
class Tiles:
    tiles: Sequence[tuple[str, str, str]]
    """The few figures that a reader takes home: name, value, what it is of."""


@dataclass(frozen=True, slots=True)
class Figure:
    caption: str
    file: Path | None = None
    """A PNG beside the Markdown; a page holds it."""
    svg: str = ""

    @property
    def png(self) -> str:
        return b64encode(self.file.read_bytes()).decode() if self.file else ""


@dataclass(frozen=True, slots=True)
class Code:
    text: str
    language: str = ""
    folded: str = ""
    """What a page shows until the reader opens it."""


Block = Heading | Paragraph | Items | Table | Tiles | Figure | Code


def markdown(blocks: Iterable[Block]) -> str:
    """The blocks as Markdown, an empty line between two."""
    return "\n".join("".join(f"{line}\n" for line in _lines(block)) for block in blocks)


def _lines(block: Block) -> list[str]:
    match block:
        case Heading(text, level):
            return [f"{'#' * level} {text}"]
        case Paragraph(text):
            return [text] if text else []
        case Items(items, lead):
            return [*filter(None, [lead]), *(f"- {item}" for item in items)]
        case Table(head, rows):
            return report_text.table(head, rows)
        case Tiles(tiles):
            return [f"- {name}: {value}, {note}" for name, value, note in tiles]
        case Figure(caption, file):
            return [f"![{caption}]({file.name})"] if file else [f"*{caption}*"]
        case Code(text, language):
            return [f"```{language}", text, "```"]


def html_page(blocks: Sequence[Block]) -> str:
    """The blocks as an HTML page that fetches nothing; its title is the first block's text.

    Control characters and marks of direction are shown as `\\x1b`.

    Raises:
        RunError: jinja2 is missing (extra `report`).
    """
    try:
        from jinja2 import Environment
        from markupsafe import Markup, escape
    except ImportError as error:
        raise missing(error) from error

    def shown(value: object) -> str:
        text = visible(str(value))
        return type(value)(text) if isinstance(value, Markup) else text

    def marked(text: str) -> Markup:
        escaped = _MARKS.sub(lambda m: f"<{m.lastgroup}>{m[m.lastgroup or 0]}</{m.lastgroup}>", escape(text))
        return Markup(escaped)  # noqa: S704

    environment = Environment(autoescape=True, finalize=shown, trim_blocks=True, lstrip_blocks=True)
    environment.filters["marked"] = marked
    template = environment.from_string((Path(__file__).parent / "page.html").read_text("utf-8"))
    return template.render(generator=GENERATOR, blocks=[(type(block).__name__, block) for block in blocks])
