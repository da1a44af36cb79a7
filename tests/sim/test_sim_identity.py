"""Which code made a record: what changes the version, what leaves it alone, and what the fingerprint takes of it."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
from sim_examples import example

from sortie.perception.detectors import DETECTORS, DetectorKind
from sortie.perception.surrogate.model import SHIPPED as CALIBRATION
from sortie.perception.types import Boxes
from sortie.policies.contract import Directive, FleetView
from sortie.policies.registry import resolve
from sortie.scenarios import code_digest
from sortie.sim import identity
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import run_folder
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
    monkeypatch.setattr(code_digest, "version", lambda library: "0" if library == "numpy" else "1")
    assert version() != before


def with_torch(monkeypatch: pytest.MonkeyPatch, torch: str | None) -> tuple[str, str]:
    def installed(library: str) -> str:
        if library == "torch" and torch is None:
            raise PackageNotFoundError
        return str(torch) if library == "torch" else "1"

    monkeypatch.setattr(code_digest, "version", installed)
    monkeypatch.setattr(identity, "code_version", inspect.unwrap(identity.code_version))  # not what is cached
    return identity.codes_here()


def test_torchs_version_is_part_of_the_code_of_flights_with_torch_alone(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = with_torch(monkeypatch, "1")[0]
    for torch in ("2.4.0", "2.13.0", None):
        assert with_torch(monkeypatch, torch) == (code, f"{code} torch {torch or 'none'}")


TORCH_FLIES: list[tuple[object, bool]] = [
    ({"perception": {"detector": "surrogate"}}, False),
    ([{"perception": {"detector": "none"}}, {"perception": {"detector": "torch"}}], True),
    ({"perception": {"detector": "mine.py:Mine"}}, True),
    ({"fleet": {"makes": [{"detector": None}, {"detector": "torch"}]}, "perception": {"detector": "surrogate"}}, True),
    ({"vary": {"perception.detector": {"kind": "choice", "values": ["none", "surrogate"]}}}, False),
    ({"vary": {"perception.detector": {"kind": "choice", "values": ["torch", "surrogate"]}}}, True),
    ({"vary": {"perception.detector": {"kind": "column", "file": "a", "column": "b"}}}, False),
    ({"columns": {"perception.detector": ["surrogate", "torch"]}}, True),
]


@pytest.mark.parametrize(("sections", "flies"), TORCH_FLIES)
def test_a_detector_that_may_compute_with_torch_is_found(sections: object, flies: bool) -> None:
    assert (identity.flight_code(sections) == identity.codes_here()[True]) is flies


def test_a_scenarios_own_detector_is_found() -> None:
    assert identity.flight_code(example("perception.detector=torch").model_dump(mode="json")) != identity.code_version()
    assert identity.flight_code(example("perception.detector=none").model_dump(mode="json")) == identity.code_version()


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
    by_name = run_sortie(example("duration_s=1", "policy.name='mine.py:decide'", "policy.params={}")).own_files
    assert set(by_name) == {"mine.py", "helper.py"}
    assert (
        run_sortie(scenario, "mine.py:decide").own_files
        == by_name
        == outcome(run_sortie(scenario, "mine.py:decide"))["own_files"]
    )
    (tmp_path / "helper.py").write_text("PEERS = 3\n")
    after = run_sortie(scenario, "mine.py:decide").own_files
    assert (after["mine.py"], after["helper.py"] != by_name["helper.py"]) == (by_name["mine.py"], True)
    assert run_sortie(scenario).own_files == {}


def quiet(view: FleetView) -> list[Directive]:
    return []


def test_a_callables_file_counts_and_one_without_a_file_by_its_source() -> None:
    scenario = example("duration_s=1", "perception.detector=none")
    (name,) = (n for n in identity.own_files(scenario, quiet) if n.endswith("test_sim_identity.py"))
    assert identity.own_files(scenario, quiet)[name] == identity.file_digest(Path(__file__))[:16]
    space: dict[str, Any] = {"__name__": "typed_in"}
    exec("def decide(view):\n    return []\n", space)  # noqa: S102 - as it is typed into an interpreter
    assert list(identity.own_files(scenario, space["decide"])) == ["typed_in.decide"]
    assert identity.own_files(scenario, resolve("worked")) == {}


def test_a_release_that_changes_no_value_leaves_the_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = example("duration_s=1", "perception.detector=none")
    before = run_sortie(scenario)
    monkeypatch.setattr("sortie.sim.engine.sortie.code_version", lambda: "9.8.7+another")
    after = run_sortie(scenario)
    assert after.version != before.version
    assert after.fingerprint == before.fingerprint


class Blind:
    """A detector that was passed in: it finds nothing."""

    def detect(self, jobs: Any) -> list[Boxes]:
        return [Boxes.empty() for _ in jobs]

    def truth(self, t_s: float, ego: Any) -> Boxes:
        return Boxes.empty()

    def count_boxes(self, capture: Any, roi: Any) -> int:
        return 0


class Called(Blind):
    name = "my model 3"


class Derived(Called):
    pass


SHORT = ("duration_s=1", "perception.detector=torch")


@pytest.mark.parametrize(
    ("detector", "name"),
    [
        (Blind(), f"{__name__}.Blind"),
        (Called(), "my model 3"),
        (Derived(), f"{__name__}.Derived"),
        (None, "none"),
    ],
)
def test_the_record_names_the_detector_that_flew(detector: Any, name: str, tmp_path: Path) -> None:
    record = run_sortie(example(*SHORT), detector_of=lambda scene, config, seed, replication: detector)
    run_folder.save(record, tmp_path / "run")
    accuracy = outcome(run_folder.load(tmp_path / "run"))["ap50"]
    assert (record.detector, accuracy["detector"], accuracy["fusion"]) == (name, name, None)
    named = [Path(file).name for file in record.own_files]
    assert ("test_sim_identity.py" in named) == (detector is not None)


def test_the_table_of_detectors_does_not_name_what_stands_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The guide has a reader try a detector under the name of another one."""
    mine = DetectorKind("finds nothing", lambda scene, config, seed, replication: Called())
    monkeypatch.setitem(DETECTORS, "torch", mine)
    assert outcome(run_sortie(example(*SHORT)))["ap50"]["detector"] == "my model 3"


def test_the_scenarios_own_detector_has_its_name_and_fusion() -> None:
    accuracy = outcome(run_sortie(example("duration_s=1", "perception.detector=surrogate")))["ap50"]
    assert (accuracy["detector"], accuracy["fusion"]) == ("surrogate", "disconet")


def test_own_weights_are_named_with_their_digest(tmp_path: Path) -> None:
    weights = tmp_path / "mine.safetensors"
    weights.write_bytes(CALIBRATION.read_bytes())
    flown = example("duration_s=1", "perception.detector=surrogate", f"perception.weights={weights}")
    assert outcome(run_sortie(flown))["own_files"] == {str(weights): identity.file_digest(weights)[:16]}


def test_another_calibration_beside_the_same_weights_is_another_sortie(tmp_path: Path) -> None:
    weights, fitted = tmp_path / "mine.safetensors", tmp_path / "mine.surrogate.safetensors"
    weights.touch()
    fitted.write_bytes(CALIBRATION.read_bytes())
    flown = example("duration_s=1", "perception.detector=surrogate", f"perception.weights={weights}")
    before = identity.own_files(flown)
    fitted.touch()
    assert identity.own_files(flown) == before
    fitted.write_bytes(b"another")
    assert identity.own_files(flown) != before


def test_a_folder_is_named_with_one_digest_of_its_files(tmp_path: Path) -> None:
    recording = tmp_path / "seen.zarr"
    recording.mkdir()
    (recording / "a").write_text("1")
    asked = ("duration_s=1", "perception.detector=recorded", f"perception.recording={recording}")
    before = identity.own_files(example(*asked))
    assert list(before) == [str(recording)]
    (recording / "a").rename(recording / "b")
    assert identity.own_files(example(*asked)) != before


def test_the_files_of_a_policy_that_does_not_fly_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def decide(view):\n    return []\n")
    own = example("duration_s=1", f"policy.name='{tmp_path}/mine.py:decide'", "policy.params={}")
    assert identity.own_files(own, "silence") == {}


def typed(view: FleetView, rho: float = 1.0) -> list[Directive]:
    return []


class Policy:
    def __call__(self, view: FleetView) -> list[Directive]:
        return []


@pytest.mark.parametrize(
    ("policy", "name"),
    [
        (typed, f"{__name__}.typed"),
        (functools.partial(typed, rho=0.1), f"{__name__}.typed(rho=0.1)"),
        (Policy(), f"{__name__}.Policy"),
        (Policy().__call__, f"{__name__}.Policy.__call__"),
        (resolve("silence"), "sortie.policies.catalogue.baselines.silence"),
    ],
)
def test_a_policy_passed_as_a_callable_is_named_by_its_module(policy: Any, name: str) -> None:
    """`worked` of one's own is not the catalogue's."""
    record = run_sortie(example("duration_s=1"), policy)
    assert outcome(record)["policy"] == name
    assert list(outcome(record)["policies"]["decisions"]) == [name]


class _Odds:
    """An argument whose repr holds its address."""


def test_a_bound_object_is_named_by_its_class_and_not_by_its_address() -> None:
    one, other = (identity.name_of(functools.partial(resolve, _Odds())) for _ in range(2))
    assert one == other
    assert "0x" not in one


def test_a_run_s_folder_says_what_flew_and_ends_in_its_fingerprint() -> None:
    record = run_sortie(example("duration_s=0.1", "policy={name: best-2}"), seed=4, replication=2)
    assert str(run_folder.default_path(record)) == f"runs/example-s4-best-2-r2-{record.fingerprint[:8]}"
    own = dataclasses.replace(record, policy="p/a.py:f", replication=0)
    assert str(run_folder.default_path(own)) == f"runs/example-s4-p_a.py_f-{own.fingerprint[:8]}"
