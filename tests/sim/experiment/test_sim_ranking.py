"""The suite that policies are ranked on, their flights, and whole rankings of a small suite."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

import sortie
from sortie.policies.registry import POLICIES
from sortie.scenarios.reading.load import load_conditions
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.cli import app
from sortie.sim.experiment import rank
from sortie.sim.experiment.conditions import scenario_of
from sortie.sim.experiment.flight import Flight, Task, fly_in_worker
from sortie.sim.experiment.rank import fly
from sortie.sim.experiment.stored import made_now, read_results, save_results
from sortie.sim.experiment.verdict import Verified
from sortie.sim.folders import RunError

pytestmark = pytest.mark.slow

SMALL = """
base: track_target
set: [perception.detector=surrogate, duration_s=1, fleet.drones=3, "mission.phases=[{at_s: 0, phase: search}]"]
seeds: []
conditions:
  - {name: poor, budget: 0.02, set: [seed=1]}
  - {name: rich, budget: 0.25, set: [seed=2, perception.scene.seed=8]}
"""
MINE = """
import sortie
def boxes(view, *, sent_budget=0.5):
    assert sent_budget in (0.02, 0.25), sent_budget
    boxes = sortie.Representation.DETECTIONS
    return [sortie.Directive(view.ego, p, boxes, 0.0, None, 5.0, reason="boxes") for p in view.peers]
def fails(view, *, sent_budget=0.5):
    if sent_budget > 0.1:
        raise RuntimeError("boom")
    return boxes(view, sent_budget=0.02)
"""
FINE = Verified(16, (), "proved", "proved")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A folder with a small suite and a policy; flights fly in this process, and are counted."""
    flown: list[int] = []

    class Pool:
        def rows(self, tasks: Iterator[Task]) -> Iterator[list[tuple[Task, Flight]]]:
            for task in tasks:
                flown.append(task.number)
                yield [(task, fly_in_worker(task))]

    @contextmanager
    def processes(workers: int) -> Iterator[Pool]:
        yield Pool()

    monkeypatch.setattr(rank, "processes", processes)
    monkeypatch.setattr(rank, "verify", lambda policy: FINE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(SMALL)
    (tmp_path / "mine.py").write_text(MINE)
    return flown


def small() -> ConditionSet:
    return rank.load_suite("small.yaml")


# --- the suite -----------------------------------------------------------------------------------


def test_the_suite_flies_under_every_policy_within_the_budget() -> None:
    suite = rank.load_suite("ranking_v1")
    for policy in POLICIES:
        for condition in suite.conditions[::10]:
            assert set(scenario_of(suite, condition, policy).policy.params.values()) <= {condition.budget}
    own = scenario_of(suite, suite.conditions[0], "best-2(received_budget=0.3)")
    assert own.policy.params == {"received_budget": 0.3}


def test_a_set_with_seeds_of_its_own_is_no_suite(here: object) -> None:
    Path("seeds.yaml").write_text(SMALL.replace("seeds: []", "seeds: [1, 2]"))
    with pytest.raises(RunError, match=r"seeds is \[1, 2\], must be \[\]"):
        rank.load_suite("seeds.yaml")
    for field, own in (("seed", "seed=2, "), ("perception.scene.seed", ", perception.scene.seed=8")):
        Path("seeds.yaml").write_text(SMALL.replace(own, ""))
        with pytest.raises(RunError, match=rf"{field} is \d in poor and in rich, must differ .* write `{field}=` into"):
            rank.load_suite("seeds.yaml")
    with pytest.raises(RunError, match="holds no conditions"):
        rank.load_suite("track_target")


# --- flights -------------------------------------------------------------------------------------


def test_an_interrupted_ranking_goes_on_where_it_was(here: list[int]) -> None:
    kept = Path("out.sqlite")
    first = fly(small(), {"boxes": None}, kept=kept)
    with closing(sqlite3.connect(kept)) as db, db:
        db.execute("DELETE FROM flights WHERE key = ?", (first["boxes"]["rich"].key,))
    assert len(here) == 2
    told: list[int] = []
    again = fly(small(), {"boxes": None}, kept=kept, progress=lambda done, of: told.append(done))
    assert (len(here), told) == (3, [1, 2])
    prints = [{c: f.fingerprint for c, f in found["boxes"].items()} for found in (first, again)]
    assert prints[0] == prints[1]
    assert again["boxes"]["poor"] == first["boxes"]["poor"]
    fly(small(), {"boxes": None}, kept=kept)
    assert len(here) == 3, "nothing is missing"


def test_a_flight_is_flown_again_after_a_change_of_the_policys_file_and_after_a_failure(here: list[int]) -> None:
    kept = Path("out.sqlite")
    found = fly(small(), dict.fromkeys(["mine.py:boxes", "mine.py:fails"]), kept=kept)
    assert not found["mine.py:boxes"]["rich"].error
    failed = found["mine.py:fails"]["rich"]
    assert "RuntimeError: boom" in failed.error
    assert set(failed.values.values()) == {None}
    fly(small(), dict.fromkeys(["mine.py:boxes", "mine.py:fails"]), kept=kept)
    assert len(here) == 4 + 1
    Path("mine.py").write_text(MINE + "# changed\n")
    fly(small(), {"mine.py:boxes": None}, kept=kept)
    assert len(here) == 5 + 2


def test_a_flight_is_flown_again_after_a_change_of_a_file_that_its_policy_opened(here: list[int]) -> None:
    """Which no scenario names: when the policy was loaded, or in flight."""
    kept = Path("out.sqlite")
    loads = "GAIN = float((Path(__file__).parent / 'gain.txt').read_text())\n"
    Path("gain.txt").write_text("0.5")
    Path("reads.py").write_text(f"from pathlib import Path\n{loads}{MINE}")
    Path("gain2.txt").write_text("0.5")
    in_flight = MINE.replace("    boxes = ", f"    open({str(Path('gain2.txt').resolve())!r}).close()\n    boxes = ")
    Path("opens.py").write_text(in_flight)
    for number in range(2):
        found = fly(small(), dict.fromkeys(["reads.py:boxes", "opens.py:boxes"]), kept=kept)
        assert not [f.error for of in found.values() for f in of.values() if f.error]
        assert len(here) == 4, f"try {number}"
    Path("gain.txt").write_text("0.6")
    fly(small(), {"reads.py:boxes": None}, kept=kept)
    assert len(here) == 6
    Path("gain2.txt").write_text("0.6")
    fly(small(), {"opens.py:boxes": None}, kept=kept)
    assert len(here) == 8


def test_a_file_is_another_one_from_another_folder_and_once_it_is_there(
    here: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy by its whole path reads a file by its name alone, which may be missing."""
    kept = tmp_path / "out.sqlite"
    reads = MINE.replace(
        "    boxes = ", "    try:\n        open('r.txt').close()\n    except OSError:\n        pass\n    boxes = "
    )
    (tmp_path / "reads.py").write_text(reads)
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "small.yaml").write_text(SMALL)
    for folder, text, flown in (
        ("a", None, 2),
        ("a", None, 2),
        ("a", "1", 4),
        ("b", "2", 6),
        ("b", "2", 6),
        ("a", "1", 8),
    ):
        monkeypatch.chdir(tmp_path / folder)
        if text is not None:
            Path("r.txt").write_text(text)
        fly(small(), {f"{tmp_path}/reads.py:boxes": None}, kept=kept)
        assert len(here) == flown, (folder, text)


def test_a_callable_gets_the_budget_and_flies_as_its_name_does(here: list[int]) -> None:
    budgets = set()

    def decide(view: sortie.FleetView, *, rho: float = 1.0) -> list[sortie.Directive]:
        budgets.add(rho)
        return list(POLICIES["boxes"](view))

    found = fly(small(), {"mine": decide, "boxes": None})
    assert budgets == {0.02, 0.25}
    scores = [[flight.values["ap50.full_scene"] for flight in each.values()] for each in found.values()]
    assert scores[0] == scores[1]


# --- stored results, and the whole ---------------------------------------------------------------


def test_the_stored_results_are_of_the_newest_suite_and_whole() -> None:
    found = read_results(rank.SUITE, rank.digest_of(rank.SUITE))
    assert found is not None
    assert set(found.flights) <= set(POLICIES)
    assert rank.REFERENCE in found.flights
    assert set(found.verified) == set(found.flights)
    suite = load_conditions(rank.SUITE)
    assert suite is not None
    assert all(set(of) == {c.name for c in suite.conditions} for of in found.flights.values())


def test_own_flights_are_all_that_a_ranking_costs(
    here: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = ["worked", "silence"]
    flown = fly(small(), dict.fromkeys(others))
    save_results(made_now("small", rank.digest_of("small.yaml"), flown, dict.fromkeys(others, FINE)), tmp_path)
    here.clear()
    monkeypatch.setattr(rank, "read_results", lambda suite, digest: read_results(suite, digest, tmp_path))
    ranking = sortie.rank("mine.py:boxes", suite="small.yaml", against=others, folder="out")
    assert len(here) == 2 + 1, "its own, and one to see whether the stored results are of this version"
    assert set(ranking.places) == {"mine.py:boxes", *others}
    assert not ranking.ranked.stale
    assert "flies otherwise" not in str(ranking.summary())
    again = sortie.rank("mine.py:boxes", suite="small.yaml", against=others, again=True, folder="again")
    assert again.places == ranking.places
    assert again.ranked.stored is None
    worked = flown["worked"]["poor"]
    flown["worked"]["poor"] = Flight("", "of another version", {**worked.values, "policy_eval_us.p50": 1e-3})
    save_results(made_now("small", rank.digest_of("small.yaml"), flown, dict.fromkeys(others, FINE)), tmp_path)
    ranking = sortie.rank("mine.py:boxes", suite="small.yaml", against=others, folder="out")
    assert ranking.ranked.stale
    assert "flies otherwise" in str(ranking.summary())
    slower = ranking.ranked.speed
    assert 0.1 < slower / (1e3 * (worked.values["policy_eval_us.p50"] or 0)) < 10, "as this machine's own flight"
    stored_us = ranking.ranked.row("silence").figures["policy_eval_us.p50"].mean
    assert ranking.ranked.decision_us("silence") == pytest.approx(slower * stored_us)
    alone = sortie.rank("mine.py:boxes", suite="small.yaml", against=[], folder="out")
    assert (alone.ranked.stored, alone.ranked.stale) == (None, False), "stored results of which nothing is shown"


def test_a_ranking_by_torch_flies_the_surrogate_too(here: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rank, "BY_TORCH", ("perception.sample_rate_hz=1",))  # cheaper than torch, and other flights
    more = [c.model_copy(update={"name": f"{c.name}_{k}"}) for k in range(4) for c in small().conditions]
    monkeypatch.setattr(rank, "_further", lambda suite, draws: more[: 2 * (3 if draws is None else draws)])
    ranking = sortie.rank(["boxes", POLICIES["silence"]], suite="small.yaml", against=[], by_torch=True, folder="out")
    assert len(here) == 2 + 2 + 2 * 3, "by torch; by the surrogate in the same conditions and three further draws"
    control = ranking.ranked.control
    assert control is not None
    assert [len(of) for of in control.flights.values()] == [8, 8]
    assert "8 further" not in str(ranking.summary())
    assert "6 further ones" in " ".join(str(ranking.summary()).split())
    alone = sortie.rank("boxes", suite="small.yaml", against=[], by_torch=True, further=0, folder="out")
    assert len(here) == 10, "nothing is missing"
    assert (alone.ranked.control, alone.ranked.width) == (None, 1.0)
    kept = json.loads((ranking.save("out") / "ranking.json").read_text())
    assert set(kept["by_surrogate"]["boxes"]) == {"poor", "rich", *(c.name for c in more[:6])}


def test_the_command_prints_keeps_and_says_by_its_exit_code_what_failed(here: list[int]) -> None:
    command = ["rank", "mine.py:boxes,mine.py:fails", "--suite", "small.yaml", "--against", "silence", "--out", "out"]
    done = CliRunner().invoke(app.app, command)
    assert done.exit_code == 1, done.output
    failed = "mine.py:fails failed in 1 of 2 conditions"
    for words in ("mine.py:boxes takes place", "failed in rich: PolicyError", failed):
        assert words in " ".join(done.output.split())
    kept = json.loads((Path("out") / "ranking.json").read_text())
    assert kept["digest"] == rank.digest_of("small.yaml")
    assert {row["policy"] for row in kept["policies"]} == {"mine.py:boxes", "mine.py:fails", "silence"}
    assert "boom" in kept["flights"]["mine.py:fails"]["rich"]["error"]
    assert (Path("out") / "ranking.png").read_bytes().startswith(b"\x89PNG")
    done = CliRunner().invoke(app.app, [*command[:1], "mine.py:boxes", *command[2:]])
    assert done.exit_code == 0, done.output


WRONG: list[tuple[dict[str, object], str]] = [
    ({"policies": "nobody"}, "nobody"),
    ({"policies": ["boxes", "boxes"]}, "each named once"),
    ({"policies": []}, "must be one or more"),
    ({"policies": 3}, "must be a policy or a list"),
    ({"policies": [3]}, "must be a name, file.py:function or a callable"),
    ({"policies": "boxes", "workers": 0}, "workers: 0, must be a whole number from 1 on"),
    ({"policies": "boxes", "against": "worked"}, "must be a list of names"),
    ({"policies": "best-2(rho=0.1)"}, "rho"),
    (
        {"policies": "boxes", "against": [], "by_torch": True, "further": 2},
        "--further 2: --suite small.yaml has 0 further draws",
    ),
    (
        {"policies": "boxes", "by_torch": True, "further": -1},
        "further: -1, must be None or a whole number from 0 to 100",
    ),
    ({"policies": "boxes", "suite": "ranking_v1", "further": 1}, "--further 1: needs --by-torch"),
]


def test_a_wrong_argument_is_named_before_anything_flies(here: list[int]) -> None:
    wrong = {}
    for asked, words in WRONG:
        with pytest.raises(sortie.SortieError) as error:
            sortie.rank(**{"suite": "small.yaml", "folder": "out"} | asked)  # type: ignore[arg-type]
        if words not in str(error.value):
            wrong[words] = str(error.value)
    assert wrong == {}
    assert not here
