"""Damping: a band on what is read; reductions at once, upgrades after the dwell, repeats for free."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sortie.policies.contract import Descriptor, Directive, Disc, LinkState, Representation, TaskPhase
from sortie.policies.damping import DampedLink, apply_hysteresis, damp, is_climb, is_switch
from sortie.scenarios.link_state import PROBED_MBPS, SILENT_MBPS, probed_mbps, state_of

FULL = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, reason="full")
HALF = FULL._replace(rate_hz=5.0, reason="half")
BOXES = Directive(0, 1, Representation.DETECTIONS, 0.0, None, 2.0, reason="boxes")
NOTHING = Directive(0, 1)
DWELL_S = 1.0


def run(start: Directive, asked: list[Directive], step_s: float = 0.1) -> list[Directive]:
    state, enforced = DampedLink(start), []
    for i, directive in enumerate(asked):
        state = damp(state, directive, i * step_s, DWELL_S)
        enforced.append(state.enforced)
    return enforced


def test_a_repeated_directive_changes_nothing_and_restarts_nothing() -> None:
    state = DampedLink(FULL)
    assert damp(state, FULL, 0.0, DWELL_S) is state
    assert damp(state, FULL._replace(reason="other words"), 5.0, DWELL_S) is state
    waiting = damp(DampedLink(BOXES), FULL, 0.0, DWELL_S)
    assert damp(waiting, FULL, 0.5, DWELL_S) is waiting, "asking again must not restart the dwell"
    assert damp(waiting, FULL, 1.0, DWELL_S).enforced == FULL


def test_reductions_pass_at_once_upgrades_wait() -> None:
    assert run(FULL, [HALF]) == [HALF]
    assert run(FULL, [BOXES]) == [BOXES]
    assert run(FULL, [NOTHING]) == [NOTHING]
    enforced = run(BOXES, [FULL] * 12)
    assert enforced[:10] == [BOXES] * 10
    assert enforced[10:] == [FULL] * 2


def test_a_passing_change_does_not_switch() -> None:
    assert set(run(BOXES, [FULL] * 9 + [BOXES] + [FULL] * 9)) == {BOXES}


def test_a_mixed_change_is_lowered_where_it_is_lower() -> None:
    asked = FULL._replace(rate_hz=2.0)
    first, *_, last = run(FULL._replace(rho=0.1), [asked] * 11)
    assert (first.rho, first.rate_hz) == (0.1, 2.0)
    assert last == asked


def test_a_region_confines_at_once_moves_freely_and_widens_late() -> None:
    here, there, wide = Disc(0, 0, 32), Disc(5, 0, 32), Disc(5, 0, 64)
    confined = FULL._replace(roi=here)
    assert run(FULL, [confined]) == [confined]
    assert run(confined, [FULL._replace(roi=there)]) == [FULL._replace(roi=there)]
    assert run(confined, [FULL._replace(roi=wide)])[0].roi == there
    released = run(confined, [FULL] * 11)
    assert [d.roi for d in released] == [here] * 10 + [None]


def test_the_reason_in_force_is_the_one_that_decided() -> None:
    confined = BOXES._replace(roi=Disc(0, 0, 32))
    asked = FULL._replace(roi=Disc(1, 0, 32))
    (waiting,) = run(confined, [asked])
    assert waiting.roi == Disc(1, 0, 32)
    assert waiting.reason == "boxes", "the disc moved, but full features are still waiting"


directives = st.builds(
    Directive,
    source=st.just(0),
    destination=st.just(1),
    representation=st.sampled_from(Representation),
    rho=st.sampled_from([0.0, 0.02, 0.25, 1.0]),
    roi=st.none() | st.builds(Disc, st.floats(-9, 9), st.floats(-9, 9), st.sampled_from([16.0, 32.0])),
    rate_hz=st.sampled_from([0.0, 2.0, 5.0, 10.0]),
    fusion_weight=st.sampled_from([0.5, 1.0]),
    duty_percent=st.sampled_from([50, 100]),
)


def above(a: Directive, b: Directive) -> bool:
    """Whether a is somewhere above b on the ladder."""
    return a.representation > b.representation or (
        a.representation == b.representation != Representation.NONE and (a.rate_hz > b.rate_hz or a.rho > b.rho)
    )


@given(st.lists(directives, min_size=1, max_size=60), st.floats(0.05, 3.0))
def test_upgrades_are_at_least_a_dwell_apart_from_their_asking(asked: list[Directive], dwell_s: float) -> None:
    """Average dwell time: no more than 1 + t / dwell upgrades in t seconds; never above what is asked now."""
    state, upgrades = DampedLink(NOTHING), []
    for i, directive in enumerate(asked):
        now_s = i * 0.1
        after = damp(state, directive, now_s, dwell_s)
        assert not above(after.enforced, directive), "more is enforced than the policy asks for"
        if above(after.enforced, state.enforced):
            upgrades.append(now_s)
        state = after
    assert len(upgrades) <= 1 + 0.1 * len(asked) / dwell_s
    assert all(b - a >= dwell_s - 1e-6 for a, b in itertools.pairwise(upgrades))


def test_one_frame_at_the_end_of_the_dwell_does_not_lift_the_grant() -> None:
    little = FULL._replace(rho=0.02, rate_hz=2.0, reason="little")
    enforced = run(NOTHING, [little] * 10 + [FULL] + [little] * 20)
    assert enforced[:10] == [NOTHING] * 10
    assert enforced[10:] == [little] * 21
    assert enforced[10].reason == "little", "the reason is of the request that is granted"


def test_what_flickers_is_granted_at_its_least() -> None:
    asked = [FULL._replace(rate_hz=(5.0, 10.0)[i // 3 % 2], rho=(0.5, 0.1)[i // 4 % 2]) for i in range(40)]
    assert run(BOXES, asked)[10:] == [FULL._replace(rate_hz=5.0, rho=0.1)] * 30


def test_what_rises_after_a_grant_waits_a_dwell_from_there() -> None:
    enforced = run(BOXES, [HALF] * 9 + [FULL] * 20)
    assert [d.rate_hz for d in enforced] == [2.0] * 10 + [5.0] * 10 + [10.0] * 9


def test_a_part_that_flickers_does_not_hold_up_a_steady_one() -> None:
    """The rate falls back at 0.6 s; ρ has been asked for since 0.4 s and is granted a dwell after that."""
    start = FULL._replace(rho=0.1, rate_hz=2.0)
    asked = [start._replace(rho=1.0 if i >= 4 else 0.1, rate_hz=10.0 if i < 6 else 2.0) for i in range(20)]
    assert [d.rho for d in run(start, asked)] == [0.1] * 14 + [1.0] * 6


def least(asked: list[Directive]) -> Directive:
    """The least of several directives in turn, in every part; a representation comes with its own ρ, and a lower one with its own disc."""
    rung = min(d.representation for d in asked)
    if rung == Representation.NONE:
        return NOTHING._replace(duty_percent=min(d.duty_percent for d in asked))
    own = next(i for i, d in enumerate(asked) if d.representation == rung)
    radii_m = [d.roi.radius_m for d in asked[own:] if d.roi is not None]
    return FULL._replace(
        representation=rung,
        rho=min(d.rho for d in asked if d.representation == rung),
        roi=Disc(0.0, 0.0, min(radii_m)) if radii_m else None,
        rate_hz=min(d.rate_hz for d in asked),
        fusion_weight=min(d.fusion_weight for d in asked),
        duty_percent=min(d.duty_percent for d in asked),
    )


def by_hand(start: Directive, asked: list[Directive], dwell: int) -> list[Directive]:
    """What is in force at each tick, from the whole history: an upgrade to the least of the last `dwell` ticks, and no
    two upgrades closer."""
    enforced, in_force, upgraded = [], start, 0
    for k, now in enumerate(asked):
        lowered = least([in_force, now])
        throughout = least(asked[max(0, k - dwell) : k + 1])
        if k - dwell >= upgraded and throughout != lowered:
            upgraded = k
            in_force = throughout
        else:
            in_force = lowered
        enforced.append(in_force)
    return enforced


def asks_at_least(asked: Directive, granted: Directive) -> bool:
    """Whether a directive asks for as much as another one in every part. ρ and disc are parts of a representation."""
    if granted.representation == Representation.NONE:
        return asked.duty_percent >= granted.duty_percent
    if asked.representation == granted.representation:
        wide = asked.roi is None or (granted.roi is not None and granted.roi.radius_m <= asked.roi.radius_m)
        if not wide or asked.rho < granted.rho:
            return False
    return (
        asked.representation >= granted.representation
        and asked.rate_hz >= granted.rate_hz
        and asked.fusion_weight >= granted.fusion_weight
        and asked.duty_percent >= granted.duty_percent
    )


flowing = directives.map(
    lambda d: d._replace(deadline_s=0.1) if d.representation else NOTHING._replace(duty_percent=d.duty_percent)
)
"""Directives of one deadline, without rate and ρ where nothing flows."""
held = st.tuples(flowing, st.integers(1, 8)).map(lambda several: [several[0]] * several[1])
histories = st.lists(held, min_size=1, max_size=12).map(lambda several: list(itertools.chain.from_iterable(several)))
"""What a policy proposes, tick by tick: each directive for one to eight ticks."""


def without_place(d: Directive) -> Directive:
    return d if d.roi is None else d._replace(roi=Disc(0.0, 0.0, d.roi.radius_m))


@given(histories, st.integers(0, 12))
def test_damping_agrees_with_the_whole_history(asked: list[Directive], dwell: int) -> None:
    state, enforced = DampedLink(NOTHING), []
    for i, directive in enumerate(asked):
        state = damp(state, directive, 0.1 * i, 0.1 * dwell)
        enforced.append(without_place(state.enforced))
    assert enforced == by_hand(NOTHING, [without_place(d) for d in asked], dwell)


@given(histories, st.integers(1, 12))
def test_no_more_is_granted_than_was_asked_for_throughout_the_dwell(asked: list[Directive], dwell: int) -> None:
    state = DampedLink(NOTHING)
    for i, directive in enumerate(asked):
        after = damp(state, directive, 0.1 * i, 0.1 * dwell)
        assert asks_at_least(directive, after.enforced), "more is in force than is asked for now"
        if not asks_at_least(state.enforced, after.enforced):
            assert i >= dwell, "an upgrade before the dwell is over"
            assert all(asks_at_least(d, after.enforced) for d in asked[i - dwell : i + 1])
        state = after


@given(histories, flowing, st.integers(1, 12))
def test_a_steady_request_is_granted_a_dwell_after_it_or_after_the_last_upgrade(
    before: list[Directive], steady: Directive, dwell: int
) -> None:
    asked = before + [steady] * (2 * dwell + 1)
    state, began = DampedLink(NOTHING), len(before)
    for i, directive in enumerate(asked):
        after = damp(state, directive, 0.1 * i, 0.1 * dwell)
        if i >= len(before) and not asks_at_least(state.enforced, after.enforced):
            began = i
        state = after
        if i >= began + dwell:
            assert without_place(state.enforced) == without_place(steady)
    settled = damp(DampedLink(NOTHING), steady, 0.0, 0.1 * dwell)
    ticks = [settled := damp(settled, steady, 0.1 * i, 0.1 * dwell) for i in range(1, dwell + 1)]
    assert ticks[-1].enforced == steady
    if steady.representation:
        assert not any(link.enforced.representation for link in ticks[:-1]), "from a link at rest after exactly a dwell"


def test_a_lower_duty_cycle_passes_at_once_even_where_nothing_flows() -> None:
    resting = NOTHING._replace(duty_percent=20)
    assert run(NOTHING, [resting]) == [resting]
    assert [d.duty_percent for d in run(resting, [NOTHING] * 11)] == [20] * 10 + [100]
    (first,) = run(NOTHING, [FULL._replace(duty_percent=20)])
    assert (first.representation, first.duty_percent) == (Representation.NONE, 20)


def test_a_disc_that_hardly_moved_is_the_same_directive() -> None:
    state = DampedLink(FULL._replace(roi=Disc(0, 0, 32)))
    assert damp(state, FULL._replace(roi=Disc(1.0, 1.0, 32)), 0.0, DWELL_S) is state
    assert damp(state, FULL._replace(roi=Disc(1.2, 1.2, 32)), 0.0, DWELL_S).enforced.roi == Disc(1.2, 1.2, 32)
    assert damp(state, FULL._replace(roi=Disc(1.0, 1.0, 31)), 0.0, DWELL_S).enforced.roi == Disc(1.0, 1.0, 31)


# --- the band on what is read ---------------------------------------------------------------------

IN_A_DISC = FULL._replace(roi=Disc(10.0, 20.0, 30.0), fusion_weight=0.5, duty_percent=50, rho=0.5)
OTHERS = {
    "representation": Representation.DETECTIONS, "rho": 0.25, "roi": Disc(60.0, 20.0, 30.0), "rate_hz": 5.0,
    "deadline_s": 0.4, "fusion_weight": 0.25, "duty_percent": 25,
}  # fmt: skip


@pytest.mark.parametrize("fields", [*itertools.combinations(OTHERS, 1), *itertools.combinations(OTHERS, 2)])
def test_a_change_that_is_no_climb_reaches_the_gate_at_once_whatever_it_is_of(fields: tuple[str, ...]) -> None:
    """Every field alone and every two together; a deadline that grows asks for no more of the link."""
    asked = IN_A_DISC._replace(**{name: OTHERS[name] for name in fields})
    assert is_switch(IN_A_DISC, asked)
    assert not is_climb(IN_A_DISC, asked)
    assert damp(DampedLink(IN_A_DISC), asked, 0.0, DWELL_S).enforced == asked


BAND = 0.25
HEARD = Descriptor(
    0, 1, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 42.0, 0.5, 0.5, 0.5,
    (10.0, 0.0), bytes(64), 0, TaskPhase.SEARCH, None,
)  # fmt: skip
FLICKERING = ("battery_soc", "cpu_headroom", "gpu_headroom")


def read(values: list[float], field: str = "goodput", band: float = BAND) -> list[float]:
    """What a drone publishes of one quantity, value by value."""
    known, seen = None, []
    for value in values:
        heard = HEARD._replace(**({"peer_goodput_mbps": (value, 0.0)} if field == "goodput" else {field: value}))
        known = heard if known is None else apply_hysteresis(known, heard, band)
        seen.append(known.peer_goodput_mbps[0] if field == "goodput" else getattr(known, field))
    return seen


@pytest.mark.parametrize("field", ["goodput", *FLICKERING])
def test_what_falls_is_read_at_once_and_what_rises_by_more_than_the_band(field: str) -> None:
    assert read([0.8, 0.4, 0.5, 0.45], field) == pytest.approx([0.8, 0.4, 0.4, 0.4])
    assert read([0.4, 0.75, 0.6, 0.5], field) == pytest.approx([0.4, 0.6, 0.6, 0.5])
    assert read([0.4, 0.75], field, band=0.0) == [0.4, 0.75]


def test_a_link_that_hovers_about_a_threshold_crosses_it_once() -> None:
    """Down below 5, up again from 5 · (1 + band) on: a Schmitt trigger in front of any policy's comparison."""
    hovering = [4.9, 5.1, 4.8, 5.9, 4.7, 6.2] * 20
    assert not any(u >= 5.0 for u in read(hovering)[1:])
    assert read([4.9, 6.25])[-1] == 5.0


def test_all_else_is_read_as_heard_and_a_roster_that_grew_anew() -> None:
    moved = HEARD._replace(stamp_ns=7, position_m=(1.0, 2.0, 3.0), task_phase=TaskPhase.TRACK)
    assert apply_hysteresis(HEARD, moved, BAND) is moved
    more = moved._replace(peer_goodput_mbps=(11.0, 0.0, 3.0), battery_soc=0.9)
    assert apply_hysteresis(HEARD, more, BAND) == more._replace(battery_soc=pytest.approx(0.72))


@given(st.lists(st.floats(0, 300), min_size=1, max_size=60), st.floats(0, 3))
@example([1e-3, 1.5e-3], 1.0)  # states of a link, no rates
def test_the_band_is_the_play_operator(values: list[float], band: float) -> None:
    """Never above what was heard, never below it by more than the band, still where it moved by less; saying the same
    again changes nothing."""
    seen = read(values, band=band)
    for u, v in zip(values, seen, strict=True):
        assert u / (1 + band) - 1e-9 <= v <= u
    for (before, v), u in zip(itertools.pairwise(seen), values[1:], strict=True):
        if u > PROBED_MBPS and before <= u <= before * (1 + band) * (1 - 1e-12):
            assert v == before
    assert read([u for u in values for _ in range(3)], band=band)[::3] == seen


def test_a_probed_link_is_read_as_heard_since_its_value_is_no_rate() -> None:
    assert read([SILENT_MBPS, probed_mbps(0.6), probed_mbps(0.7)]) == [SILENT_MBPS, probed_mbps(0.6), probed_mbps(0.7)]


@given(st.lists(st.sampled_from([0.0, SILENT_MBPS, 0.002, 4.0, 80.0]), min_size=1, max_size=20), st.floats(0, 3))
def test_the_band_never_hides_that_a_link_was_measured(values: list[float], band: float) -> None:
    for heard, seen in zip(values, read(values, band=band), strict=True):
        assert (state_of(seen) == LinkState.UNKNOWN) == (state_of(heard) == LinkState.UNKNOWN)


def test_the_cells_of_another_representation_bound_nothing() -> None:
    """Raw images have no ρ: a policy that alternates them with features keeps its features meanwhile."""
    features = FULL._replace(representation=Representation.FEATURES, rho=0.5)
    raw = features._replace(representation=Representation.RAW, rho=0.0)
    link = DampedLink(features)
    for tick in range(100):
        link = damp(link, (raw, features)[tick % 2], tick * 0.1, 1.0)
        assert (link.enforced.representation, link.enforced.rho) == (Representation.FEATURES, 0.5)
