"""Arrays and tapes on disk: the values stay, the memory does not."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from sortie.scenarios import scratch


@pytest.fixture
def on_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Everything goes to this folder at once."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(scratch, "IN_MEMORY_BYTES", 0)
    monkeypatch.setattr(scratch, "TAPE_IN_MEMORY_BYTES", 100)
    return tmp_path


def test_an_array_keeps_its_values_when_its_pages_leave_memory(on_disk: Path) -> None:
    values = np.random.default_rng(1).standard_normal((5000, 3, 2))
    array = scratch.empty(values.shape)
    array[:] = values
    scratch.release()
    np.testing.assert_array_equal(array, values)
    array.setflags(write=False)
    own = scratch.copied(array)
    own[7] = 0.0
    np.testing.assert_array_equal(array, values)
    np.testing.assert_array_equal(own[8:], values[8:])


def test_released_pages_are_not_resident(on_disk: Path) -> None:
    array = scratch.empty((1 << 22,))  # 32 MB

    def resident_bytes() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    array[:] = 1.0
    with_it = resident_bytes()
    scratch.release()
    assert with_it - resident_bytes() > 30e6
    assert array.sum() == 1 << 22


@pytest.mark.parametrize("pieces", [[], [b"ab"], [b"x" * 60, b"y" * 60, b"z"]])
def test_a_tape_gives_back_what_was_written(on_disk: Path, pieces: list[bytes]) -> None:
    tape = scratch.Tape()
    begins = [tape.append(piece) for piece in pieces]
    data = bytes(tape.finish())
    assert [data[at : at + len(piece)] for at, piece in zip(begins, pieces, strict=True)] == pieces
    assert len(data) == tape.size == sum(map(len, pieces))


def test_files_have_no_name(on_disk: Path) -> None:
    tape, array = scratch.Tape(), scratch.empty((100,))
    tape.append(bytes(1000))
    array[:] = 1.0
    assert list(on_disk.iterdir()) == []


def test_a_folder_that_refuses_is_named(on_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    monkeypatch.setattr(scratch, "folder", lambda: "/full")
    with pytest.raises(scratch.ScratchError) as error:
        scratch.empty((10,))
    assert str(error.value) == (
        "/full: no room for the sortie's temporary files: No space left on device; set TMPDIR to a folder with room"
    )


@pytest.mark.parametrize(("rows", "row_bytes"), [(1, 8), (2, 8), (3, 1 << 20), (5, 1 << 30), (10_000, 1000), (0, 8)])
def test_blocks_cover_all_rows_and_none_stands_alone(rows: int, row_bytes: int) -> None:
    blocks = scratch.blocks(rows, row_bytes)
    assert [k for b in blocks for k in range(b.start, b.stop)] == list(range(rows))
    assert rows < 2 or min(b.stop - b.start for b in blocks) >= 2
