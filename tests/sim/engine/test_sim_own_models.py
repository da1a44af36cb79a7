"""Models in a user's files fly in a sortie: they act, they are named in the record, and their errors are of one line."""

from __future__ import annotations

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


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The file of models in a folder of its own, which is the working folder."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SOURCE, tmp_path / "mine.py")
    return "mine.py"


def fly(*overrides: str, seed: int = 1) -> dict[str, Any]:
    return outcome(run_sortie(example("duration_s=3", *overrides), seed=seed))


def test_power_of_ones_own_is_what_the_ledger_books(models: str) -> None:
    own = fly(f"fleet.airframe.power_model={models}:constant")
    scenario = example("duration_s=3")
    drones, efficiency = scenario.fleet.drones, scenario.fleet.battery.drivetrain_efficiency
    assert own["energy_j"]["rotor"] == pytest.approx(drones * 3 * 300.0 / efficiency)
    more = fly(f"fleet.airframe={{power_model: '{models}:constant', power_params: {{power_w: 150}}}}")
    assert more["energy_j"]["rotor"] == pytest.approx(own["energy_j"]["rotor"] / 2)


def test_makes_fly_power_models_of_their_own(models: str) -> None:
    plain = fly()
    own = fly(f"fleet.makes=[{{name: mine, drones: [1], airframe: {{power_model: '{models}:constant'}}}}]")
    assert own["own_files"].keys() == {models}
    assert own["drones"]["0"]["energy_j"] == pytest.approx(plain["drones"]["0"]["energy_j"], rel=1e-3)
    assert own["drones"]["1"]["energy_j"] > 1.2 * plain["drones"]["1"]["energy_j"]


def test_a_detector_of_ones_own_is_scored_and_named(models: str) -> None:
    own = fly(f"perception.detector={models}:Omniscient")
    assert own["ap50"]["full_scene"] == 1.0
    assert (own["ap50"]["detector"], own["ap50"]["fusion"]) == (f"{models}:Omniscient", None)
    assert own["own_files"].keys() == {models}
    blind = fly(f"perception={{detector: '{models}:Omniscient', detector_params: {{finds: false}}}}")
    assert blind["ap50"]["full_scene"] == 0.0


def test_the_same_seed_gives_the_same_record(models: str) -> None:
    first, again, other = (fly(f"radio.link={models}:Noisy", seed=seed) for seed in (1, 1, 2))
    assert first["fingerprint"] == again["fingerprint"] != other["fingerprint"]


def test_an_edited_file_has_another_digest(models: str) -> None:
    first = fly(f"radio.link={models}:Noisy")
    with Path(models).open("a") as file:
        file.write("\n# edited\n")
    assert fly(f"radio.link={models}:Noisy")["own_files"] != first["own_files"]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("radio.link=mine.py:Raises", r"^link Raises.snr_db: ZeroDivisionError: division by zero \(mine.py, line \d+\)$"),
        ("radio.link=mine.py:Exits", r"^link Exits.snr_db: ProgramExitError: exit code 0, must return \(mine.py, line \d+\)$"),
        ("radio.link=mine.py:Noisy3", r"^link file 'mine.py' has no function or class 'Noisy3'$"),
        ("radio.link=mine.py:constant", r"^link constant: TypeError: "),
        ("perception.detector=mine.py:Half", r"^detector mine.py:Half has no 'truth', must have detect, truth, count_boxes, camera_views$"),
        ("perception.detector=mine.py:Short", r"^detector mine.py:Short: detect returns \[\], must be Boxes for each of the jobs$"),
        ("perception.detector=mine.py:Forgets", r"^detector mine.py:Forgets: detect returns None, must be Boxes for each of the jobs$"),
        ("perception.detector=mine.py:Texts", r"^detector mine.py:Texts: truth returns score without numbers, must be of shape \(\d+,\)$"),
        ("fleet.airframe.power_model=mine.py:negative", r"^power negative: returns -1 W, must be ≥ 0$"),
        ("fleet.battery.cell_model=mine.py:falling", r"^cell falling: falls from 4 to 3.99997 V at a charge of 0.000, must not fall as the charge rises$"),
        ("fleet.battery={cell_model: mine.py:straight, cell_params: {empty_v: 0}}", r"^cell straight: 0 V at a charge of 0.000, must be above 0$"),
        ("fleet.airframe.power_model=mine.py:scalar", r"^power scalar: returns shape \(\), must be \(30, \d\)$"),
    ],
)  # fmt: skip
def test_what_a_model_does_wrong_is_told_in_one_line(setting: str, message: str, models: str) -> None:
    with pytest.raises(SortieError, match=message):
        fly(setting)


def test_a_link_model_that_hangs_ends_by_the_limit_of_a_call(models: str) -> None:
    told = r"^example, seed 1: no answer within 0.2 s \(limits.decision_s\) \(mine.py, line \d+\)$"
    with pytest.raises(SortieError, match=told):
        fly(f"radio.link={models}:Hangs", "limits.decision_s=0.2")


def storm(params: str = "{}", until: str = "until_s: 2") -> str:
    return f"events=[{{kind: own, at_s: 1, {until}, model: 'mine.py:Storm', params: {params}}}]"


def lost_db(overrides: tuple[str, ...], begin_s: float, end_s: float) -> float:
    """By how much the same links are weaker at the same moments than without the overrides, the median."""
    busy = ("duration_s=3", "policy.name=all-4", "policy.params={}")
    both = [run_sortie(example(*busy, *more)).tables["transmissions"].to_pylist() for more in ((), overrides)]
    plain, changed = (
        {(r["drone"], r["peer"], r["t_sent_s"]): r["snr_db"] for r in rows if begin_s <= r["t_sent_s"] < end_s}
        for rows in both
    )
    return float(np.median([plain[key] - changed[key] for key in plain.keys() & changed.keys()]))


@pytest.mark.parametrize(("begin_s", "end_s", "expected_db"), [(0.0, 0.8, 0.0), (1.1, 1.8, 20.0), (2.1, 3.0, 0.0)])
def test_an_event_of_ones_own_acts_while_it_lasts(
    begin_s: float, end_s: float, expected_db: float, models: str
) -> None:
    assert lost_db((storm(),), begin_s, end_s) == pytest.approx(expected_db, abs=1e-6)


def test_its_jammer_goes_when_it_ends(models: str) -> None:
    jams = (storm("{loss_db: 0, jams: true}"),)
    assert lost_db(jams, 1.1, 1.8) > 10.0
    assert lost_db(jams, 2.1, 3.0) == pytest.approx(0.0, abs=1e-6)


def test_it_is_called_once_a_frame_and_may_write_events(models: str) -> None:
    texts = [event["text"] for event in fly(storm())["events"]]
    assert texts == ["mine.py:Storm begins", "a storm", "10 frames from 1 s to 1.9 s", "mine.py:Storm ends"]


def test_it_may_lose_a_drone_and_take_energy(models: str) -> None:
    plain, hit = fly(), fly(storm("{loss_db: 0, drains: 0.5, loses: 2}"))
    assert [hit["drones"][d]["airborne"] for d in ("0", "1", "2")] == [True, True, False]
    assert hit["drones"]["1"]["soc"] < 0.6 * plain["drones"]["1"]["soc"]
    assert "hit by lightning" in [event["text"] for event in hit["events"]]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("loss", r"^event mine.py:Storm: a loss of -1 dB, must be finite and ≥ 0$"),
        ("loss_nan", r"^event mine.py:Storm: a loss of nan dB, must be finite and ≥ 0$"),
        ("drone", r"^event mine.py:Storm: drone 99, must be a whole number, 0 … \d$"),
        ("loss_of_each", r"^event mine.py:Storm: a loss of shape \(5,\), must be of shape \(5, 5\), or one number$"),
        ("loss_text", r"^event mine.py:Storm: '30', must be numbers, of shape \(5, 5\), or one number$"),
        ("place", r"^event mine.py:Storm: a jammer of 30.0 dBm at \(0.0, 0.0\), must be one number at three$"),
        ("power", r"^event mine.py:Storm: '30', must be numbers, one$"),
        ("moves", r"^event Storm.begin: ValueError: assignment destination is read-only \(mine.py, line \d+\)$"),
        ("lands", r"^event Storm.begin: ValueError: assignment destination is read-only \(mine.py, line \d+\)$"),
        ("invents", r"^event Storm.begin: AttributeError: 'FleetHandle' object has no attribute 'loss_db'"),
    ],
)
def test_what_an_event_may_not_do_is_refused(wrong: str, message: str, models: str) -> None:
    with pytest.raises(SortieError, match=message):
        fly(storm(f"{{wrong: {wrong}}}"))


def test_a_metric_of_ones_own_is_in_the_outcome_and_changes_nothing_else(models: str) -> None:
    named = f"metrics={{all: {{model: '{models}:sent'}}, half: {{model: '{models}:sent', params: {{times: 0.5}}}}, none: {{model: '{models}:nothing'}}}}"
    plain, own = fly(), fly(named)
    assert own["metrics"] == {
        "all": sum(own["payload_fates"].values()),
        "half": own["metrics"]["all"] / 2,
        "none": None,
    }
    assert (plain["metrics"], plain["fingerprint"]) == ({}, own["fingerprint"])


def test_a_saved_run_keeps_its_metrics_without_their_file(models: str, tmp_path: Path) -> None:
    record = run_sortie(example("duration_s=3", f"metrics={{all: {{model: '{models}:sent'}}}}"))
    save(record, tmp_path / "run")
    Path(models).unlink()
    assert outcome(load(tmp_path / "run"))["metrics"] == record.metrics


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("words", r"^metric all \(mine.py:words\): returns 'many', must be a finite number or None$"),
        ("huge", r"^metric all \(mine.py:huge\): returns 10{59}, must be a finite number or None$"),
        ("endless", r"^metric all \(mine.py:endless\): returns inf, must be a finite number or None$"),
        ("fails", r"^metric fails: KeyError: 'no such table' \(mine.py, line \d+\)$"),
        ("gone", r"^metric file 'mine.py' has no function or class 'gone'$"),
    ],
)
def test_a_metric_that_is_no_number_is_told(function: str, message: str, models: str) -> None:
    with pytest.raises(SortieError, match=message):
        fly(f"metrics={{all: {{model: '{models}:{function}'}}}}")


def test_a_run_is_read_without_the_package_that_offered_its_models(tmp_path: Path) -> None:
    """Every kind of name; a new flight still needs them."""
    offers = {"path_loss": "wall", "link": "Noisy", "detector": "Omniscient", "power": "constant", "sensor": "drifts",
              "event": "Storm", "metric": "sent"}  # fmt: skip
    names = (
        "radio={path_loss: mine, link: mine}", "perception={detector: mine, fusion: none}", "fleet.airframe={power_model: mine}",
        "fleet.sensor=mine", "events=[{kind: own, at_s: 1, model: mine}]", "metrics={m: {model: mine}}",
    )  # fmt: skip
    models = {kind: {"mine": f"drizzle:{name}"} for kind, name in offers.items()}
    with installed_package(tmp_path, "drizzle", SOURCE.read_text(), models):
        record = run_sortie(example("duration_s=2", *names))
        save(record, tmp_path / "run")
    again = load(tmp_path / "run")
    assert again.fingerprint == record.fingerprint
    assert outcome(again) == outcome(record)
    assert again.scenario.radio.path_loss == "mine"
    assert "Fingerprint" in page(again)
    with pytest.raises(SortieError, match="mine"):
        example("duration_s=2", *names)
