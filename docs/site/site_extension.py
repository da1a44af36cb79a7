"""What the site adds to the repository's own pages: its navigation, and reference pages that are made from the code.

Nothing that is made here is written into the repository: the directives make their text while Sphinx reads a page.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from docutils import nodes
from fields_page import BEGIN, END
from pages_from_code import PAGES
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import sortie

NAVIGATION = """
```{toctree}
:hidden:

docs/site/tutorials
docs/site/how_to
docs/site/reference
docs/site/explanation
docs/site/results
docs/site/laboratory
docs/site/gallery
docs/glossary
docs/site/project
```
"""
FOLDERS = {"notebooks": "docs/site/tutorials"}
"""Folders that pages link to, and the page of the site that lists what is in them."""


def _directive(markdown: Callable[[], str]) -> type[SphinxDirective]:
    """A directive that stands for the part of a page which `markdown` makes."""

    class Made(SphinxDirective):
        def run(self) -> list[nodes.Node]:
            return self.parse_text_to_nodes(markdown(), allow_section_headings=True)

    return Made


def on_source_read(app: Sphinx, docname: str, source: list[str]) -> None:
    """Give the landing page its navigation, and point to the page of the fields where the README repeats it."""
    if docname == app.config.root_doc:
        source[0] += NAVIGATION
    elif docname == "scenarios/README":
        before, rest = source[0].split(BEGIN)
        source[0] = f"{before}[A page of its own](../docs/site/fields.md) lists them.\n{rest.split(END)[1]}"


def on_docstring(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Leave out what Python itself writes, and keep the colons of attributes."""
    if lines and lines[0].startswith(("Alias for field number", "Call self as a function")):
        lines.clear()
    elif what in {"attribute", "property"}:
        lines[:0] = ["..", ""]  # a comment: napoleon takes a colon in an attribute's first line for the end of its type


def on_signature(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Write the names of type aliases as the code does, and leave a scenario's many fields to their own page."""
    if thing is sortie.Scenario or thing is sortie.Policy:
        return "", None
    return _plain(signature), _plain(returns)


def _plain(text: str | None) -> str | None:
    return text and re.sub(r"TypeAliasForwardRef\('([^']+)'\)", r"\1", text)


def on_doctree_read(app: Sphinx, doctree: nodes.document) -> None:
    """Lead a link to a folder to the page that lists the folder."""
    page = Path(app.env.doc2path(app.env.docname))
    folders = {(Path(app.srcdir) / name).resolve(): listed for name, listed in FOLDERS.items()}
    for link in doctree.findall(pending_xref):
        listed = folders.get((page.parent / link["reftarget"]).resolve()) if link["reftype"] == "myst" else None
        if listed:
            link.attributes.update(refdomain="doc", reftarget=listed, reftargetid=None)


def on_build_finished(app: Sphinx, exception: Exception | None) -> None:
    """Make the landing page what a server shows for the site's address."""
    if exception is None and app.builder.name == "html":
        shutil.copyfile(Path(app.outdir) / f"{app.config.root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register everything with Sphinx."""
    for name, markdown in PAGES.items():
        app.add_directive(name, _directive(markdown))
    app.connect("source-read", on_source_read)
    app.connect("autodoc-process-docstring", on_docstring, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", on_signature)
    app.connect("doctree-read", on_doctree_read)
    app.connect("build-finished", on_build_finished)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
