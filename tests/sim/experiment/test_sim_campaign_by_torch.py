"""A campaign whose first units the torch detector flies as well, and what both detectors together say."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from campaign_examples import BASE, CAMPAIGN, rows_on_disk, table_bytes, write

import sortie
from sortie.scenarios.control_variates import controlled_mean
from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.campaign import load_campaign
from sortie.sim.experiment import by_torch
from sortie.sim.experiment.by_torch import answers, depends_on_detector, plan_by_torch, read_torch
from sortie.sim.experiment.drive import Progress, run_campaign
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.plan import CampaignPlan, make_plan
from sortie.sim.experiment.report import write_report
from sortie.sim.experiment.rows import read_rows
from sortie.sim.experiment.store import CampaignStore
from sortie.sim.folders import RunError

pytestmark = pytest.mark.slow

SCORED = BASE.replace("detector: none", "detector: surrogate")
METRICS = CAMPAIGN.replace("[bytes.data_sent, energy_j.total]", "[ap50.full_scene, energy_j.total]")


class TwoDetectors:
    """Rows that follow from the task: torch finds half of what the surrogate finds, and an offset by the draw."""

    def __init__(self, wave: float = 0.01) -> None:
        self.wave, self.flown = wave, list[int]()

    def rows(self, tasks: Iterator[Task]) -> Iterator[list[tuple[Task, Flight]]]:
        for task in tasks:
            self.flown.append(task.number)
            scenario = json.loads(task.scenario)
            charge = scenario["fleet"]["battery"]["initial_soc"]
            cheap = 0.8 * charge + 0.1 * (scenario["policy"]["name"] == "worked")
            torch = 0.5 * cheap + 0.01 + self.wave * np.sin(100 * charge)
            value = torch if scenario["perception"]["detector"] == "torch" else cheap
            values = dict(zip(task.figures, (value, 7.0), strict=True))
            yield [(task, Flight("", "0" * 16, values, task.key))]


def plans(tmp_path: Path, text: str = METRICS, units: int = 3) -> tuple[CampaignPlan, CampaignPlan]:
    study = load_campaign(write(tmp_path, text, SCORED))
    plan = make_plan(study)
    return plan, plan_by_torch(study, units, plan)


def flown(tmp_path: Path, units: int = 3, text: str = METRICS, wave: float = 0.01) -> Path:
    plan, torch = plans(tmp_path, text, units)
    run_campaign(plan, tmp_path / "c", TwoDetectors())
    run_campaign(torch, tmp_path / "c" / by_torch.FOLDER, TwoDetectors(wave), units=units)
    return tmp_path / "c"


def test_a_run_by_torch_differs_from_the_campaign_s_own_in_its_detector_alone(tmp_path: Path) -> None:
    plan, torch = plans(tmp_path)
    for run in range(plan.runs):
        (ours, our), (its, other) = ((json.loads(t.scenario), t) for t in (plan.task(run), torch.task(run)))
        assert its["perception"].pop("detector") == "torch"
        assert ours["perception"].pop("detector") == "surrogate"
        assert ours == its
        assert (our.seed, our.replication, our.figures) == (other.seed, other.replication, other.figures)
    assert " torch " in torch.code
    assert plan.task(0).key != torch.task(0).key


def test_more_units_may_follow_and_the_table_is_that_of_one_flight(tmp_path: Path) -> None:
    _, torch = plans(tmp_path)
    seen: list[Progress] = []
    for folder, steps in (("at once", [5]), ("by and by", [2, 5])):
        for units in steps:
            engine = TwoDetectors()
            run_campaign(torch, tmp_path / folder, engine, units=units, progress=seen.append)
    assert engine.flown == list(range(2 * torch.unit_runs, 5 * torch.unit_runs)), "only what is new"
    assert (seen[-1].finished, seen[-1].of) == (5 * torch.unit_runs,) * 2
    once, twice = (table_bytes(tmp_path / folder) for folder in ("at once", "by and by"))
    assert once == twice
    assert rows_on_disk(tmp_path / "at once") == 5 * 8


def test_the_mean_uses_the_surrogate_s_other_draws(tmp_path: Path) -> None:
    """Against the estimator itself, fed with each draw's mean over grid points and replications."""
    plan, _ = plans(tmp_path)
    folder = flown(tmp_path, 5)
    rows = read_rows(folder)
    torch = read_torch(folder, rows)
    assert torch is not None
    charge = np.array([plan.varied(2 * draw)["fleet.battery.initial_soc"] for draw in range(6)])
    cheap, own = 0.8 * charge, 0.4 * charge + 0.01 + 0.01 * np.sin(100 * charge)
    first, second = answers(rows, torch, "ap50.full_scene", differences=False)
    expected = controlled_mean(own[:5], cheap[:5], cheap[5:])
    assert second.policy == "best-2(received_budget=0.1)"
    assert second.with_surrogate.mean == pytest.approx(expected.estimate.mean)
    assert second.alone.mean == pytest.approx(own[:5].mean())
    assert first.alone.mean == pytest.approx(own[:5].mean() + 0.05)
    assert second.correlation == pytest.approx(np.corrcoef(own[:5], cheap[:5])[0, 1])
    (apart,) = answers(rows, torch, "ap50.full_scene", differences=True)
    assert apart.alone.mean == pytest.approx(-0.05)
    assert list(depends_on_detector(rows, torch)) == ["ap50.full_scene"]


def test_where_torch_is_the_surrogate_and_an_offset_the_interval_is_that_of_all_draws(tmp_path: Path) -> None:
    """The mean over forty draws and the offset, whichever ten torch flew; it is much narrower than torch's alone."""
    folder = flown(tmp_path, 10, METRICS.replace("{count: 6}", "{count: 40, method: random}"), wave=0.0)
    rows = read_rows(folder)
    torch = read_torch(folder, rows)
    assert torch is not None
    first = answers(rows, torch, "ap50.full_scene", differences=False)[0]
    everything = rows.every_unit("ap50.full_scene")[:, 0].mean()
    assert first.with_surrogate.mean == pytest.approx(0.5 * everything + 0.01)
    assert first.correlation == pytest.approx(1.0)
    assert first.worth > 2


def test_the_report_has_both_once_torch_has_flown_a_whole_unit(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    plan, torch = plans(tmp_path)
    run_campaign(plan, tmp_path / "c", TwoDetectors())
    CampaignStore(tmp_path / "c" / by_torch.FOLDER, torch).close()
    assert "By the torch detector" not in write_report(tmp_path / "c").read_text()
    run_campaign(torch, tmp_path / "c" / by_torch.FOLDER, TwoDetectors(), units=3)
    text = write_report(tmp_path / "c").read_text()
    assert "The torch detector flew the first 3 draws as well" in text
    assert "Both detectors gave the same values of energy_j.total." in text
    section = text.partition("## By the torch detector")[2].partition("## By varied field")[0]
    assert section.count("| ap50.full_scene |") == 3, "two means and a difference"


GRID = "  fleet.formation.spacing_m: {kind: grid, values: [20, 40]}\n"
MORRIS = METRICS.replace(GRID, "").replace("{count: 6}", "{count: 6, method: morris}")
BOTH = "{kind: grid, values: [surrogate, torch]}"
OWN_DETECTOR = SCORED.replace("{drones: 2}", "{drones: 2, makes: [{name: a, drones: [1], detector: surrogate}]}")
SAME_FLEET = "is varied; both detectors must fly the same fleet"


def vary(field: str) -> str:
    """The campaign with one field more that is varied."""
    return METRICS.replace("vary:", f"vary:\n  {field}")


REFUSED = [
    (METRICS, BASE, 3, "perception.detector is none, must be surrogate"),
    (METRICS, SCORED, 7, "7, must be from 2 to the campaign's 6 draws"),
    (METRICS, SCORED, 1, "1, must be from 2 to the campaign's 6 draws"),
    (MORRIS, SCORED, 3, "sample.method is morris, whose means have no intervals"),
    (vary(f"perception.detector: {BOTH}"), SCORED, 3, f"perception.detector {SAME_FLEET}"),
    (vary("perception: {kind: grid, values: [{detector: torch}]}"), SCORED, 3, f"perception {SAME_FLEET}"),
    (vary(f"fleet.makes.0.detector: {BOTH}"), OWN_DETECTOR, 3, f"fleet.makes.0.detector {SAME_FLEET}"),
    (METRICS, OWN_DETECTOR, 3, "make a has a detector or weights of its own; both must fly the same fleet"),
]


def test_what_cannot_be_estimated_is_refused_before_anything_flies(tmp_path: Path) -> None:
    said = []
    for text, base, units, _ in REFUSED:
        with pytest.raises(RunError) as error:
            sortie.campaign(write(tmp_path, text, base), out=tmp_path / "c", by_torch=units)
        said.append(str(error.value))
    assert said == [f"--by-torch: {why}" for *_, why in REFUSED]
    with pytest.raises(SortieError, match=r"^by_torch: 2.5, must be a whole number from 0 to 2\^63 - 1$"):
        sortie.campaign(write(tmp_path, METRICS, SCORED), out=tmp_path / "c", by_torch=2.5)  # type: ignore[arg-type]
    assert not (tmp_path / "c").exists()


def test_torch_flies_no_more_units_than_stop_when_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten of forty draws are asked of torch, and the campaign stops at three."""
    pools: list[TwoDetectors] = []

    @contextmanager
    def open_pool(*args: object, **options: object) -> Iterator[TwoDetectors]:
        pools.append(TwoDetectors())
        yield pools[0]

    monkeypatch.setattr("sortie.sim.experiment.drive.open_pool", open_pool)
    text = METRICS.replace("{count: 6}", "{count: 40}")
    text += "stop_when: {metric: ap50.full_scene, half_width: 0.9, at_least: 3}\n"
    done = sortie.campaign(write(tmp_path, text, SCORED), out=tmp_path / "c", by_torch=10)
    kept, torch = (sortie.open_campaign(folder) for folder in (done.path, done.path / by_torch.FOLDER))
    assert kept.finished < 40 * 8
    assert torch.finished == kept.finished // 8 * 8 < 10 * 8
