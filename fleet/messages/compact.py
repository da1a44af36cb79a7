"""A descriptor in fewer bytes than the paper's: a coarser grid, fewer bits a cell, fewer bits a number.

    header 4 B (0xC0, cells a side, bits a cell, bits a number) · stamp 8 B · agent, phase, flags, peers, targets 1 B each
    · numbers, cells and target ids, bit by bit, the last byte filled with zeros
    · optional fields (`sortie.fleet.messages.extensions`)

Numbers are fixed point over their field's range, saturating (`_RANGES`); 32 bits are IEEE floats. A goodput's lowest
number is a link not measured lately, probed or not, the next one a silent link (`sortie.scenarios.link_state`). A coarse cell stands
for a block of fine ones and is as most of them are. The format says itself how it is to be read, so that fleets need
agree on nothing; what a policy reads has the shape of the full descriptor either way.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sortie.fleet.coverage import pack_grid, unpack_grid
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.extensions import (
    WIDE_ID,
    append_extensions,
    is_wide,
    listed_goodput,
    read_phase,
    with_extensions,
)
from sortie.policies.contract import COVERAGE_CELL_M, COVERAGE_CELLS, Coverage, Descriptor, Disc, TaskPhase
from sortie.scenarios.link_state import SILENT_MBPS, LinkState, state_of

MAGIC = 0xC0
MARK = bytes([MAGIC])
GRID_CELLS, GRID_BITS, NUMBER_BITS = (0, 4, 8, 16), (1, 2), (8, 10, 12, 16, 24, 32)
_HEAD = struct.Struct("<4BiI5B")
MIN_COMPACT_BYTES = _HEAD.size
_REGION_FLAG = 0x80  # among the novelty flags, of which the two lowest bits are in use
MAX_COUNT = 255

_POSITION = (-8192.0, 8192.0)
_RANGES = (*[_POSITION] * 3, *[(-1.0, 1.0)] * 4, *[(-64.0, 64.0)] * 3, (0.0, 512.0), *[(0.0, 1.0)] * 3)
"""Position, orientation, velocity, footprint radius, charge, two headrooms; then goodput to each peer, and the region."""
_GOODPUT, _REGION = (0.0, 1023.0), (_POSITION, _POSITION, (0.0, 2048.0))


class Form(NamedTuple):
    """How finely descriptors are written; the default is the paper's schema in CDR."""

    grid_cells: int = 16
    """A side; 0 leaves the grid out."""
    grid_bits: int = 2
    """1 says seen well or not."""
    number_bits: int = 32

    @property
    def blur_m(self) -> float:
        """How far a cell may be from where it is said to be, beyond what moving on makes; infinite without a grid."""
        if self.grid_cells == 0:
            return math.inf
        block_m = (COVERAGE_CELLS // self.grid_cells - 1) * COVERAGE_CELL_M
        step_m = 0.0 if self.number_bits == 32 else _step(_POSITION, self.number_bits)
        return (block_m + step_m + COVERAGE_CELL_M * (step_m > 0.0)) * math.sqrt(2.0) if block_m or step_m else 0.0

    @property
    def soc_step(self) -> float:
        """The least difference of two charges that shows."""
        return 0.0 if self.number_bits == 32 else _step((0.0, 1.0), self.number_bits)

    @property
    def goodput_step_mbps(self) -> float:
        """The least difference of two goodputs that shows."""
        return 0.0 if self.number_bits == 32 else _step(_GOODPUT, self.number_bits)


FULL = Form()


def _step(bounds: tuple[float, float], bits: int) -> float:
    """What one more of a number means; a goodput has a number less, which says that it was never measured."""
    return (bounds[1] - bounds[0]) / ((1 << bits) - 1 - (bounds is _GOODPUT))


def encode_compact(d: Descriptor, form: Form) -> bytes:
    """Serialise a descriptor in a form; numbers beyond their range are written as its end.

    Raises:
        DescriptorTooLarge: more than 1,024 B, naming the part that is too long.
        ValueError: more than 255 peers or targets.
    """
    goodput, targets, region = listed_goodput(d), d.priority_target_ids, d.region
    for name, several in (("peer_goodput", goodput), ("priority_target_ids", targets)):
        if len(several) > MAX_COUNT:
            raise ValueError(f"{name} has {len(several)} entries, must have at most {MAX_COUNT}")
    flags = (d.novelty_flags & 0x7F) | (_REGION_FLAG if region else 0)
    second, nanosecond = divmod(d.stamp_ns, 1_000_000_000)
    head = _HEAD.pack(
        MAGIC,
        *form,
        second,
        nanosecond,
        WIDE_ID if is_wide(d) else d.agent_id,
        d.task_phase,
        flags,
        len(goodput),
        len(targets),
    )
    numbers = [
        *d.position_m,
        *d.orientation_xyzw,
        *d.velocity_mps,
        d.footprint_radius_m,
        d.battery_soc,
        d.cpu_headroom,
        d.gpu_headroom,
        *goodput,
        *(region or ()),
    ]
    bits = _BitWriter()
    for value, bounds in zip(numbers, _ranges(len(goodput), region is not None), strict=True):
        bits.put(_to_int(value, bounds, form.number_bits), form.number_bits)
    for state in _coarse(d.coverage_grid, form.grid_cells, form.grid_bits):
        bits.put(state, form.grid_bits)
    for target in targets:
        bits.put(target, 16)
    return append_extensions(head + bits.done(), d)


def decode_compact(data: bytes) -> Descriptor:
    """Parse and check what `encode_compact` wrote.

    Raises:
        MalformedDatagram: for anything that is not one valid descriptor.
    """
    if len(data) < _HEAD.size:
        raise MalformedDatagram(f"{len(data)} B, must be at least {_HEAD.size}")
    magic, cells, cell_bits, number_bits, second, nanosecond, agent_id, phase, flags, peers, targets = (
        _HEAD.unpack_from(data)
    )
    if magic != MAGIC or cells not in GRID_CELLS or cell_bits not in GRID_BITS or number_bits not in NUMBER_BITS:
        raise MalformedDatagram(f"form ({magic:#x}, {cells}, {cell_bits}, {number_bits}) is none")
    ranges = _ranges(peers, bool(flags & _REGION_FLAG))
    size = _HEAD.size + math.ceil((len(ranges) * number_bits + cells * cells * cell_bits + 16 * targets) / 8)
    if len(data) < size:
        raise MalformedDatagram(f"{len(data)} B, must be at least {size} with {peers} peers and {targets} targets")
    if nanosecond >= 1_000_000_000:
        raise MalformedDatagram(f"stamp.nanosec is {nanosecond}, must be below 10⁹")
    bits = _BitReader(data[_HEAD.size : size])
    values = [_to_float(bits.take(number_bits), bounds, number_bits) for bounds in ranges]
    if not all(map(math.isfinite, values)):
        raise MalformedDatagram("a float is not finite")
    grid = _fine(tuple(bits.take(cell_bits) for _ in range(cells * cells)), cells, cell_bits)
    ids = tuple(bits.take(16) for _ in range(targets))
    if bits.rest():
        raise MalformedDatagram("the last byte is not filled with zeros")
    said = _checked(second * 1_000_000_000 + nanosecond, agent_id, values, peers, grid, flags, read_phase(phase), ids)
    return with_extensions(said, data[size:])


def _checked(
    stamp_ns: int,
    agent_id: int,
    values: list[float],
    peers: int,
    grid: bytes,
    flags: int,
    phase: TaskPhase,
    ids: tuple[int, ...],
) -> Descriptor:
    x, y, z, qx, qy, qz, qw, vx, vy, vz, footprint_m, soc, cpu, gpu = values[:14]
    length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if not 0.9 < length < 1.1:
        raise MalformedDatagram("orientation is not a unit quaternion")
    if not (0 <= soc <= 1 and 0 <= cpu <= 1 and 0 <= gpu <= 1):
        raise MalformedDatagram(f"battery, cpu, gpu are {soc:g}, {cpu:g}, {gpu:g}, must be in [0, 1]")
    goodput, disc = tuple(values[14 : 14 + peers]), values[14 + peers :]
    if footprint_m < 0 or min(goodput, default=0.0) < 0 or (disc and disc[2] <= 0):
        raise MalformedDatagram("a radius or goodput is below 0")
    return Descriptor(
        stamp_ns,
        agent_id,
        (x, y, z),
        (qx / length, qy / length, qz / length, qw / length),
        (vx, vy, vz),
        footprint_m,
        soc,
        cpu,
        gpu,
        goodput,
        grid,
        flags & 0x7F,
        phase,
        Disc(*disc) if disc else None,
        ids,
    )


@lru_cache(maxsize=256)
def _ranges(peers: int, region: bool) -> tuple[tuple[float, float], ...]:
    return (*_RANGES, *[_GOODPUT] * peers, *(_REGION if region else ()))


def _to_int(value: float, bounds: tuple[float, float], bits: int) -> int:
    if bits == 32:
        (as_int,) = struct.unpack("<I", struct.pack("<f", value))
        return int(as_int)
    low, high = bounds
    steps = round((min(max(value, low), high) - low) / _step(bounds, bits))
    if bounds is _GOODPUT:
        state = state_of(value)
        # 0 is not measured lately, 1 silent; a measured link reads at least a step, however weak it is
        return 1 + max(steps, 1) if state == LinkState.MEASURED else int(state == LinkState.SILENT)
    # a radius of a region is above 0, however coarse
    return max(steps, 1) if bounds is _REGION[2] else steps


def _to_float(number: int, bounds: tuple[float, float], bits: int) -> float:
    if bits == 32:
        (as_float,) = struct.unpack("<f", struct.pack("<I", number))
        return float(as_float)
    if bounds is _GOODPUT:
        return max(SILENT_MBPS, (number - 1) * _step(bounds, bits)) if number else 0.0
    return bounds[0] + number * _step(bounds, bits)


@lru_cache(maxsize=1024)  # a grid stands for a second
def _coarse(grid: bytes, cells: int, bits: int) -> tuple[int, ...]:
    """Cell states of a coarser grid, row by row: seen well where half of its cells are, new where one of those is."""
    if cells == 0:
        return ()
    block = COVERAGE_CELLS // cells
    fine = unpack_grid(grid).reshape(cells, block, cells, block).transpose(0, 2, 1, 3).reshape(cells * cells, -1)
    well = 2 * (fine >= Coverage.WELL).sum(axis=1) >= block * block
    if bits == 1:
        return tuple(well.astype(int).tolist())
    seen = 2 * (fine > Coverage.UNSEEN).sum(axis=1) >= block * block
    new = (fine == Coverage.NOVEL).any(axis=1)
    state = np.where(well, np.where(new, Coverage.NOVEL, Coverage.WELL), np.where(seen, Coverage.POOR, Coverage.UNSEEN))
    return tuple(state.tolist())


@lru_cache(maxsize=1024)
def _fine(states: tuple[int, ...], cells: int, bits: int) -> bytes:
    """The full grid that coarse states stand for; one bit says seen well or poorly, no grid says unseen."""
    if cells == 0:
        return bytes(64)
    table = np.array(states, np.uint8).reshape(cells, cells)
    if bits == 1:
        table = np.where(table == 1, Coverage.WELL, Coverage.POOR).astype(np.uint8)
    block = COVERAGE_CELLS // cells
    return pack_grid(table.repeat(block, axis=0).repeat(block, axis=1))


class _BitWriter:
    """Bits, lowest first."""

    def __init__(self) -> None:
        self._value, self._length = 0, 0

    def put(self, number: int, bits: int) -> None:
        self._value |= number << self._length
        self._length += bits

    def done(self) -> bytes:
        return self._value.to_bytes(math.ceil(self._length / 8), "little")


class _BitReader:
    """The inverse of `_BitWriter`."""

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "little")

    def take(self, bits: int) -> int:
        number = self._value & ((1 << bits) - 1)
        self._value >>= bits
        return number

    def rest(self) -> int:
        return self._value
