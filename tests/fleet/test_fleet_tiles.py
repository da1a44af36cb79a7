"""Tiles: sizes to the byte, cells by rank, and what the gate hands over."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.gate import make_payload
from sortie.fleet.tiles import TILE_HEADER_BYTES, cells_of, cut
from sortie.perception import budget
from sortie.policies.contract import Directive, Representation
from sortie.radio.mac.airtime import fragments
from sortie.scenarios.schema import MIN_TILE_BYTES, Radio

FULL = Directive(0, 1, Representation.FEATURES, 0.1, None, 10.0)


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
    tiled = make_payload(FULL, 0.0, 0.0, 0.0, lambda roi: 3, 1344)
    plain = make_payload(FULL, 0.0, 0.0, 0.0, lambda roi: 3)
    assert tiled is not None
    assert plain is not None
    assert (tiled.cells, tiled.tile_cells, tiled.tile_bytes) == (409, 8, 1336)
    assert tiled.size_bytes == 51 * 1336 + 44 + 160 + 2
    assert (plain.tile_cells, plain.tile_bytes) == (0, None)
    boxes = make_payload(FULL._replace(representation=Representation.DETECTIONS, rho=0.0), 0, 0, 0, lambda roi: 3, 1344)
    assert boxes is not None
    assert boxes.tile_bytes is None
    assert budget.payload_bytes(1) == 160
