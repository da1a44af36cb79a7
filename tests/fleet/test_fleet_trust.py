"""Trust: honest claims are never doubted, false ones are, each by its own check, and trust follows doubts that last."""

from __future__ import annotations

import math
from statistics import median

import numpy as np
import pytest
from fleet_examples import grid_on_a_plain
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet import trust, trust_loops
from sortie.fleet.coverage import View, pack_grid, placed, unpack_grid
from sortie.fleet.lies import falsified
from sortie.fleet.messages.compact import Form, decode_compact, encode_compact
from sortie.fleet.standings import UNJUDGED, Standing, Standings
from sortie.fleet.trust import (
    LONG_SILENCE,
    Arrival,
    battery_doubt,
    coverage_doubt,
    discounted,
    goodput_doubt,
    judge,
    split_arrivals,
)
from sortie.perception.geometry import Cameras
from sortie.policies.contract import COVERAGE_CELL_M, Coverage, Descriptor, TaskPhase


def honest(drone: int, x_m: float = 0.0, y_m: float = 0.0, soc: float = 0.9, goodput: float = 100.0) -> Descriptor:
    """A drone at 60 m that says what it sees."""
    grid = grid_on_a_plain(x_m, y_m, 60.0)
    return Descriptor(
        0, drone, (x_m, y_m, 60.0), (0, 0, 0, 1), (0, 0, 0), 42.0, soc, 1, 1, (goodput,) * 4, grid, 0,
        TaskPhase.SEARCH, None,
    )  # fmt: skip


def fleet(second: int, liar: Descriptor | None = None) -> dict[int, Descriptor]:
    """Five drones that lose 0.05 % a second, 20 m apart; drone 1 may be another."""
    drones = {i: honest(i, 20.0 * i, 0.0, 0.9 - 0.0005 * second) for i in range(5)}
    return drones if liar is None else drones | {1: liar}


def after(seconds: int, lie: tuple[str, str] | None = None, since: int = 0) -> dict[int, Standing]:
    """What drone 0 thinks after so many seconds, drone 1 lying from `since` on."""
    standings: dict[int, Standing] = {}
    for second in range(seconds):
        known = fleet(second)
        if lie is not None and second >= since:
            known[1] = falsified(known[1], *lie)  # type: ignore[arg-type]
        standings = judge(standings, 0, known, {1: [Arrival(160_000, 0.02, 600.0)]}, looking={1})
    return standings


@pytest.mark.parametrize("lie", [None, ("coverage", "much"), ("coverage", "little"), ("goodput", "little")])
def test_trust_falls_for_the_liar_alone(lie: tuple[str, str] | None) -> None:
    trust = {i: s.trust for i, s in after(20, lie, since=5).items()}
    assert trust == {0: 1.0, 1: 1.0 if lie is None else 0.0, 2: 1.0, 3: 1.0, 4: 1.0}


@pytest.mark.parametrize("claim", ["much", "little"])
def test_a_false_battery_is_found_out(claim: str) -> None:
    """Too much comes back at once; too little does not fall, which shows once the fleet lost half a percent."""
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


# --- coverage ------------------------------------------------------------------------------------

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


# --- goodput and battery -------------------------------------------------------------------------


def test_goodput_against_what_arrived() -> None:
    came = [Arrival(160_000, 0.02, 100.0)]  # at 64 Mb/s at the least
    assert goodput_doubt(80.0, came) == ""
    assert goodput_doubt(6.5, came) == ""
    assert goodput_doubt(6.3, came) == "goodput: 6.3 Mb/s claimed, 64 arrived"
    assert goodput_doubt(150.0, came) == ""
    assert goodput_doubt(151.0, came) == "goodput: 151 Mb/s claimed, frames came at 100"
    assert goodput_doubt(0.1, [Arrival(500, 0.001, 600.0)]) == "", "a small payload says too little"
    assert goodput_doubt(500.0, []) == "", "nothing came, nothing is known"
    fast, slow = Arrival(160_000, 0.02, 600.0), Arrival(160_000, 0.2, 100.0)
    assert goodput_doubt(899.0, [slow, fast, slow]) == "", "the fastest of several bounds it"
    assert goodput_doubt(901.0, [slow, fast, slow]) == "goodput: 901 Mb/s claimed, frames came at 600"
    assert goodput_doubt(903.9, [fast], 4.0) == "", "a step of 4 Mb/s may have been added"
    assert goodput_doubt(904.1, [fast], 4.0) == "goodput: 904 Mb/s claimed, frames came at 600"


def test_battery_against_the_past_and_the_fleet() -> None:
    assert battery_doubt(0.92, 0.90, 0.95, 0.0) == ""
    assert battery_doubt(0.94, 0.90, 0.95, 0.0) == "battery: 94% after 90%"
    assert battery_doubt(0.95, 0.95, 0.95, 0.004) == "", "too early to say"
    assert battery_doubt(0.95, 0.95, 0.95, 0.02) == "battery: fell by 0.0% while the fleet's fell by 2.0%"
    assert battery_doubt(0.945, 0.945, 0.95, 0.02) == "", "a battery four times as large"


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_a_goodput_that_its_form_rounds_to_nothing_is_no_lie(bits: int) -> None:
    """1.9 Mb/s are told as 0 in steps of 4: what came at 1.6 is no doubt. What lies further off is one all the same."""
    form = Form(number_bits=bits)
    slow = [Arrival(12_000, 0.06, 8.6)]
    for goodput, came, doubted in ((1.9, slow, False), (0.1, [Arrival(160_000, 0.02, 100.0)], True)):
        standings: dict[int, Standing] = {}
        for second in range(5):
            known = {i: decode_compact(encode_compact(d, form)) for i, d in fleet(second).items()}
            known[1] = decode_compact(encode_compact(honest(1, 20.0, 0.0, 0.9 - 0.0005 * second, goodput), form))
            standings = judge(standings, 0, known, {1: came}, form)
        assert (standings[1].trust < 1.0) is doubted, standings[1].reason


def test_a_charge_in_whole_percents_is_no_lie() -> None:
    """As a real drone's telemetry has it: a step every 25 s. One that never falls is found all the same, a percent later."""
    standings: dict[int, Standing] = {}
    trust: list[tuple[float, ...]] = []
    for second in range(150):
        known = {i: honest(i, 20.0 * i, soc=0.9 - 0.0004 * second) for i in range(5)}
        for i, soc in ((1, round(known[1].battery_soc, 2)), (2, 0.9)):
            known[i] = known[i]._replace(battery_soc=soc)
        standings = judge(standings, 0, known, {})
        trust.append(tuple(s.trust for s in standings.values()))
    assert {t[:2] + t[3:] for t in trust} == {(1.0, 1.0, 1.0, 1.0)}
    assert trust[37][2] == 1.0
    assert trust[60][2] == 0.0


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


def test_a_fault_is_no_lie() -> None:
    """Half the energy gone at once, then falling as all do."""
    standings: dict[int, Standing] = {}
    for second in range(60):
        known = fleet(second)
        if second >= 10:
            known[1] = known[1]._replace(battery_soc=known[1].battery_soc / 2)
        standings = judge(standings, 0, known, {})
        assert standings[1].trust == 1.0


@pytest.mark.parametrize("drones", [2, 3])
@pytest.mark.parametrize("lost", [0.02, 0.045])
def test_a_small_fault_in_a_small_fleet_is_no_fall_of_the_fleet(drones: int, lost: float) -> None:
    """Of two others, or one, the median is nearly the faulty drone's own."""
    standings: dict[int, Standing] = {}
    for second in range(30):
        known = {i: d for i, d in fleet(second).items() if i < drones}
        if second >= 2:
            known[0] = known[0]._replace(battery_soc=known[0].battery_soc * (1 - lost))
        standings = judge(standings, 0, known, {})
        assert all(s.trust == 1.0 for s in standings.values()), second


def test_the_loss_of_a_strong_drone_brings_nobody_into_doubt() -> None:
    """Charges of 0.9 and 0.3; when one is gone the median charge jumps, falls do not."""
    standings: dict[int, Standing] = {}
    for second in range(60):
        known = {i: honest(i, 20.0 * i, soc=(0.9 if i < 3 else 0.3) - 0.0005 * second) for i in range(5)}
        if second >= 30:
            del known[1]
        standings = judge(standings, 0, known, {})
        assert all(s.trust == 1.0 for s in standings.values())


def test_the_return_of_a_silent_majority_brings_nobody_into_doubt() -> None:
    """Three of five are heard once and again from the 27th second on: they fell all the while, as all did."""
    standings: dict[int, Standing] = {}
    for second in range(60):
        known = {i: d for i, d in fleet(second).items() if i in (0, 2) or not 1 <= second < 27}
        standings = judge(standings, 0, known, {})
        assert all(s.trust == 1.0 for s in standings.values()), second


def fallen(drone: int, second: int, away: range) -> float:
    """A charge that falls by 0.05 % a second, but not while drone 1 is away on the ground."""
    return 0.9 - 0.0005 * (second - (drone == 1) * min(max(0, second - away.start), len(away)))


@pytest.mark.parametrize("rest_s", [LONG_SILENCE, 80])
def test_who_comes_back_from_a_rest_on_the_ground_is_not_doubted(rest_s: int) -> None:
    """It flew for two seconds, and its charge stayed while the others flew on."""
    standings: dict[int, Standing] = {}
    away = range(2, 2 + rest_s)
    for second in range(away.stop + 40):
        known = {i: honest(i, 20.0 * i, soc=fallen(i, second, away)) for i in range(5) if i != 1 or second not in away}
        standings = judge(standings, 0, known, {})
        assert all(s.trust == 1.0 for s in standings.values()), second


def test_no_charge_comes_back_on_the_ground() -> None:
    """After a long silence too, a charge of more than before is a doubt."""
    standings = judge({1: Standing(0, "", 90, 0.9, 0.85, True, 80)}, 0, {0: honest(0), 1: honest(1, soc=0.9)}, {})
    assert standings[1].reason == "battery: 90% after 85%"


def test_who_is_heard_late_has_not_fallen_before() -> None:
    """Small packs that lose 0.55 % a second, and a drone whose claims come late and every two seconds: from one judgement
    to the next it fell for a second, not for two, and at its first not at all."""
    standings: dict[int, Standing] = {}
    heard_at = 11
    for second in range(30):
        known = {i: honest(i, 20.0 * i, soc=0.9 - 0.0055 * second) for i in range(5)}
        known[1] = known[1]._replace(battery_soc=0.9 - 0.0055 * (second - (second - heard_at) % 2))
        if second < heard_at:
            del known[1]
        standings = judge(standings, 0, known, {})
        assert all(s.trust == 1.0 for s in standings.values()), second


@pytest.mark.parametrize(("drones", "stations"), [(3, {2}), (3, {0}), (5, {1, 2, 3}), (2, {0}), (2, {0, 1})])
def test_a_ground_station_on_mains_is_not_doubted_and_excuses_nobody(drones: int, stations: set[int]) -> None:
    """The others in the air lose 0.2 % a second; the last of them claims to lose nothing. Two in the air can be compared."""
    liar = max({*range(drones)} - stations, default=-1)
    standings: dict[int, Standing] = {}
    for second in range(20):
        known = {
            i: honest(i, 20.0 * i, soc=0.9 if i in {*stations, liar} else 0.9 - 0.002 * second) for i in range(drones)
        }
        standings = judge(standings, 0, known, {}, stations=stations)
    doubted = {i for i, s in standings.items() if s.trust < 1.0}
    assert doubted == ({liar} if drones - len(stations) > 1 and liar != 0 else set())


def test_a_ground_station_whose_charge_rises_is_doubted() -> None:
    standings: dict[int, Standing] = {}
    for second in range(5):
        known = {i: honest(i, 20.0 * i, soc=0.8 if second < 2 else 0.9) for i in (0, 1)}
        standings = judge(standings, 0, known, {}, stations={1})
    assert standings[1].reason == "battery: 90% after 80%"


@pytest.mark.parametrize("claim", [None, "much", "little"])
def test_a_charge_is_watched_on_where_it_is_told_seldom(claim: str | None) -> None:
    """Small packs that lose 0.2 % a second, heard every ten: two percent from one claim to the next are no fault."""
    standings: dict[int, Standing] = {}
    for second in range(60):
        known = {i: honest(i, 20.0 * i, soc=0.9 - 0.002 * second) for i in range(5) if i == 0 or second % 10 == 0}
        if claim is not None and 1 in known and second >= 10:
            known[1] = falsified(known[1], "battery", claim)  # type: ignore[arg-type]
        standings = judge(standings, 0, known, {})
    assert {i for i, s in standings.items() if s.trust < 1.0} == (set() if claim is None else {1})


def test_a_doubted_drone_stays_where_it_is_and_says_nothing() -> None:
    d = honest(3, 10.0, 20.0)
    small = discounted(d)
    assert (small.position_m, small.footprint_radius_m, small.agent_id) == (d.position_m, 42.0, 3)
    assert (set(small.coverage_grid), small.battery_soc, small.peer_goodput_mbps) == ({0}, 0.0, (0.0,) * 4)


@given(st.data())
def test_the_compiled_loop_finds_what_the_formula_finds(data: st.DataObject) -> None:
    """A fleet whose charge falls, stands still, jumps and is not heard, second by second against `battery_doubt`."""
    drones = data.draw(st.integers(1, 6))
    standings, grid = Standings({}), bytes(64)
    socs, stations = [0.9] * drones, data.draw(st.sets(st.integers(0, drones - 1)))
    for _ in range(data.draw(st.integers(1, 12))):
        falls = st.sampled_from([0.0, 0.0, 0.01, 0.012, 0.03, -0.04, 0.08])
        socs = [soc - data.draw(falls) for soc in socs]
        heard = sorted({0, *data.draw(st.sets(st.integers(0, drones - 1)))})
        known = {i: honest(i)._replace(coverage_grid=grid, battery_soc=socs[i]) for i in heard}
        before, standings = standings, judge(standings, 0, known, {}, stations=stations)
        fell_per_s = {
            i: (standings[i].first_soc - socs[i]) / max(standings[i].seconds - 1, 1) for i in heard if i not in stations
        }
        for i in heard:
            others, was, now = [f for k, f in fell_per_s.items() if k != i], before.get(i, UNJUDGED), standings[i]
            others_fell = median(others) * (now.seconds - 1) if others and i not in stations else 0.0
            doubt = battery_doubt(
                socs[i], was.least_soc, now.first_soc, others_fell, max(3 * Form().soc_step, 0.0 if now.fine else 0.01)
            )
            assert now.strikes == (min(was.strikes + 1, 6) if doubt and i else max(was.strikes - 1, 0))
            assert now.reason == (doubt if doubt and i else was.reason)
            assert now.least_soc == min(was.least_soc, socs[i])


def test_the_compiled_loop_has_the_constants_of_the_formula() -> None:
    for name in ("RISE", "PERCENT", "FALL", "FALL_SHARE", "LONG_SILENCE"):
        assert getattr(trust_loops, f"_{name}") == getattr(trust, name)


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
