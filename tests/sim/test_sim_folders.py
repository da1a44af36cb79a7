"""Folders and files: which are refused before the work, and several processes that write them at once or are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest
from recorded import recorded
from sim_examples import BASE, example

from sortie.scenarios.replacing import replacing
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError, ensure_files, ensure_folder, write_text
from sortie.sim.readme import with_section
from sortie.sim.results import run_folder
from sortie.sim.results.blocks import GENERATOR

FLY = "from sortie.sim.cli.app import main; main()"
KILLED = """
import os, signal, sys
from pathlib import Path
from sortie.scenarios.replacing import replacing
with replacing(Path(sys.argv[2])) as partial:
    if sys.argv[1] == "folder":
        partial.mkdir()
        partial = partial / "file"
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def refuses(words: str) -> pytest.RaisesExc[RunError]:
    return pytest.raises(RunError, match=words)


# --- what is refused before the work -------------------------------------------------------------


def test_an_empty_folder_may_be_used_and_one_with_other_things_may_not(tmp_path: Path) -> None:
    path, written = tmp_path / "run", {"a.json", "bag/b.mcap"}
    ensure_folder(path, "a.json", "run", written)
    (path / "bag").mkdir(parents=True)
    with refuses(r"run: holds bag, which no run wrote; choose another folder or move it"):
        ensure_folder(path, "a.json", "run", written)
    (path / "a.json").touch()
    ensure_folder(path, "a.json", "run", written)
    (path / "notes.txt").touch()
    with refuses(r"run: holds notes\.txt, which no run wrote; choose another folder or move it"):
        ensure_folder(path, "a.json", "run", written)


def test_a_place_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with refuses("is a file, a run needs a folder"):
        ensure_folder(tmp_path / "file", "a.json", "run", ())
    with refuses(r"its folder cannot be made or written to: .*/file is a file"):
        ensure_files(None, tmp_path / "file" / "x" / "y.txt")
    with refuses("is a folder, must be a file"):
        ensure_files(tmp_path / "new.txt", tmp_path)
    with refuses("two outputs have this name, and one would replace the other"):
        ensure_files(tmp_path / "a.json", None, tmp_path / "." / "x" / ".." / "a.json")
    ensure_files(Path("/dev/null"), Path("/dev/null"))
    ensure_files(tmp_path / "new" / "new.txt", None)
    assert not (tmp_path / "new").exists()


def test_a_file_that_the_command_did_not_write_is_replaced_only_where_that_is_asked(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(GENERATOR + "of an earlier report")
    ensure_files(page, replace=False, mark=GENERATOR)
    for text, mark in (("a user's notes", GENERATOR), (GENERATOR, None), (" " * 1000 + GENERATOR, GENERATOR)):
        page.write_text(text)
        with refuses(r"page.html: exists already; choose another file, or replace it with --replace"):
            ensure_files(page, replace=False, mark=mark)
        ensure_files(page, replace=True, mark=mark)


# --- writing -------------------------------------------------------------------------------------


def test_flights_at_once_are_all_kept(tmp_path: Path) -> None:
    """By processes: different ones in different folders, equal ones in one; nothing else is left."""
    scenario = tmp_path / "example.yaml"
    scenario.write_text(BASE)
    fly = [sys.executable, "-c", FLY, "fly", str(scenario), "--set", "duration_s=0.5", "--no-recording"]
    flights = [subprocess.Popen([*fly, "--seed", str(seed)], cwd=tmp_path) for seed in (1, 1, 2)]
    assert [flight.wait() for flight in flights] == [0, 0, 0]
    kept = sorted((tmp_path / "runs").iterdir())
    assert sorted(run_folder.load(folder).seed for folder in kept) == [1, 2]


def test_of_many_writers_each_writes_whole(tmp_path: Path) -> None:
    """The same record saved by many threads at once: each succeeds, and one whole run is there."""
    record, path = recorded("base"), tmp_path / "run"
    failed: list[Exception] = []
    together = threading.Barrier(6)

    def save() -> None:
        together.wait()
        try:
            for _ in range(3):
                assert run_folder.save(record, path) == path
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=save) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert list(tmp_path.iterdir()) == [path]
    assert run_folder.load(path).fingerprint == record.fingerprint


def test_a_run_that_came_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    one, other = (run_sortie(example("duration_s=0.1"), seed=seed) for seed in (1, 2))
    path = tmp_path / "run"
    with refuses("run: cannot be written: Directory not empty"):
        run_folder.save(other, path, also=lambda _: run_folder.save(one, path) and None)
    assert run_folder.load(path).fingerprint == one.fingerprint
    with pytest.raises(run_folder.OtherRunError, match="run: holds another run; choose another folder, or replace it"):
        run_folder.save(other, path)
    run_folder.save(other, path, replace=True)
    assert run_folder.load(path).fingerprint == other.fingerprint
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_a_killed_writer_leaves_nothing_at_the_place_and_is_tidied_up_a_day_later(kind: str, tmp_path: Path) -> None:
    place = tmp_path / "made"
    killed = subprocess.run([sys.executable, "-c", KILLED, kind, str(place)], check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".")
    write_text(tmp_path / "one", "")
    assert left.exists(), "another process may be writing it"
    os.utime(left, (0, 0))
    write_text(tmp_path / "two", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one", "two"]


def test_a_block_that_fails_or_another_writer_leaves_what_is_there_alone(tmp_path: Path) -> None:
    place = tmp_path / "made"
    with replacing(place) as one:
        one.mkdir()
        (one / "a").write_text("1")
        with replacing(place) as other:
            other.mkdir()
            (other / "a").write_text("2")
        assert (place / "a").read_text() == "2"
    assert (place / "a").read_text() == "1"
    with suppress(KeyError), replacing(place) as partial:
        partial.mkdir()
        (partial / "b").touch()
        raise KeyError
    assert [p.name for p in place.iterdir()] == ["a"]
    assert list(tmp_path.iterdir()) == [place], "nothing is left beside it"


def test_a_link_stays_and_what_it_leads_to_is_written(tmp_path: Path) -> None:
    real, link = tmp_path / "elsewhere" / "real", tmp_path / "link"
    real.parent.mkdir()
    link.symlink_to(real)
    for text in ("new", "newer"):  # a link to nothing, and to a file
        write_text(link, text)
        assert link.is_symlink()
        assert real.read_text() == text
    assert list(real.parent.iterdir()) == [real]
    folder, to_folder = tmp_path / "folder", tmp_path / "link to a folder"
    folder.mkdir()
    (folder / "old").touch()
    to_folder.symlink_to(folder)
    with replacing(to_folder) as partial:
        partial.mkdir()
        (partial / "new").touch()
    assert to_folder.is_symlink()
    assert [p.name for p in folder.iterdir()] == ["new"]


def test_a_pipe_or_a_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    ensure_files(pipe)
    end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_text(pipe, "new")
        assert os.read(end, 10) == b"new"
    finally:
        os.close(end)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_a_file_does_not_take_the_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "notes" / "mine").mkdir(parents=True)
    with refuses("notes: cannot be written: Is a directory"):
        write_text(tmp_path / "notes", "text")
    assert [p.name for p in tmp_path.rglob("*")] == ["notes", "mine"]


def test_a_section_is_put_between_its_markers_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("above\n<b>\nold\n<e>\nbelow\n")
    put = with_section(page, "<b>\nnew\n<e>", "<b>", "<e>")
    assert put == "above\n<b>\nnew\n<e>\nbelow\n"
    for wrong in (tmp_path / "none.md", page):
        with refuses(f"{wrong.name}: "):
            with_section(wrong, "", "<x>", "<e>")
    write_text(tmp_path / "deep" / "page.md", "text")
    assert (tmp_path / "deep" / "page.md").read_text() == "text"
