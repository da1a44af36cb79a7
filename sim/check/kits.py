"""The conformance kits of models from outside: what each kind is asked, and the rules of that kind alone.

A kit asks through the function by which a flight asks, so that a model meets the same checks and the same errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.fleet.energy.cell import own_cell_v
from sortie.fleet.flight.mobility import found_mobility, is_planner, positions_m
from sortie.fleet.flight.rotor import own_power_w
from sortie.fleet.sensor_faults import own_errors
from sortie.perception.detectors import make_detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture, Share
from sortie.policies.verification.kit.conformance import Check
from sortie.radio.channel.pathloss import free_space_loss_db
from sortie.radio.own_links import changed_snr, own_link, path_loss
from sortie.scenarios.plugins.reference import Params, resolve
from sortie.scenarios.reading.load import build
from sortie.scenarios.schema import Scene
from sortie.sim.check.model_rules import Rule, Subject, conform, plain
from sortie.sim.engine.own_metrics import own_metric
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results.record import SortieRecord

Array = NDArray[np.float64]
Cases = Mapping[str, Any]
Ask = Callable[[Any], Any]
FRAME_S = 0.1
CARRIER_GHZ = 5.2


class Kit(NamedTuple):
    """What one kind of model is asked."""

    load: Callable[[str, Params], Any]
    """From a reference and parameters to the model."""
    ask: Callable[[Any, Any], Any]
    """From the model and a case to the answer, by the checks that a flight does."""
    cases: Callable[[], Cases]
    rules: Callable[[Ask, Cases], Mapping[str, Rule]] = lambda ask, cases: {}
    """Those of this kind alone."""


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
    given = params or {}
    kit = KITS[kind]
    if kind == "mobility" and is_planner(found_mobility(reference, given)):
        kit = PLANNER

    def load() -> Subject:
        ask, cases = partial(kit.ask, kit.load(reference, given)), kit.cases()
        return Subject(ask, cases, kit.rules(ask, cases))

    return conform(load)


def _alone(ask: Ask, case: Any, parts: Iterable[Any], complaint: str) -> Rule:
    """The rule that each part of a case gets the same answer alone and among the others."""
    return lambda: _unequal(np.concatenate([ask(part) for part in parts], axis=-1), ask(case), complaint)


def _unequal(found: Any, wanted: Any, complaint: str, rtol: float = 1e-6) -> str | None:
    return None if np.allclose(found, wanted, rtol=rtol, atol=rtol, equal_nan=True) else complaint


# --- the radio -------------------------------------------------------------------------------------


def _lost_db(model: Any, ends: tuple[Array, Array, Array]) -> Array:
    return path_loss(model, *ends, CARRIER_GHZ, free_space_loss_db(np.maximum(ends[0], 1.0), CARRIER_GHZ))


def _links() -> Cases:
    rng = np.random.default_rng(1)
    far_m, heights_m = np.geomspace(0.1, 20_000.0, 60), rng.uniform(0.0, 300.0, (2, 60))
    at_m = rng.uniform(-200.0, 200.0, (20, 5, 3))
    square = np.linalg.norm(at_m[:, :, None] - at_m[:, None], axis=-1).reshape(20, 25)
    return {
        "one link": tuple(np.array(v) for v in (100.0, 60.0, 45.0)),
        "from 0.1 m to 20 km": (far_m, *heights_m),
        "on the ground": (far_m, np.zeros(60), np.zeros(60)),
        "distance 0": (np.zeros(3), np.full(3, 60.0), np.full(3, 60.0)),
        "frames by links": (square, *rng.uniform(30.0, 90.0, (2, 20, 25))),
        "no links": (np.empty(0), np.empty(0), np.empty(0)),
    }


def _rules_of_links(ask: Ask, cases: Cases) -> Mapping[str, Rule]:
    distance, a, b = many = cases["from 0.1 m to 20 km"]
    each = [tuple(v[[k]] for v in many) for k in range(len(distance))]
    turned = "another loss from the second end to the first"
    return {
        "links apart": _alone(ask, many, each, "the loss of a link depends on the other links of the same call"),
        "both directions alike": lambda: _unequal(ask((distance, b, a)), ask(many), turned),
    }


def _snr_db(make: Any, case: tuple[Array, Array], objects: int = 1) -> Array:
    """The SNR of every frame, by one object or by several that are used in turn."""
    at_m, snr_db = case
    models = [own_link(make, len(at_m[0]), FRAME_S, np.random.default_rng(3)) for _ in range(objects)]
    return np.array([[changed_snr(m, k * FRAME_S, at_m[k], snr_db[k]) for m in models] for k in range(len(at_m))])


def _drones_apart(drones: int, frames: int) -> tuple[Array, Array]:
    """The places of drones in each frame, and the SNR that the radio has computed for them."""
    rng = np.random.default_rng(drones)
    start_m, velocity_mps = rng.uniform(-150.0, 150.0, (drones, 3)), rng.uniform(-8.0, 8.0, (drones, 3))
    at_m = start_m + velocity_mps * (FRAME_S * np.arange(frames))[:, None, None]
    apart_m = np.linalg.norm(at_m[:, :, None] - at_m[:, None], axis=-1) + np.diag(np.full(drones, np.nan))
    return at_m, 75.0 - 20.0 * np.log10(apart_m) + rng.normal(scale=3.0, size=(drones, drones))


def _rules_of_objects(ask: Callable[..., Array], cases: Cases) -> Mapping[str, Rule]:
    case, complaint = cases["five drones"], "two objects made alike and used in turn disturb each other"
    return {"sorties apart": lambda: _unequal(ask(case, objects=2), ask(case), complaint, 0.0)}


# --- the fleet -------------------------------------------------------------------------------------


def _flight(velocity_mps: Any, mass_kg: Any, frames: int = 40) -> tuple[Array, Array, Array, Array]:
    velocity = np.broadcast_to(np.asarray(velocity_mps, float), (frames, len(mass_kg), 3)).copy()
    return velocity, np.zeros_like(velocity), velocity[..., 2].copy(), np.array(mass_kg, float)


def _flights() -> Cases:
    rng = np.random.default_rng(1)
    gusty = _flight(rng.normal(scale=6.0, size=(40, 3, 3)), [1.0, 2.0, 6.0])
    return {
        "hover": _flight((0.0, 0.0, 0.0), [2.0]),
        "30 m/s": _flight((30.0, 0.0, 0.0), [2.0]),
        "climb": _flight((0.0, 0.0, 5.0), [2.0]),
        "descent": _flight((0.0, 0.0, -5.0), [2.0]),
        "gusts and three masses": (gusty[0], rng.normal(scale=2.0, size=(40, 3, 3)), *gusty[2:]),
        "one frame": _flight((5.0, 0.0, 0.0), [2.0], 1),
    }


def _rules_of_drones(ask: Ask, cases: Cases) -> Mapping[str, Rule]:
    velocity, acceleration, climb, mass = many = cases["gusts and three masses"]
    each = [(velocity[:, [k]], acceleration[:, [k]], climb[:, [k]], mass[[k]]) for k in range(3)]
    return {"drones apart": _alone(ask, many, each, "a drone's power depends on the other drones")}


def _charges() -> Cases:
    return {"every charge": np.linspace(0.0, 1.0, 2001), "one charge": np.array([0.5]), "full": np.array([1.0])}


def _rules_of_charges(ask: Ask, cases: Cases) -> Mapping[str, Rule]:
    some = cases["every charge"][::100]
    return {"charges apart": _alone(ask, some, some[:, None], "a voltage depends on the other charges")}


def _straight(frames: int, frame_s: float, speed_mps: float) -> tuple[Array, Array]:
    times_s = frame_s * np.arange(frames, dtype=np.float64)
    return times_s, np.stack([speed_mps * times_s, np.zeros(frames), np.full(frames, 60.0)], axis=1)


def _starts(frames: int, frame_s: float, drones: int) -> tuple[Array, Array]:
    starts_m = np.stack([10.0 * np.arange(drones), np.zeros(drones), np.full(drones, 60.0)], axis=1)
    return frame_s * np.arange(frames, dtype=np.float64), starts_m


# --- perception ------------------------------------------------------------------------------------


def _load_detector(reference: str, params: Params) -> tuple[Any, Ask]:
    scene = SceneModel(Scene(), None, (-60.0, -60.0, 60.0, 60.0))
    sections = {"name": "verify", "perception": {"detector": reference, "detector_params": dict(params)}}
    detector: Any = make_detector(scene, build(sections).perception, 3)
    if detector is None:
        raise RunError(f"detector {reference!r} finds nothing, so nothing can be verified")
    return detector, getattr(detector, "begin", None) or detector.detect


def _found(model: tuple[Any, Ask], case: Any) -> list[Any]:
    """What a detector finds for jobs, or what it says of a single capture."""
    detector, detect = model
    found = case(detector) if callable(case) else detect(case)
    return list(found() if callable(found) else found)


def _capture(drone: int, t_s: float = 5.0, looked: bool = True) -> Capture:
    at_m = (20.0 * drone - 40.0, 10.0 * drone, 60.0)
    return Capture(drone, t_s, at_m, (0.0, 0.0, 0.0, 1.0), at_m, 0.0, looked)


def _share(drone: int, what: str, rho: float = 0.1, age_s: float = 0.0) -> Share:
    return Share(_capture(drone, 5.0 - age_s), what, rho, None, 0.9, age_s=age_s)


def _jobs() -> Cases:
    peers = (1, 2, 3)
    together = [(_capture(k), [_share(p, "features") for p in peers if p != k]) for k in range(4)]
    return {
        "alone": [(_capture(0), [])],
        "features": together[:1],
        "detections": [(_capture(0), [_share(p, "detections", 0.0) for p in peers])],
        "raw images": [(_capture(0), [_share(1, "raw", 0.0)])],
        "late shares": [(_capture(0), [_share(p, "features", 0.5, 0.4) for p in peers])],
        "no look of its own": [(_capture(0, looked=False), [_share(1, "features", 1.0)])],
        "four egos": together,
        "no egos": [],
        "truth": lambda detector: [detector.truth(5.0, _capture(0))],
        "boxes to send": lambda detector: [detector.count_boxes(_capture(0), roi) for roi in (None, (0.0, 0.0, 30.0))],
    }


def _rules_of_egos(ask: Ask, cases: Cases) -> Mapping[str, Rule]:
    egos = cases["four egos"]
    apart = "an ego's boxes depend on the other egos of the same call"
    order = "an ego's boxes depend on the order of the egos"
    return {
        "egos apart": lambda: None if plain([ask([ego])[0] for ego in egos]) == plain(ask(egos)) else apart,
        "order of egos": lambda: None if plain(ask(egos[::-1])[::-1]) == plain(ask(egos)) else order,
    }


def _fusion(name: str) -> Callable[..., Any]:
    """A function of `fusion_rules`, which is imported when it is called: torch takes a second."""
    return lambda *given: getattr(import_module("sortie.perception.network.fusion_rules"), name)(*given)


# --- the sortie ------------------------------------------------------------------------------------

SHORT = {"name": "verify", "duration_s": 3.0, "perception": {"detector": "none"}, "policy": {"name": "all-4"}}
_LOST = {"events": [{"kind": "drone_lost", "at_s": 1.0, "drone": 1}]}
_REGION = {"phase": "track", "region": {"centre_m": [0, 0], "radius_m": 32}}


def _flown(**changes: Any) -> SortieRecord:
    """A short sortie with every table that a record may have."""
    return run_sortie(build({**SHORT, "record": {"views": True, "beliefs": True}, **changes}))


def _event(reference: str, params: Params) -> tuple[str, Params]:
    resolve("event", reference, params)
    return reference, params


def _flown_with_event(model: tuple[str, Params], case: Cases) -> str:
    event = {"kind": "own", "at_s": 0.5, "model": model[0], "params": dict(model[1])}
    return _flown(**{**case, "events": [event | case["events"]]}).fingerprint


def _flown_by_planner(model: tuple[str, Params], case: Cases) -> str:
    fleet = {**case.get("fleet", {}), "mobility": model[0], "mobility_params": dict(model[1])}
    return _flown(**{**case, "fleet": fleet}).fingerprint


def _records() -> Cases:
    return {
        "traffic alone": _flown(),
        "with accuracy": _flown(perception={"detector": "surrogate"}),
        "one frame, two drones": _flown(duration_s=0.1, fleet={"drones": 2}),
        "a drone is lost": _flown(**_LOST),
    }


KITS: Mapping[str, Kit] = {
    "path_loss": Kit(partial(resolve, "path_loss"), _lost_db, _links, _rules_of_links),
    "link": Kit(
        partial(resolve, "link"),
        _snr_db,
        lambda: {
            "two drones": _drones_apart(2, 30),
            "five drones": _drones_apart(5, 100),
            "thirty drones": _drones_apart(30, 20),
            "one frame": _drones_apart(5, 1),
        },
        _rules_of_objects,
    ),
    "detector": Kit(_load_detector, _found, _jobs, _rules_of_egos),
    "fusion": Kit(
        _fusion("loaded"),
        lambda model, maps: model(*maps),
        _fusion("cases"),
        _fusion("rules"),
    ),
    "power": Kit(
        partial(resolve, "power"), lambda model, flight: own_power_w(model, *flight), _flights, _rules_of_drones
    ),
    "cell": Kit(partial(resolve, "cell"), own_cell_v, _charges, _rules_of_charges),
    "sensor": Kit(
        partial(resolve, "sensor"),
        lambda model, case: own_errors(model, case[0], case[1], np.random.default_rng(3)),
        lambda: {
            "hover": _straight(300, 0.1, 0.0),
            "8 m/s": _straight(300, 0.1, 8.0),
            "20 Hz": _straight(100, 0.05, 8.0),
            "one frame": _straight(1, 0.1, 0.0),
        },
    ),
    "mobility": Kit(
        found_mobility,
        lambda model, case: positions_m(model, case[0], case[1], np.random.default_rng(3)),
        lambda: {
            "one drone": _starts(300, 0.1, 1),
            "five drones": _starts(300, 0.1, 5),
            "20 Hz": _starts(300, 0.05, 2),
            "three frames": _starts(3, 0.1, 1),
        },
    ),
    "event": Kit(
        _event,
        _flown_with_event,
        lambda: {
            "from 0.5 s to the end": {"events": {}},
            "from 0.5 s to 2 s": {"events": {"until_s": 2.0}},
            "two drones": {"events": {"until_s": 2.0}, "fleet": {"drones": 2}},
        },
    ),
    "metric": Kit(
        lambda reference, params: partial(own_metric, reference, resolve("metric", reference, params)),
        lambda metric, record: metric(record),
        _records,
    ),
}
"""By kind; policies have a kit of their own (`sortie.policies.verification`)."""

PLANNER = Kit(
    lambda reference, params: (reference, params),
    _flown_by_planner,
    lambda: {
        "no region": {},
        "a region": {"mission": {"phases": [_REGION]}},
        "alone": {"fleet": {"drones": 1}},
        "a drone is lost": _LOST,
    },
)
"""Of a mobility that is a planner: it reads views, so it flies."""
