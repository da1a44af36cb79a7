"""Folders and files that several processes write at once, and processes that are killed while they write."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from sim_examples import BASE, example

from sortie.fleet.logs.mavlink import write_tlog
from sortie.perception.files import replacing as replacing_file
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import ensure_files, replacing, write_durably
from sortie.sim.results import run_folder

FLY = "from sortie.sim.cli.app import main; main()"
KILLED = """
import os, signal, sys
from pathlib import Path
from sortie.sim.folders import replacing, writing_durably
place = Path(sys.argv[2])
with (replacing if sys.argv[1] == "folder" else writing_durably)(place) as partial:
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("out", [(), ("--out", "runs/one")])
def test_flights_at_once_are_all_kept(out: tuple[str, ...], tmp_path: Path) -> None:
    """Different ones in different folders, equal ones in one; nothing else is left."""
    scenario = tmp_path / "example.yaml"
    scenario.write_text(BASE)
    fly = [sys.executable, "-c", FLY, "fly", str(scenario), "--set", "duration_s=0.5", "--no-recording", *out]
    flights = [
        subprocess.Popen([*fly, "--seed", str(seed)], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for seed in (1, 1, 2, 3)
    ]
    for flight in flights:
        _, error = flight.communicate()
        assert flight.returncode == 0 or (out and b"holds another run: seed is" in error)
    kept = sorted((tmp_path / "runs").iterdir())
    seeds = [run_folder.load(folder).seed for folder in kept]
    assert len(seeds) == len(set(seeds))
    assert out or sorted(seeds) == [1, 2, 3]


def test_of_many_writers_each_writes_whole(tmp_path: Path) -> None:
    """The same record saved by many threads at once: each succeeds, and one whole run is there."""
    record, path = run_sortie(example("duration_s=0.1")), tmp_path / "run"
    failed: list[Exception] = []
    together = threading.Barrier(6)

    def save() -> None:
        together.wait()
        try:
            for _ in range(10):
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
    refusal = r"run: holds a run of example under worked, seed 1; choose another folder, or replace it with --replace"
    with pytest.raises(run_folder.OtherRunError, match=refusal):
        run_folder.save(other, path, also=lambda _: run_folder.save(one, path) and None)
    assert run_folder.load(path).fingerprint == one.fingerprint
    run_folder.save(other, path, replace=True)
    assert run_folder.load(path).fingerprint == other.fingerprint
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_a_killed_writer_left_is_gone_with_the_next_one(kind: str, tmp_path: Path) -> None:
    place = tmp_path / "made"
    killed = subprocess.run([sys.executable, "-c", KILLED, kind, str(place)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1, "what it had begun"
    if kind == "folder":
        with replacing(place) as partial:
            (partial / "a").write_text("b")
    else:
        write_durably(place, b"b")
    assert list(tmp_path.iterdir()) == [place]


def test_what_another_writer_is_at_is_left_alone(tmp_path: Path) -> None:
    place = tmp_path / "made"
    with replacing(place) as one:
        (one / "a").write_text("1")
        with replacing(place) as other:
            (other / "a").write_text("2")
        assert (place / "a").read_text() == "2"
    assert (place / "a").read_text() == "1"
    assert list(tmp_path.iterdir()) == [place]


def part_then_rename(path: Path, data: bytes) -> None:
    with replacing_file(path) as part:
        part.write_bytes(data)


WRITERS = {
    "durably": write_durably,
    "by the perception room": part_then_rename,
    "as a telemetry log": lambda path, data: write_tlog(path, [(0, data)]),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_link_stays_and_the_file_that_it_leads_to_is_written(kind: str, tmp_path: Path) -> None:
    real, link = tmp_path / "elsewhere" / "real", tmp_path / "link"
    real.parent.mkdir()
    link.symlink_to(real)
    for data in (b"new", b"newer"):  # a link to nothing, and to a file
        WRITERS[kind](link, data)
        assert link.is_symlink()
        assert real.read_bytes().endswith(data)
    assert list(real.parent.iterdir()) == [real]


@pytest.mark.parametrize("kind", WRITERS)
def test_a_pipe_or_a_device_is_not_replaced_by_a_file(kind: str, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    ensure_files(pipe)
    end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        if kind == "as a telemetry log":  # written at once or not at all
            with pytest.raises(OSError, match="is not a regular file"):
                WRITERS[kind](pipe, b"new")
        else:
            WRITERS[kind](pipe, b"new")
            assert os.read(end, 10) == b"new"
    finally:
        os.close(end)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]
