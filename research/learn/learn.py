"""Learn how to spend a budget from simulated sorties under every arm of `sortie.policies.catalogue.adaptive`.

An offline contextual bandit. Training conditions are drawn from ranges that the held-out set
(`scenarios/library/conditions.yaml`) keeps out of; in each, every arm is flown with the same seed and draws, so that
arms differ by nothing but themselves. Per arm, ridge regression predicts the AP gained over the first arm from what a
policy sees (`sortie.policies.catalogue.adaptive.features`). The result is a few numbers in a JSON file; nothing of it needs torch.
"""

from __future__ import annotations

import itertools
import json
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sortie.perception.detectors import make_detector
from sortie.perception.metrics.ap import average_precision
from sortie.policies.catalogue.adaptive import ARMS, features, spend
from sortie.policies.contract import Directive, FleetView
from sortie.scenarios.intervals import SHARE, Estimate, mean_interval
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.sortie import DetectorMaker, run_sortie
from sortie.sim.experiment.detectors import torch_answers
from sortie.sim.folders import RunError, write_text
from sortie.sim.results.accuracy import matched

BUDGETS = (0.01, 0.04, 0.2, 0.6)
SPACINGS_M = (15, 20, 30)
SHAPES, STYLES = ("cross", "grid"), ("town", "old_town")
CHARGES = (0.95, 0.5)
RADII_M = (28, 36)
LINKS = ((), (), ("radio.tx_power_dbm=5", "radio.path_loss_exponent=2.4"))
"""Clear air twice as often as weak links."""
SECONDS = 12
TORCH_RATE_HZ = 0.5
"""How often the torch detector scores: a moment of five drones costs it most of a second."""
RIDGE = 30.0
"""Shrinkage of the slopes towards none; the mean gain of an arm is not shrunk. Of 1, 3, 10 and 30 the best in ten-fold
cross-validation over the training conditions."""


@dataclass(frozen=True, slots=True)
class Lesson:
    """One training condition: what a policy saw in it, and every arm's AP."""

    features: tuple[float, ...]
    ap: tuple[float, ...]
    condition: str


def draw_condition(seed: int, number: int, sets: Sequence[str] = ()) -> tuple[Scenario, float]:
    """Training condition `number` of a seed: a scenario and its budget (`sent_budget` of the arms).

    Args:
        sets: overrides of fields that every condition has in common, as `--set` takes them.
    """
    rng = stream(seed, number, (), "learn.context")
    budget = float(rng.choice(BUDGETS))
    tracking = bool(rng.random() < 0.5)
    region = f", region: {{radius_m: {rng.choice(RADII_M)}}}"
    phase = f"{{at_s: 0, phase: {'track' if tracking else 'search'}{region if tracking else ''}}}"
    drawn = [
        "perception.detector=surrogate",
        f"duration_s={SECONDS}",
        "fleet.route.waypoints_m=[[-60, 0], [20, 0]]",
        "mission.target.waypoints_m=[[-60, -1.75], [200, -1.75]]",
        f"mission.phases=[{phase}]",
        f"fleet.formation.shape={rng.choice(SHAPES)}",
        f"fleet.formation.spacing_m={rng.choice(SPACINGS_M)}",
        f"perception.scene.style={rng.choice(STYLES)}",
        f"perception.scene.seed={int(rng.integers(1000, 10**6))}",
        f"fleet.battery.initial_soc={rng.choice(CHARGES)}",
        f"seed={int(rng.integers(1, 10**6))}",
        *LINKS[int(rng.integers(len(LINKS)))],
    ]
    return load("track_target", [*drawn, *sets]), budget


def fly_lesson(seed: int, number: int, by_torch: bool = False, sets: Sequence[str] = ()) -> Lesson:
    """Fly every arm in a training condition; `by_torch`: scored by the torch detector, at fewer moments."""
    scenario, budget = draw_condition(seed, number, sets)
    detector_of: DetectorMaker = make_detector
    if by_torch:
        perception = scenario.perception.model_copy(update={"sample_rate_hz": TORCH_RATE_HZ})
        scenario, detector_of = scenario.model_copy(update={"perception": perception}), torch_answers()
    mission = scenario.mission.phases[0].phase == "track"
    seen: list[tuple[float, ...]] = []
    aps = []
    for index, arm in enumerate(ARMS):

        def decide(view: FleetView, index: int = index, arm: object = arm) -> list[Directive]:
            if index == 0:
                seen.append(features(view, budget))
            return spend(view, ARMS[index], budget, "lesson")

        record = run_sortie(scenario, decide, detector_of=detector_of)
        frames = list(matched(record, mission=mission).values())
        aps.append(average_precision(frames))
    settled = np.mean(seen[len(seen) // 2 :], axis=0)
    about = f"budget {budget:g}, {'track' if mission else 'search'}, {scenario.fleet.formation.shape}"
    return Lesson(tuple(float(x) for x in settled), tuple(float(a) for a in aps), about)


def fly_lessons(
    seed: int,
    count: int,
    *,
    sets: Sequence[str] = (),
    by_torch: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> list[Lesson]:
    """Lessons of so many conditions, with overrides of fields (`sets`); those in which AP is undefined are left out.

    Raises:
        RunError: none is left.
    """
    with ProcessPoolExecutor(max_workers=workers) as pool:
        lessons = []
        every = pool.map(fly_lesson, [seed] * count, range(count), [by_torch] * count, [sets] * count)
        for k, lesson in enumerate(every):
            if progress is not None:
                progress(k + 1)
            if np.isfinite(lesson.ap).all():
                lessons.append(lesson)
    if not lessons:
        raise RunError(
            f"no accuracy in any of {count} conditions: there was no car to be seen, or perception.detector is none"
        )
    return lessons


def fit(lessons: list[Lesson]) -> dict[str, list[list[float]] | list[float]]:
    """Per arm, the gain over the first arm as a linear function of the features, by ridge regression.

    Returns:
        `mean` and `scale` [F] of the features, and `weights` [arms][1 + F], intercept first.
    """
    x = np.array([lesson.features for lesson in lessons])
    gain = np.array([np.array(lesson.ap) - lesson.ap[0] for lesson in lessons])
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
    z = (x - mean) / scale
    slopes = np.linalg.solve(z.T @ z + RIDGE * np.eye(z.shape[1]), z.T @ (gain - gain.mean(axis=0)))
    weights = np.vstack([gain.mean(axis=0), slopes]).T
    return {"mean": mean.tolist(), "scale": scale.tolist(), "weights": weights.tolist()}


def gains(lessons: list[Lesson], arm: int) -> dict[tuple[str, float], Estimate]:
    """AP of an arm over the first by phase and budget: the mean over conditions with its 95 % interval."""
    gains: dict[tuple[str, float], Estimate] = {}
    for phase in ("search", "track"):
        for budget in BUDGETS:
            gained = np.array(
                [
                    lesson.ap[arm] - lesson.ap[0]
                    for lesson in lessons
                    if (lesson.features[1] > 0.5) == (phase == "track") and np.isclose(10 ** lesson.features[0], budget)
                ]
            )
            if len(gained):
                gains[phase, budget] = mean_interval(gained, SHARE.of_differences())
    return gains


def thresholds(lessons: list[Lesson]) -> dict[str, float]:
    """Budgets from which on the first arm (maps to all) finds more than the last (boxes to all), by phase; phases without
    lessons are left out.

    Where the mean gain of boxes falls through zero, by its slope over log budget between the two budgets flown; the least
    budget where boxes never gain, infinity where they gain at every one.
    """
    cases = {"search": False, "track": True}
    some = {name: [s for s in lessons if (s.features[1] > 0.5) == tracking] for name, tracking in cases.items()}
    return {name: _falls_through_zero(few) for name, few in some.items() if few}


def _falls_through_zero(lessons: list[Lesson]) -> float:
    budget = np.array([10 ** s.features[0] for s in lessons])
    gain = np.array([s.ap[-1] - s.ap[0] for s in lessons])
    flown = [(b, float(gain[np.isclose(budget, b)].mean())) for b in BUDGETS if np.isclose(budget, b).any()]
    for (a, up), (b, down) in itertools.pairwise(flown):
        if up > 0 >= down:
            return float(a * (b / a) ** (up / (up - down)))
    return flown[0][0] if flown[0][1] <= 0 else float("inf")


def save(path: Path, lessons: list[Lesson], seed: int, *, by_torch: bool = False, sets: Sequence[str] = ()) -> None:
    """Write the fit, with how it was made."""
    fitted = fit(lessons)
    command = shlex.join(
        ["python", "-m", "research", "learn", *["--by-torch"] * by_torch, *(w for one in sets for w in ("--set", one))]
    )
    about = f"{command}, {len(lessons)} conditions of seed {seed}, each under {len(ARMS)} arms, {SECONDS} s"
    write_text(path, json.dumps({"about": about, **fitted}, indent=1) + "\n")
