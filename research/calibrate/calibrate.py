"""Make a calibration and its card from runs of the torch detector; an interrupted calibration resumes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.calibrate.collect import FLOOR, DetectorRuns, collect, read
from research.calibrate.correlation import fit_correlation, fit_shared_false_positives
from research.calibrate.fit import fit
from research.calibrate.judge import WITHIN, CalibrationVerdict, judge
from research.calibrate.levels import level
from research.calibrate.plan import MANNERS, THRESHOLD, Split, scene_model
from research.calibrate.rows import FitRows, rows_of
from sortie.perception.errors import InputError
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import average_precision, match
from sortie.perception.network.checkpoint import read_config
from sortie.perception.network.detector import named_weights
from sortie.perception.surrogate.model import Parameters, save
from sortie.scenarios.replacing import replacing
from sortie.scenarios.report_text import NONE, interval, table

FLOORS = (0.3, 0.25, 0.2, 0.15, 0.1)
LOST = 0.003
"""AP that leaving weaker boxes out may cost."""
Progress = Callable[[str, int, int], None]


def calibrate(
    out: Path,
    *,
    work: Path,
    weights: Path | None = None,
    scenes: int = 44,
    held_out: int = 14,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Parameters, CalibrationVerdict]:
    """Run the detector over `scenes` and `held_out` scenes, fit to the first, judge by the second, and write both to `out`.

    Args:
        out: the calibration (safetensors); its card lies beside it (Markdown).
        work: keeps the detector's runs, by weights; scenes that are there are not run again.
        weights: the detector's; None takes the shipped ones.

    Raises:
        InputError: weights that do not fit, too few scenes, or an `out` that ends as its card does.
    """
    if out.suffix == ".md":
        raise InputError(f"out is {out}, must not end in .md, as its card does")
    if scenes < 2 or held_out < 2:
        raise InputError(f"{scenes} scenes and {held_out} held out, must be at least 2 each")
    report = progress or (lambda stage, done, of: None)
    path = named_weights(weights)
    config = read_config(path)
    key = hashlib.blake2b(path.read_bytes(), digest_size=5).hexdigest()
    fitted = _detector_runs("fit", scenes, work, seed, weights, key, report)
    judged = _detector_runs("held-out", held_out, work, seed, weights, key, report)
    floor = _floor(fitted, seed)
    report("rows", 0, len(fitted))
    rows = []
    for k, recorded in enumerate(fitted):
        rows.append(rows_of(recorded, floor, seed))
        report("rows", k + 1, len(fitted))
    parts = iter(range(1, 6))  # those of `fit`
    parameters = fit(
        FitRows.join(rows), _boxes(fitted, seed), floor, seed, progress=lambda _: report("fit", next(parts), 5)
    )
    facts: dict[str, Any] = {
        "fusion": config.fusion,
        "weights": key,
        "file": path.name,
        "seed": seed,
        "scenes": scenes,
        "held_out": held_out,
    }
    parameters = replace(
        parameters, shared_false_positives=fit_shared_false_positives(fitted, floor, seed), card={**facts, "id": ""}
    )
    parameters = fit_correlation(parameters, fitted, seed, THRESHOLD, lambda done, of: report("together", done, of))
    parameters = level(parameters, fitted, seed, THRESHOLD, lambda done, of: report("levels", done, of))
    arrays = [
        parameters.alike,
        parameters.shared_false_positives,
        parameters.residuals,
        *(w for n in parameters.nets.values() for w in n.weight),
    ]
    digest = hashlib.blake2b(b"".join(np.ascontiguousarray(w).tobytes() for w in arrays), digest_size=4)
    facts["id"] = f"{config.fusion}-{key}-{digest.hexdigest()}"
    parameters = replace(parameters, card=facts)
    verdict = judge(parameters, judged, seed)
    parameters = replace(parameters, card={**facts, **verdict.facts()})
    save(out, parameters)
    with replacing(out.with_suffix(".md")) as part:
        part.write_text(card(parameters, verdict), "utf-8")
    return parameters, verdict


def _detector_runs(
    split: Split, count: int, work: Path, seed: int, weights: Path | None, key: str, report: Progress
) -> list[DetectorRuns]:
    out = []
    for k in range(count):
        report(f"the detector, {split} scenes", k, count)
        out += [read(collect(work, seed, split, k, m, weights, key), split) for m in range(len(MANNERS))]
    report(f"the detector, {split} scenes", count, count)
    return out


def _floor(recorded: Sequence[DetectorRuns], seed: int) -> float:
    """The highest score below which boxes hardly count, alone and with plenty shared."""
    for floor in FLOORS:
        if all(full - left <= LOST for full, left in (_ap(recorded, seed, shared, floor) for shared in (False, True))):
            return floor
    return FLOORS[-1]


def _ap(recorded: Sequence[DetectorRuns], seed: int, shared: bool, floor: float) -> tuple[float, float]:
    """AP of the detector's boxes, and of those above `floor`."""
    matched = []
    for a in recorded:
        scene = scene_model(seed, a.split, a.scene)
        for job, boxes in zip(a.jobs, a.boxes, strict=True):
            if bool(job.shares) == shared:
                truth = ground_truth(scene.cars_at(job.ego.t_s).table(), job.ego.true_pose).single()
                matched.append(match(boxes.take(boxes.score >= THRESHOLD), truth))
    return average_precision(matched), average_precision([m.at(floor) for m in matched])


def _boxes(recorded: Sequence[DetectorRuns], seed: int) -> NDArray[np.float64]:
    """[3, s]: score thresholds; of a drone alone, the share of the cars with a box above each, and the number of false positives."""
    rows = FitRows.join(
        [rows_of(replace(a, jobs=jobs, boxes=boxes), FLOOR, seed) for a in recorded for jobs, boxes in [_alone(a)]]
    )
    thresholds = np.array([FLOOR, 0.05, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
    found = [(rows.score >= t).mean() for t in thresholds]
    alarms = [(rows.alarm[:, 5] >= t).sum() / len(rows.job) for t in thresholds]
    return np.array([thresholds, found, alarms])


def _alone(recorded: DetectorRuns) -> tuple[list[Any], list[Any]]:
    pairs = [(j, b) for j, b in zip(recorded.jobs, recorded.boxes, strict=True) if not j.shares]
    return [j for j, _ in pairs], [b for _, b in pairs]


def card(parameters: Parameters, verdict: CalibrationVerdict) -> str:
    """The calibration's card, Markdown."""
    f = parameters.card

    def sure(value: float, low: float, high: float) -> str:
        return interval(value, low, high, lambda v: f"{v:+.3f}")

    levels = "\n".join(table(
        ("condition", "torch", "surrogate", "error", f"within ±{WITHIN:g}"),
        (
            (
                v.condition, f"{v.torch:.3f}", f"{v.surrogate:.3f}", sure(v.error, v.low, v.high),
                "yes" if abs(v.error) <= WITHIN else "no",
            )
            for v in verdict.levels
        ),
    ))  # fmt: skip
    orders = "\n".join(table(
        ("contrast", "torch", "surrogate", "order"),
        (
            (
                f"{o.b} − {o.a}", sure(o.torch, o.low, o.high), f"{o.surrogate:+.3f}",
                NONE if not o.significant else "kept" if o.kept else "lost",
            )
            for o in verdict.orders
        ),
    ))  # fmt: skip
    within = sum(abs(v.error) <= WITHIN for v in verdict.levels)
    kept = [o.kept for o in verdict.orders if o.significant]
    return f"""# Calibration {f["id"]}

Made by `python -m research calibrate --weights {f["file"]} --scenes {f["scenes"]} --held-out {f["held_out"]} --seed {f["seed"]}` from the torch detector's own runs
with fusion {f["fusion"]}, weights {f["weights"]}. Boxes below a score of {parameters.floor:g} are left out: AP loses at most {LOST:g} by it.

## AP@0.5 on held-out scenes

{f["held_out"]} scenes, {verdict.levels[0].egos} moments a condition; the error with its 95 % interval by whole scenes. {within} of {len(verdict.levels)} conditions within ±{WITHIN:g}.

{levels}

## Order of policies

The torch detector's contrast with its paired 95 % interval by whole scenes. {sum(kept)} of {len(kept)} significant orders kept.

{orders}
"""
