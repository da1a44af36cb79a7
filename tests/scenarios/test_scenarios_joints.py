"""The scenarios' joints: intervals, times, link states, and values of makes against the fleet's.

Joints, each with a test below:

1. Samples of two kinds in one interval: their number, their spread, the level asked for, and what lies on the border.
2. A pair's difference: each side's own spread.
3. Frames, scoring periods and tracked frames of every pair of rates.
4. States of a link, one after the other: each function of a goodput agrees about where one ends.
5. A make's network, weights and delay against the fleet's: in place of them, also where the value is zero or none.
6. Peers of equal overlap: each ego begins after itself.
7. Slots of every shape: who is where, and who stays when one more comes.
8. A flight that is shortened: what begins before its end, of every list. A campaign's largest fleet, wherever it stands.
   A campaign and what its base expects.
9. A class's largest backoff: at a first try and after failures.

Draws that must be independent of each other: streams of another seed, replication, entity or purpose.
"""

from __future__ import annotations

import json
import math
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sortie.scenarios.disc import AGENT_IDS, Disc, disc_overlap, rank_by_overlap
from sortie.scenarios.formation import slots
from sortie.scenarios.intervals import p_value, paired, percentile_interval, resamples
from sortie.scenarios.link_state import (
    PROBED_MBPS,
    SILENT_MBPS,
    WAITING_MBPS,
    LinkState,
    heard_share,
    is_tried,
    probed_mbps,
    state_of,
)
from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.load import ScenarioError, build, loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream


def scenario(text: str) -> Scenario:
    return loads(f"name: joints\n{text}")


# --- intervals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
def test_an_interval_leaves_out_as_much_below_as_above(level: float) -> None:
    draws = np.arange(1001.0)
    low, high = percentile_interval(draws, level)
    assert (low, high) == pytest.approx((500 - 500 * level, 500 + 500 * level))
    assert percentile_interval(np.append(draws, math.nan), level) == (low, high)


def test_a_draw_of_no_difference_speaks_for_no_difference() -> None:
    """Zeros count on both sides; the smaller side counts twice, and the observed one with it."""
    assert p_value(np.array([1.0, 2.0, 3.0, 4.0])) == pytest.approx(2 / 5)
    assert p_value(np.array([-1.0, 1.0, 2.0, 3.0])) == pytest.approx(4 / 5)
    assert p_value(np.array([0.0, 1.0, 2.0, 3.0])) == pytest.approx(4 / 5)
    assert p_value(np.array([0.0, 0.0, 0.0, 3.0, math.nan])) == 1.0
    assert p_value(-np.array([1.0, 2.0, 3.0, 4.0])) == pytest.approx(2 / 5)


def test_what_pairing_saves_follows_from_each_side_s_own_spread() -> None:
    a, b = np.array([1.0, 3.0, 5.0, math.nan, 2.0]), np.array([2.0, 8.0, 14.0, 1.0, math.nan])
    both = paired(a, b)
    spread_a, spread_b = 4.0, 36.0  # of 1, 3, 5 and of 2, 8, 14
    assert both.difference.mean == pytest.approx((1 + 5 + 9) / 3)
    assert both.difference.count == 3
    assert both.saved == pytest.approx((spread_a + spread_b) / 16.0)
    other = paired(b, a)
    assert other.saved == pytest.approx(both.saved)
    assert other.difference.mean == pytest.approx(-both.difference.mean)


def test_one_pair_has_a_difference_and_no_spread() -> None:
    one = paired(np.array([1.0, math.nan]), np.array([3.0, 5.0]))
    assert (one.difference.mean, one.difference.count) == (2.0, 1)
    assert math.isnan(one.saved)
    none = paired(np.array([math.nan]), np.array([3.0]))
    assert none.difference.count == 0
    assert math.isnan(none.saved)


def test_resamples_draw_as_many_as_there_are_alike_often() -> None:
    weights = resamples(7, 4000, 3)
    assert (weights.sum(axis=1) == 7).all()
    assert weights.mean(axis=0) == pytest.approx(np.ones(7), abs=0.08)
    assert not np.array_equal(weights, resamples(7, 4000, 4))


# --- times ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [10.0, 7.5, 4.0, 1.0])
@pytest.mark.parametrize("scored_hz", [10.0, 3.0, 2.0, 0.7])
@pytest.mark.parametrize("tracked_hz", [10.0, 5.0, 3.0, 1.0])
def test_frames_of_every_rate_stand_in_their_periods(rate_hz: float, scored_hz: float, tracked_hz: float) -> None:
    s = scenario(
        f"duration_s: 20\ncontext: {{rate_hz: {rate_hz}}}\n"
        f"perception: {{detector: none, sample_rate_hz: {scored_hz}, tracking_rate_hz: {tracked_hz}}}"
    )
    assert s.frames == math.ceil(20 * rate_hz)
    assert s.frame_s == 1 / rate_hz
    periods = s.scoring_periods
    assert [f for p in periods for f in p] == list(range(s.frames))
    assert len(periods) == math.ceil(20 * min(rate_hz, scored_hz) - 1e-9)
    for k, (period, frame) in enumerate(zip(periods, s.scored_frames, strict=True)):
        turn = k * (math.sqrt(5) - 1) / 2 % 1.0
        assert frame == period.start + int(turn * len(period))
    each = max(1.0, rate_hz / tracked_hz)
    tracked = s.tracked_frames
    for k, frame in enumerate(tracked):
        first, last = math.ceil(k * each - 1e-9), math.ceil((k + 1) * each - 1e-9)
        inside = [f for f in s.scored_frames if first <= f < last]
        assert frame == (inside[0] if inside else first)
    assert len(tracked) == math.ceil(s.frames / each - 1e-9)


@pytest.mark.parametrize("rate_hz", [10.0, 3.0, 7.0])
def test_a_frame_begins_at_every_multiple_of_its_length_before_the_end(rate_hz: float) -> None:
    """Though a product such as 4.1 · 10 is a digit above the whole number."""
    for frames in range(1, 140):
        made = scenario(
            f"duration_s: {frames / rate_hz!r}\ncontext: {{rate_hz: {rate_hz}}}\nperception: {{detector: none}}"
        )
        assert made.frames == frames


@pytest.mark.parametrize(
    "event",
    [
        "kind: link_drop, drone: 1", "kind: jam, position_m: [0, 0, 9]", "kind: gnss_loss", "kind: spoof, drone: 1",
        "kind: lie, drone: 1",
    ],
)  # fmt: skip
def test_an_event_ends_after_it_begins(event: str) -> None:
    for until_s in (2, 1.5):
        with pytest.raises(ScenarioError, match=rf"events\.0\.until_s: {until_s:g}, must be above at_s = 2"):
            scenario(f"duration_s: 9\nevents: [{{{event}, at_s: 2, until_s: {until_s}}}]")
    assert scenario(f"duration_s: 9\nevents: [{{{event}, at_s: 2, until_s: 2.001}}]").events


# --- links ------------------------------------------------------------------------------------------------


def test_every_function_of_a_goodput_agrees_about_the_states_of_a_link() -> None:
    below = math.nextafter(0.0, 1.0)
    values = {
        0.0: LinkState.UNKNOWN, below: LinkState.SILENT, SILENT_MBPS: LinkState.SILENT,
        math.nextafter(SILENT_MBPS, 1.0): LinkState.PROBED, PROBED_MBPS: LinkState.PROBED,
        math.nextafter(PROBED_MBPS, 1.0): LinkState.MEASURED, WAITING_MBPS: LinkState.MEASURED, 100.0: LinkState.MEASURED,
    }  # fmt: skip
    assert {v: state_of(v) for v in values} == values
    for v, state in values.items():
        assert bool(is_tried(v)) == (state in (LinkState.SILENT, LinkState.MEASURED))
        assert (heard_share(v) is not None) == (state == LinkState.PROBED)
    np.testing.assert_array_equal(is_tried(np.array(list(values))), [bool(is_tried(v)) for v in values])
    for share in (0.1, 0.5, 1.0):
        assert heard_share(probed_mbps(share)) == pytest.approx(share)
    assert state_of(probed_mbps(0.0)) == LinkState.SILENT


# --- shortened flights and varied ones -----------------------------------------------------------------------


@pytest.mark.parametrize(("duration_s", "left"), [(4.0, 2), (2.0, 1), (2.1, 2), (1.9, 1), (10.0, 3)])
def test_a_shortened_flight_keeps_what_begins_before_its_end(duration_s: float, left: int) -> None:
    """Events, changes, commands and replays alike; what begins with the end, at 2 or 4 s, is after it."""
    at = [{"at_s": t} for t in (1.0, 2.0, 4.0)]
    whole = {
        "name": "joints", "duration_s": 9.0, "events": [{"kind": "drone_lost", "drone": 0, **a} for a in at],
        "policy": {
            "name": "worked", "changes": [{"name": "silence", **a} for a in at] + [{"name": "worked", "command": "go"}],
            "commands": [{"command": "go", **a} for a in at], "replays": [{"drone": 0, "view": "{}", **a} for a in at],
        },
    }  # fmt: skip
    short = build(whole, {"duration_s": duration_s})
    policy = short.policy
    times = [[one.at_s for one in each] for each in (short.events, policy.changes, policy.commands, policy.replays)]
    wanted = [1.0, 2.0, 4.0][:left]
    assert times == [wanted, [*wanted, None], wanted, wanted]
    with pytest.raises(ScenarioError, match="must be below duration_s = 4"):
        build({**whole, "duration_s": 4.0})  # written so, it is a mistake


@pytest.mark.parametrize("values", [[2, 7, 3], [7, 2, 3], [3, 2, 7]])
def test_a_campaign_has_room_for_its_largest_fleet_and_longest_mission_wherever_they_stand(
    values: list[int], tmp_path: Path
) -> None:
    """In a list, in a file's column, and at either end of a range."""
    (tmp_path / "base.yaml").write_text(
        "name: base\nfleet: {drones: 4}\nmission: {phases: [{at_s: 0, phase: search}]}\n"
    )
    (tmp_path / "column.csv").write_text("\n".join(["n", *map(str, values)]) + "\n")
    phases = [[{"at_s": k, "phase": "search"} for k in range(n)] for n in values]
    spreads: dict[str, Any] = {
        "grid": {"kind": "grid", "values": values}, "choice": {"kind": "choice", "values": values},
        "column": {"kind": "column", "file": "column.csv", "column": "n"},
        "integers": {"kind": "integers", "low": min(values), "high": max(values)},
    }  # fmt: skip
    for spread in spreads.values():
        vary = {"fleet.drones": spread, "mission.phases": {"kind": "grid", "values": phases}}
        campaign = {"campaign": "c", "base": "base.yaml", "vary": vary, "metrics": ["wall_s"], "policies": ["worked"]}
        (tmp_path / "c.yaml").write_text(json.dumps(campaign))
        study = load_campaign(tmp_path / "c.yaml")
        assert (study.drones, study.phases) == (7, 7)


def test_a_campaign_leaves_out_what_its_base_expects(tmp_path: Path) -> None:
    """Of figures and of decisions alike: with fewer drones or a shorter flight it need not hold, nor make sense."""
    base = {
        "name": "base", "duration_s": 9.0, "fleet": {"drones": 4},
        "expect": [{"metric": "ap50.full_scene", "at_least": 0.1}],
        "expect_decisions": [{"drone": 3, "from_s": 6.0, "until_s": 8.0}],
    }  # fmt: skip
    (tmp_path / "base.yaml").write_text(json.dumps(base))
    for changed in ({"vary": {"fleet.drones": {"kind": "grid", "values": [2, 3]}}}, {"set": {"duration_s": 5.0}}):
        campaign = {"campaign": "c", "base": "base.yaml", "metrics": ["wall_s"], **changed}
        (tmp_path / "c.yaml").write_text(json.dumps(campaign))
        study = load_campaign(tmp_path / "c.yaml")
        assert (study.base.expect, study.base.expect_decisions) == ((), ())


# --- makes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "network", "space"),
    [
        ({}, ("torch", "fleet.w"), ""),
        ({"detector": "surrogate"}, ("surrogate", None), ""),  # weights of another kind of detector are not its own
        ({"weights": "own.w"}, ("torch", "own.w"), "one"),
        ({"detector": "torch"}, ("torch", "fleet.w"), ""),
        ({"weights": "fleet.w"}, ("torch", "fleet.w"), ""),  # named again, it is the same network
        ({"weights": "fleet.w", "feature_space": "own"}, ("torch", "fleet.w"), "own"),
        ({"detector": "torch", "weights": "own.w"}, ("torch", "own.w"), "one"),
        ({"weights": "own.w", "feature_space": "shared"}, ("torch", "own.w"), "shared"),
        ({"detector": "surrogate", "feature_space": "other"}, ("surrogate", None), "other"),
    ],
)
def test_a_make_s_network_is_its_own_or_the_fleet_s(make: dict[str, Any], network: Any, space: str) -> None:
    base = scenario("perception: {detector: torch, weights: fleet.w}\nfleet: {drones: 3}").model_dump(mode="json")
    base["fleet"]["makes"] = [{"name": "one", "drones": [1], **make}]
    made = Scenario.model_validate(base)
    assert tuple(made.networks[1]) == (*network, None)
    assert tuple(made.networks[0]) == tuple(made.networks[2]) == ("torch", "fleet.w", None)
    assert made.feature_spaces[0] == made.feature_spaces[2] == ""
    if "detector" not in make or "feature_space" in make or make["detector"] == "torch":
        assert made.feature_spaces[1] == space


@pytest.mark.parametrize(
    ("make", "codebook"),
    [
        ({}, "fleet.cb"),
        ({"feature_space": "own"}, "fleet.cb"),  # another name for the same network
        ({"codebook": "own.cb"}, "own.cb"),
        ({"weights": "own.w"}, None),  # the fleet's codes are of other features
        ({"detector": "surrogate"}, None),
        ({"weights": "own.w", "codebook": "own.cb"}, "own.cb"),
    ],
)
def test_a_make_s_codebook_is_its_own_or_that_of_the_same_network(make: dict[str, Any], codebook: str | None) -> None:
    base = scenario("perception: {detector: torch, weights: fleet.w, codebook: fleet.cb}\nfleet: {drones: 3}")
    sections = base.model_dump(mode="json")
    sections["fleet"]["makes"] = [{"name": "one", "drones": [1], **make}]
    networks = Scenario.model_validate(sections).networks
    assert [network.codebook for network in networks] == ["fleet.cb", codebook, "fleet.cb"]


def test_an_override_changes_one_value_of_what_a_drone_s_make_gives_it() -> None:
    fleet = scenario(
        "fleet:\n  drones: 3\n  airframe: {mass_kg: 3.0, payload_kg: 0.5}\n"
        "  makes: [{name: small, drones: [1, 2], airframe: {mass_kg: 1.0, disc_area_m2: 0.2}}]\n"
        "  overrides: [{drone: 0, payload_kg: 0.1}, {drone: 1, payload_kg: 0.3}]"
    ).fleet
    assert [(a.mass_kg, a.disc_area_m2, a.payload_kg) for a in fleet.airframes] == [
        (3.0, 0.503, 0.1), (1.0, 0.2, 0.3), (1.0, 0.2, 0.0),
    ]  # fmt: skip


def test_a_delay_of_zero_is_a_delay() -> None:
    made = scenario(
        "perception: {detector: none, compute_delay_s: 0.05}\nfleet: {drones: 3, makes: [{name: a, drones: [1], compute_delay_s: 0}]}"
    )
    assert made.compute_delays_s == (0.05, 0.0, 0.05)


# --- places ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ego", [0, 2, 4, 200])
def test_peers_of_equal_overlap_go_round_from_the_ego(ego: int) -> None:
    peers = [p for p in (0, 1, 2, 3, 4, 200, 255) if p != ego]
    ranked = rank_by_overlap(ego, dict.fromkeys(peers, 0.5))
    assert ranked == sorted(peers, key=lambda p: (p - ego) % AGENT_IDS)
    best = rank_by_overlap(ego, {p: (0.9 if p == peers[-1] else 0.5) for p in peers})
    assert best[0] == peers[-1]


@pytest.mark.parametrize(("a", "b"), [(20.0, 40.0), (40.0, 20.0), (30.0, 30.0)])
def test_the_share_is_of_the_first_disc_at_every_distance(a: float, b: float) -> None:
    """By counting points."""
    side = np.linspace(-a, a, 801)
    x, y = np.meshgrid(side, side)
    inside = x**2 + y**2 <= a**2
    for apart in (0.0, 5.0, 15.0, 25.0, 45.0, 59.0, 61.0):
        both = inside & ((x - apart) ** 2 + y**2 <= b**2)
        assert disc_overlap(apart, a, b) == pytest.approx(both.sum() / inside.sum(), abs=5e-3)
    assert disc_overlap(0.0, 0.0, b) == 0.0
    assert Disc(1, 2, 3).radius_m == 3


@pytest.mark.parametrize("shape", ["cross", "line", "wedge", "grid", "circle"])
@pytest.mark.parametrize("n", [1, 2, 5, 9, 12])
def test_slots_are_a_spacing_apart_and_one_more_drone_moves_nobody(shape: str, n: int) -> None:
    at = slots(shape, n, 20.0)
    apart = [math.dist(p, q) for p, q in combinations(at.tolist(), 2)]
    if shape != "circle":
        np.testing.assert_array_equal(slots(shape, n + 1, 20.0)[:n], at)
        assert at[0].tolist() == [0.0, 0.0]
        assert min(apart, default=20.0) == pytest.approx(20.0)
    elif n > 2:
        assert np.hypot(*at.T) == pytest.approx(np.full(n, n * 20 / (2 * math.pi)))
    if n == 5:
        left_first = {"cross": [1, 2], "line": [1], "wedge": [1], "grid": [2]}.get(shape, [])
        for i in left_first:
            assert at[i, 1] >= 0  # forward or left before rear or right
    if shape == "cross" and n >= 5:
        assert at[1:5].tolist() == [[20, 0], [0, 20], [-20, 0], [0, -20]]


# --- draws ------------------------------------------------------------------------------------------------------------


def test_streams_of_another_seed_replication_entity_or_purpose_share_nothing() -> None:
    keys: list[tuple[int, int, int | tuple[int, ...], str]] = [
        (1, 0, 0, "a"), (2, 0, 0, "a"), (1, 1, 0, "a"), (1, 0, 1, "a"), (1, 0, 0, "b"), (1, 0, (0, 0), "a"), (1, 0, (), "a"),
        (1, 0, (0, 1), "a"), (1, 0, (1, 0), "a"), (0, 1, 0, "a"), (1, 0, (0, 0, 0), "a"), (0, 0, 1, "a"),
    ]  # fmt: skip
    drawn = np.array([stream(*key).random(2000) for key in keys])
    assert len(np.unique(drawn)) == drawn.size
    correlation = np.corrcoef(drawn)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 0.1
    np.testing.assert_array_equal(stream(1, 0, 0, "a").random(5), drawn[0, :5])
    np.testing.assert_array_equal(stream(1, 0, (0,), "a").random(5), drawn[0, :5])


# --- backoff -------------------------------------------------------------------------------------------------


def test_a_class_may_keep_its_window_after_failures_and_not_narrow_it() -> None:
    edca = scenario("radio: {edca: {best_effort: {cw_min: 31, cw_max: 31}}}").radio.edca
    assert (edca.best_effort.cw_min, edca.best_effort.cw_max) == (31, 31)
    with pytest.raises(ScenarioError, match="must be at least cw_min = 31"):
        scenario("radio: {edca: {best_effort: {cw_min: 31, cw_max: 30}}}")
