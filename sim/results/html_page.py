"""The frame of a page of results: one self-contained HTML file, without a script, with nothing fetched from anywhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

from sortie.scenarios.report_text import visible

GENERATOR = '<meta name="generator" content="Sortie">'
"""In the head of each page that Sortie writes."""
STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.55 system-ui, sans-serif; color: #1c2128; background: #f4f5f7; margin: 0; }
main { max-width: 60rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
.of { color: #5a6472; margin: .2rem 0 1.2rem; } p { max-width: 46rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr)); gap: .7rem; margin: 1.4rem 0; }
.tile, figure, table, details { background: #fff; border-radius: 8px; box-shadow: 0 1px 2px #0002; }
.tile { padding: .8rem 1rem; } .tile b { display: block; font-size: 1.45rem; font-weight: 600; }
.tile span { color: #5a6472; font-size: .85rem; }
figure { margin: 0 0 1rem; padding: .8rem 1rem .4rem; } figcaption { font-weight: 600; margin-bottom: .3rem; }
svg { width: 100%; height: auto; }
table { border-collapse: collapse; width: 100%; overflow: hidden; } th { text-align: left; }
td, th { padding: .35rem .8rem; border-top: 1px solid #eceef1; vertical-align: top; }
td.t { text-align: right; font-variant-numeric: tabular-nums; width: 5rem; color: #5a6472; }
.event td { background: #fdf6df; } i { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin-right: .5em; }
.events { list-style: none; padding: 0; margin: .4rem 0 1rem; color: #6b5200; } .events b { display: inline-block; min-width: 1.6em; }
details { padding: .6rem 1rem; margin-top: .7rem; } pre { overflow-x: auto; font-size: .8rem; }
footer { color: #5a6472; font-size: .85rem; margin-top: 2rem; }
"""


class Html(str):
    """A text that is HTML; every other text is escaped where it enters a page."""

    __slots__ = ()


def html(template: str, *values: object, **named: object) -> Html:
    """HTML from a template of `str.format`; its values are escaped, unless they are HTML.

    Control characters and marks of direction are escaped as well, as `\\x1b`.

    Example:
        >>> html("<b>{}</b>{}", "a < b", Html("<br>"))
        '<b>a &lt; b</b><br>'
    """
    return Html(template.format(*map(_escaped, values), **{name: _escaped(value) for name, value in named.items()}))


def joined(parts: Iterable[Html]) -> Html:
    """Pieces of HTML one behind the other."""
    return Html("".join(parts))


def table(*rows: Html) -> Html:
    """A table of `table_row`s."""
    return html("<table>{}</table>", joined(rows))


def table_row(tag: str, *cells: object) -> Html:
    """A row of a table: `th` for a head, `td` for cells."""
    return html("<tr>{}</tr>", joined(html("<{0}>{1}</{0}>", tag, cell) for cell in cells))


def _escaped(value: object) -> str:
    return value if isinstance(value, Html) else escape(visible(str(value)))


def html_page(title: str, of: str, body: Html) -> str:
    """A whole page.

    Args:
        title: as text.
        of: what the page is of, as text; one line below the title.
        body: the rest; it ends with a line's end.
    """
    return html(_PAGE, generator=Html(GENERATOR), title=title, style=Html(STYLE), of=of, body=body)


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
{generator}
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body><main>
<h1>{title}</h1>
<p class="of">{of}</p>
{body}</main></body>
</html>
"""


def figures_html(figures: Mapping[str, str]) -> Html:
    """Figures as HTML, from their SVG texts by caption."""
    return joined(
        html("<figure><figcaption>{}</figcaption>{}</figure>", caption, Html(visible(svg)))
        for caption, svg in figures.items()
    )
