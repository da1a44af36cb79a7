"""The contract's numbers are those of the rooms that it may not import."""

from __future__ import annotations

from sortie.perception import budget
from sortie.perception.geometry import CELLS, CHANNELS
from sortie.policies.contract import FEATURE_CELL_BYTES, FEATURE_CELLS, FEATURE_MAP_MEGABITS
from sortie.scenarios.representation import BOX_NAMES, MAP_NAMES, NAME_OF, REPRESENTATION_OF, Representation
from sortie.sim.export.topics import TopicKind


def test_a_feature_map_is_as_large_as_the_detector_makes_it() -> None:
    assert FEATURE_CELLS == budget.CELLS == CELLS**2
    assert FEATURE_CELL_BYTES == budget.payload_bytes(1) == 2 * CHANNELS
    assert budget.payload_bytes(FEATURE_CELLS) * 8 / 1e6 == FEATURE_MAP_MEGABITS


def test_every_representation_has_its_name_and_its_topic() -> None:
    assert all(name == r.name.lower() and REPRESENTATION_OF[name] is r for r, name in NAME_OF.items())
    assert {"none", *BOX_NAMES, *MAP_NAMES} == set(REPRESENTATION_OF)
    assert [TopicKind.of(r).reliable for r in Representation] == [NAME_OF[r] in BOX_NAMES for r in Representation]
