"""Measures the dose–response study frame by frame: each frame is encoded once by each network, whatever the doses.

A frame that is finished under every dose is kept as one file per network, so that a run that was cut off goes on. Another
version of the code (`boxes_digest`) measures all frames anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from research.benchmark.dataset import SIZES, Benchmark, Frames, load_frames, make_split
from research.flip.dose_view import DoseView, Tuning
from research.flip.doses import Dose, DosePlan, DoseRow, FrameRange, row_of
from research.flip.run import SHIPPED
from research.paper.instrument import CPU, CarNetInstrument
from research.paper.results import TAU
from research.paper.scores import Bootstrap
from research.paper.ways import SINGLE, Sharing, in_order, under_all_names
from sortie.perception.code_digest import boxes_digest
from sortie.perception.errors import InputError
from sortie.perception.evaluation.harness import (
    FrameResult,
    Settings,
    assemble,
    exchanges,
    frame_hash,
    frame_keys,
    match_all,
    read_frames,
    truth,
    write_frames,
)
from sortie.perception.evaluation.sharing import link_bytes
from sortie.perception.geometry import CELLS, Geometry, to_local

Progress = Callable[[str, int, int], None]
Found = tuple[dict[str, FrameResult], dict[str, list[float]]]
"""By a dose's label: a frame's matched boxes, and the weight on zeros in each of its cells with a car."""
SETTINGS = Settings(floor=TAU, regions=("full",))


def measure(
    plan: DosePlan,
    folder: Path,
    root: Path,
    *,
    weights: Path = SHIPPED,
    frames: Sequence[FrameRange] | None = None,
    workers: int = 1,
    device: torch.device = CPU,
    progress: Progress | None = None,
) -> Iterator[DoseRow]:
    """Every network at every dose, one row after the other.

    Args:
        folder: finished frames are kept here, so that a run that was cut off goes on where it was.
        root: folder of benchmarks; splits that are missing are made.
        weights: the networks' folder.
        frames: in place of the plan's.
        progress: called with (stage, done, of).

    Raises:
        InputError: frames beyond the test split, or weights that are not there.
    """
    tell = progress or (lambda stage, done, of: None)
    data = frames_of(plan.frames if frames is None else frames, root, tell)
    found = measure_frames(
        plan, folder, data, weights=weights, workers=workers, device=device, progress=partial(tell, "frames")
    )
    for network, several in found.items():
        for dose in plan.dose:
            wanted = {c: c.plain() for c in plan.conditions(dose)}
            results = [results[dose.label] for results, _ in several]
            distinct = assemble(results, tuple(dict.fromkeys(wanted.values())), SETTINGS, data.scene)
            every = under_all_names(distinct, wanted)
            weight = float(np.concatenate([weights[dose.label] for _, weights in several]).mean())
            yield row_of(plan, network, dose, weight, Bootstrap(every, dose.unsent, ways=dose.ways), len(data))


def measure_frames(
    plan: DosePlan,
    folder: Path,
    data: Frames,
    *,
    weights: Path = SHIPPED,
    workers: int = 1,
    device: torch.device = CPU,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, list[Found]]:
    """By network: every frame in turn under every dose. One frame is finished in all networks before the next begins."""
    networks = {n: CarNetInstrument.load(weights / f"{n}.safetensors", device) for n in plan.networks}
    keys, of_plan = frame_keys(data), _digest(plan)
    start = next(iter(networks.values())).start_worker

    def task(f: int) -> dict[str, Found]:
        name = frame_hash(data, f, keys[f])

        def of_network(instrument: CarNetInstrument) -> Found:
            path = folder / "doses" / f"{instrument.fingerprint}-{of_plan}" / f"{name}.parquet"
            if path.exists():
                results, facts = read_frames(path)
                return results, facts["weights"]
            results, weight = frame_of(plan, instrument, data, f, keys[f])
            write_frames(path, results, {"weights": weight})
            return results, weight

        return {n: of_network(instrument) for n, instrument in networks.items()}

    out: dict[str, list[Found]] = {n: [] for n in networks}
    for done, found in enumerate(in_order(task, range(len(data)), workers, start), 1):
        for network, one in found.items():
            out[network].append(one)
        if progress is not None:
            progress(done, len(data))
    return out


def _digest(plan: DosePlan) -> str:
    what = [
        boxes_digest(),
        asdict(SETTINGS),
        [asdict(d) for d in plan.dose],
        plan.budgets,
        plan.starved,
        plan.many,
        plan.few,
    ]
    return hashlib.blake2b(json.dumps(what).encode(), digest_size=8).hexdigest()


def frame_of(
    plan: DosePlan,
    instrument: CarNetInstrument,
    data: Frames,
    f: int,
    key: tuple[int, int],
    settings: Settings = SETTINGS,
) -> Found:
    """One frame under every dose: the results of `evaluate` with the network tuned to each, in a fraction of the time."""
    drones, geometry = data.est_pose.shape[1], instrument.geometry
    # doses that differ in nothing that a condition sees are computed once: by what is exchanged, under which tunings
    needed: dict[Sharing, dict[Tuning, None]] = {}
    for dose in plan.dose:
        for c in plan.conditions(dose):
            exchanged, tuning = _computed_as(dose, c.plain(drones))
            needed.setdefault(exchanged, {})[tuning] = None
    view = instrument.look(data, f)
    dosed = DoseView(view, [_tuning(d) for d in plan.dose])
    given = exchanges(view, data, f, key, tuple(needed), settings, geometry, None)
    local: list[NDArray[np.float64]] = []
    at: dict[tuple[Sharing, Tuning], slice] = {}
    for n, (exchanged, tunings) in enumerate(needed.items()):
        these = [e for e, _ in given[n * settings.egos : (n + 1) * settings.egos]]
        alone = exchanged == SINGLE
        under = (
            dict.fromkeys(tunings, view.detect(these, settings.floor))
            if alone
            else dosed.detect(these, list(tunings), settings.floor)
        )
        for tuning, boxes in under.items():
            at[exchanged, tuning] = slice(len(local), len(local) + settings.egos)
            local += boxes
    there = [truth(data, f, ego, geometry) for ego in range(settings.egos)]
    ego_of = np.tile(np.arange(settings.egos), len(at))
    units = match_all(local, ego_of, data.est_pose[f], there, {"full": None}, settings)["full"]
    cost = {
        c: [(sum(count), *link_bytes(count)) for _, count in given[n * settings.egos : (n + 1) * settings.egos]]
        for n, c in enumerate(needed)
    }
    results = {}
    for dose in plan.dose:
        wanted = dict.fromkeys(c.plain(drones) for c in plan.conditions(dose))
        results[dose.label] = FrameResult(
            (np.nan, np.nan),
            {(c.label, "full"): units[at[_computed_as(dose, c)]] for c in wanted},
            {c.label: cost[_computed_as(dose, c)[0]] for c in wanted},
        )
    cells = [cells_with_cars(data, f, ego, geometry, instrument.fused_cells) for ego in range(drones)]
    weights = {d.label: dosed.weight_on_zeros(_tuning(d), cells) for d in plan.dose}
    return results, weights


def _tuning(dose: Dose) -> Tuning:
    return Tuning(dose.temperature, dose.silent_weight, dose.unsent)


def _computed_as(dose: Dose, plain: Sharing) -> tuple[Sharing, Tuning]:
    """What is exchanged under a condition, and under which tuning; a drone alone does not depend on the dose."""
    if plain == SINGLE:
        return SINGLE, Tuning(1.0, 0.0, "zero")
    return replace(plain, unsent="zero"), _tuning(dose)


def frames_of(ranges: Sequence[FrameRange], root: Path, tell: Progress) -> Frames:
    """The frames of these ranges, one after the other."""
    scenes, _ = SIZES["test"]  # a scene has one frame
    files: list[Path] = []
    for r in ranges:
        if not 0 <= r.first <= r.last < scenes:
            raise InputError(f"frames {r.first} to {r.last} of benchmark {r.bench_seed}: must lie in 0 to {scenes - 1}")
        render, which = partial(tell, f"rendering benchmark {r.bench_seed}"), range(r.first, r.last + 1)
        files += make_split(Benchmark(seed=r.bench_seed), "test", root, scenes=which, progress=render)
    return load_frames(files)


def cells_with_cars(data: Frames, f: int, ego: int, geometry: Geometry, n: int = CELLS) -> NDArray[np.int64]:
    """The cell (row by row, of n × n) of each car in an ego's square, [cars]."""
    cars, pose = truth(data, f, ego, geometry).table(), data.true_pose[f, ego]
    at = np.stack(to_local(cars[:, 0], cars[:, 1], pose))
    cell_m = 2 * geometry.half_extent_m / n
    row, column = np.clip((at + geometry.half_extent_m) // cell_m, 0, n - 1).astype(np.int64)
    out: NDArray[np.int64] = row * n + column
    return out
