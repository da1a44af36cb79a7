"""The search's parts one by one: ranges that tile their axis, parts of a view, rosters, what is kept, what is outside.

1. The cells of a run tile the axis float by float, and the policy decides in each as on its ends.
2. A step that a float cannot hold is refused.
3. What stands for a mapping, flags, target ids and names answers as the real one, in every way that there is.
4. Every ego with every subset of the drones, once.
5. What is older, what is left without the detached, and what counts as a rise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import PERSON_FLAG, Directive, Disc, Representation, Roster, TaskPhase
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import WORDS, Scope
from sortie.policies.verification.kit.age_rule import older_views, raised_part, without_detached
from sortie.policies.verification.kit.single_view import PLANE, RepeatableView, check_property
from sortie.policies.verification.kit.views import from_json, to_json
from sortie.policies.verification.proof.proof import prove
from sortie.policies.verification.proof.ranges import FleetOfRanges
from sortie.policies.verification.proof.search import Run as OneRun
from sortie.policies.verification.proof.search import rosters
from sortie.policies.verification.proof.solver import solver_paths
from sortie.policies.verification.proof.symbols import Path as Run
from sortie.policies.verification.proof.symbols import Ranged, Refused, explore

DECIDERS: list[Callable[[Any], Any]] = [
    lambda x: x < 0.25,
    lambda x: x <= 0.25,
    lambda x: x > -1.5,
    lambda x: x >= 2,
    lambda x: x == 0.1,
    lambda x: x != 0,
    lambda x: x + 0.1 < 0.3,
    lambda x: 3 - x > 1.7,
    lambda x: x - 0.7 <= 0.1,
    lambda x: x * -3 >= 0.3,
    lambda x: x / 3 > 0.1,
    lambda x: x // 1 == -1,
    lambda x: x // 0.3 >= 2,
    lambda x: abs(x) < 0.5,
    lambda x: -x < 0.5,
    lambda x: (x < 1, x * 2 < 1, x < -1),
    lambda x: (x < 0.5) + (x < 0.25) + (x < 0.75) if x > 0.125 else -1,
    lambda x: x < math.nan,
    lambda x: not x,
    lambda x: (x + 1 < x + 1, x + 1 <= x + 1, x == x),
]


@pytest.mark.parametrize("decide", DECIDERS)
@pytest.mark.parametrize(("low", "high"), [(-2.0, 3.0), (0.0, 1.0), (-3, 4)])
def test_the_cells_tile_the_axis_and_decide_as_their_ends(decide: Callable[[Any], Any], low: Any, high: Any) -> None:
    cells = [(path.bounds("x", 0.0), found) for path, found in explore(lambda p: decide(_of(p, low, high)))]
    cells.sort(key=lambda cell: cell[0])
    assert cells
    assert cells[0][0][0] == low
    assert cells[-1][0][1] == high
    for ((_, end), _), ((begin, _), _) in itertools.pairwise(cells):
        assert begin == (end + 1 if isinstance(low, int) else math.nextafter(end, math.inf))
    for (a, b), found in cells:
        for x in (a, b):
            assert decide(x) == found


def _of(path: Run, low: Any, high: Any) -> Ranged:
    return path.number("x", low, high)


def test_a_range_of_one_number_counts_with_its_steps() -> None:
    def run(path: Run) -> Any:
        x, y = path.number("x", 0.0, 1.0), path.number("y", 0.0, 4.0)
        return y < x + 1 if x == 0.5 else None

    ends = {found: path.bounds("y", -1.0) for path, found in explore(run)}
    assert ends[True] == (0.0, math.nextafter(1.5, 0))
    assert ends[False] == (1.5, 4.0)
    assert ends[None] == (0.0, 4.0)


@pytest.mark.parametrize(
    "act",
    [
        lambda x: x * 1e308,
        lambda x: x * -1e308,
        lambda x: x - 1e308 - 1e308,
        math.sqrt,
        lambda x: x % 2,
        hash,
    ],
)
def test_what_no_float_can_hold_or_no_range_can_answer_is_refused(act: Callable[[Any], Any]) -> None:
    with pytest.raises(Refused):
        list(explore(lambda path: act(path.number("x", -1.0, 1e5))))


def _fleet(path: Run, drones: int = 3, ego: int = 0) -> FleetOfRanges:
    return FleetOfRanges(path, drones, ego, tuple(range(drones)), 0.1)


def test_a_mapping_is_seen_in_every_order_and_in_the_same_one_throughout() -> None:
    def run(path: Run) -> tuple[int, ...]:
        view = _fleet(path).view()
        seen = list(view.descriptors)
        assert list(reversed(view.descriptors)) == seen[::-1]
        assert [i for i, _ in view.age_s.items()] == seen
        return tuple(seen)

    assert [found for _, found in explore(run)] == list(itertools.permutations(range(3)))
    pair = {tuple(_fleet(Run([k]), 2).view().age_s) for k in (0, 1)}
    assert pair == {(0, 1), (1, 0)}


def test_flags_answer_for_the_bits_that_are_asked_for() -> None:
    found = {mask: sorted(f for _, f in explore(lambda p: _flags(p) & mask)) for mask in (4, 6, 0b1000_0001)}  # noqa: B023
    assert found == {4: [0, 4], 6: [0, 2, 4, 6], 0b1000_0001: [0, 1, 128, 129]}
    assert sorted(f for _, f in explore(lambda p: int(_flags(p)))) == list(range(256))


def _flags(path: Run) -> Any:
    return _fleet(path).view().descriptors[1].novelty_flags


def test_targets_are_counted_and_nothing_more() -> None:
    def targets(path: Run) -> Any:
        return _fleet(path).view().descriptors[1].priority_target_ids

    assert sorted(found for _, found in explore(lambda p: len(targets(p)))) == list(range(17))
    bounds = {found: path.bounds("targets of drone 1", 0) for path, found in explore(lambda p: bool(targets(p)))}
    assert bounds == {False: (0, 0), True: (1, 16)}
    with pytest.raises(Refused):
        list(explore(lambda p: targets(p)[0]))


def test_a_network_is_the_egos_or_another_whoever_is_asked_first() -> None:
    def run(path: Run) -> tuple[bool, ...]:
        d = _fleet(path, ego=1).view().descriptors
        same, codebook = d[0].feature_space == d[1].feature_space, d[1].codebook == d[0].codebook
        assert (d[1].feature_space == d[0].feature_space) == same
        assert (d[0].feature_space != d[1].feature_space) != same
        assert d[1].feature_space == d[1].feature_space
        example = _fleet(path, ego=1).example()
        assert example.shares_features_with(0) == same
        assert (example.descriptors[0].codebook == example.descriptors[1].codebook) == codebook
        return same, codebook

    assert sorted(found for _, found in explore(run)) == sorted(itertools.product([False, True], repeat=2))
    with pytest.raises(Refused):
        list(explore(lambda p: _fleet(p).view().descriptors[1].codebook == _fleet(p).view().descriptors[2].codebook))
    with pytest.raises(Refused):
        list(
            explore(lambda p: _fleet(p).view().descriptors[0].codebook == _fleet(p).view().descriptors[1].feature_space)
        )


def test_an_example_has_what_the_run_found() -> None:
    """Each field of each drone by itself: in the cell it is what made the run take its side."""

    def run(path: Run) -> Any:
        fleet = _fleet(path)
        d = fleet.view().descriptors
        answer = (
            d[1].battery_soc < 0.3, d[2].gpu_headroom > 0.9, d[0].goodput_to(2) < 5, d[2].goodput_to(0) < 7,
            d[1].region is None, d[0].region is None, d[2].task_phase == TaskPhase.LANDING,
        )  # fmt: skip
        plain = fleet.example().descriptors
        assert answer == (
            plain[1].battery_soc < 0.3, plain[2].gpu_headroom > 0.9, plain[0].goodput_to(2) < 5, plain[2].goodput_to(0) < 7,
            plain[1].region is None, plain[0].region is None, plain[2].task_phase == TaskPhase.LANDING,
        )  # fmt: skip
        assert plain[1].goodput_to(1) == d[1].goodput_to(1) == 0.0
        return answer

    assert len({found for _, found in explore(run)}) == 2**7
    highest = _fleet(Run([])).view().descriptors[1]
    for name, low, high in (("battery_soc", 0.0, 1.0), ("cpu_headroom", 0.0, 1.0)):
        number = getattr(highest, name)
        assert number._path.bounds(number._axis, 0.0) == (low, high)
    goodput = highest.goodput_to(0)
    assert goodput._path.bounds(goodput._axis, 0.0) == (0.0, 1e5)


@pytest.mark.parametrize("drones", [1, 2, 3, 4])
def test_every_ego_hears_every_subset_of_the_others_once(drones: int) -> None:
    found = list(rosters(drones))
    ids = range(drones)
    every = {(ego, s) for ego in ids for n in range(1, drones + 1) for s in itertools.combinations(ids, n) if ego in s}
    assert len(found) == len(set(found)) == drones * 2 ** (drones - 1)
    assert set(found) == every


# --- views by hand ------------------------------------------------------------------------------------

VIEW = fleet_of(3)._replace(period_s=0.2, age_s={0: 0.0, 1: 0.5, 2: 1.5})


def test_ages_are_raised_one_by_one_and_all_together_beyond_both_thresholds() -> None:
    found = [{i: age_s - VIEW.age_s[i] for i, age_s in v.age_s.items()} for v in older_views(VIEW)]
    assert found == [
        pytest.approx({i: add_s * (i in who) for i in range(3)})
        for add_s in (0.2, 0.7, 2.1, 200.0)
        for who in ((0,), (1,), (2,), (0, 1, 2))
    ]
    assert len(list(RepeatableView(VIEW).older())) == 16
    large = fleet_of(30)
    ages_s = [set(v.age_s.values()) for v in RepeatableView(large).older()]
    assert [len(of_all) for of_all in ages_s] == [1] * 4
    assert [min(of_all) for of_all in ages_s] == pytest.approx([0.2, 0.45, 1.15, 100.1])
    raised = {0: 0.0, 1: 9.0, 2: 1.5}
    assert next(RepeatableView(VIEW, raised).older()).age_s == raised


def test_without_the_detached_all_else_is_as_it_was() -> None:
    older = VIEW._replace(age_s={0: 0.0, 1: 5.0, 2: 1.9})
    left = without_detached(VIEW, older)
    assert (list(left.descriptors), left.age_s) == ([0, 2], {0: 0.0, 2: 1.5})
    assert without_detached(VIEW, VIEW) is VIEW


def _link(peer: int, rung: Representation, rho: float = 0.0, rate_hz: float = 2.0) -> Directive:
    return Directive(0, peer, rung, rho, rate_hz=rate_hz)


def test_what_counts_as_a_rise() -> None:
    none, boxes, maps = Representation.NONE, Representation.DETECTIONS, Representation.FEATURES
    assert raised_part([_link(1, boxes)], [_link(1, boxes)]) is None
    assert "representation rises" in str(raised_part([_link(1, boxes)], [_link(1, maps)]))
    assert "rho rises from 0.5 to 0.51" in str(raised_part([_link(1, maps, 0.5)], [_link(1, maps, 0.51)]))
    assert raised_part([_link(1, maps, 0.5)], [_link(1, boxes, 0.9)]) is None  # the share of another rung
    assert "rate_hz rises" in str(raised_part([_link(1, maps)], [_link(1, boxes, rate_hz=2.1)]))
    assert "none before" in str(raised_part([], [_link(1, boxes)]))
    plain = [Directive(0, 1, 5, rate_hz=2.0)], [Directive(0, 1, 3, rate_hz=2.0)]  # type: ignore[arg-type]
    assert "representation rises from 5 to 3" in str(raised_part(*plain))
    assert raised_part([], [_link(1, none)]) is None
    # higher than with the peer that is gone: a rise only if it is higher than without that peer too
    assert raised_part([_link(1, none)], [_link(1, boxes)], [_link(1, boxes)]) is None
    assert "0→1" in str(raised_part([_link(1, none)], [_link(1, maps)], [_link(1, boxes)]))
    assert "0→1" in str(raised_part([_link(1, none)], [_link(1, boxes)], [_link(2, boxes)]))


def test_every_word_reads_whose_it_is() -> None:
    d = VIEW.descriptors
    me = d[0]._replace(
        battery_soc=0.1, cpu_headroom=0.2, gpu_headroom=0.3, task_phase=TaskPhase.RETURN, peer_goodput_mbps=(11.0, 12.0),
        region=None, priority_target_ids=(5,), novelty_flags=PERSON_FLAG | 1, feature_space="a", codebook="c",
    )  # fmt: skip
    peer = d[1]._replace(
        battery_soc=0.4, cpu_headroom=0.5, gpu_headroom=0.6, task_phase=TaskPhase.LANDING, peer_goodput_mbps=(21.0, 22.0),
        region=Disc(0, 0, 5), novelty_flags=3, feature_space="a", codebook="d",
    )  # fmt: skip
    view = VIEW._replace(descriptors={0: me, 1: peer, 2: d[2]}, age_s={0: 0.0, 1: 0.5, 2: 2.1})
    link = Directive(0, 1, Representation.CODES, 0.25, None, 7.0, 0.5, 0.75, 40)
    scope = Scope(view, me, [link], {}, link)
    known = {name: word.value(scope) for name, word in WORDS.items()}
    assert known == {
        "battery": 0.1, "cpu": 0.2, "gpu": 0.3, "phase": TaskPhase.RETURN, "peers": 1, "region": False, "targets": True,
        "target_in_region": False, "human": True, "human_in_region": False, "goodput_mbps": 11.0, "age_s": 0.5,
        "age_periods": 2.5, "peer_battery": 0.4, "peer_human": False, "peer_phase": TaskPhase.LANDING, "same_network": True,
        "same_codebook": False, "representation": known["representation"], "rho": 0.25, "rate_hz": 7.0, "deadline_s": 0.5,
        "fusion_weight": 0.75, "duty": 0.4, "roi": False,
    }  # fmt: skip


def test_a_view_is_read_again_as_it_was_written() -> None:
    one = VIEW.descriptors[1]._replace(
        stamp_ns=123, orientation_xyzw=(0.1, 0.2, 0.3, 0.4), velocity_mps=(1.0, 2.0, 3.0), footprint_radius_m=41.5,
        battery_soc=0.1, cpu_headroom=0.2, gpu_headroom=0.3, coverage_grid=bytes(range(64)), novelty_flags=7,
        task_phase=TaskPhase.LANDING, region=Disc(1.5, -2.5, 3.5), priority_target_ids=(4, 5), feature_space="other",
        codebook="0" * 14, roster=Roster(6, (0, 1, 2)), peer_goodput_mbps=(1.25, 2.5),
    )  # fmt: skip
    period_s, detached = 0.1234567890123, 7.000000001
    view = VIEW._replace(
        ego=2, period_s=period_s, descriptors={**VIEW.descriptors, 1: one}, detached_after_periods=detached
    )
    assert from_json(to_json(view)) == view
    assert from_json(to_json(VIEW)) == VIEW


def _one(**fields: Any) -> Callable[[Any], list[Directive]]:
    return lambda view: [_link(1, Representation.DETECTIONS)._replace(**fields)]


def test_a_run_that_ranks_the_peers_of_several_drones_is_replayed_with_all_its_orders() -> None:
    asked = list[tuple[list[int], ...]]()

    def decide(view: Any) -> list[Directive]:
        asked.append(tuple(peers_by_overlap(view, i) for i in range(3)))
        return _one()(view)

    count = 0
    for _, found in explore(lambda p: OneRun(decide, _fleet(p))):
        found.compare()
        count += 1
    assert count == 2**3
    assert asked[::2] == asked[1::2]
    assert len(set(map(str, asked))) == count
    assert peers_by_overlap(VIEW, 0) == peers_by_overlap(VIEW.frozen, 0)


def test_raised_ages_begin_at_the_lowest_of_the_cell() -> None:
    path = Run([1])
    fleet = _fleet(path)
    assert not fleet.view().age_s[1] < 0.35
    assert fleet.raised_example() is None
    assert fleet.example().age_s[1] > 0.35
    assert fleet.older_view().age_s[1] >= 0.35
    assert fleet.example().age_s[1] == 0.35
    raised = fleet.raised_example()
    assert raised is not None
    assert raised == {0: 0.0, 1: 0.35, 2: 0.0}


def test_a_refuted_verdict_about_ages_has_the_ages_that_show_it(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import sortie\n"
        "def decide(view):\n"
        "    return [sortie.Directive(view.ego, p, 1, rate_hz=9.0 if 0.61 < view.age_s[p] < 0.62 else 2.0, reason='r')"
        " for p in view.peers]\n"
    )
    policy = resolve(f"{file}:decide")
    contract, monotone = prove(policy, max_drones=2, views=0, cells=200_000)
    assert (contract.outcome, monotone.outcome) == ("proved", "refuted")
    assert monotone.counterexample is not None
    assert monotone.raised_age_s is not None
    (peer,) = monotone.counterexample.peers
    assert 0.61 < monotone.raised_age_s[peer] < 0.62
    said = check_property(PLANE[1], policy, monotone.counterexample, monotone.raised_age_s)
    assert said == monotone.what
    assert "rate_hz rises from 2.0 to 9.0" in monotone.what


COMBINING: list[Callable[[Any, Any], Any]] = [
    lambda x, y: 1 - x < y,
    lambda x, y: x - 0.5 > y,
    lambda x, y: x * y > 0.25,
    lambda x, y: 2 / (x + 1) > 1.5,
    lambda x, y: x / (y + 1) >= 0.5,
    lambda x, y: abs(x - y) < 0.125,
    lambda x, y: -x >= y - 1,
    lambda x, y: (x < y, x <= y, x > y, x >= y, x == y, x != y),
    lambda x, y: (x <= math.inf, x < -math.inf, x > -math.inf, x >= math.inf, x == math.inf),
    lambda x, y: (x**2 < y, x + y > 1, x < 0.5),
]


@pytest.mark.parametrize("decide", COMBINING)
def test_a_solver_s_cells_decide_as_the_numbers_in_them(decide: Callable[[Any, Any], Any]) -> None:
    def run(path: Run) -> Any:
        return decide(path.number("x", 0.0, 1.0), path.number("y", 0.0, 1.0))

    found, grid = set(), [k / 8 for k in range(9)]
    for path, answer in explore(run, solver_paths()):
        x, y = path.bounds("x", 0.0)[0], path.bounds("y", 0.0)[0]
        assert 0 <= x <= 1
        assert 0 <= y <= 1
        assert decide(x, y) == answer
        found.add(answer)
    assert found >= {decide(x, y) for x in grid for y in grid}
