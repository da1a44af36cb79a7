"""The dose–response study: its plan, what it measures, and how its hypotheses are judged."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from research.benchmark.dataset import Frames
from research.flip import dose_run
from research.flip.dose_run import Found, cells_with_cars, frame_of, frames_of, measure_frames
from research.flip.doses import (
    PLAN,
    Dose,
    DosePlan,
    DoseRow,
    Effect,
    FrameRange,
    facts,
    read_plan,
    row_of,
    verdicts,
)  # fmt: skip
from research.flip.run import SHIPPED
from research.paper.instrument import CarNetInstrument
from research.paper.ways import SINGLE, evaluate
from sortie.perception.evaluation.harness import FrameResult, Settings
from sortie.perception.geometry import CELLS, FULL
from sortie.perception.metrics.ap import Matched
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.detector import shipped
from sortie.scenarios.shipped import NETWORKS

PLANNED = read_plan()
NO_BOXES = Matched(np.zeros(0), np.zeros(0, bool), 3)
NOTHING = Effect(0.0, -1.0, 1.0)


def fleet(frames: int = 1, seed: int = 0) -> Frames:
    """Five drones 20 m apart over random pictures, and three cars."""
    rng = np.random.default_rng(seed)
    pose = np.zeros((frames, 5, 3))
    pose[:, :, 0] = 20.0 * np.arange(5)
    cars = np.tile(
        [[10.0, 5.0, 4.5, 1.9, 0.3], [-40.0, 30.0, 4.5, 1.9, 1.0], [70.0, -60.0, 4.5, 1.9, 2.0]], (frames, 1, 1)
    )
    images = rng.integers(0, 255, (frames, 5, 4, 256, 256), dtype=np.uint8)
    return Frames(images, pose, pose.copy(), cars, np.arange(frames))


def row(network: str, dose: Dose, weight: float, starved: float, silent: float, *contrasts: float) -> DoseRow:
    """Figures with intervals of ± 1."""
    starved_, silent_, *two = (Effect(v, v - 1.0, v + 1.0) for v in (starved, silent, *contrasts))
    return DoseRow(network, dose, weight, starved_, silent_, tuple(two), 80)


def test_the_plan_names_networks_that_are_there_and_frames_that_the_trial_had_not_seen() -> None:
    assert all((SHIPPED / f"{name}.safetensors").is_file() for name in PLANNED.networks)
    assert PLANNED.frames == (FrameRange(0, 80, 239), FrameRange(1, 0, 239))
    assert [d.label for d in PLANNED.dose] == [
        "T 1", "T 1, β 2", "T 1, β 4", "T ∞", "T ∞, β 0.35", "T ∞, β 0.7", "T 1, masked", "T ∞, masked",
        "T ∞, absent as zeros",
    ]  # fmt: skip


def test_a_dose_is_put_into_every_condition_but_that_of_a_drone_alone() -> None:
    alone, *others = PLANNED.conditions(Dose(2.0, unsent="masked", absent="zeros"))
    assert alone == SINGLE
    assert {(c.unsent, c.absent) for c in others} == {("masked", "zeros")}
    assert [c.received_budget for c in others] == [0.01, 0.0, 0.0, 0.02, 0.02, 0.05, 0.05, 0.1, 0.1, 0.25, 0.25]


def test_equal_weights_give_silent_peers_four_fifths_where_all_reach_and_more_with_a_bonus() -> None:
    net, data = load_weights(COARSE), fleet()
    near = np.array([32 * CELLS + 32])  # in the middle of the first drone's square: all five reach it
    for bonus in (0.0, 0.35):
        view = CarNetInstrument(net, fusion_params={"temperature": math.inf, "silent_weight": bonus}).look(data, 0)
        wanted = 4 * math.exp(bonus) / (1 + 4 * math.exp(bonus))
        assert view.weight_on_zeros(0, near) == pytest.approx([wanted], abs=1e-6)
    # the last drone is 80 m ahead: its square does not reach what lies 90 m behind the first
    far = np.array([4 * CELLS + 32])
    uniform = CarNetInstrument(net, fusion_params={"temperature": math.inf}).look(data, 0)
    reach = sum(abs(-102.4 + 4.5 * 3.2 - 20.0 * k) < 102.4 for k in range(1, 5))
    assert reach < 4
    assert uniform.weight_on_zeros(0, far) == pytest.approx([reach / (1 + reach)], abs=1e-6)


def test_only_disconet_has_such_weights() -> None:
    view = CarNetInstrument(load_weights(shipped("fcooper"))).look(fleet(), 0)
    with pytest.raises(ValueError, match="fusion is fcooper, must be disconet"):
        view.weight_on_zeros(0, np.array([0]))


def test_the_weight_is_that_of_cells_with_cars_by_true_poses() -> None:
    data = fleet()
    data.true_pose[0, 0] = [0.0, 0.0, math.pi / 2]  # faces north: the car at (10, 5) is 5 m ahead and 10 m to the right
    cells = cells_with_cars(data, 0, 0, FULL)
    assert cells.tolist()[0] == math.floor((102.4 + 5.0) / 3.2) * CELLS + math.floor((102.4 - 10.0) / 3.2)


COARSE = NETWORKS / "disconet.safetensors"
"""Cells are fused as they are sent."""
SMALL_PLAN = replace(
    PLANNED,
    budgets=(0.05,),
    dose=(Dose(2.0, 0.35), Dose(2.0, unsent="masked"), Dose(2.0, absent="zeros")),
)
"""Every kind of dose, at one budget."""


def test_all_doses_at_once_give_what_each_gives_alone() -> None:
    net, data, key = load_weights(COARSE), fleet(), (0, 0)
    few = Settings(egos=1)
    found, weights = frame_of(SMALL_PLAN, CarNetInstrument(net), data, 0, key, few)
    for dose in SMALL_PLAN.dose:
        alone = CarNetInstrument(net, fusion_params=dose.params)
        conditions = tuple(SMALL_PLAN.conditions(dose))
        wanted = evaluate(alone, data, conditions, regions=("full",), egos=few.egos)
        for c in conditions:
            for unit, other in zip(
                wanted.units[c, "full"], found[dose.label].units[c.plain().label, "full"], strict=True
            ):
                assert unit.truths == other.truths
                assert unit.score == pytest.approx(other.score, abs=1e-5)
                assert unit.hit.tolist() == other.hit.tolist()
            assert [row[0] for row in found[dose.label].cost[c.plain().label]] == wanted.cells[c].tolist()
        view = alone.look(data, 0)
        each = [view.weight_on_zeros(ego, cells_with_cars(data, 0, ego, FULL)) for ego in range(5)]
        expected = np.zeros(len(weights[dose.label])) if dose.unsent == "masked" else np.concatenate(each)
        assert weights[dose.label] == pytest.approx(expected, abs=1e-6)


def test_a_study_that_was_cut_off_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[int] = []

    def once(plan: DosePlan, instrument: CarNetInstrument, data: Frames, f: int, key: object) -> Found:
        if measured == [0]:
            raise KeyboardInterrupt
        measured.append(f)
        found = FrameResult((math.nan, math.nan), {("single", "full"): [NO_BOXES]}, {"single": [(0, 0, 0)]})
        return {"T 1": found}, {"T 1": [0.25 * f]}

    monkeypatch.setattr(dose_run, "frame_of", once)
    plan, data = replace(PLANNED, networks=("full-0",)), fleet(2)
    with pytest.raises(KeyboardInterrupt):
        measure_frames(plan, tmp_path, data)
    measured.append(-1)
    (several,) = measure_frames(plan, tmp_path, data).values()
    assert measured == [0, -1, 1]
    assert [weights for _, weights in several] == [{"T 1": [0.0]}, {"T 1": [0.25]}]
    # another dose is another study
    again = replace(plan, dose=(*plan.dose, Dose(3.0)))
    measure_frames(again, tmp_path, data)
    assert measured == [0, -1, 1, 0, 1]
    # another code measures anew
    monkeypatch.setattr(dose_run, "boxes_digest", lambda: "another")
    measure_frames(plan, tmp_path, data)
    assert measured == [0, -1, 1, 0, 1, 0, 1]


class Table:
    """APs by condition, in place of an evaluation's."""

    def ap(self, condition: object, region: object) -> float:
        c = condition
        return 0.5 if c == SINGLE else 0.4 + 0.1 * c.received_budget + 0.01 * c.k  # type: ignore[attr-defined]

    def draws(self, condition: object, region: object) -> np.ndarray:
        return np.full(10, self.ap(condition, region))


def test_a_row_is_two_minus_four_at_the_same_bytes_and_four_starved_minus_alone() -> None:
    found = row_of(PLANNED, "full-0", Dose(), 0.3, Table(), 7)  # type: ignore[arg-type]
    assert found.starved.value == pytest.approx(100 * (0.4 + 0.001 + 0.04 - 0.5))
    assert found.silent.value == pytest.approx(-2.0)
    assert [c.value for c in found.contrasts] == pytest.approx([-2.0] * 4)
    assert facts(found)["weight_on_zeros"] == 0.3


LEAST = row("a", Dose(), 0.1, 3.0, -2.0, -4.0, -4.0, -4.0, -4.0)
MOST = row("a", Dose(math.inf, 0.7), 0.8, -3.0, 5.0, 2.0, 0.0, -1.5, -2.0)
MASKED = row("a", Dose(unsent="masked"), 0.0, 5.0, 0.0, -3.0, -3.0, -3.0, -3.0)


@pytest.mark.parametrize(
    ("changed", "holds"),
    [
        ({}, (True, True, True, True, True)),
        ({"MOST": replace(MOST, contrasts=(Effect(-5.0, -6.0, -4.0), *MOST.contrasts[1:]))}, (False, False, True, True, True)),
        ({"MOST": replace(MOST, contrasts=(*MOST.contrasts[:3], NOTHING))}, (True, False, True, True, True)),
        ({"MOST": replace(MOST, starved=NOTHING)}, (True, True, False, True, True)),
        ({"MASKED": replace(MASKED, starved=NOTHING)}, (True, True, True, False, True)),
        ({"MASKED": replace(MASKED, contrasts=(NOTHING, *MASKED.contrasts[1:]))}, (True, True, True, False, True)),
        ({"MOST": replace(MOST, silent=Effect(0.0, -1.5, 1.5))}, (True, True, True, True, False)),
    ],
)  # fmt: skip
def test_each_hypothesis_falls_alone(changed: dict[str, DoseRow], holds: tuple[bool, ...]) -> None:
    rows = [changed.get("MOST", MOST), LEAST, changed.get("MASKED", MASKED)]
    assert verdicts(rows) == {"a": holds}


def test_absent_peers_as_zeros_are_no_dose_of_the_curve() -> None:
    other = row("a", Dose(math.inf, absent="zeros"), 0.9, 0.0, 0.0, -9.0, -9.0, -9.0, -9.0)
    assert verdicts([LEAST, MOST, MASKED, other]) == {"a": (True,) * 5}


def test_a_study_without_a_control_is_refused() -> None:
    with pytest.raises(ValueError, match="needs zero fill at two doses or more, and a masked control"):
        verdicts([LEAST, MOST])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("7:0", "frames is '7:0', must be a benchmark's seed and frames, such as 7:0-239"),
        ("a:0-1", "frames is 'a:0-1', must be"),
    ],
)
def test_a_range_of_another_form_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameRange.parse(text)


@pytest.mark.parametrize("span", [FrameRange(0, 5, 4), FrameRange(0, 0, 240)])
def test_frames_beyond_the_split_are_refused(span: FrameRange, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"frames {span.first} to {span.last} of benchmark 0: must lie in 0 to 239"):
        frames_of([span], tmp_path, lambda stage, done, of: None)


def test_a_plan_with_a_fault_is_refused_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.read_text("utf-8").replace('\nunsent = "masked"', '\nunsent = "left out"', 1), "utf-8")
    with pytest.raises(ValueError, match=r"plan\.toml: dose\.6\.unsent: Input should be 'zero' or 'masked'"):
        read_plan(path)
