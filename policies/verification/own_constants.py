"""Drawn views whose numbers lie at a policy's own constants, where its decisions change.

A view drawn from all numbers rarely has the charge at which a policy has its fault. The numbers in its code are good guesses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from sortie.policies.contract import FleetView
from sortie.policies.verification.views import LARGEST, LONGEST_S, MAX_DRONES, draw_view
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.streams import stream

MOST_SIZES, MOST_LARGE_SIZES = 24, 6
"""So many sizes of fleets are tried, and so many more of those whose drones have rosters, which take long to draw."""
_SHARES = ("battery_soc", "cpu_headroom", "gpu_headroom")
_APART = 1_000_000
"""These views are numbered from here on, so that they are others than the drawn ones."""


def views_at(constants: Iterable[float], seed: int, count: int) -> Iterator[FleetView]:
    """`count` views with numbers at these constants or one float beside them, then a few of fleets that are as large.

    Args:
        constants: a policy's own.
        seed: of all its views.
        count: how many; 0 for none at all.
    """
    known = sorted(set(constants))
    if not known or not count:
        return
    for number in range(count):
        yield _moved(draw_view(seed, _APART + number), known, stream(seed, number, (), "verify.constants"))
    whole = [int(c) for c in known if c == int(c)]
    # with c peers first: a cut leaves no constant out before others have three sizes
    sizes = list(dict.fromkeys(c + more for more in (1, 2, 0) for c in whole if MAX_DRONES < c + more <= LARGEST))
    listed, large = ([size for size in sizes if (size > LISTED_IDS) == is_large] for is_large in (False, True))
    for number, size in enumerate((*listed[:MOST_SIZES], *large[:MOST_LARGE_SIZES])):
        view = draw_view(seed, _APART + count + number, size, 1.0)
        yield view
        ego = next((c for c in whole if c in view.descriptors and c > MAX_DRONES), view.ego)
        if ego != view.ego:
            yield view._replace(ego=ego)


def _moved(view: FleetView, constants: Sequence[float], rng: np.random.Generator) -> FleetView:
    """The view with some numbers at constants."""

    def near(low: float, high: float) -> float | None:
        known = [c for c in constants if low <= c <= high]
        if not known or rng.random() < 0.3:
            return None
        c = float(rng.choice(known))
        around = (c, c, math.nextafter(c, -math.inf), math.nextafter(c, math.inf))
        return float(min(max(float(rng.choice(around)), low), high))

    descriptors, ages_s = dict(view.descriptors), dict(view.age_s)
    egos = [int(c) for c in constants if c in descriptors]
    ego = int(rng.choice(egos)) if egos and rng.random() < 0.3 else view.ego
    together = rng.random() < 0.5  # of all drones, or of the ego alone
    for i, d in descriptors.items():
        if i != ego and not together:
            continue
        changed: dict[str, Any] = {field: x for field in _SHARES if (x := near(0, 1)) is not None}
        goodput, age_s, flags = near(0, 1e5), near(0, LONGEST_S), near(0, 255)
        if goodput is not None:
            changed["peer_goodput_mbps"] = (goodput,) * len(d.peer_goodput_mbps)
        if flags is not None and rng.random() < 0.3:
            changed["novelty_flags"] = int(flags)
        if age_s is not None and rng.random() < 0.5:
            ages_s[i] = age_s
        descriptors[i] = d._replace(**changed)
    return view._replace(ego=ego, descriptors=descriptors, age_s=ages_s)
