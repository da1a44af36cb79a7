"""What sharing is worth with the fine network, beside the coarse one (`make figures FIGURE=fine_network`).

The plan, committed before any of these frames and flights was looked at; until then only the validation split of benchmark
seed 0 was, by training's own card:

- Frames. The test split of benchmark seed 8, 120 scenes with one fleet-frame of five egos each; its layouts occur in no
  training. Intervals over scenes. Both shipped networks, each with its own box errors and codebook.
- Ways to share. Silence, averaged detections, features at four shares of the cells, codes of 10 B (`representations.py`).
- Poses. For the fine network both whole maps and averaged detections once more, with the poses of all five drones corrected
  by what they see (`sortie.perception.pose_matching`), from the boxes of each drone alone.
- Other fleets. 60 scenes of seed 7's test layouts as they are, with all drones 45 m up, and with headings that differ by 45°
  (standard deviation): AP alone and sharing all (`difficulty_effects.py`).
- Flights. `track_target` for 16 s, scored once a second, in eight towns, 71 … 78, with as many seeds: `silence`, `boxes`, and `all-4`, which
  sends all peers what the channel carries of whole maps; for the fine network the last two with `match_poses` as well. AP of
  the full scene; the unit is the flight (`make figures FIGURE=fine_flights`).
- Time. One ego with four whole maps: encoder, spreading, fusion and head, both networks in turn, thirty times. And one flight
  of 24 s under `all-4`, scored twice a second.

Expected of the fine network: sharing all reaches an AP of 0.65 and a drone alone 0.35;
whole maps beat averaged boxes by 3 points; corrected poses add 2 points to whole maps, and raise the AP of `boxes` and `all-4` in
flight; 45 m and 45° cost at most 8 points; in flight `all-4` has twice the AP of
`silence`; it takes at most 1.5 times as long as the coarse network, and a flight scored twice a second is faster than real time.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from research.benchmark.dataset import Benchmark, Frames, load_frames, make_split
from research.benchmark.survey import survey
from research.paper.difficulty_effects import SEED, Effect, ParameterShift, moves
from research.paper.difficulty_effects import measure as difficulty_effects
from research.train.boxes_alone import boxes_alone
from research.validation import representations
from research.validation.representations import TAU, Row, difference
from research.validation.stored import Column, Table
from sortie.perception.geometry import CELLS
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.detector import named_weights
from sortie.perception.network.fused import Peer, fused_map
from sortie.perception.network.inference import folded
from sortie.perception.network.memory import keep_freed
from sortie.perception.pose_matching import matched_poses, sure
from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

NETWORKS = {
    name: named_weights(Path(f"{file}.safetensors")) for name, file in (("coarse", "disconet"), ("fine", "fine"))
}
BENCH_SEED, SCENES = 8, 120
RHO, CODE_BYTES = (0.02, 0.05, 0.25, 1.0), (10,)
LEFT_OUT = ("tracks", "detections, suppressed", "uncertain boxes", "uncertain boxes, anything in common", "raw images")
OTHER_FLEETS = (("as it is", ""), ("altitude_m", "45 m"), ("yaw_sigma_deg", "45°"))
FLEET_SCENES = 60
TOWNS = range(71, 79)
POLICIES = ("silence", "boxes", "all-4")
SHORT = ("duration_s=16", "perception.sample_rate_hz=1")
REPEATS = 30
WHOLE, BOXES, SILENCE = "features, ρ = 1", "detections, averaged", "silence"


def ways(root: Path) -> Table:
    """What each way to share is worth, by network."""
    frames = load_frames(make_split(Benchmark(BENCH_SEED), "test", root, scenes=SCENES))
    rows: list[list[object]] = []
    for name, weights in NETWORKS.items():
        found = [r for r in representations.measure(frames, weights, RHO, CODE_BYTES) if r.way.label not in LEFT_OUT]
        rows += [_way(name, r, found) for r in found]
        if name == "fine":
            matched = representations.measure(with_matched_poses(frames, weights), weights, (1.0,), ())
            names = {f"{label}, corrected poses": r for r in matched if (label := r.way.label) in (WHOLE, BOXES)}
            more = [replace(r, way=replace(r.way, label=label)) for label, r in names.items()]
            rows += [_way(name, r, [*found, *more]) for r in more]
    columns = [Column("network"), Column("shared"), Column("an ego receives in a frame", ",.2f", " kB"), Column("AP@0.5", ".3f")]  # fmt: skip
    columns += [Column(f"over {other}", "+.1f", factor=100) for other in ("silence", "averaged boxes, estimated poses")]
    about = (
        f"{len(frames)} frames of the test split of benchmark seed {BENCH_SEED}, five egos each; intervals over scenes."
    )
    return Table(columns, rows, about)  # type: ignore[arg-type]


def with_matched_poses(frames: Frames, weights: Path) -> Frames:
    """The frames, in which drones believe the poses that fit to what all of them see."""
    alone = boxes_alone(load_weights(weights), frames, TAU)
    pairs = zip(frames.est_pose, alone, strict=True)
    return replace(frames, est_pose=np.stack([matched_poses(p, [sure(b).xy_m for b in boxes]) for p, boxes in pairs]))


def _way(network: str, row: Row, rows: Sequence[Row]) -> list[object]:
    label = row.way.label
    over = [None if label == other else difference(rows, label, other) for other in (SILENCE, BOXES)]
    return [network, _named(label), row.kilobytes, (row.ap, row.low, row.high), *over]


def _named(label: str) -> str:
    """A way by the names of the page's other tables."""
    return label.replace("features", "maps").replace("detections, averaged", "averaged boxes")


def other_fleets(store: Path) -> Table:
    """Sharing all, lower and with other headings, and which cars any of five drones can see.

    Args: `store`, folder of finished scenes.
    """
    chosen = [m for m in moves() if (m.parameter, m.value) in OTHER_FLEETS]
    seen = [_seen(move) for move in chosen]
    rows: list[list[object]] = []
    for name, weights in NETWORKS.items():
        found = difficulty_effects(weights, store, scenes=FLEET_SCENES, workers=2, rows=chosen)
        rows += [[name, *_fleet(effect), share] for effect, share in zip(found, seen, strict=True)]
    columns = [Column("network"), Column("parameter"), Column("moved to"), *(Column(n, ".3f") for n in ("AP alone", "AP sharing all"))]  # fmt: skip
    columns += [Column("change, points", "+.1f", factor=100), Column("cars that any drone sees", ".0f", " %", 100)]
    about = f"{FLEET_SCENES} scenes of seed {SEED}'s test layouts, one fleet-frame of five egos each. Change: of AP sharing all against the network's first row, paired by scene."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def _fleet(effect: Effect) -> list[object]:
    change = None if effect.change is None else (effect.change.delta, effect.change.low, effect.change.high)
    return [effect.move.parameter, effect.move.value, effect.gain.ap_a, effect.gain.ap_b, change]


def _seen(move: ParameterShift) -> float:
    """The share of cars that any of five drones sees, by straight lines."""
    counts = [survey(Benchmark(SEED, move.difficulty), "test", k) for k in range(FLEET_SCENES)]
    return float(np.average([c.fleet for c in counts], weights=[c.cars for c in counts]))


def flights() -> Table:
    """AP of the full scene in flight."""
    rows: list[list[object]] = []
    for name, weights in NETWORKS.items():
        ap = {policy: flown(weights, policy) for policy in POLICIES}
        if name == "fine":
            ap |= {f"{p}, corrected poses": flown(weights, p, "perception.match_poses=true") for p in POLICIES[1:]}
        for label, each in ap.items():
            over = [
                None if label == other or other is None else _gain(each, ap[other])
                for other in ("silence", _plain(label))
            ]
            rows.append([name, label, _interval(each), *over])
    columns = [Column("network"), Column("policy"), Column("AP of the full scene", ".3f")]
    columns += [Column(f"over {other}", "+.1f", factor=100) for other in ("silence", "the same, estimated poses")]
    about = f"`track_target` for 16 s, scored once a second; towns and seeds {TOWNS[0]} to {TOWNS[-1]}; intervals over flights."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def _plain(label: str) -> str | None:
    """The policy of a row with matched poses."""
    policy, matched, _ = label.partition(", corrected poses")
    return policy if matched else None


def flown(weights: Path, policy: str, *more: str) -> list[float]:
    """AP of the full scene of each flight."""
    ap = []
    for town in TOWNS:
        changes = [*SHORT, f"perception.weights={weights}", f"perception.scene.seed={town}", *more]
        ap.append(float(outcome(run_sortie(load("track_target", changes), policy, town))["ap50"]["full_scene"]))
    return ap


def _gain(ap: Sequence[float], over: Sequence[float]) -> tuple[float, float, float]:
    return _interval(np.subtract(ap, over).tolist())


def _interval(values: Sequence[float]) -> tuple[float, float, float]:
    found = mean_interval(values)
    return found.mean, found.low, found.high


def draw(table: Table, path: Path) -> None:
    """AP over the bytes that an ego receives, by network, from the table of `ways`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    for network, colour in (("coarse", "#7a7d85"), ("fine", "#1d6f80")):
        rows = {str(label): (kilobytes, ap) for name, label, kilobytes, ap, *_ in table.rows if name == network}
        axes.axhline(rows[SILENCE][1][0], color=colour, lw=1, ls=":", label=f"{network}: silence")
        for kind, marker in (("maps", "o"), ("codes of 10 B", "^"), (_named(BOXES), "s")):
            chosen = [v for label, v in rows.items() if label.startswith(kind) and "poses" not in label]
            x, (ap, low, high) = [v[0] for v in chosen], np.array([v[1] for v in chosen]).T
            label = f"{network}: {kind}"
            axes.errorbar(x, ap, yerr=[ap - low, high - ap], color=colour, marker=marker, capsize=2, label=label)
        for label, marker in ((_named(f"{BOXES}, corrected poses"), "D"), (_named(f"{WHOLE}, corrected poses"), "*")):
            if label in rows:
                x, (ap, low, high) = rows[label]
                style = {"color": "#d08a1d", "marker": marker, "ms": 9, "capsize": 2}
                axes.errorbar(x, ap, [[ap - low], [high - ap]], label=f"{network}: {label}", **style)
    axes.set_xscale("log")
    axes.set_xlabel("content that an ego receives in a frame from four peers, kB (logarithmic)")
    axes.set_ylabel("AP@0.5")
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, ncols=3, loc="outside lower center")
    figure.savefig(path, dpi=110)


@torch.inference_mode()
def forward_ms(repeats: int = REPEATS) -> dict[str, float]:
    """Median time of one ego's boxes from its picture and four whole maps, by network, taken in turn."""
    keep_freed()  # as in flight
    nets = {name: folded(load_weights(weights)) for name, weights in NETWORKS.items()}
    picture = torch.randint(0, 255, (1, 4, 256, 256), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    poses = [(0.0, 0.0, 0.1), (20.3, 1.2, 0.12), (-20.1, 1.4, 0.08), (1.0, 20.6, 0.11), (1.6, -19.4, 0.1)]
    sent = torch.ones(CELLS, CELLS, dtype=torch.bool)
    taken: dict[str, list[float]] = {name: [] for name in nets}
    for turn in range(repeats + 3):
        for name, net in nets.items():
            peers = [Peer(pose, 1.0, net.spread(net.encoder(picture))[0], sent) for pose in poses[1:]]
            begin = time.perf_counter()
            own = net.spread(net.encoder(picture))[0]
            fused = fused_map(net, poses[0], own, peers, "masked")
            assert fused is not None
            net.head(fused)
            if turn >= 3:  # warm
                taken[name].append(1e3 * (time.perf_counter() - begin))
    return {name: statistics.median(each) for name, each in taken.items()}


def times() -> Table:
    """`forward_ms` as a table, and how much faster than real time a flight is."""
    found = forward_ms()
    rows = [[name, ms, ms / found["coarse"], flight_speed(NETWORKS[name])] for name, ms in found.items()]
    columns = [Column("network"), Column("one ego and four maps", ".1f", " ms"), Column("times the coarse one", ".2f")]
    columns.append(Column("speed of a flight, simulated seconds a second", ".1f"))
    return Table(
        columns,
        rows,
        "Maps: medians of thirty. The flight: 24 s of `track_target` under `all-4`, scored twice a second.",
    )


def flight_speed(weights: Path) -> float:
    """Simulated over wall-clock seconds of one flight, its scene made before."""
    scenario = load("track_target", [f"perception.weights={weights}", "duration_s=24"])
    run_sortie(load("track_target", [f"perception.weights={weights}", "duration_s=1"]), "all-4", TOWNS[0])
    begin = time.perf_counter()
    run_sortie(scenario, "all-4", TOWNS[0])
    return scenario.duration_s / (time.perf_counter() - begin)


def tables(root: Path, picture: Path) -> dict[str, Table]:
    """AP on still frames. Args: `root`, folder of benchmarks; `picture`, file of the plot."""
    shared = ways(root)
    draw(shared, picture)
    return {"fine_ways": shared}
