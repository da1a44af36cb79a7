"""Trust: it falls for who lies and comes back, and what coverage and goodput claims are held against."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from fleet_examples import DESCRIPTOR, grid_on_a_plain
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet import trust
from sortie.fleet.coverage import (
    View,
    pack_grid,
    placed,
    unpack_grid,
)
from sortie.fleet.lies import falsified
from sortie.fleet.messages.compact import Form, decode_compact, encode_compact
from sortie.fleet.standings import Standing
from sortie.fleet.trust import (
    Arrival,
    coverage_doubt,
    discounted,
    goodput_doubt,
    judge,
    split_arrivals,
)
from sortie.perception.geometry import Cameras
from sortie.policies.contract import (
    COVERAGE_CELL_M,
    Coverage,
    Descriptor,
    TaskPhase,
)


@cache
def grid_of(x_m: float, y_m: float) -> bytes:
    return grid_on_a_plain(x_m, y_m, 60.0)


def honest(drone: int, x_m: float = 0.0, y_m: float = 0.0, soc: float = 0.9, goodput: float = 100.0) -> Descriptor:
    """A drone at 60 m that says what it sees."""
    place, level, still, links = (x_m, y_m, 60.0), (0, 0, 0, 1), (0, 0, 0), (goodput,) * 4
    grid = grid_of(x_m, y_m)
    return Descriptor(0, drone, place, level, still, 42.0, soc, 1, 1, links, grid, 0, TaskPhase.SEARCH, None)


def charged(soc: Mapping[int, float]) -> dict[int, Descriptor]:
    """Drones 20 m apart with these charges."""
    return {i: honest(i, 20.0 * i, soc=its) for i, its in soc.items()}


def fleet(second: int, liar: Descriptor | None = None) -> dict[int, Descriptor]:
    """Five drones that lose 0.05 % a second, 20 m apart; drone 1 may be another."""
    drones = charged(dict.fromkeys(range(5), 0.9 - 0.0005 * second))
    return drones if liar is None else drones | {1: liar}


def doubted(seconds: int, known: Callable[[int], Mapping[int, Descriptor]], **of: Any) -> list[set[int]]:
    """Whom drone 0 doubts after each second, of those that it hears then."""
    standings: Mapping[int, Standing] = {}
    found = []
    for second in range(seconds):
        standings = judge(standings, 0, known(second), {}, **of)
        found.append({i for i, s in standings.items() if s.trust < 1.0})
    return found


def after(seconds: int, lie: tuple[str, str] | None = None, since: int = 0) -> dict[int, Standing]:
    """What drone 0 thinks after so many seconds, drone 1 lying from `since` on."""
    standings: dict[int, Standing] = {}
    for second in range(seconds):
        known = fleet(second)
        if lie is not None and second >= since:
            known[1] = falsified(known[1], *lie)  # type: ignore[arg-type]
        standings = judge(standings, 0, known, {1: [Arrival(160_000, 0.02, 600.0)]}, looking={1})
    return standings


def test_trust_falls_for_the_liar_alone() -> None:
    for lie in (None, ("coverage", "much"), ("coverage", "little"), ("goodput", "little")):
        trust = {i: s.trust for i, s in after(20, lie, since=5).items()}
        assert trust == {0: 1.0, 1: 1.0 if lie is None else 0.0, 2: 1.0, 3: 1.0, 4: 1.0}, lie


def test_a_false_battery_is_found_out() -> None:
    """Too much comes back at once; too little does not fall, which shows once the fleet lost half a percent."""
    for claim in ("much", "little"):
        found = after(40, ("battery", claim), since=5)[1]
        assert found.trust == 0.0
        assert found.reason.startswith("battery: ")
    assert after(8, ("battery", "little"), since=5)[1].trust == 1.0


def test_trust_takes_two_doubts_in_a_row_and_comes_back() -> None:
    assert [Standing(strikes=k).trust for k in range(7)] == [1.0, 1.0, 0.5, 0.25, 0.125, 0.0625, 0.0]
    lying = fleet(0) | {1: falsified(fleet(0)[1], "coverage", "much")}
    standings: dict[int, Standing] = {}
    seen = []
    for second in range(12):
        standings = judge(standings, 0, lying if second < 3 else fleet(second), {})
        seen.append(standings[1].trust)
    assert seen == [1.0, 0.5, 0.25, 0.5, *[1.0] * 8]


def test_nobody_doubts_itself() -> None:
    liar = falsified(honest(1), "coverage", "much")
    standings: dict[int, Standing] = {}
    for _ in range(5):
        standings = judge(standings, 1, fleet(0, liar), {})
    assert standings[1].trust == 1.0


def test_who_left_is_remembered_as_it_was() -> None:
    standings = after(20, ("coverage", "much"))
    gone = {i: d for i, d in fleet(20).items() if i != 1}
    assert judge(standings, 0, gone, {})[1] == standings[1]._replace(seconds=21, unheard=1)


def test_a_doubted_drone_stays_where_it_is_and_says_nothing() -> None:
    d = honest(3, 10.0, 20.0)
    small = discounted(d)
    assert (small.position_m, small.footprint_radius_m, small.agent_id) == (d.position_m, 42.0, 3)
    assert (set(small.coverage_grid), small.battery_soc, small.peer_goodput_mbps) == ({0}, 0.0, (0.0,) * 4)


def test_a_lie_changes_what_it_is_about_and_nothing_else() -> None:
    """Who claims to see nothing claims nothing new either; other flags stay."""
    fields = {
        "coverage": {"coverage_grid", "novelty_flags"},
        "goodput": {"peer_goodput_mbps"},
        "battery": {"battery_soc"},
    }
    for about, claim in product(fields, ("much", "little")):
        truth = DESCRIPTOR._replace(novelty_flags=0b111 if claim == "little" else 0b110)
        told = falsified(truth, about, claim)  # type: ignore[arg-type]
        assert {f for f in truth._fields if getattr(told, f) != getattr(truth, f)} == fields[about]
        if about == "coverage":
            assert told.novelty_flags == (0b110 if claim == "little" else 0b111)


# --- coverage ---------------------------------------------------------------------------------------------

metres = st.floats(-2000, 2000)


@given(
    metres, metres, st.floats(0, 2 * math.pi), st.floats(0, 12), st.floats(0, 1), st.floats(20, 120), st.floats(0, 28)
)
def test_an_honest_grid_is_never_doubted(
    x_m: float, y_m: float, heading: float, speed_mps: float, since_s: float, height_m: float, tilt_deg: float
) -> None:
    """A look of up to a second ago beside the pose of now, at any place, height, tilt and speed up to 12 m/s."""
    vx, vy = speed_mps * math.cos(heading), speed_mps * math.sin(heading)
    half = math.radians(tilt_deg) / 2
    tilted = (math.sin(half) * math.cos(heading), math.sin(half) * math.sin(heading), 0.0, math.cos(half))
    then = x_m - since_s * vx, y_m - since_s * vy
    row, column = (math.floor(v / COVERAGE_CELL_M) for v in reversed(then))
    d = honest(1)._replace(position_m=(x_m, y_m, height_m), velocity_mps=(vx, vy, 0.0), orientation_xyzw=tilted)
    here = d.coverage_corner
    seen = View(row - 8, column - 8, grid_on_a_plain(*then, height_m, tilted))
    assert coverage_doubt(d._replace(coverage_grid=placed(seen, *here)), looks=height_m < 100) == ""


def test_a_drone_that_does_not_look_may_see_nothing() -> None:
    """One that sends payloads of its own looks sees something."""
    blind = honest(1)._replace(coverage_grid=bytes(64))
    assert coverage_doubt(blind) == ""
    assert coverage_doubt(blind, looks=True) == "coverage: 0 cells seen by a drone that looks"
    x_m, y_m, _ = blind.position_m
    low, high = (blind._replace(position_m=(x_m, y_m, z_m)) for z_m in (19.9, 20.0))
    assert (coverage_doubt(low, looks=True), bool(coverage_doubt(high, looks=True))) == ("", True), (
        "houses hide the ground"
    )


def test_a_footprint_does_not_excuse_a_grid() -> None:
    d = falsified(honest(1), "coverage", "much")._replace(footprint_radius_m=500.0)
    assert coverage_doubt(d).startswith("coverage: ")


def test_the_check_counts_cells_that_cannot_be() -> None:
    """All but those seen well on a plain, and two cells around them."""
    seen = unpack_grid(honest(1).coverage_grid) >= Coverage.WELL
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    assert seen[np.ix_(rows, columns)].all(), "a rectangle"
    expected = 256 - (len(rows) + 2) * (len(columns) + 2)
    lie = falsified(honest(1), "coverage", "much")
    assert coverage_doubt(lie) == f"coverage: {expected} cells seen well that its cameras cannot show so"


def test_what_a_drone_may_have_seen_follows_from_its_speed_at_the_moment() -> None:
    """A look of a second ago reaches as much further as it flew; one grid is judged anew for each speed."""
    rows, columns = np.indices((16, 16)) - 7.5
    grid = pack_grid(np.where(np.hypot(rows, columns) < 6.0, Coverage.WELL, Coverage.UNSEEN))
    still = honest(1)._replace(coverage_grid=grid)
    for speed_mps, doubted in ((0.0, True), (12.0, False), (0.0, True)):
        assert (coverage_doubt(still._replace(velocity_mps=(speed_mps, 0.0, 0.0))) != "") == doubted


def test_speed_and_blur_each_excuse_cells_of_their_own() -> None:
    """The same grid and place is judged anew for another speed and another form, whichever was judged first."""
    claim = honest(1, 3.0, 4.0)._replace(position_m=(3.0, 4.0, 20.0))
    lying = falsified(claim, "coverage", "much")
    fast = lying._replace(velocity_mps=(200.0, 0.0, 0.0))
    turned = lying._replace(orientation_xyzw=(0.0, math.sin(0.4), 0.0, math.cos(0.4)))
    for cells in (16, 8):
        blur_m = Form(grid_cells=cells).blur_m
        before = coverage_doubt(lying, blur_m)
        assert before
        assert coverage_doubt(fast, blur_m) == ""
        assert coverage_doubt(lying, 300.0) == ""
        assert coverage_doubt(turned, blur_m) != before
        assert coverage_doubt(lying, blur_m) == before


def test_who_looks_and_sees_nothing_is_doubted_in_any_form_that_has_a_grid() -> None:
    known = {i: honest(i)._replace(coverage_grid=bytes(64)) for i in (0, 1)}
    for form, doubted in ((Form(), True), (Form(grid_cells=8), True), (Form(grid_cells=0), False)):
        assert (judge({}, 0, known, {}, form, {1})[1].strikes == 1) is doubted


def test_a_claim_is_counted_once_whoever_made_the_record_of_its_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[int] = []
    count = trust._count
    monkeypatch.setattr(trust, "_count", lambda claims, *rest: counted.append(len(claims)) or count(claims, *rest))
    claims = [honest(i, 20.0 * i) for i in range(4)]
    first = trust._count_cells(claims, 0.0, [Cameras(60.0) for _ in claims])
    assert trust._count_cells(claims, 0.0, [Cameras(60.0) for _ in claims]) == first
    assert counted == [4]
    trust._count_cells(claims, 0.0, [Cameras(61.0) for _ in claims])
    assert counted == [4, 4]


# --- goodput ----------------------------------------------------------------------------------------------


def test_goodput_against_what_arrived() -> None:
    """At 64 Mb/s at the least in frames of 100; the median bounds a claim from below, the fastest rate from above."""
    came, small = [Arrival(160_000, 0.02, 100.0)], [Arrival(500, 0.001, 600.0)]
    fast, slow, rare = Arrival(160_000, 0.02, 600.0), Arrival(160_000, 0.2, 100.0), [Arrival(20_000, 0.1, 2.0, 1.0)]
    many, one = Arrival(20_000, 0.016, 100.0), Arrival(20_000, 0.0004, 600.0)  # 10 and 400 Mb/s
    rows = [
        ("within", 80.0, came, 0.0, ""),
        ("low enough", 6.5, came, 0.0, ""),
        ("too low", 6.3, came, 0.0, "goodput: 6.3 Mb/s claimed, 64 arrived"),
        ("high enough", 150.0, came, 0.0, ""),
        ("too high", 151.0, came, 0.0, "goodput: 151 Mb/s claimed, frames came at 100"),
        ("a small payload says too little", 0.1, small, 0.0, ""),
        ("nothing came, nothing is known", 500.0, [], 0.0, ""),
        ("the fastest of several bounds it", 899.0, [slow, fast, slow], 0.0, ""),
        ("above the fastest", 901.0, [slow, fast, slow], 0.0, "goodput: 901 Mb/s claimed, frames came at 600"),
        ("a step of 4 Mb/s may have been added", 903.9, [fast], 4.0, ""),
        ("more than a step", 904.1, [fast], 4.0, "goodput: 904 Mb/s claimed, frames came at 600"),
        ("more than twice the rate", 4.0, rare, 0.0, "goodput: 4 Mb/s claimed, frames came at 2"),
        ("rounded up by a step", 4.0, rare, 1.5, ""),
        ("by more than a step", 5.0, rare, 1.5, "goodput: 5 Mb/s claimed, frames came at 2"),
        ("one that came faster makes no claim a lie", 5.0, [many, many, one], 0.0, ""),
        ("two of three", 5.0, [many, one, one], 0.0, "goodput: 5.0 Mb/s claimed, 400 arrived"),
        ("above both", 1000.0, [many, one], 0.0, "goodput: 1000 Mb/s claimed, frames came at 600"),
        ("the faster of both", 800.0, [many, one], 0.0, ""),
    ]
    found = {name: goodput_doubt(claimed, arrivals, step) for name, claimed, arrivals, step, _ in rows}
    assert found == {name: doubt for name, *_, doubt in rows}


def test_a_goodput_that_its_form_rounds_to_nothing_is_no_lie() -> None:
    """1.9 Mb/s are told as 0 in steps of 4: what came at 1.6 is no doubt. What lies further off is one all the same."""
    slow, quick = [Arrival(12_000, 0.06, 8.6)], [Arrival(160_000, 0.02, 100.0)]
    for bits, (goodput, came, is_doubted) in product((8, 10, 12, 16), ((1.9, slow, False), (0.1, quick, True))):
        form = Form(number_bits=bits)
        standings: Mapping[int, Standing] = {}
        for second in range(5):
            claims = fleet(second, honest(1, 20.0, 0.0, 0.9 - 0.0005 * second, goodput))
            known = {i: decode_compact(encode_compact(d, form)) for i, d in claims.items()}
            standings = judge(standings, 0, known, {1: came}, form)
        assert (standings[1].trust < 1.0) is is_doubted, (bits, standings[1].reason)


def test_a_claim_answers_for_what_came_before_it() -> None:
    came = [Arrival(160_000, 0.02, 600.0, t_done_s) for t_done_s in (1.0, 2.0, 3.0, 4.0)]
    assert split_arrivals(came, 2.0) == (came[:2], came[2:])
    assert split_arrivals(came, 0.5) == ([], came)
    assert split_arrivals(came, 4.5) == (came[2:], []), "a link may break in the two seconds before"


def test_a_claim_may_be_of_what_did_not_come() -> None:
    """At the edge of range a payload that is lost brings an honest estimate to nothing at once."""
    came = [Arrival(160_000, 0.02, 600.0, t_done_s) for t_done_s in (1.0, 1.1, 1.3, 1.4)]
    assert split_arrivals(came, 1.47) == (came, []), "the next is not sent yet"
    for some, told_s, why in (
        (came, 1.49, "one that was sent at 1.48 may be on its way, or lost"),
        (came[:1], 1.07, "how often its sender sends is not known"),
    ):
        told, _ = split_arrivals(some, told_s)
        assert goodput_doubt(0.1, told) == "", why
        assert goodput_doubt(901.0, told) == "goodput: 901 Mb/s claimed, frames came at 600", "lost or not"
