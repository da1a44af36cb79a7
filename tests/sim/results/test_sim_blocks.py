"""A report's blocks in Markdown and on a page: each in its own form, and no text that a page or a reader could take for markup."""

from __future__ import annotations

import builtins
from base64 import b64encode
from pathlib import Path
from typing import Any

import pytest

from sortie.sim.folders import RunError
from sortie.sim.results.blocks import (
    GENERATOR,
    Block,
    Code,
    Figure,
    Heading,
    Items,
    Paragraph,
    Table,
    Tiles,
    html_page,
    markdown,
)

HARM = "<b>\x1b & `x*"

BLOCKS = [
    ("heading", Heading(HARM), f"## {HARM}\n", r"<h2>&lt;b&gt;\x1b &amp; `x*</h2>"),
    ("title", Heading("a", 1), "# a\n", "<h1>a</h1>"),
    (
        "paragraph",
        Paragraph("`<i>` is **2 * 3**, *not now*, 2 * 3 * 4 or a*b*c"),
        "`<i>` is **2 * 3**, *not now*, 2 * 3 * 4 or a*b*c\n",
        "<p><code>&lt;i&gt;</code> is <b>2 * 3</b>, <em>not now</em>, 2 * 3 * 4 or a*b*c</p>",
    ),
    ("nothing", Paragraph(), "", ""),
    (
        "items",
        Items(["**a**: <", "b"], "Two:"),
        "Two:\n- **a**: <\n- b\n",
        "<p>Two:</p>\n<ul><li><b>a</b>: &lt;</li><li>b</li></ul>",
    ),
    ("lead alone", Items([], "None."), "None.\n", "<p>None.</p>"),
    (
        "table",
        Table(("", "<"), [("**a**", "1")]),
        "| | < |\n|---|---|\n| **a** | 1 |\n",
        '<div class="wide"><table>\n<tr><th></th><th>&lt;</th></tr>\n<tr><td>**a**</td><td>1</td></tr>\n</table></div>',
    ),
    (
        "coloured",
        Table((), [("1 s", "a"), ("2 s", "b")], ["#123", ""]),
        None,
        '<div class="wide"><table class="timed">\n<tr><td>1 s</td><td><i style="background:#123"></i>a</td></tr>\n'
        '<tr class="event"><td>2 s</td><td>b</td></tr>\n</table></div>',
    ),
    (
        "tiles",
        Tiles([("AP", "0.5", "of <2>")]),
        "- AP: 0.5, of <2>\n",
        '<div class="tiles"><div><span>AP</span><b>0.5</b><span>of &lt;2&gt;</span></div></div>',
    ),
    (
        "drawing",
        Figure("<c>", svg="<svg>\x1b</svg>"),
        None,
        "<figure><figcaption>&lt;c&gt;</figcaption>\n" r"<svg>\x1b</svg>" "\n</figure>",
    ),
    ("code", Code("a < b", "python"), "```python\na < b\n```\n", "<pre>a &lt; b</pre>"),
    ("folded", Code("a", folded="<more>"), None, "<details><summary>&lt;more&gt;</summary><pre>a</pre></details>"),
]


def body(blocks: list[Block]) -> str:
    return html_page([Heading("t", 1), *blocks]).partition("<h1>t</h1>\n")[2].partition("</main>")[0].rstrip("\n")


def test_each_block_has_its_form_in_markdown_and_on_a_page() -> None:
    wrong = []
    for name, block, text, page in BLOCKS:
        wrong += [(name, "Markdown", markdown([block]))] * (text is not None and markdown([block]) != text)
        wrong += [(name, "page", body([block]))] * (body([block]) != page)
    assert wrong == []
    assert markdown([Heading("a"), Paragraph("b"), Paragraph(), Paragraph("c")]) == "## a\n\nb\n\n\nc\n"
    page = html_page([Heading("<t>", 1)])
    assert "<title>&lt;t&gt;</title>" in page
    assert GENERATOR in page[:1000]


def test_a_picture_is_named_in_markdown_and_held_by_a_page(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG")
    figure = Figure("a <figure>", tmp_path / "a.png")
    assert markdown([figure]) == "![a <figure>](a.png)\n"
    data = b64encode(b"\x89PNG").decode()
    assert f'<img alt="a &lt;figure&gt;" src="data:image/png;base64,{data}">' in body([figure])


def test_without_jinja2_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "jinja2":
            raise ImportError(name, name=name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    assert markdown([Heading("a")]) == "## a\n", "Markdown needs no extra"
    with pytest.raises(RunError, match=r"^jinja2 is missing: pip install 'sortie-sim\[report\]'$"):
        html_page([Heading("a", 1)])
