"""The worked policy against the paper's decision table, row by row and at its thresholds."""

from __future__ import annotations

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue.deputies import deputies
from sortie.policies.catalogue.worked import worked
from sortie.policies.checks import check_directives
from sortie.policies.contract import (
    Directive,
    Disc,
    FleetView,
    LinkState,
    Policy,
    PolicyError,
    Representation,
    TaskPhase,
)
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.registry import parameters, resolve
from sortie.scenarios.link_state import SILENT_MBPS


def to_peer_1(view: FleetView) -> Directive:
    return next(d for d in worked(view) if d.destination == 1)


@pytest.mark.parametrize(
    ("soc", "rung", "rate_hz"),
    [
        (1.0, Representation.FEATURES, 10.0),
        (0.60, Representation.FEATURES, 10.0),
        (0.599, Representation.FEATURES, 5.0),
        (0.30, Representation.FEATURES, 5.0),
        (0.299, Representation.DETECTIONS, 2.0),
        (0.0, Representation.DETECTIONS, 2.0),
    ],
)
def test_battery_picks_rung_and_rate(soc: float, rung: Representation, rate_hz: float) -> None:
    d = to_peer_1(fleet_of(5, soc=soc))
    assert (d.representation, d.rate_hz) == (rung, rate_hz)
    assert "battery" in d.reason


@pytest.mark.parametrize(("goodput", "rung"), [(5.0, Representation.FEATURES), (4.99, Representation.DETECTIONS)])
def test_a_weak_link_carries_detections(goodput: float, rung: Representation) -> None:
    d = to_peer_1(fleet_of(5, goodput=goodput))
    assert d.representation == rung
    assert d.rate_hz == (10.0 if rung == Representation.FEATURES else 2.0)


@pytest.mark.parametrize(
    ("goodput", "state", "reason"),
    [
        (0.0, LinkState.UNKNOWN, "goodput not measured yet"),
        (SILENT_MBPS, LinkState.SILENT, "goodput: link silent, nothing got through"),
        (3.14, LinkState.MEASURED, "goodput 3.1 < 5 Mb/s"),
    ],
)
@pytest.mark.parametrize("policy", [worked, deputies])
def test_a_reason_says_what_is_known_of_the_link(policy: Policy, goodput: float, state: LinkState, reason: str) -> None:
    view = fleet_of(5, goodput=goodput)
    assert view.me is not None
    assert view.me.link_state(1) == state
    (d,) = [d for d in policy(view) if d.destination == 1]
    assert d.reason.endswith(reason)
    assert (d.representation, d.rate_hz) == (Representation.DETECTIONS, 2.0), "the paper's line for less than 5 Mb/s"


def test_a_weak_link_never_raises_the_rate() -> None:
    assert to_peer_1(fleet_of(5, soc=0.1, goodput=1.0)).rate_hz == 2.0


def test_tracking_confines_to_the_region() -> None:
    assert to_peer_1(fleet_of(5)).roi is None
    assert to_peer_1(fleet_of(5, phase=TaskPhase.TRACK)).roi == Disc(0, 0, 32)


def test_only_the_two_most_overlapping_peers_get_anything() -> None:
    sent = {d.destination: d.representation != Representation.NONE for d in worked(fleet_of(5))}
    assert sent == {1: True, 2: True, 3: False, 4: False}


def test_jitter_of_a_metre_does_not_reorder_peers() -> None:
    view = fleet_of(5)
    near = dict(view.descriptors)
    near[3] = near[3]._replace(position_m=(15.0, 0.5, 60.0))
    near[2] = near[2]._replace(position_m=(15.5, 0.0, 60.0))
    sent = [d.destination for d in worked(FleetView(0, 0.1, near, view.age_s)) if d.rate_hz]
    assert sent == [1, 2], "overlaps within a step tie, and ties go round by id"


def test_drones_in_one_place_do_not_all_choose_the_same_peers() -> None:
    view = fleet_of(5)
    here = {i: d._replace(position_m=(0.0, 0.0, 60.0)) for i, d in view.descriptors.items()}
    chosen = {i: peers_by_overlap(FleetView(i, 0.1, here, view.age_s))[:2] for i in here}
    assert chosen == {0: [1, 2], 1: [2, 3], 2: [3, 4], 3: [4, 0], 4: [0, 1]}


# --- the contract and the registry ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rho": 1.5}, r"directive 0→1: rho is 1.5, must be in \[0, 1\]"),
        ({"rho": float("nan")}, r"directive 0→1: rho is nan, must be in \[0, 1\]"),
        ({"rate_hz": -1.0}, r"directive 0→1: rate_hz is -1.0, must be in \[0, 30\]"),
        ({"source": 2}, r"directive 2→1: source is 2, must be the ego 0"),
        ({"destination": 9}, r"directive 0→9: destination 9 is not a peer in the view \[1, 2, 3, 4\]"),
        ({"destination": 0}, r"directive 0→0: destination 0 is not a peer"),
        ({"roi": Disc(0, 0, 0)}, r"directive 0→1: roi.radius_m is 0, must be > 0"),
        ({"duty_percent": 101}, r"directive 0→1: duty_percent is 101, must be in \[0, 100\]"),
    ],
)
def test_a_broken_directive_is_named(change: dict[str, object], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        check_directives([Directive(0, 1)._replace(**change)], fleet_of(5))


def test_two_directives_for_one_link_are_refused() -> None:
    with pytest.raises(PolicyError, match="directive 0→1: second directive for the same link"):
        check_directives([Directive(0, 1), Directive(0, 1)], fleet_of(5))


def test_something_else_than_a_directive_is_refused() -> None:
    with pytest.raises(PolicyError, match="a policy returns Directive, got str"):
        check_directives(["all"], fleet_of(5))  # type: ignore[list-item]


def test_registry_errors_name_what_there_is(tmp_path) -> None:
    with pytest.raises(PolicyError, match=r"unknown policy 'best', did you mean best-2\? known: worked, all-4"):
        resolve("best")
    with pytest.raises(PolicyError, match="policy 'worked' has no parameter 'k', it has: rho"):
        resolve("worked", {"k": 3})
    with pytest.raises(PolicyError, match="not found"):
        resolve(f"{tmp_path}/none.py:decide")
    (tmp_path / "mine.py").write_text("def decide(view): return []\n")
    with pytest.raises(PolicyError, match="has no function 'decode'"):
        resolve(f"{tmp_path}/mine.py:decode")
    (tmp_path / "bad.py").write_text("def decide(view) return []\n")
    with pytest.raises(PolicyError, match="does not load: SyntaxError"):
        resolve(f"{tmp_path}/bad.py:decide")
    (tmp_path / "late.py").write_text("import math\n\nLEAST = math.sqrt(-1)\n")
    with pytest.raises(PolicyError, match=r"late.py' does not load: ValueError: .* \(late\.py, line 3\)$"):
        resolve(f"{tmp_path}/late.py:decide")
    with pytest.raises(PolicyError, match=r"mine.py' without its function, must be .*mine.py:function"):
        resolve(f"{tmp_path}/mine.py")
    assert list(resolve(f"{tmp_path}/mine.py:decide")(fleet_of(5))) == []


def test_parameters_are_the_keyword_only_arguments() -> None:
    assert parameters(worked) == {"rho": 1.0}
    assert to_peer_1(fleet_of(5)).rho == 1.0
    assert next(iter(resolve("worked", {"rho": 0.25})(fleet_of(5)))).rho == 0.25
