"""Staleness, the gate and the coverage statement."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet import gate
from sortie.fleet.coverage import footprint_radius_m, pack_grid, unpack_grid
from sortie.fleet.gate import Gate, make_payload
from sortie.fleet.messages.wire import DIRECTIVE_BYTES
from sortie.policies.contract import Directive, Disc, Representation
from sortie.policies.staleness import CEILING, LinkHealth, cap_by_age, health
from sortie.policies.verification.invariants.language import COMPARE
from sortie.policies.verification.invariants.words import DECISIONS

FULL = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, reason="full")
ORIGIN = (0.0, 0.0, 0.0)


# --- staleness -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("age_s", "expected"),
    [
        (0.0, LinkHealth.FRESH),
        (0.3, LinkHealth.FRESH),
        (0.1 + 0.1 + 0.1, LinkHealth.FRESH),  # 0.30000000000000004 is three periods, not more
        (0.301, LinkHealth.DEGRADED),
        (1.0, LinkHealth.DEGRADED),
        (1.001, LinkHealth.DETACHED),
        (None, LinkHealth.DETACHED),
    ],
)
def test_more_than_three_periods_degrade_more_than_ten_detach(age_s: float | None, expected: LinkHealth) -> None:
    assert health(age_s, 0.1, 3, 10) == expected


def test_a_degraded_link_carries_detections_slowly_and_a_detached_one_nothing() -> None:
    degraded = cap_by_age(FULL, LinkHealth.DEGRADED, 0.42)
    assert (degraded.representation, degraded.rate_hz, degraded.rho) == (Representation.DETECTIONS, 2.0, 0.0)
    assert degraded.reason == "degraded: descriptor 0.42 s old"
    detached = cap_by_age(FULL, LinkHealth.DETACHED, None)
    assert detached.representation == Representation.NONE
    assert detached.reason == "detached: never heard"
    assert cap_by_age(FULL, LinkHealth.FRESH, 0.1) is FULL


NUMBERS = st.sampled_from([0.0, 0.1, 0.5, 1.0, 2.0, 5.0])


@given(st.builds(Directive, st.just(0), st.just(1), st.sampled_from(Representation), st.sampled_from([0.0, 0.5]),
                 st.sampled_from([None, Disc(0.0, 0.0, 5.0)]), NUMBERS, NUMBERS, st.sampled_from([0.5, 1.0])),
       st.sampled_from(LinkHealth))  # fmt: skip
def test_a_ceiling_allows_the_directives_that_age_leaves_as_they_are(asked: Directive, health: LinkHealth) -> None:
    below = all(COMPARE[sign](DECISIONS[word].raw(asked), value) for word, sign, value in CEILING[health])  # type: ignore[misc]
    assert below == (cap_by_age(asked, health, 0.5) == asked)


@given(st.sampled_from(Representation), st.floats(0, 30), st.floats(0, 1), st.floats(0, 20), st.floats(0, 20))
def test_age_only_reduces(rung: Representation, rate_hz: float, rho: float, a_s: float, b_s: float) -> None:
    young_s, old_s = sorted((a_s, b_s))
    asked = Directive(0, 1, rung, rho, None, rate_hz)
    young = cap_by_age(asked, health(young_s, 0.1, 3, 10), young_s)
    old = cap_by_age(asked, health(old_s, 0.1, 3, 10), old_s)
    assert old.representation <= young.representation
    assert old.rate_hz <= young.rate_hz
    assert old.rho <= young.rho


# --- the gate ------------------------------------------------------------------------------------


def sends(gate_: Gate, rate_hz: float, seconds: float = 10.0, frame_s: float = 0.1) -> int:
    gate_.enforce(FULL._replace(rate_hz=rate_hz))
    return sum(len(gate_.due(k * frame_s + 0.033)) for k in range(round(seconds / frame_s)))


@pytest.mark.parametrize(
    ("rate_hz", "expected"), [(10.0, 100), (5.0, 50), (3.0, 30), (2.0, 20), (0.5, 5), (0.0, 0), (30.0, 100)]
)
def test_the_gate_keeps_the_rate(rate_hz: float, expected: int) -> None:
    assert sends(Gate(), rate_hz) == pytest.approx(expected, abs=1)


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


def test_duty_is_the_highest_asked_for() -> None:
    g = Gate()
    assert g.duty_percent == 100
    g.enforce(FULL._replace(duty_percent=20))
    g.enforce(FULL._replace(destination=2, duty_percent=50))
    assert g.duty_percent == 50


OVERHEAD = gate.HEADER_BYTES + DIRECTIVE_BYTES


@pytest.mark.parametrize(
    ("directive", "cells", "content"),
    [
        (FULL, 4096, 655_360),  # a whole map needs no index
        (FULL._replace(rho=0.25), 1024, 163_840 + 512),  # bitmap
        (FULL._replace(rho=0.02), 81, 12_960 + 122),  # list of 12-bit indices
        (FULL._replace(representation=Representation.RAW), 0, 5_400_000),
        (FULL._replace(representation=Representation.DETECTIONS), 0, 40 * 24),
        (FULL._replace(representation=Representation.TRACKS), 0, 12 * 20),
    ],
)
def test_payloads_have_the_papers_sizes(directive: Directive, cells: int, content: int) -> None:
    payload = make_payload(directive, *ORIGIN, lambda roi: 40)
    assert payload is not None
    assert (payload.cells, payload.size_bytes) == (cells, OVERHEAD + content)


def test_a_region_confines_cells_and_boxes() -> None:
    disc = Disc(10.0, 5.0, 32.0)
    payload = make_payload(FULL._replace(roi=disc), *ORIGIN, lambda roi: 0)
    assert payload is not None
    assert payload.cells == pytest.approx(314, abs=6), "π 32² / 3.2² cells (FACTS §1)"
    asked: list[Disc | None] = []
    make_payload(
        FULL._replace(representation=Representation.DETECTIONS, roi=disc), *ORIGIN, lambda r: asked.append(r) or 3
    )
    assert asked == [disc]


def test_nothing_is_sent_where_the_region_is_out_of_sight() -> None:
    assert make_payload(FULL._replace(roi=Disc(900, 0, 32)), *ORIGIN, lambda roi: 0) is None
    assert make_payload(FULL._replace(representation=Representation.NONE), *ORIGIN, lambda roi: 9) is None


def test_compact_payloads_go_reliably() -> None:
    kinds = {r: make_payload(FULL._replace(representation=r), *ORIGIN, lambda roi: 1) for r in list(Representation)[1:]}
    assert {r.name: p.reliable for r, p in kinds.items() if p} == {
        "TRACKS": True, "DETECTIONS": True, "UNCERTAIN_BOXES": True, "CODES": False, "FEATURES": False, "RAW": False,
    }  # fmt: skip


# --- coverage ------------------------------------------------------------------------------------


def test_footprint_of_the_paper() -> None:
    assert footprint_radius_m(60.0) == pytest.approx(42.0, abs=0.02)
    assert footprint_radius_m(-1.0) == 0.0


@given(st.lists(st.integers(0, 3), min_size=256, max_size=256))
def test_grid_packs_into_64_bytes_and_back(states: list[int]) -> None:
    grid = np.array(states, np.uint8).reshape(16, 16)
    packed = pack_grid(grid)
    assert len(packed) == 64
    assert np.array_equal(unpack_grid(packed), grid)
