"""Compact descriptors: what comes back is what was written, as far as the form goes, in as many bytes."""

from __future__ import annotations

import math
from functools import partial
from itertools import product

import pytest
from fleet_examples import DESCRIPTOR, descriptors
from hypothesis import assume, given
from hypothesis import strategies as st

from sortie.fleet.coverage import pack_grid, unpack_grid
from sortie.fleet.messages.auth import Dropped, DropReason, open_datagram
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.compact import (
    GRID_BITS,
    GRID_CELLS,
    MIN_COMPACT_BYTES,
    NUMBER_BITS,
    Form,
    decode_compact,
    encode_compact,
)
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.policies.contract import Coverage, LinkState
from sortie.scenarios.link_state import SILENT_MBPS

forms = st.builds(Form, st.sampled_from(GRID_CELLS), st.sampled_from(GRID_BITS), st.sampled_from(NUMBER_BITS))
SANE = DESCRIPTOR._replace(priority_target_ids=(7, 65535), novelty_flags=3)


def test_the_finest_form_loses_nothing() -> None:
    assert decode_compact(encode_compact(SANE, Form())) == SANE


def test_numbers_come_back_to_half_a_step() -> None:
    for bits in (8, 10, 12, 16, 24):
        back = decode_compact(encode_compact(SANE, Form(number_bits=bits)))
        half_step = 0.5 / (2**bits - 1)
        for found, said, span in (
            (back.position_m, SANE.position_m, 16384),
            (back.battery_soc, SANE.battery_soc, 1),
            (back.footprint_radius_m, SANE.footprint_radius_m, 512),
            (back.peer_goodput_mbps, SANE.peer_goodput_mbps, 1023),
        ):
            assert found == pytest.approx(said, abs=half_step * span + 1e-9, rel=0), bits
        assert math.isclose(math.hypot(*back.orientation_xyzw), 1.0)
        exact = ("stamp_ns", "agent_id", "task_phase", "novelty_flags", "priority_target_ids", "coverage_grid")
        assert all(getattr(back, f) == getattr(SANE, f) for f in exact)


def test_every_form_keeps_the_state_of_a_link() -> None:
    """Never measured, silent, measured however weakly, measured."""
    d = DESCRIPTOR._replace(agent_id=0, peer_goodput_mbps=(0.0, SILENT_MBPS, 0.01, 80.0))
    states = [LinkState.UNKNOWN, LinkState.SILENT, LinkState.MEASURED, LinkState.MEASURED]
    for encode in (encode_descriptor, *(partial(encode_compact, form=Form(number_bits=bits)) for bits in NUMBER_BITS)):
        back = decode_descriptor(encode(d))
        assert [back.link_state(i) for i in (1, 2, 3, 4)] == states, encode
        assert decode_descriptor(encode(back)).peer_goodput_mbps == back.peer_goodput_mbps


def test_numbers_beyond_their_range_are_its_end() -> None:
    far = SANE._replace(position_m=(1e6, -1e6, 60.0), peer_goodput_mbps=(5000.0,))
    back = decode_compact(encode_compact(far, Form(number_bits=16)))
    assert back.position_m[:2] == (8192.0, -8192.0)
    assert back.peer_goodput_mbps == (1023.0,)


def test_a_size_is_what_its_parts_come_to() -> None:
    numbers = 14 + 4 + 3
    for cells, bits, number_bits in product(GRID_CELLS, GRID_BITS, NUMBER_BITS):
        size = 17 + math.ceil((numbers * number_bits + cells * cells * bits + 2 * 16) / 8)
        assert len(encode_compact(SANE, Form(cells, bits, number_bits))) == size, (cells, bits, number_bits)


def test_a_coarse_cell_is_as_most_of_its_fine_ones() -> None:
    fine = unpack_grid(bytes(64)).copy()
    fine[0:2, 0:2] = [[Coverage.WELL, Coverage.WELL], [Coverage.POOR, Coverage.UNSEEN]]
    fine[0:2, 2:4] = [[Coverage.NOVEL, Coverage.WELL], [Coverage.POOR, Coverage.POOR]]
    fine[2:4, 0:2] = [[Coverage.WELL, Coverage.POOR], [Coverage.UNSEEN, Coverage.UNSEEN]]
    d = SANE._replace(coverage_grid=pack_grid(fine))
    two = unpack_grid(decode_compact(encode_compact(d, Form(grid_cells=8))).coverage_grid)
    assert (two[0, 0], two[1, 3], two[2, 0], two[3, 2]) == (2, 3, 1, 0)
    one = unpack_grid(decode_compact(encode_compact(d, Form(8, 1))).coverage_grid)
    assert (one[0, 0], one[1, 3], one[2, 0], one[3, 2]) == (2, 2, 1, 1)
    assert decode_compact(encode_compact(d, Form(grid_cells=0))).coverage_grid == bytes(64)


@given(descriptors, forms)
def test_writing_what_was_read_gives_the_same_bytes(d, form) -> None:  # type: ignore[no-untyped-def]
    assume(d.agent_id <= 254 and d.novelty_flags < 128)
    assume(form.number_bits < 32)
    assume(-(2**31) * 10**9 <= d.stamp_ns < 2**31 * 10**9)
    once = decode_compact(encode_compact(d, form))
    again = decode_compact(encode_compact(once, form))
    assert again.coverage_grid == once.coverage_grid
    assert again.position_m == pytest.approx(once.position_m, abs=1e-6)
    assert again.peer_goodput_mbps == pytest.approx(once.peer_goodput_mbps, abs=1e-6)


def test_the_wire_tells_the_forms_apart() -> None:
    assert decode_descriptor(encode_compact(SANE, Form(8, 2, 16))).agent_id == SANE.agent_id
    with pytest.raises(MalformedDatagram, match=r"form \(0xc0, 5, 2, 16\) is none"):
        decode_descriptor(encode_compact(SANE, Form(8, 2, 16))[:1] + b"\x05\x02\x10" + bytes(40))
    short = open_datagram(b"\xc0" + bytes(5), None)
    assert short == Dropped(DropReason.TRUNCATED, f"6 B, must be at least {MIN_COMPACT_BYTES}")


def test_too_many_peers_are_named() -> None:
    with pytest.raises(ValueError, match="peer_goodput has 256 entries, must have at most 255"):
        encode_compact(SANE._replace(peer_goodput_mbps=(1.0,) * 256), Form())
