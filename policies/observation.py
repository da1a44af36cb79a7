"""Observations and actions of a learner: a drone's view as numbers, and an action as directives.

`sortie.sim.env` trains with these two functions. A policy file that uses them decides as the learner did, with the same
numbers, and needs neither PettingZoo nor gymnasium.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sortie.policies.contract import Coverage, Descriptor, Directive, FleetView, LinkState, Representation, TaskPhase

RUNGS = (Representation.NONE, Representation.DETECTIONS, Representation.FEATURES, Representation.UNCERTAIN_BOXES)
"""Nothing, boxes, feature maps, boxes with uncertainty: 0 to 3 in an action, and by no means in order of fidelity."""
RHOS = (0.02, 0.1, 0.25, 1.0)
RATES_HZ = (2.0, 5.0, 10.0)
CHOICES = (len(RUNGS), len(RHOS), len(RATES_HZ), 2)
"""Choices of an action for each link: representation, ρ (the share of the feature cells), rate, and whether it is confined to the region."""
ROW = 25
"""Numbers of one drone in an observation; `observe` says which."""
LIMIT = 10.0

Obs = np.ndarray[Any, np.dtype[np.float32]]


def observe(view: FleetView | None, others: Sequence[int]) -> Obs:
    """A drone's view as numbers.

    Args:
        view: what the drone heard; None where it has not decided yet.
        others: the other drones, ascending.

    Returns:
        float32 [1 + others, 25], within −10 … 10: the ego's row, then the others'. A drone that it has not heard has zeros.
        The columns, with the unit of a number and how many columns there are: heard, 0 or 1; age, s; place from the ego,
        100 m (3); velocity, 10 m/s (3); footprint, 100 m; charge; headroom of CPU and GPU (2); goodput from the ego,
        100 Mb/s; state of that link (0 unknown, 1/3 silent, 2/3 probed, 1 measured); phase, one-hot (5); whether it has a
        region; the region's place from the ego, 100 m (2), and radius, 100 m; share of the grid seen well; whether it
        reports targets.

    Example:
        >>> observe(None, [1, 2]).shape
        (3, 25)
    """
    rows = np.zeros((1 + len(others), ROW), np.float32)
    me = None if view is None else view.me
    if view is not None and me is not None:
        for k, i in enumerate([view.ego, *others]):
            if i in view.descriptors:
                rows[k] = _row(me, view.descriptors[i], view.age_s[i])
    return np.clip(rows, -LIMIT, LIMIT)


def directives(view: FleetView, others: Sequence[int], action: np.ndarray[Any, Any] | None) -> list[Directive]:
    """An action as directives.

    Args:
        view: the deciding drone's.
        others: the other drones, ascending.
        action: whole numbers [others, 4], for each other drone the choice of `RUNGS`, `RHOS` and `RATES_HZ`, and whether
            (1) to send the region alone; None sends nothing.

    Returns:
        One directive for each peer in the view.
    """
    me, found = view.me, []
    for peer in view.peers:
        if action is None or me is None:
            found.append(Directive(view.ego, peer, reason="no action yet"))
            continue
        rung, cells, rate, confined = (int(c) for c in action[others.index(peer)])
        rho = RHOS[cells] if RUNGS[rung] == Representation.FEATURES else 0.0
        roi = me.region if confined else None
        found.append(Directive(view.ego, peer, RUNGS[rung], rho, roi, RATES_HZ[rate], reason="action"))
    return found


def _row(me: Descriptor, d: Descriptor, age_s: float) -> list[float]:
    """As `observe` says."""
    place = [(a - b) / 100 for a, b in zip(d.position_m, me.position_m, strict=True)]
    phase = [float(d.task_phase == p) for p in TaskPhase]
    region = [0.0] * 4
    if d.region is not None:
        x_m, y_m = d.region.x_m - me.position_m[0], d.region.y_m - me.position_m[1]
        region = [1.0, x_m / 100, y_m / 100, d.region.radius_m / 100]
    cells = np.unpackbits(np.frombuffer(d.coverage_grid, np.uint8), bitorder="little").reshape(-1, 2) @ (1, 2)
    return [
        1.0,
        age_s,
        *place,
        *(v / 10 for v in d.velocity_mps),
        d.footprint_radius_m / 100,
        d.battery_soc,
        d.cpu_headroom,
        d.gpu_headroom,
        me.goodput_to(d.agent_id) / 100,
        me.link_state(d.agent_id) / LinkState.MEASURED,
        *phase,
        *region,
        float((cells >= Coverage.WELL).mean()),
        float(bool(d.priority_target_ids)),
    ]
