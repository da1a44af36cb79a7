"""Damping: a band on what is read; reductions at once, upgrades after the dwell, repeats for free."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from policies_examples import fleet_of

from sortie.policies.contract import Descriptor, Directive, Disc, LinkState, Representation, Roster, TaskPhase
from sortie.policies.damping import SAME_DISC_M, DampedLink, apply_hysteresis, damp, is_climb, is_switch
from sortie.scenarios.link_state import PROBED_MBPS, SILENT_MBPS, probed_mbps, state_of

FULL = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, reason="full")
HALF = FULL._replace(rate_hz=5.0, reason="half")
BOXES = Directive(0, 1, Representation.DETECTIONS, 0.0, None, 2.0, reason="boxes")
NOTHING = Directive(0, 1)
LITTLE = FULL._replace(rho=0.02, rate_hz=2.0, reason="little")
HERE, THERE, WIDE = Disc(0, 0, 32), Disc(5, 0, 32), Disc(5, 0, 64)
CONFINED, TIRED = FULL._replace(roi=HERE), NOTHING._replace(duty_percent=20)
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


COURSES: dict[str, tuple[Directive, list[Directive], list[Directive]]] = {
    "less passes at once": (FULL, [HALF], [HALF]),
    "a lower rung passes at once": (FULL, [BOXES], [BOXES]),
    "nothing passes at once": (FULL, [NOTHING], [NOTHING]),
    "more waits for the dwell": (BOXES, [FULL] * 12, [BOXES] * 10 + [FULL] * 2),
    "a passing change does not switch": (BOXES, [FULL] * 9 + [BOXES] + [FULL] * 9, [BOXES] * 19),
    "a disc confines at once": (FULL, [CONFINED], [CONFINED]),
    "a disc moves freely": (CONFINED, [FULL._replace(roi=THERE)], [FULL._replace(roi=THERE)]),
    "a disc widens late": (CONFINED, [FULL._replace(roi=WIDE)], [FULL._replace(roi=THERE)]),
    "a disc is released late": (CONFINED, [FULL] * 11, [CONFINED] * 10 + [FULL]),
    "one frame does not lift the grant": (
        NOTHING,
        [LITTLE] * 10 + [FULL] + [LITTLE] * 20,
        [NOTHING] * 10 + [LITTLE] * 21,
    ),
    "a rise after a grant waits from there": (
        BOXES,
        [HALF] * 9 + [FULL] * 20,
        [BOXES] * 10 + [HALF] * 10 + [FULL] * 9,
    ),
    "the duty falls at once at rest": (NOTHING, [TIRED], [TIRED]),
    "the duty rises late at rest": (TIRED, [NOTHING] * 11, [TIRED] * 10 + [NOTHING]),
    "the duty falls while the link waits": (NOTHING, [FULL._replace(duty_percent=20)], [TIRED]),
}
"""A link in force, what is proposed every 0.1 s, and what is then in force."""


def test_reductions_pass_at_once_and_upgrades_wait() -> None:
    found = {name: run(start, asked) for name, (start, asked, _) in COURSES.items()}
    assert {name: d for name, d in found.items() if d != COURSES[name][2]} == {}


def test_the_reason_in_force_is_the_one_that_decided() -> None:
    confined = BOXES._replace(roi=Disc(0, 0, 32))
    (waiting,) = run(confined, [FULL._replace(roi=Disc(1, 0, 32))])
    assert waiting.roi == Disc(1, 0, 32)
    assert waiting.reason == "boxes", "the disc moved, but full features are still waiting"
    enforced = run(NOTHING, [LITTLE] * 10 + [FULL])
    assert enforced[10].reason == "little", "the reason is of the request that is granted"


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


def least(asked: list[Directive]) -> Directive:
    """The least of several directives in every part. A representation brings its own ρ, a lower one its disc."""
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


flowing = directives.map(
    lambda d: d._replace(deadline_s=0.1) if d.representation else NOTHING._replace(duty_percent=d.duty_percent)
)
"""Directives of one deadline, without rate and ρ where nothing flows."""
held = st.tuples(flowing, st.integers(1, 8)).map(lambda several: [several[0]] * several[1])
histories = st.lists(held, min_size=1, max_size=12).map(lambda several: list(itertools.chain.from_iterable(several)))
"""What a policy proposes, tick by tick: each directive for one to eight ticks."""


def without_place(d: Directive) -> Directive:
    return d if d.roi is None else d._replace(roi=Disc(0.0, 0.0, d.roi.radius_m))


@given(histories, flowing, st.integers(0, 12))
def test_damping_agrees_with_the_whole_history(before: list[Directive], steady: Directive, dwell: int) -> None:
    """A steady request at the end is granted."""
    state, enforced, asked = DampedLink(NOTHING), [], before + [steady] * (2 * dwell + 1)
    for i, directive in enumerate(asked):
        state = damp(state, directive, 0.1 * i, 0.1 * dwell)
        enforced.append(without_place(state.enforced))
    assert enforced == by_hand(NOTHING, [without_place(d) for d in asked], dwell)
    assert enforced[-1] == without_place(steady)


def test_a_disc_that_hardly_moved_is_the_same_directive() -> None:
    state = DampedLink(FULL._replace(roi=Disc(0, 0, 32)))
    assert damp(state, FULL._replace(roi=Disc(1.0, 1.0, 32)), 0.0, DWELL_S) is state
    assert damp(state, FULL._replace(roi=Disc(1.2, 1.2, 32)), 0.0, DWELL_S).enforced.roi == Disc(1.2, 1.2, 32)
    assert damp(state, FULL._replace(roi=Disc(1.0, 1.0, 31)), 0.0, DWELL_S).enforced.roi == Disc(1.0, 1.0, 31)
    a = FULL._replace(roi=Disc(0.0, 0.0, 32.0))
    assert is_switch(a, a._replace(roi=Disc(SAME_DISC_M, 0.0, 32.0)))
    assert not is_switch(a, a._replace(roi=Disc(0.99 * SAME_DISC_M, 0.0, 32.0)))


@pytest.mark.parametrize("waits", [3, 5])
def test_an_upgrade_that_waited_begins_with_the_disc_of_the_moment(waits: int) -> None:
    """A target drives on while its link waits: what is granted is aimed at where it is, and nothing waits any more."""
    low = Directive(0, 1, Representation.FEATURES, 0.2, Disc(0.0, 0.0, 30.0), 2.0)
    link = DampedLink(low)
    for k in range(waits + 1):
        disc = Disc(2.0 * k, 0.0, 30.0)
        link = damp(link, low._replace(roi=disc, rate_hz=10.0, deadline_s=0.1 + 0.01 * k), 0.1 * k, 0.1 * waits)
        assert link.enforced.roi == disc  # also while the rate waits
        assert link.enforced.rate_hz == (10.0 if k == waits else 2.0)
    assert link.enforced.deadline_s == pytest.approx(0.1 + 0.01 * waits)
    assert link.proposals == ()


USUAL = Directive(0, 1, Representation.FEATURES, 0.4, Disc(0, 0, 30), 5.0, 0.2, 0.5, 50, "usual")
STEPS: list[tuple[str, Any, Any]] = [
    ("representation", Representation.DETECTIONS, Representation.RAW),
    ("rho", 0.1, 0.9),
    ("roi", Disc(0, 0, 10), Disc(0, 0, 60)),
    ("roi", Disc(0, 0, 10), None),
    ("rate_hz", 2.0, 10.0),
    ("fusion_weight", 0.25, 1.0),
    ("duty_percent", 20, 100),
]


def test_each_field_alone_falls_at_once_and_rises_after_its_dwell_time() -> None:
    for field, less, more in STEPS:
        down = damp(DampedLink(USUAL), USUAL._replace(**{field: less}), 5.0, 1.0)
        assert getattr(down.enforced, field) == less
        up, asked = DampedLink(USUAL), USUAL._replace(**{field: more})
        for now_s, wanted in ((5.0, getattr(USUAL, field)), (5.9, getattr(USUAL, field)), (6.0, more)):
            up = damp(up, asked, now_s, 1.0)
            assert getattr(up.enforced, field) == wanted


def test_a_change_that_is_no_climb_reaches_the_gate_at_once_whatever_it_is_of() -> None:
    """Every field alone and every two together; a deadline that grows asks for no more of the link."""
    others = {field: less for field, less, _ in STEPS} | {"roi": Disc(60.0, 20.0, 30.0), "deadline_s": 0.4}
    for fields in [*itertools.combinations(others, 1), *itertools.combinations(others, 2)]:
        asked = USUAL._replace(**{name: others[name] for name in fields})
        assert is_switch(USUAL, asked)
        assert not is_climb(USUAL, asked)
        assert damp(DampedLink(USUAL), asked, 0.0, DWELL_S).enforced == asked


def test_the_cells_of_another_representation_bound_nothing() -> None:
    """Raw images have no ρ: a policy that alternates them with features keeps its features meanwhile."""
    features = FULL._replace(representation=Representation.FEATURES, rho=0.5)
    raw = features._replace(representation=Representation.RAW, rho=0.0)
    link = DampedLink(features)
    for tick in range(100):
        link = damp(link, (raw, features)[tick % 2], tick * 0.1, 1.0)
        assert (link.enforced.representation, link.enforced.rho) == (Representation.FEATURES, 0.5)


# --- the band on what is read ---------------------------------------------------------------------

BAND = 0.25
FLICKERING = ("battery_soc", "cpu_headroom", "gpu_headroom")
HEARD = fleet_of(3).descriptors[1]._replace(peer_goodput_mbps=(10.0, 0.0), **dict.fromkeys(FLICKERING, 0.5))


def published(values: list[float], field: str = "goodput", band: float = BAND) -> list[Descriptor]:
    """What a drone publishes, value by value of one quantity."""
    known, seen = None, []
    for value in values:
        heard = HEARD._replace(**({"peer_goodput_mbps": (value, 0.0)} if field == "goodput" else {field: value}))
        known = heard if known is None else apply_hysteresis(known, heard, band)
        seen.append(known)
    return seen


def read(values: list[float], field: str = "goodput", band: float = BAND) -> list[float]:
    """What a drone publishes of one quantity, value by value."""
    seen = published(values, field, band)
    return [d.peer_goodput_mbps[0] if field == "goodput" else getattr(d, field) for d in seen]


@pytest.mark.parametrize("field", ["goodput", *FLICKERING])
def test_what_falls_is_read_at_once_and_what_rises_by_more_than_the_band(field: str) -> None:
    assert read([0.8, 0.4, 0.5, 0.45], field) == pytest.approx([0.8, 0.4, 0.4, 0.4])
    assert read([0.4, 0.75, 0.6, 0.5], field) == pytest.approx([0.4, 0.6, 0.6, 0.5])
    assert read([0.4, 0.75], field, band=0.0) == [0.4, 0.75]
    last = published([0.4, 0.75], field)[-1]
    assert all(getattr(last, other) == 0.5 for other in FLICKERING if other != field)


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


def test_a_goodput_keeps_its_band_when_members_come_and_go() -> None:
    """Each peer's is held against its own last one, in whichever place of the list that stands."""
    me = HEARD._replace(agent_id=2)
    before = me._replace(peer_goodput_mbps=(10.0, 50.0, 90.0), roster=Roster(1, (0, 1, 2, 5)))
    now = me._replace(peer_goodput_mbps=(11.0, 30.0, 100.0), roster=Roster(2, (0, 2, 5, 9)))  # to 0, 5 and 9
    seen = apply_hysteresis(before, now, 0.2)
    assert seen.goodput_to(0) == 10.0  # a rise within the band
    assert seen.goodput_to(5) == 30.0  # a fall from 90
    assert seen.goodput_to(9) == pytest.approx(100 / 1.2)  # new: nothing was published before
    same = apply_hysteresis(before, before._replace(peer_goodput_mbps=(11.0, 55.0, 120.0)), 0.2)
    assert same.peer_goodput_mbps == pytest.approx((10.0, 50.0, 100.0))


@given(st.lists(st.floats(0, 300), min_size=1, max_size=60), st.floats(0, 3))
@example([1e-3, 1.5e-3], 1.0)  # states of a link, no rates
def test_the_band_is_the_play_operator(values: list[float], band: float) -> None:
    """Never above what was heard, never below it by more than the band, still where it moved by less; saying the same
    again changes nothing."""
    seen = read(values, band=band)
    for u, v in zip(values, seen, strict=True):
        assert u / (1 + band) - 1e-9 <= v <= u
        assert (state_of(v) == LinkState.UNKNOWN) == (state_of(u) == LinkState.UNKNOWN)
    for (before, v), u in zip(itertools.pairwise(seen), values[1:], strict=True):
        if u > PROBED_MBPS and before <= u <= before * (1 + band) * (1 - 1e-12):
            assert v == before
    assert read([u for u in values for _ in range(3)], band=band)[::3] == seen


def test_a_link_that_was_only_probed_is_read_as_heard_since_its_value_is_no_rate() -> None:
    heard = [SILENT_MBPS, probed_mbps(0.6), probed_mbps(0.7)]
    assert read(heard) == heard
    for values in itertools.product([0.0, SILENT_MBPS, 0.002, 4.0, 80.0], repeat=2):
        states = [[state_of(v) == LinkState.UNKNOWN for v in seen] for seen in (values, read(list(values), band=2.0))]
        assert states[0] == states[1]
