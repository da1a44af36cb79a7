"""The surrogate against the torch detector on what drones ask in flight: formations, ages and discs as sorties have them.

A sortie is flown by the surrogate, and again with the same traffic and the torch detector's answers at every scored moment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.ap import average_precision
from perception.detectors import Constructor, Detector
from perception.scene import SceneModel
from scenarios.contexts import Context, Contexts
from scenarios.load import load, load_contexts
from scenarios.schema import Perception
from sim.contexts import paired_interval, scenario_of
from sim.outcome import both_matched
from sim.sortie import run_sortie

POLICIES = ("silence", "all-4", "boxes")
REGIONS = {"full_scene": "everywhere", "mission": "in the mission's disc"}


class Asked:
    """The torch detector's boxes and the surrogate's guess of how many a drone would send, so that traffic is the surrogate's."""

    def __init__(self, torch: Detector, surrogate: Detector) -> None:
        self.detect, self.truth = torch.detect, torch.truth
        self.count_boxes, self.camera_views = surrogate.count_boxes, torch.camera_views


@dataclass(frozen=True, slots=True)
class Level:
    """AP@0.5 of one policy in one region of one context, by both."""

    policy: str
    context: str
    region: str
    torch: float
    surrogate: float


def flights(
    name: str,
    calibration: Path,
    weights: Path | None,
    rate_hz: float,
    policies: Sequence[str] = POLICIES,
    progress: Callable[[str, int, int], None] | None = None,
) -> Iterator[Level]:
    """Fly a scenario, or every context of a set with its first seed, under some policies.

    Raises:
        ScenarioError, PolicyError: what cannot be flown, before anything is.
    """
    contexts = load_contexts(name)
    if contexts is None:
        contexts = Contexts(base=name, seeds=(load(name).seed,), contexts=(Context(name="sortie", rho=1.0),))
        planned = [(p, contexts.contexts[0], load(name, [f"policy.name={p}", "policy.params={}"])) for p in policies]
    else:
        planned = [(p, c, scenario_of(contexts, c, p)) for c in contexts.contexts for p in policies]
    both = torch_answers(calibration, weights), _surrogate(calibration)
    for k, (policy, context, scenario) in enumerate(planned):
        if progress is not None:
            progress(f"{name} by both detectors", k, len(planned))
        perception = scenario.perception.model_copy(update={"detector": "surrogate", "sample_rate_hz": rate_hz})
        scenario = scenario.model_copy(update={"perception": perception})
        found = [both_matched(run_sortie(scenario, None, contexts.seeds[0], detector_of=make)) for make in both]
        for region in REGIONS:
            theirs, ours = (average_precision(list(f[region].values())) for f in found)
            if not np.isnan(theirs):  # there is such a region, and there are cars in it
                yield Level(policy, context.name, region, theirs, ours)
    if progress is not None:
        progress(f"{name} by both detectors", len(planned), len(planned))


def torch_answers(calibration: Path | None = None, weights: Path | None = None) -> Constructor:
    """What makes a sortie's detector so that its traffic is the surrogate's and its boxes are the torch detector's, which is
    asked at scored moments alone. None takes what is shipped."""
    from perception.detector import TorchDetector  # here: torch takes a second to import

    ours = _surrogate(calibration)

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
        return Asked(TorchDetector(scene, config, seed, weights), ours(scene, config, seed, replication))

    return make


def _surrogate(calibration: Path | None) -> Constructor:
    from perception.surrogate.detector import SurrogateDetector

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
        return SurrogateDetector(scene, config, seed, calibration, replication)

    return make


@dataclass(frozen=True, slots=True)
class Mean:
    """The mean over contexts of a policy's AP, or of what it gains over another's, by both; with 95 % intervals, contexts
    resampled in pairs, of the torch detector's and of the difference."""

    what: str
    region: str
    torch: tuple[float, float, float]
    surrogate: float
    error: tuple[float, float, float]


def means(levels: Sequence[Level]) -> Iterator[Mean]:
    """Of every policy, then of every policy against every earlier one."""
    policies = list(dict.fromkeys(v.policy for v in levels))
    for region in REGIONS:
        ap = {p: _table([v for v in levels if (v.policy, v.region) == (p, region)]) for p in policies}
        for p in policies:
            if len(ap[p]):
                yield _mean(p, region, ap[p])
        for k, p in enumerate(policies):
            for earlier in policies[:k]:
                if len(ap[p]):
                    yield _mean(f"{p} − {earlier}", region, ap[p] - ap[earlier])


def _table(levels: Sequence[Level]) -> np.ndarray:
    return np.array([(v.torch, v.surrogate) for v in levels])


def _mean(what: str, region: str, both: np.ndarray) -> Mean:
    error = both[:, 1] - both[:, 0]
    torch, off = ((float(v.mean()), *paired_interval(v)) for v in (both[:, 0], error))
    return Mean(what, region, torch, float(both[:, 1].mean()), off)
