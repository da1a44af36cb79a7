"""What age leaves of a link, when the gate lets a payload through, and how large payloads and tiles are."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.gate import HEADER_BYTES, Gate, Payload, make_payload
from sortie.fleet.messages.wire import DIRECTIVE_BYTES
from sortie.fleet.tiles import TILE_HEADER_BYTES, cells_of, cut
from sortie.perception.types import Boxes
from sortie.policies.contract import Directive, Disc, Representation
from sortie.policies.staleness import CEILING, DEGRADED_RATE_HZ, LinkHealth, cap_by_age, health
from sortie.policies.verification.invariants.language import COMPARE
from sortie.policies.verification.invariants.words import DECISIONS
from sortie.radio.mac.airtime import fragments
from sortie.scenarios.schema import (
    MIN_TILE_BYTES,
    Radio,
)

FULL = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, reason="full")
ORIGIN = (0.0, 0.0, 0.0)


# --- staleness --------------------------------------------------------------------------------------------


def test_more_than_three_periods_degrade_and_more_than_ten_detach() -> None:
    fresh = [0.0, 0.3, 0.1 + 0.1 + 0.1]  # 0.30000000000000004 is three periods, not more
    degraded, detached = [0.301, 1.0], [1.001, None]
    assert [health(age_s, 0.1, 3, 10) for age_s in fresh] == [LinkHealth.FRESH] * 3
    assert [health(age_s, 0.1, 3, 10) for age_s in degraded] == [LinkHealth.DEGRADED] * 2
    assert [health(age_s, 0.1, 3, 10) for age_s in detached] == [LinkHealth.DETACHED] * 2


def test_a_degraded_link_carries_detections_slowly_and_a_detached_one_nothing() -> None:
    degraded = cap_by_age(FULL, LinkHealth.DEGRADED, 0.42)
    assert (degraded.representation, degraded.rate_hz, degraded.rho) == (Representation.DETECTIONS, 2.0, 0.0)
    assert degraded.reason == "degraded: descriptor 0.42 s old"
    detached = cap_by_age(FULL, LinkHealth.DETACHED, None)
    assert detached.representation == Representation.NONE
    assert detached.reason == "detached: never heard"
    assert cap_by_age(FULL, LinkHealth.FRESH, 0.1) is FULL


def test_staleness_leaves_duty_weight_deadline_and_region_as_they_were_asked() -> None:
    """It reduces what a link carries and how often. A link that carries nothing has its drone's duty all the same."""
    rates_hz = (0.5, DEGRADED_RATE_HZ, 10.0)
    for rung, rate_hz, duty in product(Representation, rates_hz, (100, 30, 0)):
        asked = Directive(2, 5, rung, 0.4, Disc(1, 2, 3), rate_hz, 0.7, 0.25, duty, "asked")
        capped = cap_by_age(asked, LinkHealth.DEGRADED, 0.6)
        assert (capped.source, capped.destination, capped.duty_percent) == (2, 5, duty)
        assert capped.representation == min(rung, Representation.DETECTIONS)
        assert capped.rate_hz == min(rate_hz, DEGRADED_RATE_HZ)
        assert (capped.roi, capped.deadline_s, capped.fusion_weight) == (asked.roi, 0.7, 0.25)
        assert capped.rho == (0.0 if rung > Representation.DETECTIONS else 0.4)
        gone = cap_by_age(asked, LinkHealth.DETACHED, 0.6)
        assert gone[:3] == (2, 5, Representation.NONE)
        assert gone.duty_percent == duty


NUMBERS = st.sampled_from([0.0, 0.1, 0.5, 1.0, 2.0, 5.0])
REGIONS = st.sampled_from([None, Disc(0.0, 0.0, 5.0)])
RUNGS = st.sampled_from(Representation)
RHOS, WEIGHTS = st.sampled_from([0.0, 0.5]), st.sampled_from([0.5, 1.0])


@given(
    st.builds(Directive, st.just(0), st.just(1), RUNGS, RHOS, REGIONS, NUMBERS, NUMBERS, WEIGHTS),
    st.sampled_from(LinkHealth),
)
def test_a_ceiling_allows_the_directives_that_age_leaves_as_they_are(asked: Directive, health: LinkHealth) -> None:
    bounds = [(COMPARE[sign], DECISIONS[word].raw(asked), value) for word, sign, value in CEILING[health]]
    below = all(holds(asked_for, value) for holds, asked_for, value in bounds)  # type: ignore[misc]
    assert below == (cap_by_age(asked, health, 0.5) == asked)


# --- the gate ---------------------------------------------------------------------------------------------


def test_the_gate_keeps_the_rate() -> None:
    """Over ten seconds of frames of 0.1 s, none of which sends more than one payload."""
    sent = {}
    for rate_hz in (10.0, 5.0, 3.0, 2.0, 0.5, 0.0, 30.0):
        gate = Gate()
        gate.enforce(FULL._replace(rate_hz=rate_hz))
        sent[rate_hz] = sum(len(gate.due(k * 0.1 + 0.033)) for k in range(100))
    assert sent == {hz: pytest.approx(min(10 * hz, 100), abs=1 if hz else 0) for hz in sent}


def test_repeating_a_directive_restarts_no_timer() -> None:
    """The bug that the paper names: a repeated command restarted the data timer and silenced the link."""
    g = Gate()
    sent = 0
    for k in range(100):
        g.enforce(FULL._replace(rate_hz=2.0))  # every frame anew
        sent += len(g.due(k * 0.1))
    assert sent == 20


def test_a_changed_rate_counts_from_the_last_send() -> None:
    g = Gate()
    g.enforce(FULL._replace(rate_hz=2.0))
    assert len(g.due(0.0)) == 1
    g.enforce(FULL._replace(rate_hz=5.0))
    assert [len(g.due(t)) for t in (0.1, 0.2)] == [0, 1]


def test_links_are_served_by_ascending_peer_and_none_sends_nothing() -> None:
    g = Gate()
    for peer in (3, 1, 2):
        g.enforce(
            FULL._replace(destination=peer, representation=Representation.NONE if peer == 2 else FULL.representation)
        )
    assert [d.destination for d in g.due(0.0)] == [1, 3]


def test_a_drone_looks_as_often_as_any_of_its_links_asks_also_one_that_carries_nothing() -> None:
    gate = Gate()
    assert gate.duty_percent == 100
    gate.enforce(FULL._replace(duty_percent=20))
    gate.enforce(Directive(0, 2, duty_percent=70))
    assert gate.duty_percent == 70
    gate.enforce(Directive(0, 2, duty_percent=10))
    gate.enforce(Directive(0, 3, duty_percent=5))
    assert gate.duty_percent == 20


def test_a_link_that_pauses_keeps_its_slots() -> None:
    """Asking for nothing and for the same again within a slot lets nothing more through."""
    gate = Gate()
    gate.enforce(FULL._replace(rate_hz=1.0))
    assert len(gate.due(10.0)) == 1
    gate.enforce(Directive(0, 1))
    gate.enforce(FULL._replace(rate_hz=1.0))
    assert gate.due(10.5) == []
    assert len(gate.due(11.0)) == 1


def test_a_link_that_could_not_send_does_not_make_up_for_it() -> None:
    """Whatever kept it from sending: from then on it sends at its rate, one payload a frame at most."""
    for rate_hz, rested_s in product((2.0, 3.0, 5.0), (0.7, 5.0)):
        gate = Gate()
        gate.enforce(FULL._replace(rate_hz=rate_hz))
        assert len(gate.due(0.0)) == 1
        sent = [k for k in range(20) if gate.due(rested_s + 0.1 * k)]
        assert len(sent) == pytest.approx(2 * rate_hz, abs=1)
        assert np.diff(sent[1:]).min() >= int(10 / rate_hz)  # the first may keep to the slots of before


# --- payloads ---------------------------------------------------------------------------------------------


def made(directive: Directive, boxes: int = 3, *given: Any, **of: Any) -> Payload:
    payload = make_payload(directive, *ORIGIN, lambda roi: boxes, *given, **of)
    assert payload is not None
    return payload


def test_payloads_have_the_papers_sizes() -> None:
    wrong = {}
    for directive, cells, content in (
        (FULL, 4096, 655_360),  # a whole map needs no index
        (FULL._replace(rho=0.25), 1024, 163_840 + 512),  # bitmap
        (FULL._replace(rho=0.02), 81, 12_960 + 122),  # list of 12-bit indices
        (FULL._replace(representation=Representation.RAW), 0, 5_400_000),
        (FULL._replace(representation=Representation.DETECTIONS), 0, 40 * 24),
        (FULL._replace(representation=Representation.TRACKS), 0, 12 * 20),
        (FULL._replace(representation=Representation.UNCERTAIN_BOXES), 0, 40 * 36),
    ):
        payload = made(directive, 40)
        if (payload.cells, payload.size_bytes) != (cells, HEADER_BYTES + DIRECTIVE_BYTES + content):
            wrong[directive] = payload
    assert wrong == {}


def test_codes_have_their_exact_bytes_and_features_none_of_theirs() -> None:
    """A share of 0.05 of the cells, and an index of 12 bits each; a codebook in front of codes."""
    codes = FULL._replace(representation=Representation.CODES, rho=0.05)
    sent = made(codes, 3, 1344, code_bytes=5)
    assert (sent.cells, sent.boxes, sent.index_bytes, sent.code_bytes, sent.tile_bytes) == (204, 0, 306, 5, None)
    assert sent.size_bytes == HEADER_BYTES + DIRECTIVE_BYTES + 8 + 204 * 5 + 306
    assert make_payload(codes._replace(rho=0.0001), *ORIGIN, lambda roi: 3) is None
    features = made(FULL._replace(rho=0.05), 3, code_bytes=5)
    assert (features.size_bytes, features.code_bytes) == (HEADER_BYTES + DIRECTIVE_BYTES + 204 * 160 + 306, 0)


def test_a_region_confines_cells_and_boxes() -> None:
    disc = Disc(10.0, 5.0, 32.0)
    assert made(FULL._replace(roi=disc)).cells == pytest.approx(314, abs=6), "π 32² / 3.2² cells (FACTS §1)"
    asked: list[Disc | None] = []
    detections = FULL._replace(representation=Representation.DETECTIONS, roi=disc)
    make_payload(detections, *ORIGIN, lambda roi: asked.append(roi) or 3)
    assert asked == [disc]


def people(n: int) -> Boxes:
    return Boxes(np.zeros((n, 2)), np.ones((n, 2)), np.zeros(n), np.full(n, 0.9))


def test_people_of_the_region_are_among_the_detections() -> None:
    """They count as boxes, of the region alone, where no tracker tells of the region."""
    roi, asked = Disc(5.0, 5.0, 30.0), []
    tracks = FULL._replace(representation=Representation.TRACKS, roi=roi)

    def told(what: str, answer: Any) -> Any:
        return lambda where: asked.append((what, where)) or answer

    of = {"count_boxes": told("boxes", 4), "tracks_in": told("tracks", None), "people_in": told("people", people(2))}
    sent = make_payload(tracks, *ORIGIN, **of)
    assert sent is not None
    assert sent.people is not None
    assert (sent.boxes, len(sent.people), sent.size_bytes) == (6, 2, made(tracks, 6).size_bytes)
    assert dict(asked) == dict.fromkeys(("boxes", "tracks", "people"), roi)


def test_nothing_is_sent_where_the_region_is_out_of_sight() -> None:
    assert make_payload(FULL._replace(roi=Disc(900, 0, 32)), *ORIGIN, lambda roi: 0) is None
    assert make_payload(FULL._replace(representation=Representation.NONE), *ORIGIN, lambda roi: 9) is None


def test_compact_payloads_go_reliably() -> None:
    kinds = {r: made(FULL._replace(representation=r), 1) for r in list(Representation)[1:]}
    reliable = {Representation.TRACKS, Representation.DETECTIONS, Representation.UNCERTAIN_BOXES}
    assert {r for r, payload in kinds.items() if payload.reliable} == reliable


# --- tiles ------------------------------------------------------------------------------------------------


def test_eight_cells_fit_a_fragment_of_cyclones() -> None:
    tiles = cut(4096, 1344)
    assert (tiles.cells_each, tiles.tile_bytes, tiles.number) == (8, 44 + 8 * 160 + 12, 512)
    assert tiles.size_bytes == 512 * 1336
    assert tiles.size_bytes / (4096 * 160) == pytest.approx(1.044, abs=1e-3)  # what it costs to be of use alone


@given(cells=st.integers(1, 4096), limit=st.integers(MIN_TILE_BYTES, 65_000))
def test_tiles_hold_every_cell_once_and_keep_to_their_limit(cells: int, limit: int) -> None:
    tiles = cut(cells, limit)
    assert tiles.tile_bytes <= limit
    assert tiles.size_bytes == tiles.number * TILE_HEADER_BYTES + cells * 160 + tiles.index_bytes
    assert fragments(tiles.size_bytes, tiles.tile_bytes) == tiles.number  # the radio cuts it where the tiles end
    assert cells_of(range(tiles.number), cells, tiles.cells_each) == tuple(range(cells))
    wider = TILE_HEADER_BYTES + (tiles.cells_each + 1) * 160 + -(-(tiles.cells_each + 1) * 3 // 2)
    assert wider > limit  # no further cell would fit


def test_a_fragment_must_hold_a_cell() -> None:
    assert cut(3, MIN_TILE_BYTES).cells_each == 1
    with pytest.raises(ValueError, match="fragment_bytes is 205, must be at least 206 for a tile of one cell"):
        cut(3, MIN_TILE_BYTES - 1)
    with pytest.raises(ValueError, match="must be at least 206 where framing is tiles"):
        Radio(framing="tiles", fragment_bytes=205)


def test_the_gate_cuts_features_and_nothing_else() -> None:
    """Codes are one sample also where features are tiles; so are detections."""
    tenth = FULL._replace(rho=0.1)
    tiled, plain = made(tenth, 3, 1344), made(tenth)
    assert (tiled.cells, tiled.tile_cells, tiled.tile_bytes) == (409, 8, 1336)
    assert tiled.size_bytes == 51 * 1336 + 44 + 160 + 2
    assert (plain.tile_cells, plain.tile_bytes) == (0, None)
    for rung in (Representation.CODES, Representation.DETECTIONS):
        whole = made(tenth._replace(representation=rung), 3, 1344)
        assert (whole.tile_cells, whole.tile_bytes) == (0, None)
    codes = tenth._replace(representation=Representation.CODES)
    short, long = made(codes, 3, 1344, code_bytes=4), made(codes, 3, code_bytes=9)
    assert (short.code_bytes, long.size_bytes - short.size_bytes) == (4, 5 * short.cells)
