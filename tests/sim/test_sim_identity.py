"""Which code made a record: what changes the version, what leaves it alone, and what the fingerprint takes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from sim_examples import example

from sortie.policies.contract import Directive, FleetView
from sortie.policies.registry import resolve
from sortie.sim import identity
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

FILES = ("__init__.py", "fleet/agent.py", "perception/weights/net.safetensors", "sim/core.cpython-311.so")


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    monkeypatch.setattr(identity, "files", lambda name: tmp_path)
    return tmp_path


def version() -> str:
    return identity.code_version.__wrapped__()


@pytest.mark.parametrize("name", [*FILES, "fleet/new.py", "a/folder/of/its/own.json"])
def test_every_file_of_the_package_counts(package: Path, name: str) -> None:
    before = version()
    (package / name).parent.mkdir(parents=True, exist_ok=True)
    (package / name).write_text("after")
    assert version() != before


def test_a_moved_file_counts(package: Path) -> None:
    before = version()
    (package / "fleet/agent.py").rename(package / "fleet/drone.py")
    assert version() != before


@pytest.mark.parametrize("name", ["fleet/README.md", "fleet/__pycache__/agent.nbc", ".hidden", ".cache/x.py"])
def test_what_no_run_reads_does_not_count(package: Path, name: str) -> None:
    before = version()
    (package / name).parent.mkdir(parents=True, exist_ok=True)
    (package / name).write_text("anything")
    assert version() == before


def test_a_librarys_version_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    before = version()
    monkeypatch.setattr(identity, "version", lambda library: "0" if library == "numpy" else identity.RELEASE)
    assert version() != before


def test_the_record_and_the_outcome_name_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    record = run_sortie(example("duration_s=1", "perception.detector=none"))
    assert record.version == identity.code_version() == outcome(record)["version"]
    assert record.version.startswith(f"{identity.RELEASE}+")


MINE = "from helper import PEERS\n\n\ndef decide(view):\n    return []\n"


def test_the_users_own_code_is_named_with_a_digest_of_each_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "helper.py").write_text("PEERS = 2\n")
    scenario = example("duration_s=1", "perception.detector=none")
    by_name = run_sortie(example("duration_s=1", "policy.name='mine.py:decide'", "policy.params={}")).user_code
    assert set(by_name) == {"mine.py", "helper.py"}
    assert (
        run_sortie(scenario, "mine.py:decide").user_code
        == by_name
        == outcome(run_sortie(scenario, "mine.py:decide"))["user_code"]
    )
    (tmp_path / "helper.py").write_text("PEERS = 3\n")
    after = run_sortie(scenario, "mine.py:decide").user_code
    assert (after["mine.py"], after["helper.py"] != by_name["helper.py"]) == (by_name["mine.py"], True)
    assert run_sortie(scenario).user_code == {}


def quiet(view: FleetView) -> list[Directive]:
    return []


def test_a_callables_file_counts_and_one_without_a_file_by_its_source() -> None:
    scenario = example("duration_s=1", "perception.detector=none")
    (name,) = (n for n in identity.user_code(scenario, quiet) if n.endswith("test_sim_identity.py"))
    assert identity.user_code(scenario, quiet)[name] == identity.file_digest(Path(__file__))[:16]
    space: dict[str, Any] = {"__name__": "typed_in"}
    exec("def decide(view):\n    return []\n", space)  # noqa: S102 - as it is typed into an interpreter
    assert list(identity.user_code(scenario, space["decide"])) == ["decide"]
    assert identity.user_code(scenario, resolve("worked")) == {}


def test_a_change_of_code_that_changes_no_value_leaves_the_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = example("duration_s=1", "perception.detector=none")
    before = run_sortie(scenario)
    monkeypatch.setattr("sortie.sim.engine.sortie.code_version", lambda: f"{identity.RELEASE}+another")
    after = run_sortie(scenario)
    assert after.version != before.version
    assert after.fingerprint == before.fingerprint
