"""Small parts that all rooms share: links, draws, sums, digests, pages, shipped files and temporary ones."""

from __future__ import annotations

import builtins
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sortie
from sortie.scenarios import code_digest, scratch
from sortie.scenarios.link_state import (
    PROBED_MBPS,
    SILENT_MBPS,
    WAITING_MBPS,
    LinkState,
    heard_share,
    is_tried,
    probed_mbps,
    state_of,
)
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.reading.files import named_files
from sortie.scenarios.report_text import replace_section
from sortie.scenarios.shipped import CALIBRATION, CODEBOOK, ERRORS, NETWORKS, beside, calibration_of, companions
from sortie.scenarios.streams import stream


def test_every_function_of_a_goodput_agrees_about_the_states_of_a_link() -> None:
    unknown, silent, probed, measured = LinkState.UNKNOWN, LinkState.SILENT, LinkState.PROBED, LinkState.MEASURED
    values = {0.0: unknown, math.nextafter(0.0, 1.0): silent, SILENT_MBPS: silent, PROBED_MBPS: probed}
    values |= {math.nextafter(SILENT_MBPS, 1.0): probed, math.nextafter(PROBED_MBPS, 1.0): measured}
    values |= {WAITING_MBPS: measured, 100.0: measured}
    assert {v: state_of(v) for v in values} == values
    assert [v for v in values if is_tried(v)] == [v for v, state in values.items() if state in (silent, measured)]
    assert [v for v in values if heard_share(v) is not None] == [v for v, state in values.items() if state == probed]
    np.testing.assert_array_equal(is_tried(np.array(list(values))), [bool(is_tried(v)) for v in values])
    assert [heard_share(probed_mbps(share)) for share in (0.1, 0.5, 1.0)] == pytest.approx([0.1, 0.5, 1.0])
    assert state_of(probed_mbps(0.0)) == silent


def test_streams_of_another_seed_replication_entity_or_purpose_share_nothing() -> None:
    entities: list[int | tuple[int, ...]] = [1, (0, 0), (), (0, 1), (1, 0), (0, 0, 0)]
    keys = [(1, 0, 0, "a"), (2, 0, 0, "a"), (1, 1, 0, "a"), (1, 0, 0, "b"), (0, 1, 0, "a"), (0, 0, 1, "a")]
    drawn = np.array([stream(*key).random(2000) for key in [*keys, *((1, 0, entity, "a") for entity in entities)]])
    assert len(np.unique(drawn)) == drawn.size
    correlation = np.corrcoef(drawn)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 0.1
    np.testing.assert_array_equal(stream(1, 0, 0, "a").random(5), drawn[0, :5])
    np.testing.assert_array_equal(stream(1, 0, (0,), "a").random(5), drawn[0, :5])


# --- sums -----------------------------------------------------------------------------------------


def test_a_plain_sum_rounds_after_each_addition_from_the_left() -> None:
    assert plain_sum([1e16, 1.0, -1e16, 0.5]) == 0.5
    assert plain_sum(iter([0.1] * 10)) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 != 1.0
    assert plain_sum([]) == 0


def test_the_record_of_a_flight_does_not_depend_on_how_the_built_in_sum_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which it does in one way up to Python 3.11, and in another from 3.12 on. Two flights, as the sum must differ."""
    settings = {"duration_s": 1, "perception.detector": "none"}
    plain = builtins.sum

    def exact(values: Iterable[Any], /, start: Any = 0) -> Any:
        listed = list(values)
        if not listed or any(type(x) is not float for x in listed):
            return plain(listed, start)
        return math.fsum([start, *listed])

    before = sortie.fly("track_target", settings).fingerprint
    monkeypatch.setattr(builtins, "sum", exact)
    assert sortie.fly("track_target", settings).fingerprint == before


# --- digests, pages and shipped files -------------------------------------------------------------


def test_a_digest_is_of_the_room_s_sources_and_of_the_libraries_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("perception/joining.py", "perception/deep/ap.py", "perception/net.safetensors", "radio/air.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    monkeypatch.setattr(code_digest, "files", lambda name: tmp_path / name.removeprefix("sortie."))
    versions = {"torch": "1"}
    monkeypatch.setattr(code_digest, "version", versions.__getitem__)

    def digest(*libraries: str) -> str:
        return code_digest.sources_digest.__wrapped__(("perception",), libraries)

    known = digest("torch")
    assert known != digest()
    for name in ("perception/net.safetensors", "radio/air.py", "perception/README.md"):
        (tmp_path / name).write_text("after")
        assert digest("torch") == known, "weights, other rooms and pages do not count"
    for name in ("perception/joining.py", "perception/deep/ap.py", "perception/deep/new.py"):
        (tmp_path / name).write_text("after")
        assert digest("torch") != known
        known = digest("torch")
    versions["torch"] = "2"
    assert digest("torch") != known


def test_a_section_replaces_what_was_between_the_markers() -> None:
    begin, end = "<!-- part:begin -->", "<!-- part:end -->"
    section, before = f"{begin}\nnew\n{end}", f"# Title\n\n{begin}\nold\n{end}\n\nmore\n"
    after = replace_section(before, section, begin, end)
    assert after == f"# Title\n\n{section}\n\nmore\n"
    assert replace_section(after, section, begin, end) == after
    for broken in ("no markers", f"{end}{begin}", before + before):
        with pytest.raises(ValueError, match="once each, in this order"):
            replace_section(broken, section, begin, end)


def test_what_belongs_to_a_network_lies_beside_its_weights(tmp_path: Path) -> None:
    """Its calibration, its codebook and its box errors; a scenario that names the weights names them too."""
    whole = {CALIBRATION, CODEBOOK, ERRORS, beside(Path(CALIBRATION), ERRORS).name}
    found = companions(Path("disconet.safetensors"))
    assert {path.name.removeprefix("disconet") for path in found} == whole
    assert all(path.parent == Path() and (NETWORKS / path).is_file() for path in found)
    weights, fitted = tmp_path / "mine.safetensors", tmp_path / "mine.surrogate.safetensors"
    weights.touch()
    assert calibration_of(weights) == weights, "it may be a calibration itself"
    sections = {"perception": {"weights": str(weights)}, "fleet": {"makes": [{"weights": str(weights)}]}}
    named = {str(weights)}
    for suffix in sorted(whole):
        assert set(named_files(sections)) == named
        beside(weights, suffix).touch()
        named |= {str(beside(weights, suffix))}
    assert set(named_files(sections)) == named
    assert calibration_of(weights) == calibration_of(fitted) == fitted


# --- temporary files ------------------------------------------------------------------------------


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
    assert list(on_disk.iterdir()) == [], "files have no name"


def test_released_pages_are_not_resident(on_disk: Path) -> None:
    def resident_bytes() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    array = scratch.empty((1 << 22,))  # 32 MB
    array[:] = 1.0
    with_it = resident_bytes()
    scratch.release()
    assert with_it - resident_bytes() > 30e6
    assert array.sum() == 1 << 22


def test_a_tape_gives_back_what_was_written_in_memory_and_on_disk(on_disk: Path) -> None:
    for pieces in ([], [b"ab"], [b"x" * 60, b"y" * 60, b"z"], [b"a" * 99, b"bc", b"d" * 200, b""]):
        tape = scratch.Tape()
        begins = [tape.append(piece) for piece in pieces]
        data = bytes(tape.finish())
        assert [data[at : at + len(piece)] for at, piece in zip(begins, pieces, strict=True)] == pieces
        assert len(data) == tape.size == sum(map(len, pieces))
    assert list(on_disk.iterdir()) == [], "files have no name"


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


def test_blocks_cover_all_rows_and_none_stands_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for rows, row_bytes in ((1, 8), (2, 8), (3, 1 << 20), (5, 1 << 30), (7, 1 << 30), (10_000, 1000), (0, 8)):
        found = scratch.blocks(rows, row_bytes)
        assert [k for b in found for k in range(b.start, b.stop)] == list(range(rows))
        assert all(b.stop - b.start >= min(2, rows) for b in found)
