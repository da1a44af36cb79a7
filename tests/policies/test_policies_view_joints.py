"""What goes out of a view, a directive and a request whole: copies, equality, both axes, every flag, whose ranking.

1. A view that can be read only stays so in both mappings, and a copy of it has every field of its own.
2. A directive is the same whatever its reason says, also as a key.
3. Of a request both axes count, together and each from the drone's own place.
4. Peers of another receiver are ranked from that receiver on.
5. Each policy's parameters and what it takes from another policy.
"""

from __future__ import annotations

import copy
import json
import pickle
from functools import partial
from pathlib import Path

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue import adaptive
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around
from sortie.policies.catalogue.other_representations import codes, uncertain_boxes
from sortie.policies.catalogue.prior.where2comm import where2comm
from sortie.policies.catalogue.vantage import NEAR_M, over_region, vantage
from sortie.policies.catalogue.worked import worked
from sortie.policies.checks import check_reposition
from sortie.policies.contract import (
    PERSON_FLAG,
    Directive,
    Disc,
    FleetView,
    PolicyError,
    Reposition,
    Representation,
    TaskPhase,
)
from sortie.policies.damping import SAME_DISC_M, is_switch
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.registry import resolve, viewpoint_of, within_budget
from sortie.scenarios.plugins.user_calls import Guarded
from sortie.scenarios.plugins.user_code import imported_files

VIEW = fleet_of(4)


def _pickled(view: FleetView) -> FleetView:
    found: FleetView = pickle.loads(pickle.dumps(view))  # noqa: S301 - written a moment before
    return found


def _with(view: FleetView, drone: int, **fields: object) -> FleetView:
    descriptors = dict(view.descriptors)
    descriptors[drone] = descriptors[drone]._replace(**fields)
    return view._replace(descriptors=descriptors)


def test_a_frozen_view_is_read_only_throughout_and_a_copy_is_all_of_it() -> None:
    view = FleetView(2, 0.2, VIEW.descriptors, VIEW.age_s, 7.0)
    with pytest.raises(TypeError):
        view.frozen.descriptors[0] = VIEW.descriptors[1]  # type: ignore[index]
    with pytest.raises(TypeError):
        view.frozen.age_s[0] = 1.0  # type: ignore[index]
    for other in (_pickled(view.frozen), copy.deepcopy(view.frozen), copy.copy(view.frozen)):
        assert other == view
        assert (type(other.descriptors), type(other.age_s)) == (dict, dict)


def test_a_person_is_found_whatever_other_flags_are_set() -> None:
    tracked = fleet_of(3, phase=TaskPhase.TRACK)
    for flags in range(8):
        assert _with(tracked, 1, novelty_flags=flags).human_in_region == (flags & PERSON_FLAG > 0)


def test_a_directive_is_the_same_whatever_its_reason_says() -> None:
    a = Directive(0, 1, Representation.FEATURES, 0.5, rate_hz=5.0, reason="one")
    b = a._replace(reason="other")
    assert a == b
    assert (a != b) is False
    assert hash(a) == hash(b)
    assert {a: 1}[b] == 1
    assert a != a._replace(duty_percent=99)
    assert a != tuple(a)


def test_a_request_is_as_far_as_both_axes_together_from_the_drone_itself() -> None:
    view = _with(VIEW, 0, position_m=(300.0, -500.0, 60.0))
    for x_m, y_m in ((120.0, 160.0), (-200.0, 0.0), (0.0, -200.0)):  # 200 m each
        check_reposition(Reposition(300.0 + x_m, -500.0 + y_m), view)
    for x_m, y_m in ((150.0, 150.0), (0.0, 201.0), (-201.0, 0.0), (0.0, 800.0)):
        with pytest.raises(PolicyError, match="must be at most 200 m"):
            check_reposition(Reposition(300.0 + x_m, -500.0 + y_m), view)


def test_peers_that_cover_as_much_are_ranked_from_the_receiver_on() -> None:
    together = VIEW._replace(
        ego=2, descriptors={i: d._replace(position_m=(0.0, 0.0, 60.0)) for i, d in VIEW.descriptors.items()}
    )
    for receiver in range(4):
        assert peers_by_overlap(together, receiver) == [(receiver + k) % 4 for k in (1, 2, 3)]
    assert peers_by_overlap(together) == [3, 0, 1]


def test_what_a_policy_takes_from_another_one_it_takes_with_its_own_parameters() -> None:
    for budget in (0.0, 0.1, 1.0):
        shares = [d.rho for d in everyone(VIEW, received_budget=budget)]
        assert [d.rho for d in codes(VIEW, received_budget=budget)] == shares
        assert [d.rho for d in vantage(VIEW, received_budget=budget)] == shares
        assert {d.representation for d in codes(VIEW, received_budget=budget)} == {Representation.CODES}
    wanted = [Directive(0, p, Representation.UNCERTAIN_BOXES, rate_hz=10.0) for p in VIEW.peers]
    assert uncertain_boxes(VIEW) == wanted


@pytest.mark.parametrize(("name", "usual"), [("disconet-style", 1.0), ("v2vnet-style", 1.0), ("where2comm-style", 1.0)])
def test_a_prior_method_sends_the_share_that_it_is_asked_for(name: str, usual: float) -> None:
    assert {d.rho for d in resolve(name)(VIEW)} == {usual}
    assert {d.rho for d in resolve(name, {"rho": 0.125})(VIEW)} == {0.125}


def test_where2comm_asks_for_one_cell_where_the_peer_lacks_nothing() -> None:
    grid = bytes([2, *[0] * 63])  # the south-west cell alone is seen well, by all alike
    view = VIEW._replace(
        descriptors={
            i: d._replace(coverage_grid=grid, position_m=(0.0, 0.0, 60.0)) for i, d in VIEW.descriptors.items()
        }
    )
    me = view.descriptors[0]
    assert {d.roi for d in where2comm(view, rounds=2)} == {disc_around(centre_cell(me))}
    assert {d.roi for d in where2comm(view, rounds=1)} == {disc_around(frozenset({(-8, -8)}))}


def test_vantage_moves_a_fleet_that_is_just_not_near() -> None:
    region = Disc(0.0, 0.0, 32.0)

    def asked(away_m: float) -> Reposition | None:
        fields = {"position_m": (away_m, 0.0, 60.0), "region": region, "task_phase": TaskPhase.TRACK}
        descriptors = {i: d._replace(**fields) for i, d in VIEW.descriptors.items()}
        return over_region(VIEW._replace(descriptors=descriptors))

    near, at, far = asked(NEAR_M - 0.5), asked(NEAR_M), asked(250.0)
    assert near is not None
    assert at is not None
    assert far is not None
    assert (near.x_m, at.x_m, far.x_m) == (NEAR_M - 0.5, 0.0, 150.0)


def test_the_few_who_get_maps_are_those_who_overlap_most() -> None:
    far = _with(VIEW, 1, position_m=(500.0, 0.0, 60.0))
    few = adaptive.spend(far, adaptive.Arm(2, True, True), 0.25, "why")
    assert {d.destination: d.representation for d in few} == {
        1: Representation.DETECTIONS,
        2: Representation.FEATURES,
        3: Representation.FEATURES,
    }
    none = adaptive.spend(far, adaptive.Arm(2, False, True), 0.25, "why")
    assert none[0].representation == Representation.NONE


def test_arms_are_counted_round_and_round() -> None:
    arms = len(adaptive.ARMS)
    answers = [adaptive.arm(VIEW, index=k, sent_budget=0.1) for k in range(arms)]
    assert answers[0] != answers[-1]
    for k in range(arms):
        assert adaptive.arm(VIEW, index=arms + k, sent_budget=0.1) == answers[k]
        assert answers[k] == adaptive.spend(VIEW, adaptive.ARMS[k], 0.1, "fixed arm")


@pytest.mark.parametrize(
    ("mean", "scale", "weights"),
    [
        ([0.0] * 4, [1.0] * 5, [[0.0] * 6] * 3),
        ([0.0] * 5, [1.0] * 6, [[0.0] * 6] * 3),
        ([0.0] * 5, [1.0] * 5, [[0.0] * 5] * 3),
        ([0.0] * 5, [1.0] * 5, [[0.0] * 6] * 2),
        ([0.0] * 5, [1.0] * 5, [[0.0] * 6] * 4),
        ([0.0] * 5, [float("nan")] * 5, [[0.0] * 6] * 3),
        ([0.0] * 5, [1.0] * 5, [[0.0] * 5 + [float("inf")]] * 3),
    ],
)
def test_a_model_of_other_shapes_or_without_numbers_is_refused(
    mean: list[float], scale: list[float], weights: list[list[float]], tmp_path: Path
) -> None:
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"mean": [0.0] * 5, "scale": [1.0] * 5, "weights": [[0.0] * 6] * 3}))
    assert adaptive.read_model(path).mean == (0.0,) * 5
    path.write_text(json.dumps({"mean": mean, "scale": scale, "weights": weights}))
    with pytest.raises(ValueError, match="must have 3 arms of 1"):
        adaptive.read_model(path)


def test_a_users_file_bounds_its_parameters_itself_and_is_found_with_what_it_imports(tmp_path: Path) -> None:
    (tmp_path / "limits_of_mine.py").write_text("MOST = 3\n")
    file = tmp_path / "mine.py"
    file.write_text(
        "import limits_of_mine\n"
        "import sortie\n"
        "def where(view, *, k=1):\n"
        "    return None if k < limits_of_mine.MOST else sortie.Reposition(float(k), 0.0)\n"
        "@sortie.looks_from(where)\n"
        "def decide(view, *, k=1, rho=0.5):\n"
        "    return []\n"
    )
    policy = resolve(f"{file}:decide", {"k": -5, "rho": 7.0})
    assert isinstance(policy, partial)
    assert policy.keywords == {"k": -5, "rho": 7.0}
    found = viewpoint_of(policy)
    assert isinstance(found, partial)
    assert found.keywords == {"k": -5}
    assert isinstance(found.func, Guarded)
    assert {path.name for path in imported_files(file)} == {"mine.py", "limits_of_mine.py"}
    with pytest.raises(PolicyError, match="rho is 7"):
        resolve("worked", {"rho": 7.0})


def test_a_budget_goes_to_the_parameter_that_a_policy_has() -> None:
    wanted = {"all-4": "received_budget", "best-2-receivers": "sent_budget", "worked": "rho"}
    for name, parameter in wanted.items():
        assert within_budget(resolve(name), 0.1) == {parameter: 0.1}
    assert within_budget(resolve("silence"), 0.1) == {}


def test_a_drone_that_does_not_know_itself_decides_nothing_even_of_who_is_gone() -> None:
    view = FleetView(9, 0.1, VIEW.descriptors, {0: 0.1, 1: 30.0, 2: 0.1, 3: 0.1})
    for policy in (worked, everyone, codes, where2comm, adaptive.adaptive):
        assert list(policy(view)) == []


def test_a_disc_that_moved_by_half_a_cell_is_another_one() -> None:
    a = Directive(0, 1, Representation.FEATURES, 0.5, Disc(0.0, 0.0, 32.0), 5.0)
    assert is_switch(a, a._replace(roi=Disc(SAME_DISC_M, 0.0, 32.0)))
    assert not is_switch(a, a._replace(roi=Disc(0.99 * SAME_DISC_M, 0.0, 32.0)))
