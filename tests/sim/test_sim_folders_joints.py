"""Which folders and files are refused before the work, which are replaced, and what the digests of a user's files take in."""

from __future__ import annotations

import functools
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from sim_examples import example

from sortie.scenarios.replacing import replacing
from sortie.sim import identity
from sortie.sim.folders import RunError, ensure_files, ensure_folder, write_text
from sortie.sim.readme import with_section
from sortie.sim.results.html_page import GENERATOR

# --- folders -----------------------------------------------------------------------------------------


def test_an_empty_folder_may_be_used_and_one_with_other_things_may_not(tmp_path: Path) -> None:
    path, written = tmp_path / "run", {"a.json", "bag/b.mcap"}
    ensure_folder(path, "a.json", "run", written)
    (path / "bag").mkdir(parents=True)
    with pytest.raises(RunError, match=r"run: holds bag, which no run wrote; choose another folder or move it"):
        ensure_folder(path, "a.json", "run", written)
    (path / "a.json").touch()
    ensure_folder(path, "a.json", "run", written)
    (path / "notes.txt").touch()
    with pytest.raises(RunError, match=r"run: holds notes\.txt, which no run wrote; choose another folder or move it"):
        ensure_folder(path, "a.json", "run", written)


def test_a_place_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="is a file, a run needs a folder"):
        ensure_folder(tmp_path / "file", "a.json", "run", ())
    with pytest.raises(RunError, match=r"its folder cannot be made or written to: .*/file is a file"):
        ensure_files(None, tmp_path / "file" / "x" / "y.txt")
    with pytest.raises(RunError, match="is a folder, must be a file"):
        ensure_files(tmp_path / "new.txt", tmp_path)
    ensure_files(tmp_path / "new" / "new.txt", None)
    assert not (tmp_path / "new").exists()


def test_a_file_that_the_command_did_not_write_is_replaced_only_where_that_is_asked(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(GENERATOR + "of an earlier report")
    ensure_files(page, replace=False, mark=GENERATOR)
    for text, mark in (("a user's notes", GENERATOR), (GENERATOR, None), (" " * 1000 + GENERATOR, GENERATOR)):
        page.write_text(text)
        with pytest.raises(
            RunError, match=r"page.html: exists already; choose another file, or replace it with --repl"
        ):
            ensure_files(page, replace=False, mark=mark)
        ensure_files(page, replace=True, mark=mark)


def test_two_outputs_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="two outputs have this name, and one would replace the other"):
        ensure_files(tmp_path / "a.json", None, tmp_path / "." / "x" / ".." / "a.json")
    ensure_files(Path("/dev/null"), Path("/dev/null"))


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path: Path) -> None:
    there, link = tmp_path / "there", tmp_path / "link"
    there.mkdir()
    (there / "old").touch()
    link.symlink_to(there)
    with replacing(link) as partial:
        partial.mkdir()
        (partial / "new").touch()
    assert link.is_symlink()
    assert [p.name for p in there.iterdir()] == ["new"]


def test_a_block_that_fails_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "old").touch()
    with suppress(KeyError), replacing(path) as partial:
        partial.mkdir()
        (partial / "new").touch()
        raise KeyError
    assert [p.name for p in path.iterdir()] == ["old"]
    assert [p.name for p in tmp_path.iterdir()] == ["run"], "nothing is left beside it"


def test_a_section_is_put_between_its_markers_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("above\n<b>\nold\n<e>\nbelow\n")
    put = with_section(page, "<b>\nnew\n<e>", "<b>", "<e>")
    assert put == "above\n<b>\nnew\n<e>\nbelow\n"
    for wrong in (tmp_path / "none.md", page):
        with pytest.raises(RunError, match=f"{wrong.name}: "):
            with_section(wrong, "", "<x>", "<e>")
    write_text(tmp_path / "deep" / "page.md", "text")
    assert (tmp_path / "deep" / "page.md").read_text() == "text"


# --- names and digests -------------------------------------------------------------------------------


def decide(view: Any, *args: Any, **params: Any) -> list[Any]:
    return []


class Finds:
    """A detector or a policy; a subclass may do something else."""

    name = "finds"

    def __call__(self, view: Any) -> list[Any]:
        return []


class FindsMore(Finds): ...


def test_a_bound_function_is_named_with_its_arguments_the_same_in_every_process() -> None:
    here = __name__
    assert identity.name_of(functools.partial(decide, None, True, 0.5, rho=1, by="x", of=Finds())) == (
        f"{here}.decide(None, True, 0.5, rho=1, by='x', of=finds)"
    )
    assert identity.name_of(functools.partial(functools.partial(decide, a=1), b=decide)) == (
        f"{here}.decide(a=1, b={here}.decide)"
    )
    assert identity.name_of(Finds()) == "finds"
    assert identity.name_of(FindsMore()) == f"{here}.FindsMore"
    own = FindsMore()
    own.name = "own"
    assert identity.name_of(own) == "own"


def test_a_file_is_read_again_once_it_has_changed_be_it_as_long_as_before(tmp_path: Path) -> None:
    file = tmp_path / "a.bin"
    file.write_bytes(b"one")
    os.utime(file, ns=(1, 1))
    first = identity._digest(file)
    file.write_bytes(b"two")
    os.utime(file, ns=(2, 2))
    assert identity._digest(file) != first
    assert identity._digest(file) == identity.file_digest(file)[:16]


def test_the_digest_of_a_folder_takes_names_places_and_contents(tmp_path: Path) -> None:
    def digest(**files: str) -> str:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in files.items():
            place = folder / name.replace("__", "/")
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text)
        return identity._digest(folder)

    one = digest(a="1", b="2")
    assert digest(b="2", a="1") == one
    others = [
        digest(a="2", b="1"),
        digest(a="1", c="2"),
        digest(a="1", sub__b="2"),
        digest(a="1", b="3"),
        digest(a="1"),
    ]
    assert len({one, *others}) == 6


def test_the_files_of_all_that_is_passed_in_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mine, scenario = Path(__file__).name, example()
    for policy, detector in (
        (decide, None),
        (functools.partial(decide, a=1), None),
        (Finds(), None),
        (None, Finds()),
        ("worked", Finds()),
    ):
        assert mine in {Path(name).name for name in identity.own_files(scenario, policy, detector)}
    assert identity.own_files(scenario, None, None) == {}


def test_a_policy_that_is_asked_for_by_name_takes_the_place_of_the_scenario_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("own.py", "other.py"):
        Path(name).write_text("def decide(view):\n    return []\n")
    scenario = example("policy.name='own.py:decide'", "policy.params={}")
    assert list(identity.own_files(scenario)) == ["own.py"]
    assert list(identity.own_files(scenario, "own.py:decide")) == ["own.py"]
    assert list(identity.own_files(scenario, "other.py:decide")) == ["other.py"]
    assert list(identity.own_files(scenario, "worked")) == []
    Path("own.py").unlink()
    with pytest.raises(ValueError, match=r"own.py"):
        identity.own_files(scenario)
