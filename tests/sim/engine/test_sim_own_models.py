"""Models in a user's files fly in a sortie: they act, they are named in the record, and their errors are of one line.

Each flies by itself: short flights of three drones.
"""

from __future__ import annotations

import functools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from installed_package import installed_package
from sim_examples import example

from sortie.scenarios.errors import SortieError
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.report import page
from sortie.sim.results.run_folder import load, save

SOURCE = Path(__file__).parent / "own_models.py"
FEW = ("duration_s=1", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]")


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The file of models in a folder of its own, which is the working folder."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SOURCE, tmp_path / "mine.py")
    return "mine.py"


def fly(*overrides: str, seed: int = 1) -> dict[str, Any]:
    return outcome(run_sortie(example(*FEW, *overrides), seed=seed))


def test_power_of_one_s_own_is_what_the_ledger_books(models: str) -> None:
    own = fly(f"fleet.airframe.power_model={models}:constant")
    assert own["energy_j"]["rotor"] == pytest.approx(3 * 300.0 / example().fleet.battery.drivetrain_efficiency)
    half = fly(f"fleet.airframe={{power_model: '{models}:constant', power_params: {{power_w: 150}}}}")
    assert half["energy_j"]["rotor"] == pytest.approx(own["energy_j"]["rotor"] / 2)
    plain, make = fly(), fly(f"fleet.makes=[{{name: m, drones: [1], airframe: {{power_model: '{models}:constant'}}}}]")
    assert make["own_files"].keys() == {models}
    assert make["drones"]["0"]["energy_j"] == pytest.approx(plain["drones"]["0"]["energy_j"], rel=1e-3)
    assert make["drones"]["1"]["energy_j"] > 1.2 * plain["drones"]["1"]["energy_j"]


def test_a_detector_of_one_s_own_is_scored_and_named(models: str) -> None:
    own = fly(f"perception.detector={models}:Omniscient")
    assert own["ap50"]["full_scene"] == 1.0
    assert (own["ap50"]["detector"], own["ap50"]["fusion"]) == (f"{models}:Omniscient", None)
    assert own["own_files"].keys() == {models}
    blind = fly(f"perception={{detector: '{models}:Omniscient', detector_params: {{finds: false}}}}")
    assert blind["ap50"]["full_scene"] == 0.0


def test_the_same_seed_gives_the_same_record_and_an_edited_file_has_another_digest(models: str) -> None:
    link = f"radio.link={models}:Noisy"
    first, again, other = (fly(link, seed=seed) for seed in (1, 1, 2))
    assert first["fingerprint"] == again["fingerprint"] != other["fingerprint"]
    with Path(models).open("a") as file:
        file.write("\n# edited\n")
    assert fly(link)["own_files"] != first["own_files"]


# --- events --------------------------------------------------------------------------------------


def storm(params: str = "{}") -> str:
    return f"events=[{{kind: own, at_s: 0.8, until_s: 1.4, model: 'mine.py:Storm', params: {params}}}]"


@functools.cache
def snr_db(*overrides: str) -> dict[tuple[int, int, float], float]:
    """By sender, receiver and time."""
    record = run_sortie(example(*FEW, "duration_s=2", "policy.name=all-4", "policy.params={}", *overrides))
    rows = record.tables["transmissions"].to_pylist()
    return {(r["drone"], r["peer"], r["t_sent_s"]): r["snr_db"] for r in rows}


def lost_db(event: str, begin_s: float, end_s: float) -> float:
    """By how much the same links are weaker at the same moments than without the event, the median."""
    plain, changed = snr_db(), snr_db(event)
    both = [key for key in plain.keys() & changed.keys() if begin_s <= key[2] < end_s]
    return float(np.median([plain[key] - changed[key] for key in both]))


def test_an_event_of_one_s_own_acts_while_it_lasts_and_may_write_events(models: str) -> None:
    for begin_s, end_s, loss in ((0.0, 0.8, 0.0), (0.85, 1.38, 20.0), (1.5, 2.0, 0.0)):
        assert lost_db(storm(), begin_s, end_s) == pytest.approx(loss, abs=1e-6)
    jams = storm("{loss_db: 0, jams: true}")
    assert lost_db(jams, 0.85, 1.38) > 10.0
    assert lost_db(jams, 1.5, 2.0) == pytest.approx(0.0, abs=1e-6)
    texts = [event["text"] for event in fly(storm(), "duration_s=1.5")["events"]]
    assert texts == ["mine.py:Storm begins", "a storm", "6 frames from 0.8 s to 1.3 s", "mine.py:Storm ends"]
    plain, hit = fly(), fly(storm("{loss_db: 0, drains: 0.5, loses: 2}"))
    assert [drone["airborne"] for drone in hit["drones"].values()] == [True, True, False]
    assert hit["drones"]["1"]["soc"] < 0.6 * plain["drones"]["1"]["soc"]
    assert "hit by lightning" in [event["text"] for event in hit["events"]]


def test_a_metric_of_one_s_own_is_in_the_outcome_and_stays_without_its_file(models: str, tmp_path: Path) -> None:
    """And changes nothing else."""
    sent = f"model: '{models}:sent'"
    named = (
        f"metrics={{all: {{{sent}}}, half: {{{sent}, params: {{times: 0.5}}}}, none: {{model: '{models}:nothing'}}}}"
    )
    record = run_sortie(example(*FEW, named))
    own = outcome(record)
    every = sum(own["payload_fates"].values())
    assert own["metrics"] == {"all": every, "half": every / 2, "none": None}
    plain = fly()
    assert (plain["metrics"], plain["fingerprint"]) == ({}, own["fingerprint"])
    save(record, tmp_path / "run")
    Path(models).unlink()
    assert outcome(load(tmp_path / "run"))["metrics"] == record.metrics


# --- errors --------------------------------------------------------------------------------------

BOXES = r"detect returns .*, must be Boxes for each of the jobs$"
READ_ONLY = r"^event Storm.begin: ValueError: assignment destination is read-only \(mine.py, line \d+\)$"
WRONG: dict[str, str] = {
    "radio.link=mine.py:Raises": r"^link Raises.snr_db: ZeroDivisionError: division by zero \(mine.py, line \d+\)$",
    "radio.link=mine.py:Exits": r"^link Exits.snr_db: ProgramExitError: exit code 0, must return \(mine.py, line",
    "radio.link=mine.py:Noisy3": r"^link file 'mine.py' has no function or class 'Noisy3'$",
    "radio.link=mine.py:constant": r"^link constant: TypeError: ",
    "perception.detector=mine.py:Half": r"^detector mine.py:Half has no 'truth', must have detect, truth, count_boxes",
    "perception.detector=mine.py:Short": rf"^detector mine.py:Short: {BOXES}",
    "perception.detector=mine.py:Forgets": rf"^detector mine.py:Forgets: {BOXES}",
    "perception.detector=mine.py:Texts": r"truth returns score without numbers, must be of shape \(\d+,\)$",
    "fleet.airframe.power_model=mine.py:negative": r"^power negative: returns -1 W, must be ≥ 0$",
    "fleet.battery.cell_model=mine.py:falling": r"^cell falling: falls from 4 to 3.99997 V at a charge of 0.000, must",
    "fleet.battery={cell_model: mine.py:straight, cell_params: {empty_v: 0}}": r"^cell straight: 0 V at a charge",
    "fleet.airframe.power_model=mine.py:scalar": r"^power scalar: returns shape \(\), must be \(10, \d\)$",
    "metrics={all: {model: 'mine.py:words'}}": r"^metric all \(mine.py:words\): returns 'many', must be a finite",
    "metrics={all: {model: 'mine.py:huge'}}": r"^metric all \(mine.py:huge\): returns 10{59}, must be a finite number",
    "metrics={all: {model: 'mine.py:endless'}}": r"^metric all \(mine.py:endless\): returns inf, must be a finite",
    "metrics={all: {model: 'mine.py:fails'}}": r"^metric fails: KeyError: 'no such table' \(mine.py, line \d+\)$",
    "metrics={all: {model: 'mine.py:gone'}}": r"^metric file 'mine.py' has no function or class 'gone'$",
    storm("{wrong: loss}"): r"^event mine.py:Storm: a loss of -1 dB, must be finite and ≥ 0$",
    storm("{wrong: loss_nan}"): r"^event mine.py:Storm: a loss of nan dB, must be finite and ≥ 0$",
    storm("{wrong: drone}"): r"^event mine.py:Storm: drone 99, must be a whole number, 0 … \d$",
    storm("{wrong: loss_of_each}"): r": a loss of shape \(5,\), must be of shape \(3, 3\), or one number$",
    storm("{wrong: loss_text}"): r"^event mine.py:Storm: '30', must be numbers, of shape \(3, 3\), or one number$",
    storm(
        "{wrong: place}"
    ): r"^event mine.py:Storm: a jammer of 30.0 dBm at \(0.0, 0.0\), must be one number at three$",
    storm("{wrong: power}"): r"^event mine.py:Storm: '30', must be numbers, one$",
    storm("{wrong: moves}"): READ_ONLY,
    storm("{wrong: lands}"): READ_ONLY,
    storm("{wrong: invents}"): r"^event Storm.begin: AttributeError: 'FleetHandle' object has no attribute 'loss_db'",
}
"""What is set, and the error."""


def test_what_a_model_does_wrong_is_one_line(models: str) -> None:
    for setting, words in WRONG.items():
        with pytest.raises(SortieError, match=words):
            fly(setting)


def test_a_link_model_that_hangs_ends_by_the_limit_of_a_call(models: str) -> None:
    words = r"^example, seed 1: no answer within 0.2 s \(limits.decision_s\) \(mine.py, line \d+\)$"
    with pytest.raises(SortieError, match=words):
        fly(f"radio.link={models}:Hangs", "limits.decision_s=0.2")


def test_a_run_is_read_without_the_package_that_offered_its_models(tmp_path: Path) -> None:
    """Every kind of name; a new flight still needs them."""
    offers = {
        "path_loss": "wall",
        "link": "Noisy",
        "detector": "Omniscient",
        "power": "constant",
        "sensor": "drifts",
        "event": "Calm",
        "metric": "sent",
    }
    names = (
        "radio={path_loss: mine, link: mine}",
        "perception={detector: mine, fusion: none}",
        "fleet.airframe={power_model: mine}",
        "fleet.sensor=mine",
        "events=[{kind: own, at_s: 0.5, model: mine}]",
        "metrics={m: {model: mine}}",
    )
    packages = {kind: {"mine": f"drizzle:{name}"} for kind, name in offers.items()}
    with installed_package(tmp_path, "drizzle", SOURCE.read_text(), packages):
        record = run_sortie(example(*FEW, *names))
        save(record, tmp_path / "run")
    again = load(tmp_path / "run")
    assert again.fingerprint == record.fingerprint
    assert outcome(again) == outcome(record)
    assert again.scenario.radio.path_loss == "mine"
    assert "Fingerprint" in page(again)
    with pytest.raises(SortieError, match="mine"):
        example(*FEW, *names)
