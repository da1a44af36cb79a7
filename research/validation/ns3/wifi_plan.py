"""A plan of traffic that ns-3 and `sortie.radio.Air` both run: who stands where, and who sends what when."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FRAME_S = 0.1
FRAGMENT_BYTES = 1344
DESCRIPTOR_BYTES = 208
HEIGHT_M = 60.0


def cross(arm_m: float = 20.0, drones: int = 5) -> FloatArray:
    """One drone in the middle, the others in turn along +x, +y, −x, −y, each round one arm farther out; [N, 3]."""
    ways = ((1, 0), (0, 1), (-1, 0), (0, -1))
    out = [(ways[k % 4][0] * (k // 4 + 1) * arm_m, ways[k % 4][1] * (k // 4 + 1) * arm_m) for k in range(drones - 1)]
    return _at_height([(0.0, 0.0), *out])


def grid(drones: int = 25, spacing_m: float = 20.0) -> FloatArray:
    """Rows of ⌈√N⌉ drones; [N, 3]."""
    side = int(np.ceil(np.sqrt(drones)))
    return _at_height([(spacing_m * (i % side), spacing_m * (i // side)) for i in range(drones)])


def line(drones: int, spacing_m: float = 20.0) -> FloatArray:
    """Drones in a row along x; [N, 3]."""
    return _at_height([(spacing_m * i, 0.0) for i in range(drones)])


def _at_height(places_m: list[tuple[float, float]]) -> FloatArray:
    return np.array([(x, y, HEIGHT_M) for x, y in places_m], np.float64)


def pairs_of(positions_m: FloatArray, count: int, seed: int = 5) -> list[tuple[int, int]]:
    """So many (sender, receiver) pairs, dealt round to the senders, each sender's nearest peers first."""
    n = len(positions_m)
    distance_m = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=-1)
    near = [[int(j) for j in np.argsort(distance_m[i], kind="stable") if j != i] for i in range(n)]
    turn = np.random.default_rng(seed).permutation(n) if n > 5 else np.arange(n)
    dealt = [(int(i), near[i][rank]) for rank in range(n - 1) for i in turn]
    return sorted(dealt[:count], key=lambda pair: pair[0])


@dataclass
class Plan:
    """Who sends what when; times are those at which it reaches the sender's radio, in seconds."""

    positions_m: FloatArray
    descriptors: list[tuple[float, int, int]] = field(default_factory=list)
    """Time, sender, payload bytes: group-addressed."""
    payloads: list[tuple[float, int, int, int]] = field(default_factory=list)
    """Time, sender, receiver, bytes: best effort, with a deadline of one frame."""
    saturated: list[tuple[int, int]] = field(default_factory=list)
    """Sender, receiver: flows that are always backlogged."""

    def text(self) -> str:
        """The plan as the ns-3 driver reads it."""
        rows = [f"node {x} {y} {z}" for x, y, z in self.positions_m]
        rows += [f"bcast {t:.9f} {s} {size} {k}" for k, (t, s, size) in enumerate(self.descriptors)]
        rows += [f"data {t:.9f} {s} {r} {size} {k}" for k, (t, s, r, size) in enumerate(self.payloads)]
        rows += [f"sat {s} {r}" for s, r in self.saturated]
        return "\n".join(rows) + "\n"


def sortie_plan(
    positions_m: FloatArray, pairs: list[tuple[int, int]], payload_bytes: int, stop_s: float, seed: int = 1
) -> Plan:
    """The traffic of a sortie.

    Descriptors leave 0 to 80 ms into each frame, drawn anew each time (a sortie draws one phase for each drone; a short
    run averages over more of them this way). Payloads leave 36 to 40 ms into each frame, as a sortie's features do.
    """
    rng = np.random.default_rng(seed)
    n = len(positions_m)
    plan = Plan(positions_m)
    for k in range(round(stop_s / FRAME_S)):
        plan.descriptors += [(k * FRAME_S + 0.08 * rng.random(), i, DESCRIPTOR_BYTES) for i in range(n)]
        ready_s = (0.036 + 0.004 * rng.random(n)).tolist()  # numpy's numbers would slow the whole clock down
        plan.payloads += [(k * FRAME_S + ready_s[s], s, r, payload_bytes) for s, r in pairs]
    plan.descriptors.sort()
    plan.payloads.sort(key=lambda row: row[0])  # stable: each sender's in the order of `pairs`
    return plan


@dataclass(frozen=True)
class Case:
    """One setting in which ns-3 and the Air are compared."""

    name: str
    shape: str = "cross"
    """`cross`, `grid` or `line`."""
    drones: int = 5
    spacing_m: float = 20.0
    payload_bytes: int = 0
    pairs: int = 0
    """How many (sender, receiver) pairs send a payload in each frame."""
    mcs: int = 7
    fade: str = "none"
    """`none`, `frame` or `ppdu`: Rician fading with 12 dB, and the Air's own shadowing of 3.5 dB where it is not none."""
    rts: bool = False
    saturated: tuple[tuple[int, int], ...] = ()
    descriptors: bool = True
    """Whether each drone publishes a descriptor in each frame."""
    warm_s: float = 0.6
    stop_s: float = 3.0
    load: float = 0.0
    """Payload bits offered, of what the senders could carry together; 0 where nobody counted."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """More options of the ns-3 driver."""

    def positions_m(self) -> FloatArray:
        """[N, 3]."""
        if self.shape == "cross":
            return cross(self.spacing_m, self.drones)
        return {"grid": grid, "line": line}[self.shape](self.drones, self.spacing_m)

    def plan(self, seed: int) -> Plan:
        """Its traffic."""
        at = self.positions_m()
        if self.saturated:
            return Plan(at, saturated=list(self.saturated))
        plan = sortie_plan(at, pairs_of(at, self.pairs), self.payload_bytes, self.stop_s, seed)
        if not self.descriptors:
            plan.descriptors.clear()
        return plan
