"""What a learner observes of a view, number by number, and what its actions become."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from policies_examples import fleet_of

from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Representation, TaskPhase
from sortie.policies.observation import ROW, directives, observe
from sortie.scenarios.link_state import PROBED_MBPS, SILENT_MBPS

SEARCH, TRACK, LANDING = TaskPhase.SEARCH, TaskPhase.TRACK, TaskPhase.LANDING


def test_a_row_tells_the_goodput_to_that_drone_and_not_from_it() -> None:
    view = fleet_of(3)
    me, peer = view.descriptors[0], view.descriptors[2]
    heard = {
        **view.descriptors,
        0: me._replace(peer_goodput_mbps=(8.0, 40.0)),
        2: peer._replace(peer_goodput_mbps=(3.0, 5.0)),
    }
    seen = observe(view._replace(descriptors=heard), [1, 2])
    assert seen[1:, 12] == pytest.approx([0.08, 0.4])
    assert seen[1:, 13] == pytest.approx([1.0, 1.0])


def view_of_four() -> FleetView:
    """Drone 1 has heard 0 and 3 of a fleet of four; no two of its numbers are the same."""
    north = (0.0, 0.0, 0.6, 0.8)
    grid = bytes([0b11_10_01_00] * 16) + bytes(48)  # of every four cells one poor, one well, one new
    links = (20.0, PROBED_MBPS, SILENT_MBPS), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)
    west = bytes([0b10]) + bytes(63)
    at = (100.0, -50.0, 60.0), (90.0, -20.0, 75.0), (5000.0, -50.0, 60.0)
    one = Descriptor(7, 1, at[0], north, (5.0, -2.0, 1.0), 42.0, 0.9, 0.8, 0.7, links[0], grid, 0, TRACK, None, (4,))
    zero = Descriptor(8, 0, at[1], north, (-3.0, 4.0, 0.5), 52.5, 0.6, 0.4, 0.3, links[1], bytes(64), 0, SEARCH, None)
    three = Descriptor(9, 3, at[2], north, (0.0, 0.0, 0.0), 35.0, 0.5, 0.2, 0.1, links[2], west, 0, LANDING, None)
    regions = Disc(130.0, -90.0, 32.0), Disc(100.0, 50.0, 10.0)
    each = {1: one._replace(region=regions[0]), 0: zero, 3: three._replace(region=regions[1])}
    return FleetView(1, 0.1, each, {1: 0.0, 0: 0.25, 3: 1.5})


def test_every_number_of_an_observation_by_hand() -> None:
    """The ego first, then the others in the order asked for; who was not heard has zeros; places end at 1 km."""
    phases = {p: [float(p == q) for q in TaskPhase] for p in TaskPhase}
    moves = {1: [0, 0, 0, 0.5, -0.2, 0.1], 0: [-0.1, 0.3, 0.15, -0.3, 0.4, 0.05], 3: [10.0, 0, 0, 0, 0, 0]}
    states = {
        1: [0.42, 0.9, 0.8, 0.7, 0.0, 0.0],
        0: [0.525, 0.6, 0.4, 0.3, 0.2, 1.0],
        3: [0.35, 0.5, 0.2, 0.1, SILENT_MBPS / 100, 1 / 3],
    }
    wanted = {
        1: [1, 0.0, *moves[1], *states[1], *phases[TRACK], 1, 0.3, -0.4, 0.32, 32 / 256, 1],
        0: [1, 0.25, *moves[0], *states[0], *phases[SEARCH], 0, 0, 0, 0, 0, 0],
        2: [0.0] * ROW,
        3: [1, 1.5, *moves[3], *states[3], *phases[LANDING], 1, 0, 1.0, 0.1, 1 / 256, 0],
    }
    view = view_of_four()
    for others in ([0, 2, 3], [3, 0]):
        seen = observe(view, others)
        assert seen.dtype == np.float32
        np.testing.assert_allclose(seen, [wanted[i] for i in (1, *others)], atol=1e-6)
    without = view._replace(descriptors={i: d for i, d in view.descriptors.items() if i != 1})
    assert not observe(without, [0, 2, 3]).any(), "it knows nothing of itself yet"


@pytest.mark.parametrize("others", [[0, 2, 3], [0, 3]])
def test_an_action_is_a_directive_for_each_peer_that_was_heard(others: list[int]) -> None:
    """Its row is by the place among the others, heard or not; only maps have a share of cells."""
    view = view_of_four()
    action = np.zeros((len(others), 4), int)
    region = Disc(130.0, -90.0, 32.0)
    chosen: list[tuple[Any, Representation, float, Disc | None, float]] = [
        ((0, 3, 0, 0), Representation.NONE, 0.0, None, 2.0),
        ((1, 2, 1, 1), Representation.DETECTIONS, 0.0, region, 5.0),
        ((2, 1, 2, 0), Representation.FEATURES, 0.1, None, 10.0),
        ((2, 0, 0, 1), Representation.FEATURES, 0.02, region, 2.0),
        ((2, 2, 0, 1), Representation.FEATURES, 0.25, region, 2.0),
        ((2, 3, 0, 1), Representation.FEATURES, 1.0, region, 2.0),
        ((3, 3, 1, 0), Representation.UNCERTAIN_BOXES, 0.0, None, 5.0),
    ]
    for one, other in zip(chosen, chosen[1:] + chosen[:1], strict=True):
        action[0], action[-1] = one[0], other[0]
        assert directives(view, others, action) == [
            Directive(1, peer, rung, rho, roi, rate_hz) for peer, (_, rung, rho, roi, rate_hz) in ((0, one), (3, other))
        ]
    nothing = [Directive(1, 0), Directive(1, 3)]
    assert directives(view, others, None) == nothing
    without = view._replace(descriptors={i: d for i, d in view.descriptors.items() if i != 1})
    assert directives(without, others, action) == nothing
