"""Paths that a command cannot use, and places where it runs: one line, before anything flies or is proved."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest
from cli_examples import command, refusal
from sim_examples import BASE, example

from sortie.scenarios.reading.nodes import ScenarioError
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.identity import own_files
from sortie.sim.results import run_folder
from sortie.sim.results.run_files import SCENARIO

SCHEMA = "sortie.schema.json"
LONG = "n" * 300


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "example.yaml").write_text(BASE)
    return tmp_path


@pytest.mark.parametrize("place", [".", "..", "/", "inside/.."])
def test_a_run_does_not_replace_the_working_folder(
    place: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "inside").mkdir()
    told = refusal(folder, ("fly", "example.yaml", "--out", place), capsys)
    assert f"error: {place}: is the working folder or holds it, a run would replace it" in told


def test_a_working_folder_that_was_deleted_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert command("fly", "track_target", "--set", "duration_s=1") == 2
    assert capsys.readouterr().err == "error: the working folder was deleted; change to another folder\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("fly", "example.yaml", "--out", LONG),
        ("fly", "example.yaml", "--policy", f"{LONG}.py:f"),
        ("fly", "example.yaml", "--set", f"radio.link={LONG}.py:f"),
        ("fly", "example.yaml", "--set", f"perception.weights={LONG}"),
        ("check", LONG),
        ("report", LONG),
        ("export", LONG, "--pcap"),
        ("replay", LONG),
        ("compare", "example.yaml", "--policies", "silence", "--out", LONG),
        ("verify", f"{LONG}.py:f"),
    ],
)
def test_a_name_that_is_too_long_is_one_line(
    arguments: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "nnnnnn" in refusal(folder, arguments, capsys)


def test_counterexamples_have_a_folder_before_anything_is_proved(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = refusal(folder, ("verify", "silence", "--out", "example.yaml"), capsys)
    assert "its folder cannot be made or written to" in told
    assert "example.yaml is a file" in told


@pytest.mark.parametrize("theirs", ["{}", "[]", "not JSON", '{"title": "Scenario", "properties": {}}'])
def test_a_schema_of_somebody_else_is_not_replaced(
    theirs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / SCHEMA).write_text(theirs)
    assert f"error: {SCHEMA}: is there already" in refusal(tmp_path, ("new", "mine"), capsys)
    assert (tmp_path / SCHEMA).read_text() == theirs


def test_a_schema_of_an_older_version_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert command("new", "mine") == 0
    newest = json.loads((tmp_path / SCHEMA).read_text("utf-8"))
    older = {**newest, "properties": {"fleet": newest["properties"]["fleet"]}}
    (tmp_path / SCHEMA).write_text(json.dumps(older))
    assert command("new", "another") == 0
    assert json.loads((tmp_path / SCHEMA).read_text("utf-8")) == newest


def test_a_run_is_kept_as_utf_8_whatever_the_locale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def in_latin(encoding: str | None, stacklevel: int = 2) -> str:
        return encoding or "latin-1"

    record = run_sortie(example("duration_s=0.1", "description=north → south"))
    monkeypatch.setattr(io, "text_encoding", in_latin)  # what pathlib asks for the locale's
    run_folder.save(record, tmp_path / "run")
    assert "→" in (tmp_path / "run" / SCENARIO).read_text("utf-8")
    assert run_folder.load(tmp_path / "run").fingerprint == record.fingerprint


def test_what_a_terminal_cannot_show_is_escaped(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (folder / "out.txt").open("w", encoding="latin-1") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert command("list", "policies") == 0
        assert (sys.stdout.encoding, sys.stdout.errors) == ("latin-1", "backslashreplace")


@pytest.mark.parametrize("field", ["perception.weights", "perception.codebook"])
def test_a_file_that_is_missing_is_named_with_its_field(field: str) -> None:
    with pytest.raises(ScenarioError, match=f"^{field}: nope.safetensors: no such file$"):
        own_files(example(f"{field}=nope.safetensors"))


def test_a_file_of_a_make_that_is_missing_is_named_with_its_field() -> None:
    makes = "fleet.makes=[{name: other, drones: [1], weights: nope.safetensors}]"
    with pytest.raises(ScenarioError, match=r"^fleet\.makes\.0\.weights: nope.safetensors: no such file$"):
        own_files(example("perception.detector=torch", makes))
