"""Damping: reductions at once, upgrades after the dwell, repeats for free."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from policies.contract import Directive, Disc, Representation
from policies.damping import LinkState, damp

FULL = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, reason="full")
HALF = FULL._replace(rate_hz=5.0, reason="half")
BOXES = Directive(0, 1, Representation.DETECTIONS, 0.0, None, 2.0, reason="boxes")
NOTHING = Directive(0, 1)
DWELL_S = 1.0


def run(start: Directive, asked: list[Directive], step_s: float = 0.1) -> list[Directive]:
    state, enforced = LinkState(start), []
    for i, directive in enumerate(asked):
        state = damp(state, directive, i * step_s, DWELL_S)
        enforced.append(state.enforced)
    return enforced


def test_a_repeated_directive_changes_nothing_and_restarts_nothing() -> None:
    state = LinkState(FULL)
    assert damp(state, FULL, 0.0, DWELL_S) is state
    assert damp(state, FULL._replace(reason="other words"), 5.0, DWELL_S) is state
    waiting = damp(LinkState(BOXES), FULL, 0.0, DWELL_S)
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
    state, upgrades = LinkState(NOTHING), []
    for i, directive in enumerate(asked):
        now_s = i * 0.1
        after = damp(state, directive, now_s, dwell_s)
        assert not above(after.enforced, directive), "more is enforced than the policy asks for"
        if above(after.enforced, state.enforced):
            upgrades.append(now_s)
        state = after
    assert len(upgrades) <= 1 + 0.1 * len(asked) / dwell_s
    assert all(b - a >= dwell_s - 1e-6 for a, b in itertools.pairwise(upgrades))


def test_a_lower_duty_cycle_passes_at_once_even_where_nothing_flows() -> None:
    resting = NOTHING._replace(duty_percent=20)
    assert run(NOTHING, [resting]) == [resting]
    assert [d.duty_percent for d in run(resting, [NOTHING] * 11)] == [20] * 10 + [100]
    (first,) = run(NOTHING, [FULL._replace(duty_percent=20)])
    assert (first.representation, first.duty_percent) == (Representation.NONE, 20)


def test_a_disc_that_hardly_moved_is_the_same_directive() -> None:
    state = LinkState(FULL._replace(roi=Disc(0, 0, 32)))
    assert damp(state, FULL._replace(roi=Disc(1.0, 1.0, 32)), 0.0, DWELL_S) is state
    assert damp(state, FULL._replace(roi=Disc(1.2, 1.2, 32)), 0.0, DWELL_S).enforced.roi == Disc(1.2, 1.2, 32)
    assert damp(state, FULL._replace(roi=Disc(1.0, 1.0, 31)), 0.0, DWELL_S).enforced.roi == Disc(1.0, 1.0, 31)
