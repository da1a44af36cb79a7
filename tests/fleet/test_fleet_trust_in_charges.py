"""Trust in charges: whoever claims its true charge is never doubted, and a false one is found out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

import numpy as np
from agent_rig import descriptor, memory
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet import trust, trust_loops
from sortie.fleet.messages.compact import Form
from sortie.fleet.plane import equipment_of
from sortie.fleet.standings import UNJUDGED, Standing, Standings
from sortie.fleet.trust import (
    LONG_SILENCE,
    battery_doubt,
    judge,
)
from sortie.policies.contract import (
    Descriptor,
)
from sortie.scenarios.reading.load import loads

FALLS = 0.0005
"""How much of its charge a drone loses in a second."""


def claims(soc: Mapping[int, float]) -> dict[int, Descriptor]:
    """What drones with these charges claim; none says that it sees anything."""
    return {i: descriptor(i, battery_soc=its, coverage_grid=bytes(64)) for i, its in soc.items()}


Charges = Callable[[int], Mapping[int, float]]


def ever_doubted(seconds: int, charges: Charges, **of: Any) -> tuple[set[int], set[int]]:
    """Whom drone 0 doubts after these seconds, and whom it doubted at any time."""
    standings: Mapping[int, Standing] = {}
    ever: set[int] = set()
    for second in range(seconds):
        standings = judge(standings, 0, claims(charges(second)), {}, **of)
        now = {i for i, s in standings.items() if s.trust < 1.0}
        ever |= now
    return now, ever


def left(second: float) -> float:
    return 0.9 - FALLS * second


def test_battery_against_the_past_and_the_fleet() -> None:
    rows = [
        ((0.92, 0.90, 0.95, 0.0), ""),
        ((0.94, 0.90, 0.95, 0.0), "battery: 94% after 90%"),
        ((0.90, 0.86, 0.95, 0.0), "battery: 90% after 86%"),
        ((0.95, 0.95, 0.95, 0.004), ""),  # too early to say
        ((0.95, 0.95, 0.95, 0.02), "battery: fell by 0.0% while the fleet's fell by 2.0%"),
        ((0.945, 0.945, 0.95, 0.02), ""),  # a battery four times as large
    ]
    assert {given: battery_doubt(*given) for given, _ in rows} == dict(rows)


def rested(drone: int, second: int, away: range) -> float:
    """A charge that falls, but not while drone 1 is away on the ground."""
    return left(second - (drone == 1) * min(max(0, second - away.start), len(away)))


def after_a_rest(rest_s: int) -> Charges:
    away = range(2, 2 + rest_s)
    return lambda second: {i: rested(i, second, away) for i in range(5) if i != 1 or second not in away}


def with_a_small_fault(drones: int, lost: float) -> Charges:
    return lambda second: {i: left(second) * (1 - lost if i == 0 and second >= 2 else 1) for i in range(drones)}


def heard_late(second: int) -> dict[int, float]:
    """Small packs that lose 0.55 % a second; claims of drone 1 come late and every two seconds."""
    soc = dict.fromkeys(range(5), 0.9 - 0.0055 * second)
    soc[1] = 0.9 - 0.0055 * (second - (second - 11) % 2)
    return soc if second >= 11 else {i: its for i, its in soc.items() if i != 1}


HONEST: dict[str, tuple[int, Charges]] = {
    "all fall alike": (60, lambda s: dict.fromkeys(range(5), left(s))),
    "half of it is gone at once": (60, lambda s: {i: left(s) / (2 if i == 1 and s >= 10 else 1) for i in range(5)}),
    "a fault of 2 % in a fleet of two": (30, with_a_small_fault(2, 0.02)),
    "a fault of 4.5 % in a fleet of two": (30, with_a_small_fault(2, 0.045)),
    "a fault of 2 % in a fleet of three": (30, with_a_small_fault(3, 0.02)),
    "a fault of 4.5 % in a fleet of three": (30, with_a_small_fault(3, 0.045)),
    # the median charge jumps, falls do not
    "a strong drone is lost": (60, lambda s: {i: left(s) - 0.6 * (i >= 3) for i in range(5) if i != 1 or s < 30}),
    # they fell all the while, as all did
    "a silent majority comes back": (60, lambda s: {i: left(s) for i in range(5) if i in (0, 2) or not 1 <= s < 27}),
    # it flew for two seconds, and its charge stayed while the others flew on
    "a rest of a long silence": (LONG_SILENCE + 42, after_a_rest(LONG_SILENCE)),
    "a rest of 80 s": (122, after_a_rest(80)),
    # from one judgement to the next it fell for a second, not for two, and at its first not at all
    "a drone that is heard late": (30, heard_late),
    # two percent from one claim to the next are no fault
    "claims every ten seconds": (60, lambda s: {i: 0.9 - 0.002 * s for i in range(5) if i == 0 or s % 10 == 0}),
    "whole percents, as telemetry has them": (
        150,
        lambda s: {i: round(0.9 - 0.0004 * s, 2) if i == 1 else 0.9 - 0.0004 * s for i in range(5)},
    ),
}
"""How many seconds, and the charges of who is heard in each of them."""


def test_who_claims_its_true_charge_is_never_doubted() -> None:
    doubts = {name: ever_doubted(*row)[1] for name, row in HONEST.items()}
    assert {name: doubt for name, doubt in doubts.items() if doubt} == {}


def seldom(claim: float) -> Charges:
    """Small packs, of which all but the own are heard every ten seconds; drone 1 claims this from the tenth on."""
    return lambda s: {i: claim if i == 1 and s >= 10 else 0.9 - 0.002 * s for i in range(5) if i == 0 or s % 10 == 0}


FALSE: dict[str, tuple[int, Charges, set[int]]] = {
    "much, told seldom": (60, seldom(1.0), {1}),
    "little, told seldom": (60, seldom(0.05), {1}),
    # of two drones the median of both falls would be half the fall: who is judged is no part of it
    "one falls and one claims not to": (40, lambda s: {0: 0.9 - 0.0011 * s, 1: 0.9 - 0.00008 * s}, {1}),
    "a charge that stays": (61, lambda s: {i: 0.9 - 0.0004 * s * (i != 2) for i in range(5)}, {2}),
}
"""How many seconds, the charges, and who is doubted in the end."""


def test_who_claims_a_false_charge_is_doubted_alone() -> None:
    found = {name: ever_doubted(seconds, charges) for name, (seconds, charges, _) in FALSE.items()}
    assert found == {name: (liars, liars) for name, (_, _, liars) in FALSE.items()}


def test_a_charge_that_stays_is_found_a_percent_after_one_in_whole_percents_could_stay() -> None:
    _, charges, _ = FALSE["a charge that stays"]
    assert ever_doubted(38, charges)[1] == set()
    assert ever_doubted(61, charges)[0] == {2}


def falling_but(still: set[int], drones: int) -> Charges:
    return lambda second: {i: 0.9 if i in still else 0.9 - 0.002 * second for i in range(drones)}


def test_a_ground_station_on_mains_is_not_doubted_and_excuses_nobody() -> None:
    """Others in the air lose 0.2 % a second; the last of them claims to lose none. Two in the air can be compared."""
    wrong = {}
    for drones, stations in ((3, {2}), (3, {0}), (5, {1, 2, 3}), (2, {0}), (2, {0, 1})):
        liar = max({*range(drones)} - stations, default=-1)
        still = stations | {liar}
        found = ever_doubted(20, falling_but(still, drones), stations=stations)[0]
        if found != ({liar} if drones - len(stations) > 1 and liar != 0 else set()):
            wrong[drones, tuple(stations)] = found
    assert wrong == {}


def test_no_charge_comes_back_on_the_ground() -> None:
    """That of a ground station, and that of a drone after a long silence."""
    standings: Mapping[int, Standing] = {}
    for second in range(5):
        standings = judge(standings, 0, claims(dict.fromkeys((0, 1), 0.8 if second < 2 else 0.9)), {}, stations={1})
    assert standings[1].reason == "battery: 90% after 80%"
    standings = judge({1: Standing(0, "", 90, 0.9, 0.85, True, 80)}, 0, claims({0: 0.9, 1: 0.9}), {})
    assert standings[1].reason == "battery: 90% after 85%"


def test_a_charge_may_stand_still_for_three_steps_of_its_form() -> None:
    """Against a fleet that fell by less than that and by more, of one that told its charge finely before."""
    for bits in (8, 10):
        step = Form(number_bits=bits).soc_step
        for fallen, is_doubted in ((2.5 * step, False), (3.5 * step + 0.006, True)):
            known = claims({i: 0.9 - fallen * (i != 1) for i in range(5)})
            standings = {i: Standing(0, "", 60, 0.9, 0.9 - fallen * (i != 1), fine=True) for i in known}
            assert (judge(standings, 0, known, {}, Form(number_bits=bits))[1].strikes > 0) is is_doubted


def test_a_steep_fall_begins_a_new_watch_at_the_highest_bound_however_long_nobody_heard() -> None:
    """A fall of six percent between two claims far apart: the charge is watched from there on."""
    known = claims({0: 0.84, 1: 0.84})
    after = judge({1: Standing(0, "", 30, 0.95, 0.9, True, 9)}, 0, known, {})[1]
    assert (after.seconds, after.first_soc, after.least_soc, after.reason) == (1, 0.84, 0.84, "")
    before = {1: Standing(2, "battery: of before", 30, 0.95, 0.9, True)}
    assert judge(before, 0, claims({0: 0.84, 1: 0.895}), {})[1].reason == "battery: of before"


def test_a_drone_knows_which_members_of_the_scenario_stand_on_the_ground() -> None:
    """So it does not doubt a station that keeps its charge, and does doubt such a drone."""
    for ground, doubted in (("[]", [2]), ("[{drone: 2}]", [])):
        text = f"name: ground\nduration_s: 4\nfleet: {{drones: 3, ground: {ground}}}\nperception: {{detector: none}}"
        mine = memory(trust=True, makes=equipment_of(loads(text)))
        for second in range(20):
            for i in range(3):
                soc = 0.9 if i == 2 else 0.9 - 0.002 * second
                mine.hold(descriptor(i, second, battery_soc=soc, coverage_grid=bytes(64)), float(second))
            mine.judge(second + 0.05)
        assert [i for i in range(3) if mine.trust_in(i) < 1.0] == doubted


def test_a_drone_that_was_away_itself_doubts_nobody_for_that_time() -> None:
    """Drones 0 and 1 rest; the others lose a percent meanwhile, which is no fall of the seconds before and after."""
    mine = memory(trust=True)
    for second in (*range(4), *range(100, 110)):
        flown_s = {0: second % 96, 1: second % 96, 2: second, 3: second, 4: second}
        for i, lasted_s in flown_s.items():
            soc = 0.9 - 0.0001234 * lasted_s
            mine.hold(descriptor(i, second, battery_soc=soc, coverage_grid=bytes(64)), float(second))
        mine.judge(second + 0.05)
        assert [mine.trust_in(i) for i in flown_s] == [1.0] * 5, second


@given(st.data())
def test_the_compiled_loop_finds_what_the_formula_finds(data: st.DataObject) -> None:
    """A fleet whose charge falls, stands still, jumps and is not heard, second by second against `battery_doubt`."""
    drones = data.draw(st.integers(1, 6))
    standings = Standings({})
    socs, stations = [0.9] * drones, data.draw(st.sets(st.integers(0, drones - 1)))
    for _ in range(data.draw(st.integers(1, 12))):
        falls = st.sampled_from([0.0, 0.0, 0.01, 0.012, 0.03, -0.04, 0.08])
        socs = [soc - data.draw(falls) for soc in socs]
        heard = sorted({0, *data.draw(st.sets(st.integers(0, drones - 1)))})
        known = claims({i: socs[i] for i in heard})
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


@given(st.lists(st.integers(-50, 50), min_size=1, max_size=7), st.data())
def test_the_median_of_the_others_is_that_of_the_formula(falls: list[int], data: st.DataObject) -> None:
    """Of an odd and of an even number of others, equal ones among them."""
    me = data.draw(st.integers(0, len(falls) - 1))
    others = [fall for k, fall in enumerate(falls) if k != me]
    found = trust_loops._median_without.py_func(np.sort(np.array(falls, float)), float(falls[me]))
    assert found == (median(others) if others else 0.0)


def test_the_compiled_loop_has_the_constants_of_the_formula() -> None:
    for name in ("RISE", "PERCENT", "FALL", "FALL_SHARE", "LONG_SILENCE"):
        assert getattr(trust_loops, f"_{name}") == getattr(trust, name)
