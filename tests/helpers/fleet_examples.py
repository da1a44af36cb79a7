"""Descriptors and directives to test with: one of each by hand, and any that are valid (hypothesis)."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from sortie.fleet.coverage import attitude, camera_states, pack_grid
from sortie.policies.contract import COVERAGE_CELL_M, Descriptor, Directive, Disc, Representation, Roster, TaskPhase

DESCRIPTOR = Descriptor(
    stamp_ns=61_300_000_001,
    agent_id=3,
    position_m=(-12.5, 20.25, 60.0),
    orientation_xyzw=(0.5, -0.5, 0.5, 0.5),
    velocity_mps=(5.0, -0.5, 0.125),
    footprint_radius_m=42.0,
    battery_soc=0.75,
    cpu_headroom=0.5,
    gpu_headroom=0.25,
    peer_goodput_mbps=(80.0, 0.0, 12.5, 3.0),
    coverage_grid=bytes(range(64)),
    novelty_flags=5,
    task_phase=TaskPhase.TRACK,
    region=Disc(10.0, -20.0, 32.0),
)
DIRECTIVE = Directive(
    source=1,
    destination=4,
    representation=Representation.FEATURES,
    rho=0.25,
    roi=Disc(10.0, -20.0, 32.0),
    rate_hz=5.0,
    deadline_s=0.125,
    fusion_weight=0.5,
    duty_percent=60,
)


def _float32(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32)


def _vectors(n: int, bound: float = 2.0**20) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[_float32(-bound, bound)] * n)


def _unit(q: tuple[float, ...]) -> tuple[float, ...]:
    a = np.asarray(q)
    return tuple(np.float32(a / np.linalg.norm(a)).tolist())


ids = st.integers(0, 254)
shares = _float32(0, 1)
discs = st.builds(Disc, _float32(-5000, 5000), _float32(-5000, 5000), _float32(2.0**-10, 4096))
descriptors = st.builds(
    Descriptor,
    stamp_ns=st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1),
    agent_id=ids,
    position_m=_vectors(3),
    orientation_xyzw=_vectors(4, 1.0).filter(lambda q: np.linalg.norm(q) > 0.1).map(_unit),
    velocity_mps=_vectors(3),
    footprint_radius_m=_float32(0, 4096),
    battery_soc=shares,
    cpu_headroom=shares,
    gpu_headroom=shares,
    peer_goodput_mbps=st.lists(_float32(0, 4096), max_size=20).map(tuple),
    coverage_grid=st.binary(min_size=64, max_size=64),
    novelty_flags=st.integers(0, 255),
    task_phase=st.sampled_from(TaskPhase),
    region=st.none() | discs,
    priority_target_ids=st.lists(st.integers(0, 65535), max_size=20).map(tuple),
    feature_space=st.just(""),
    roster=st.none(),
    codebook=st.just(""),
)
rosters = st.builds(
    Roster, st.integers(0, 2**32 - 1), st.sets(st.integers(0, 60), min_size=1, max_size=12).map(sorted).map(tuple)
)


def with_members(d: Descriptor, roster: Roster | None) -> Descriptor:
    """The descriptor of a drone of the roster, with its goodputs as those to the other members."""
    if roster is None:
        return d
    links = (*d.peer_goodput_mbps, *[1.5] * len(roster.members))[: len(roster.members) - 1]
    me = roster.members[d.agent_id % len(roster.members)]
    return d._replace(agent_id=me, peer_goodput_mbps=links, roster=roster)


extended_descriptors = st.builds(
    lambda d, space, roster, codebook: with_members(d._replace(feature_space=space, codebook=codebook), roster),
    descriptors,
    st.just("") | st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9_.+-]{0,31}\Z"),
    st.none() | rosters,
    st.just("") | st.binary(min_size=7, max_size=7).map(bytes.hex),
)
"""With optional fields, or without."""
directives = (
    st.tuples(ids, ids)
    .filter(lambda link: link[0] != link[1])
    .flatmap(
        lambda link: st.builds(
            Directive,
            source=st.just(link[0]),
            destination=st.just(link[1]),
            representation=st.sampled_from(Representation),
            rho=shares,
            roi=st.none() | discs,
            rate_hz=_float32(0, 30),
            deadline_s=_float32(0, 10),
            fusion_weight=shares,
            duty_percent=st.integers(0, 100),
        )
    )
)


def grid_on_a_plain(x_m: float, y_m: float, z_m: float, xyzw: tuple[float, ...] = (0, 0, 0, 1)) -> bytes:
    """The coverage grid of a drone that looks from here, with nothing in between and nothing new."""
    at = [v - np.floor(v / COVERAGE_CELL_M) * COVERAGE_CELL_M for v in (x_m, y_m)]
    return pack_grid(camera_states(*np.array([*at, z_m]), attitude(np.array(xyzw, float))))
