"""The conformance kits of models from outside: what each kind is asked, and the rules of that kind alone.

A kit asks through the function by which a flight asks, so that a model meets the same checks and the same errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.fleet.energy.cell import own_cell_v
from sortie.fleet.flight.mobility import found_mobility, is_planner, positions_m
from sortie.fleet.flight.rotor import own_power_w
from sortie.fleet.sensor_faults import own_errors
from sortie.perception.detectors import make_detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.policies.verification.kit.conformance import Check
from sortie.radio.channel.pathloss import free_space_loss_db
from sortie.radio.own_links import changed_snr, own_link, path_loss
from sortie.scenarios.plugins.reference import Params, resolve
from sortie.scenarios.reading.load import build
from sortie.scenarios.schema import Scene
from sortie.sim.check.model_rules import Subject, Witness, conform, plain
from sortie.sim.engine.own_metrics import own_metric
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results.record import SortieRecord

Array = NDArray[np.float64]
FRAME_S = 0.1
CARRIER_GHZ = 5.2


def verify(kind: str, reference: str, params: Params | None = None) -> list[Check]:
    """Run a kind's conformance kit on a model.

    Args:
        kind: a key of `KITS`.
        reference: an installed plug-in's name, or `path/to/file.py:Name`.
        params: keyword-only arguments of the model.

    Raises:
        RunError: no such kind.
        PluginError: the model is not there, does not load, or has no such parameter.
    """
    if kind not in KITS:
        raise RunError(f"no kind of model is called {kind!r}, must be policy, {', '.join(KITS)}")
    return conform(partial(KITS[kind], reference, params or {}))


# --- the radio -------------------------------------------------------------------------------------


def _path_loss(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    model: Any = Witness(resolve("path_loss", reference, params), changed)

    def ask(ends: tuple[Array, Array, Array]) -> Array:
        free_db = free_space_loss_db(np.maximum(ends[0], 1.0), CARRIER_GHZ)
        return path_loss(model, *ends, CARRIER_GHZ, free_db)

    rng = np.random.default_rng(1)
    far_m, heights_m = np.geomspace(0.1, 20_000.0, 60), rng.uniform(0.0, 300.0, (2, 60))
    at_m = rng.uniform(-200.0, 200.0, (20, 5, 3))
    square = np.linalg.norm(at_m[:, :, None] - at_m[:, None], axis=-1).reshape(20, 25)
    cases = {
        "one link": tuple(np.array(v) for v in (100.0, 60.0, 45.0)),
        "from 0.1 m to 20 km": (far_m, *heights_m),
        "on the ground": (far_m, np.zeros(60), np.zeros(60)),
        "distance 0": (np.zeros(3), np.full(3, 60.0), np.full(3, 60.0)),
        "frames by links": (square, *rng.uniform(30.0, 90.0, (2, 20, 25))),
        "no links": (np.empty(0), np.empty(0), np.empty(0)),
    }
    many = cases["from 0.1 m to 20 km"]

    def each_alone() -> str | None:
        alone = [float(ask(tuple(v[k] for v in many))) for k in range(len(far_m))]
        return _unequal(alone, ask(many), "the loss of a link depends on the other links of the same call", 1e-6)

    def both_ways() -> str | None:
        distance, a, b = many
        return _unequal(ask((distance, b, a)), ask(many), "another loss from the second end to the first", 1e-6)

    return Subject(ask, cases, {"links apart": each_alone, "both directions alike": both_ways}, changed)


def _link(reference: str, params: Params) -> Subject:
    make, changed = resolve("link", reference, params), list[str]()

    def begun(drones: int, seed: int = 3) -> Callable[[int], Array]:
        """A model under way: from a frame's number to its SNR."""
        model: Any = own_link(make, drones, FRAME_S, np.random.default_rng(seed))
        model.snr_db = Witness(model.snr_db, changed)
        rng = np.random.default_rng(drones)
        start_m, velocity_mps = rng.uniform(-150.0, 150.0, (drones, 3)), rng.uniform(-8.0, 8.0, (drones, 3))
        shadow_db = rng.normal(scale=3.0, size=(drones, drones))

        def frame(k: int) -> Array:
            at_m = start_m + velocity_mps * k * FRAME_S
            apart_m = np.linalg.norm(at_m[:, None] - at_m[None], axis=-1) + np.diag(np.full(drones, np.nan))
            return changed_snr(model, k * FRAME_S, at_m, 75.0 - 20.0 * np.log10(apart_m) + shadow_db)

        return frame

    def ask(case: tuple[int, int]) -> Array:
        drones, frames = case
        frame = begun(drones)
        return np.stack([frame(k) for k in range(frames)])

    def side_by_side() -> str | None:
        first, second = begun(5), begun(5)
        both = [(first(k), second(k)) for k in range(30)]
        return _unequal(
            [a for a, _ in both], ask((5, 30)), "two objects made alike and used in turn disturb each other"
        )

    cases = {"two drones": (2, 30), "five drones": (5, 100), "thirty drones": (30, 20), "one frame": (5, 1)}
    return Subject(ask, cases, {"sorties apart": side_by_side}, changed)


# --- the fleet -------------------------------------------------------------------------------------


def _power(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    model: Any = Witness(resolve("power", reference, params), changed)

    def ask(flight: tuple[Array, Array, Array, Array]) -> Array:
        return own_power_w(model, *flight)

    def flight(velocity_mps: Any, mass_kg: Any, frames: int = 40) -> tuple[Array, Array, Array, Array]:
        velocity = np.broadcast_to(np.asarray(velocity_mps, float), (frames, len(mass_kg), 3)).copy()
        return velocity, np.zeros_like(velocity), velocity[..., 2].copy(), np.array(mass_kg, float)

    rng = np.random.default_rng(1)
    gusty = flight(rng.normal(scale=6.0, size=(40, 3, 3)), [1.0, 2.0, 6.0])
    cases = {
        "hover": flight((0.0, 0.0, 0.0), [2.0]),
        "30 m/s": flight((30.0, 0.0, 0.0), [2.0]),
        "climb": flight((0.0, 0.0, 5.0), [2.0]),
        "descent": flight((0.0, 0.0, -5.0), [2.0]),
        "gusts and three masses": (gusty[0], rng.normal(scale=2.0, size=(40, 3, 3)), *gusty[2:]),
        "one frame": flight((5.0, 0.0, 0.0), [2.0], 1),
    }
    many = cases["gusts and three masses"]

    def each_alone() -> str | None:
        alone = [ask((many[0][:, [k]], many[1][:, [k]], many[2][:, [k]], many[3][[k]])) for k in range(3)]
        return _unequal(np.concatenate(alone, axis=1), ask(many), "a drone's power depends on the other drones", 1e-6)

    return Subject(ask, cases, {"drones apart": each_alone}, changed)


def _cell(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    model: Any = Witness(resolve("cell", reference, params), changed)

    def ask(soc: Array) -> Array:
        return own_cell_v(model, soc)

    cases = {"every charge": np.linspace(0.0, 1.0, 2001), "one charge": np.array([0.5]), "full": np.array([1.0])}

    def each_alone() -> str | None:
        soc = np.linspace(0.0, 1.0, 21)
        alone = np.concatenate([ask(soc[[k]]) for k in range(len(soc))])
        return _unequal(alone, ask(soc), "a voltage depends on the other charges", 1e-9)

    return Subject(ask, cases, {"charges apart": each_alone}, changed)


def _sensor(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    model: Any = Witness(resolve("sensor", reference, params), changed)

    def ask(case: tuple[int, float, float]) -> Array:
        frames, frame_s, speed_mps = case
        times_s = np.arange(frames, dtype=np.float64) * np.float64(frame_s)
        at_m = np.stack([speed_mps * times_s, np.zeros(frames), np.full(frames, 60.0)], axis=1)
        return own_errors(model, times_s, at_m, np.random.default_rng(3))

    cases = {"hover": (300, 0.1, 0.0), "8 m/s": (300, 0.1, 8.0), "20 Hz": (100, 0.05, 8.0), "one frame": (1, 0.1, 0.0)}
    return Subject(ask, cases, changed=changed)


def _mobility(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    model: Any = found_mobility(reference, params)
    if is_planner(model):
        return _planner(reference, params)
    model = Witness(model, changed)

    def ask(case: tuple[int, float, int]) -> Array:
        frames, frame_s, drones = case
        starts_m = np.stack([10.0 * np.arange(drones), np.zeros(drones), np.full(drones, 60.0)], axis=1)
        return positions_m(model, frame_s * np.arange(frames, dtype=np.float64), starts_m, np.random.default_rng(3))

    cases = {
        "one drone": (300, 0.1, 1),
        "five drones": (300, 0.1, 5),
        "20 Hz": (300, 0.05, 2),
        "three frames": (3, 0.1, 1),
    }
    return Subject(ask, cases, changed=changed)


def _planner(reference: str, params: Params) -> Subject:
    """A planner flies, since it reads views; its object is made anew for each flight."""

    def ask(case: Mapping[str, Any]) -> str:
        fleet = {**case.get("fleet", {}), "mobility": reference, "mobility_params": dict(params)}
        return _flown(**{**case, "fleet": fleet}).fingerprint

    region = {"phase": "track", "region": {"centre_m": [0, 0], "radius_m": 32}}
    cases = {
        "no region": {},
        "a region": {"mission": {"phases": [region]}},
        "alone": {"fleet": {"drones": 1}},
        "a drone is lost": {"events": [{"kind": "drone_lost", "at_s": 1.0, "drone": 1}]},
    }
    return Subject(ask, cases)


# --- perception ------------------------------------------------------------------------------------


def _detector(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    scene = SceneModel(Scene(), None, (-60.0, -60.0, 60.0, 60.0))
    sections = {"name": "verify", "perception": {"detector": reference, "detector_params": dict(params)}}
    detector: Any = make_detector(scene, build(sections).perception, 3)
    if detector is None:
        raise RunError(f"detector {reference!r} finds nothing, so nothing can be verified")
    detect = Witness(getattr(detector, "begin", None) or detector.detect, changed)

    def capture(drone: int, t_s: float = 5.0, looked: bool = True) -> Capture:
        at_m = (20.0 * drone - 40.0, 10.0 * drone, 60.0)
        return Capture(drone, t_s, at_m, (0.0, 0.0, 0.0, 1.0), at_m, 0.0, looked)

    def share(drone: int, what: str, rho: float = 0.1, age_s: float = 0.0) -> Share:
        return Share(capture(drone, 5.0 - age_s), what, rho, None, 0.9, age_s=age_s)

    def boxes(jobs: list[tuple[Capture, list[Share]]]) -> list[Boxes]:
        found = detect(jobs)
        return list(found() if callable(found) else found)

    def ask(case: Any) -> Any:
        if callable(case):
            return case()
        return boxes(case)

    peers = (1, 2, 3)
    together: list[tuple[Capture, list[Share]]] = [(capture(k), [share(p, "features") for p in peers if p != k]) for k in range(4)]  # fmt: skip
    cases = {
        "alone": [(capture(0), [])],
        "features": together[:1],
        "detections": [(capture(0), [share(p, "detections", 0.0) for p in peers])],
        "raw images": [(capture(0), [share(1, "raw", 0.0)])],
        "late shares": [(capture(0), [share(p, "features", 0.5, 0.4) for p in peers])],
        "no look of its own": [(capture(0, looked=False), [share(1, "features", 1.0)])],
        "four egos": together,
        "no egos": [],
        "truth": lambda: detector.truth(5.0, capture(0)),
        "boxes to send": lambda: [detector.count_boxes(capture(0), roi) for roi in (None, (0.0, 0.0, 30.0))],
    }

    def egos_apart() -> str | None:
        alone = [boxes([job])[0] for job in together]
        return (
            None
            if plain(alone) == plain(boxes(together))
            else "an ego's boxes depend on the other egos of the same call"
        )

    def order_of_egos() -> str | None:
        turned = boxes(together[::-1])[::-1]
        return None if plain(turned) == plain(boxes(together)) else "an ego's boxes depend on the order of the egos"

    return Subject(ask, cases, {"egos apart": egos_apart, "order of egos": order_of_egos}, changed)


def _fusion(reference: str, params: Params) -> Subject:
    from sortie.perception.network import fusion_rules as rules  # here: torch takes a second to import

    changed: list[str] = []
    fusion, cases = Witness(rules.loaded(reference, params), changed), rules.cases()

    def ask(maps: rules.Maps) -> Any:
        return fusion(*maps)

    return Subject(ask, cases, rules.rules(ask, cases), changed)


# --- the sortie ------------------------------------------------------------------------------------

SHORT = {"name": "verify", "duration_s": 3.0, "perception": {"detector": "none"}, "policy": {"name": "all-4"}}


def _flown(**changes: Any) -> SortieRecord:
    """A short sortie with every table that a record may have."""
    return run_sortie(build({**SHORT, "record": {"views": True, "beliefs": True}, **changes}))


def _event(reference: str, params: Params) -> Subject:
    resolve("event", reference, params)

    def ask(case: Mapping[str, Any]) -> str:
        event = {"kind": "own", "at_s": 0.5, "model": reference, "params": dict(params)}
        return _flown(**{**case, "events": [event | case["events"]]}).fingerprint

    cases = {
        "from 0.5 s to the end": {"events": {}},
        "from 0.5 s to 2 s": {"events": {"until_s": 2.0}},
        "two drones": {"events": {"until_s": 2.0}, "fleet": {"drones": 2}},
    }
    return Subject(ask, cases)


def _metric(reference: str, params: Params) -> Subject:
    changed: list[str] = []
    metric: Any = Witness(resolve("metric", reference, params), changed)

    def ask(record: SortieRecord) -> float | None:
        return own_metric(reference, metric, record)

    cases = {
        "traffic alone": _flown(),
        "with accuracy": _flown(perception={"detector": "surrogate"}),
        "one frame, two drones": _flown(duration_s=0.1, fleet={"drones": 2}),
        "a drone is lost": _flown(events=[{"kind": "drone_lost", "at_s": 1.0, "drone": 1}]),
    }
    return Subject(ask, cases, changed=changed)


KITS: Mapping[str, Callable[[str, Params], Subject]] = {
    "path_loss": _path_loss,
    "link": _link,
    "detector": _detector,
    "fusion": _fusion,
    "power": _power,
    "cell": _cell,
    "sensor": _sensor,
    "mobility": _mobility,
    "event": _event,
    "metric": _metric,
}
"""By kind; policies have a kit of their own (`sortie.policies.verification`)."""


def _unequal(found: Any, wanted: Any, complaint: str, rtol: float = 0.0) -> str | None:
    return None if np.allclose(found, wanted, rtol=rtol, atol=rtol, equal_nan=True) else complaint
