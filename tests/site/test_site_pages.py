"""The documentation site without building it: no page is left out, and the pages made from the code hold all of it."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pages_from_code
import pytest
from places import ROOT

import sortie
from sortie.sim.cli.app import COMMANDS

pytestmark = pytest.mark.pages

SITE = ROOT / "docs" / "site"


def listed(text: str, folder: Path) -> Iterator[Path]:
    """The pages that the toctrees of a page name, as paths without their endings."""
    for tree in re.findall(r"```\{toctree\}\n(.*?)```", text, re.S):
        for entry in tree.splitlines():
            name = re.sub(r".*<(.*)>", r"\1", entry.strip())
            if name and not name.startswith(":"):
                found = sorted(folder.glob(f"{name}.md")) if "*" in name else [folder / name]
                yield from (path.resolve().with_suffix("") for path in found)


def pages() -> set[Path]:
    """Every page that `conf.py` takes in."""
    patterns = runpy.run_path(str(SITE / "conf.py"))["include_patterns"]
    named = [path.relative_to(ROOT) for pattern in patterns for path in ROOT.glob(pattern.replace("**.", "**/*."))]
    return {(ROOT / name).with_suffix("") for name in named}


def test_every_page_is_in_the_navigation_once() -> None:
    sources = [(path.read_text("utf-8"), SITE) for path in SITE.glob("*.md")]
    sources.append(((SITE / "site_extension.py").read_text("utf-8"), ROOT))
    entries = [entry for text, folder in sources for entry in listed(text, folder)]
    assert len(entries) == len(set(entries)), "a page stands in the navigation twice"
    names = {str(page.relative_to(ROOT)) for page in pages()} - {"README"}  # the landing page holds the navigation
    assert {str(entry.relative_to(ROOT)) for entry in entries} == names


def test_the_patterns_find_the_pages_of_the_rooms() -> None:
    names = {str(page.relative_to(ROOT)) for page in pages()}
    assert {"README", "docs/guide/policy", "radio/README", "perception/network/fusion/README"} <= names
    assert "notebooks/fly_and_look" in names
    assert not any(fnmatch(name, "build/*") or fnmatch(name, ".*") for name in names)


def test_the_api_page_has_every_public_name() -> None:
    written = re.findall(r"^\.\. auto\w+:: sortie\.(\w+)$", pages_from_code.api_markdown(), re.M)
    assert sorted(written) == sorted(set(sortie.__all__) - {"__version__"})


def test_the_command_page_has_every_command_with_its_options() -> None:
    text = pages_from_code.commands_markdown()
    headings = re.findall(r"^## (.*)$", text, re.M)
    assert {f"sortie {name}" for name in COMMANDS} <= set(headings)
    assert "sortie campaign report" in headings
    fly = text[text.index("## sortie fly") : text.index("## sortie compare")]
    assert "sortie fly [OPTIONS] [SCENARIO]" in fly
    assert "| `--set KEY=VALUE` | Override a field: fleet.battery.initial\\_soc=0.5 |" in fly


def test_the_fields_page_has_a_heading_for_each_section() -> None:
    text = pages_from_code.fields_with_headings()
    assert {"## fleet.battery", "## radio", "## events[] of kind jam"} <= set(text.splitlines())
    assert "\n**" not in text


def test_the_library_page_has_every_file() -> None:
    shown = re.findall(r"literalinclude\} /(.*)$", pages_from_code.library_markdown(), re.M)
    assert sorted(ROOT / name for name in shown) == sorted((ROOT / "scenarios" / "library").glob("*.yaml"))


def test_every_directive_of_a_page_is_one_of_ours() -> None:
    used = {name for path in SITE.glob("*.md") for name in re.findall(r"```\{(sortie-\w+)\}", path.read_text("utf-8"))}
    assert used == set(pages_from_code.PAGES)


def test_the_gallery_shows_every_picture() -> None:
    shown = re.findall(r"!\[.+\]\((.*)\)", (SITE / "gallery.md").read_text("utf-8"))
    assert sorted((SITE / path).resolve() for path in shown) == sorted((ROOT / "docs").rglob("*.png"))
