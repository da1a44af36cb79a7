"""Which rule of `perception.join` has the higher AP in flights: suppression or averaging (`make figures FIGURE=join_rules`).

The plan, written before anything was flown:

- **Flights**: `track_target`'s fleet and radio, searching, 8 s, eight towns in four styles, a seed each. A flight is flown
  once under each rule, with the same random draws. AP@0.5 of the full scene, by the surrogate at 2 Hz. The last rows are
  scored by the torch detector at 0.5 Hz, on the traffic of the surrogate.
- **Cases**: every representation that is made of boxes; boxes beside maps (two networks in one fleet); and boxes with
  what may harm a mean: pose errors of one drone and of all, late boxes, weak links, a drone that lies, a clock that is
  off, a blind camera, trucks, two drones, ten drones.
- **Decision**: averaging becomes the default if its mean gain over suppression is positive with the whole 95 % interval
  in the first three rows and by the torch detector, and if no row has an interval that lies below zero. A row below zero
  is reported, and then the default stays.

Boxes with uncertainty are left out: receivers join them by covariance intersection under either rule.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from research.calibrate.in_flight import torch_answers
from research.validation.stored import Cell, Column, Table
from sortie.perception.detectors import make_detector
from sortie.policies.contract import Directive, FleetView, Policy, Representation, boxes_across_networks
from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import DetectorMaker, run_sortie
from sortie.sim.results.outcome import outcome

FIRST_TOWN, TOWNS = 7_100, 8
STYLES = ("town", "old_town", "suburb", "yard")
RULES = ("nms", "average")
BASE = (
    "expect=[]", "expect_decisions=[]", "perception.detector=surrogate", "duration_s=8", "mission.phases=[{at_s: 0, phase: search}]",
    "fleet.route.waypoints_m=[[-60, 0], [60, 0]]", "mission.target.waypoints_m=[[-60, -1.75], [200, -1.75]]",
)  # fmt: skip


def to_all(kind: Representation, rate_hz: float, view: FleetView, rho: float = 0.0) -> list[Directive]:
    """The same to every peer; a late payload is still fused."""
    return [Directive(view.ego, p, kind, rho, None, rate_hz, deadline_s=1.0, reason="to all") for p in view.peers]


boxes = partial(to_all, Representation.DETECTIONS, 10.0)
slow_boxes = partial(to_all, Representation.DETECTIONS, 2.0)
tracks = partial(to_all, Representation.TRACKS, 10.0)


@boxes_across_networks
def maps(view: FleetView) -> list[Directive]:
    """A tenth of the cells to every peer of the same network, boxes to the others."""
    return to_all(Representation.FEATURES, 10.0, view, rho=0.1)


@dataclass(frozen=True, slots=True)
class Case:
    """One row: a policy, and what its scenario changes."""

    name: str
    policy: Policy
    sets: tuple[str, ...] = ()
    by_torch: bool = False


def _event(kind: str, rest: str) -> tuple[str, ...]:
    return (f"events=[{{kind: {kind}, at_s: 0.5, {rest}}}]",)


LATE = ("perception.max_age_s=2",)
TWO_NETWORKS = ("fleet.makes=[{name: scout, drones: [3, 4], feature_space: scout}]",)
CASES = (
    Case("boxes", boxes),
    Case("tracks", tracks),
    Case("boxes at 2 Hz", slow_boxes, LATE),
    Case("maps in each of two networks, boxes between them", maps, TWO_NETWORKS),
    Case("boxes that leave 0.3 s late", boxes, (*LATE, "perception.compute_delay_s=0.3")),
    Case("one drone believes to be 3 m away", boxes, _event("position_fault", "drone: 1, offset_m: [2.1, -2.1, 0]")),
    Case("one heading is off by 5°", boxes, _event("heading_fault", "drone: 1, offset_deg: 5")),
    Case("all positions drift, 0.5 m after a second", boxes, _event("gnss_loss", "position_walk_m: 0.5")),
    Case("a clock is off by 0.2 s", boxes, _event("clock_skew", "drone: 1, skew_s: 0.2")),
    Case("a drone lies about its footprint", boxes, _event("lie", "drone: 1, about: coverage, claim: much")),
    Case("a blind camera", boxes, _event("camera_blocked", "drone: 1")),
    Case("weak links", boxes, ("radio.tx_power_dbm=3", "radio.path_loss_exponent=2.45")),
    Case("trucks among the cars", boxes, ("perception.scene.trucks=0.3",)),
    Case("two drones", boxes, ("fleet.drones=2",)),
    Case("ten drones", boxes, ("fleet.drones=10",)),
    Case("boxes, by torch", boxes, by_torch=True),
    Case(
        "one drone believes to be 3 m away, by torch", boxes,
        _event("position_fault", "drone: 1, offset_m: [2.1, -2.1, 0]"), by_torch=True,
    ),
)  # fmt: skip


def measure(cases: Sequence[Case] = CASES, towns: int = TOWNS) -> Iterator[list[Cell]]:
    """A row a case: its name, the AP under each rule, and the gain of averaging."""
    for case in cases:
        detector_of: DetectorMaker = torch_answers() if case.by_torch else make_detector
        ap = [[_ap(case, rule, town, detector_of) for town in range(towns)] for rule in RULES]
        gain = mean_interval([b - a for a, b in zip(*ap, strict=True)], SHARE.of_differences())
        yield [case.name, *(sum(its) / towns for its in ap), (gain.mean, gain.low, gain.high)]


def _ap(case: Case, rule: str, town: int, detector_of: DetectorMaker) -> float:
    scored = ("perception.sample_rate_hz=0.5",) if case.by_torch else ()
    there = (f"perception.scene.seed={FIRST_TOWN + town}", f"perception.scene.style={STYLES[town % len(STYLES)]}")
    scenario = load("track_target", [*BASE, *there, *case.sets, *scored, f"perception.join={rule}"])
    record = run_sortie(scenario, case.policy, FIRST_TOWN + town, detector_of=detector_of)
    return float(outcome(record)["ap50"]["full_scene"])


def table() -> Table:
    """Every case."""
    return Table(
        [
            Column("what is shared, or what is wrong"), Column("AP, suppressed", ".3f"), Column("AP, averaged", ".3f"),
            Column("averaged over suppressed", "+.1f", factor=100),
        ],
        list(measure()),
        f"{TOWNS} towns, a flight of 8 s in each under either rule; AP@0.5 of the full scene; gains in points, with intervals over towns.",
    )  # fmt: skip
