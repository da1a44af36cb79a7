"""What pages name is there: their links, their files, and every command with its options."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from page_commands import commands_in, fault
from places import ROOT

from sortie.sim.cli.app import app

pytestmark = pytest.mark.pages

PAGES = [
    *sorted(page for page in ROOT.glob("[!.]*/**/*.md") if "runs" not in page.parts),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
]
ROOM_PAGES = [page for page in PAGES if page.name == "README.md" and page.parent.name not in ("docs", "guide")]
PROGRAMS_OF_OTHERS = {"mavlogdump.py"}
A_USER_S_FILES = {"my_policy.py", "policy.py", "file.py", "mine.py", "path/to/file.py", "fusion.py", "my_fusion.py"}


def shown(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_links_lead_somewhere() -> None:
    broken = [
        f"{shown(page)}: {target}"
        for page in PAGES
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text("utf-8"))
        if "://" not in target and not (page.parent / target).exists()
    ]
    assert broken == []


def test_files_that_pages_name_are_there() -> None:
    """From the page's folder, from the root, or, for a bare name, anywhere below the page's folder."""
    missing = []
    for page in ROOM_PAGES:
        for name in set(re.findall(r"`([\w/]+\.py)`", page.read_text("utf-8"))) - PROGRAMS_OF_OTHERS - A_USER_S_FILES:
            places = [page.parent / name, ROOT / name, *(page.parent.rglob(name) if "/" not in name else ())]
            if not any(place.is_file() for place in places):
                missing.append(f"{shown(page)}: {name}")
    assert missing == []


def test_every_command_told_is_one_with_these_options() -> None:
    told = [(shown(page), command) for page in PAGES for command in commands_in(page, "sortie")]
    assert len(told) > 100
    assert [(page, command) for page, command in told if fault(app, command) is not None] == []


def test_a_command_that_is_none_is_found() -> None:
    for words in ("soar", "fly track_target --speed 3", "recording break", "live --loss lots"):
        assert fault(app, f"sortie {words}") is not None, words


def test_pictures_have_words_for_those_who_do_not_see_them() -> None:
    assert [shown(page) for page in PAGES if "![](" in page.read_text("utf-8")] == []
