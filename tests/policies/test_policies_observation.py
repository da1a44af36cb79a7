"""What a learner observes of a view."""

import pytest
from policies_examples import fleet_of

from sortie.policies.observation import observe


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
