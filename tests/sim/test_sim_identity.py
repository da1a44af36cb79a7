"""Which code made a record: what changes the version, what leaves it alone, and which files of a user it names."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
from recorded import recorded
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
SHORT = ("duration_s=0.3", "fleet.drones=2", "mission.phases=[{at_s: 0, phase: search}]")


def version() -> str:
    return identity.code_version.__wrapped__()


def test_every_file_of_the_package_counts_but_for_those_that_no_run_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(name: str, text: str) -> None:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    monkeypatch.setattr(identity, "files", lambda name: tmp_path)
    for name in FILES:
        write(name, "before")
    seen = [version()]
    for name in (*FILES, "fleet/new.py", "a/folder/of/its/own.json"):
        write(name, "after")
        seen.append(version())
    (tmp_path / "fleet/agent.py").rename(tmp_path / "fleet/drone.py")
    seen.append(version())
    assert len(set(seen)) == len(seen) == 8
    for name in ("fleet/README.md", "fleet/__pycache__/agent.nbc", ".hidden", ".cache/x.py"):
        write(name, "anything")
    assert version() == seen[-1]


def test_the_version_of_a_library_counts_and_torch_s_for_flights_with_torch_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = version()
    monkeypatch.setattr(identity, "code_version", inspect.unwrap(identity.code_version))  # not what is cached
    codes = []
    for torch, numpy in (("2.4.0", "1"), ("2.13.0", "1"), (None, "1"), ("2.4.0", "2")):

        def installed(library: str, versions: Any = {"torch": torch, "numpy": numpy}) -> str:  # noqa: B006
            if versions.get(library, "") is None:
                raise PackageNotFoundError
            return str(versions.get(library, "1"))

        monkeypatch.setattr(code_digest, "version", installed)
        codes.append(identity.codes_here())
    assert before != codes[0][0] != codes[3][0]
    code = codes[0][0]
    assert codes[:3] == [(code, f"{code} torch 2.4.0"), (code, f"{code} torch 2.13.0"), (code, f"{code} torch none")]


TORCH_FLIES: list[tuple[object, bool]] = [
    ({"perception": {"detector": "surrogate"}}, False),
    ([{"perception": {"detector": "none"}}, {"perception": {"detector": "torch"}}], True),
    ({"perception": {"detector": "mine.py:Mine"}}, True),
    ({"fleet": {"makes": [{"detector": None}, {"detector": "torch"}]}, "perception": {"detector": "surrogate"}}, True),
    ({"vary": {"perception.detector": {"kind": "choice", "values": ["none", "surrogate"]}}}, False),
    ({"vary": {"perception.detector": {"kind": "choice", "values": ["torch", "surrogate"]}}}, True),
    ({"vary": {"perception.detector": {"kind": "column", "file": "a", "column": "b"}}}, False),
    ({"columns": {"perception.detector": ["surrogate", "torch"]}}, True),
    (example("perception.detector=torch").model_dump(mode="json"), True),
    (example("perception.detector=none").model_dump(mode="json"), False),
]


def test_a_detector_that_may_compute_with_torch_is_found() -> None:
    wrong = [
        sections
        for sections, flies in TORCH_FLIES
        if (identity.flight_code(sections) == identity.codes_here()[True]) is not flies
    ]
    assert wrong == []


def test_a_record_names_its_code_and_another_release_leaves_the_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    before = recorded("base")
    assert before.version == identity.code_version() == outcome(before)["version"]
    assert before.version.startswith(f"{identity.RELEASE}+")
    after = dataclasses.replace(before, version="9.8.7+another")
    assert after.fingerprint == before.fingerprint


# --- a user's files ------------------------------------------------------------------------------

MINE = "from helper import PEERS\n\n\ndef decide(view):\n    return []\n"


def test_the_user_s_own_code_is_named_with_a_digest_of_each_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "helper.py").write_text("PEERS = 2\n")
    flown = run_sortie(example(*SHORT, "policy={name: 'mine.py:decide'}"))
    before = flown.own_files
    assert set(before) == {"mine.py", "helper.py"}
    assert run_sortie(example(*SHORT), "mine.py:decide").own_files == before == outcome(flown)["own_files"]
    (tmp_path / "helper.py").write_text("PEERS = 3\n")
    after = run_sortie(example(*SHORT), "mine.py:decide").own_files
    assert (after["mine.py"], after["helper.py"] != before["helper.py"]) == (before["mine.py"], True)
    assert recorded("base").own_files == {}


def test_a_policy_that_is_asked_for_by_name_takes_the_place_of_the_scenario_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("own.py", "other.py"):
        Path(name).write_text("def decide(view):\n    return []\n")
    scenario = example("policy={name: 'own.py:decide'}")
    for policy, files in (
        (None, ["own.py"]),
        ("own.py:decide", ["own.py"]),
        ("other.py:decide", ["other.py"]),
        ("worked", []),
    ):
        assert list(identity.own_files(scenario, policy)) == files
    Path("own.py").unlink()
    with pytest.raises(ValueError, match=r"own.py"):
        identity.own_files(scenario)


def decide(view: Any, *args: Any, **params: Any) -> list[Directive]:
    return []


class Finds:
    """A detector or a policy that was passed in; a subclass may do something else."""

    name = "finds"

    def __call__(self, view: FleetView) -> list[Directive]:
        return []

    def detect(self, jobs: Any) -> list[Boxes]:
        return [Boxes.empty() for _ in jobs]

    def truth(self, t_s: float, ego: Any) -> Boxes:
        return Boxes.empty()

    def count_boxes(self, capture: Any, roi: Any) -> int:
        return 0


class FindsMore(Finds): ...


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
        found = {Path(name).name: digest for name, digest in identity.own_files(scenario, policy, detector).items()}
        assert found[mine] == identity.file_digest(Path(__file__))[:16]
    assert identity.own_files(scenario, None, None) == identity.own_files(scenario, resolve("worked")) == {}
    space: dict[str, Any] = {"__name__": "typed_in"}
    exec("def decide(view):\n    return []\n", space)  # noqa: S102 - as it is typed into an interpreter
    assert list(identity.own_files(scenario, space["decide"])) == ["typed_in.decide"]


def test_weights_their_calibration_and_recordings_are_named_with_their_digests(tmp_path: Path) -> None:
    weights, fitted = tmp_path / "mine.safetensors", tmp_path / "mine.surrogate.safetensors"
    weights.write_bytes(CALIBRATION.read_bytes())
    flown = example(*SHORT, "perception.detector=surrogate", f"perception.weights={weights}")
    assert run_sortie(flown).own_files == {str(weights): identity.file_digest(weights)[:16]}
    fitted.write_bytes(CALIBRATION.read_bytes())
    before = identity.own_files(flown)
    fitted.touch()
    assert identity.own_files(flown) == before
    fitted.write_bytes(b"another")
    assert identity.own_files(flown) != before
    seen = tmp_path / "seen.zarr"
    seen.mkdir()
    (seen / "a").write_text("1")
    asked = example("perception.detector=recorded", f"perception.recording={seen}")
    before = identity.own_files(asked)
    assert list(before) == [str(seen)]
    (seen / "a").rename(seen / "b")
    assert identity.own_files(asked) != before


def test_a_digest_takes_names_places_and_contents_and_a_changed_file_is_read_again(tmp_path: Path) -> None:
    def digest(**files: str) -> str:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in files.items():
            place = folder / name.replace("__", "/")
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text)
        return identity._digest(folder)

    one = digest(a="1", b="2")
    assert digest(b="2", a="1") == one
    others = [digest(a="2", b="1"), digest(a="1", c="2"), digest(a="1", sub__b="2"), digest(a="1", b="3")]
    assert len({one, digest(a="1"), *others}) == 6
    file = tmp_path / "a.bin"
    digests = []
    for text, changed_ns in ((b"one", 1), (b"two", 2)):  # as long as before
        file.write_bytes(text)
        os.utime(file, ns=(changed_ns, changed_ns))
        digests.append(identity._digest(file))
    assert digests[0] != digests[1] == identity.file_digest(file)[:16]


# --- names ---------------------------------------------------------------------------------------


class Odds:
    """An argument of which the repr holds its address."""


def test_what_is_passed_in_is_named_the_same_in_every_process() -> None:
    here = __name__
    own = FindsMore()
    own.name = "own"
    for thing, name in (
        (decide, f"{here}.decide"),
        (Finds(), "finds"),
        (FindsMore(), f"{here}.FindsMore"),
        (own, "own"),
        (Finds().__call__, f"{here}.Finds.__call__"),
        (resolve("silence"), "sortie.policies.catalogue.baselines.silence"),
        (functools.partial(decide, Odds()), f"{here}.decide({here}.Odds)"),
        (functools.partial(functools.partial(decide, a=1), b=decide), f"{here}.decide(a=1, b={here}.decide)"),
        (
            functools.partial(decide, None, True, 0.5, rho=1, by="x", of=Finds()),
            f"{here}.decide(None, True, 0.5, rho=1, by='x', of=finds)",
        ),
    ):
        assert identity.name_of(thing) == name


def test_the_record_names_the_policy_and_the_detector_that_flew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = example(*SHORT, "perception.detector=torch")
    for detector, name in ((Finds(), "finds"), (FindsMore(), f"{__name__}.FindsMore"), (None, "none")):
        made = lambda scene, config, seed, replication, detector=detector: detector  # noqa: E731
        record = run_sortie(scenario, functools.partial(decide, rho=0.1), detector_of=made)
        told = outcome(run_folder.load(run_folder.save(record, tmp_path / name)))
        assert (record.detector, told["ap50"]["detector"], told["ap50"]["fusion"]) == (name, name, None)
        assert told["policy"] == f"{__name__}.decide(rho=0.1)"
        assert list(told["policies"]["decisions"]) == [told["policy"]]
    in_its_place = DetectorKind("finds nothing", lambda scene, config, seed, replication: Finds())
    monkeypatch.setitem(DETECTORS, "torch", in_its_place)  # the guide has a reader try a detector under another's name
    assert outcome(run_sortie(scenario))["ap50"]["detector"] == "finds"
    accuracy = outcome(recorded("surrogate"))["ap50"]
    assert (accuracy["detector"], accuracy["fusion"]) == ("surrogate", "disconet")


def test_a_run_s_folder_says_what_flew_and_ends_in_its_fingerprint() -> None:
    record = run_sortie(example(*SHORT, "policy={name: best-2}"), seed=4, replication=2)
    assert str(run_folder.default_path(record)) == f"runs/example-s4-best-2-r2-{record.fingerprint[:8]}"
    own = dataclasses.replace(record, policy="p/a.py:f", replication=0)
    assert str(run_folder.default_path(own)) == f"runs/example-s4-p_a.py_f-{own.fingerprint[:8]}"
