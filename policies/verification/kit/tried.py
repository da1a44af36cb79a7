"""Tries a policy on views up to the first on which it fails, and makes that view smaller."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from sortie.policies.contract import COVERAGE_BYTES, DETACHED_AFTER_PERIODS, Descriptor, FleetView, TaskPhase
from sortie.scenarios.disc import LISTED_IDS

SHRUNK_DRONES = 100_000
"""A view is made smaller by views of together at most so many drones: 20 of the largest fleet, or thousands of small ones."""

_PLAIN: dict[str, Any] = {
    "stamp_ns": 0,
    "orientation_xyzw": (0.0, 0.0, 0.0, 1.0),
    "velocity_mps": (0.0, 0.0, 0.0),
    "cpu_headroom": 1.0,
    "gpu_headroom": 1.0,
    "coverage_grid": bytes(COVERAGE_BYTES),
    "novelty_flags": 0,
    "region": None,
    "priority_target_ids": (),
    "feature_space": "",
    "roster": None,
    "codebook": "",
    "task_phase": TaskPhase.SEARCH,
    "battery_soc": 1.0,
    "footprint_radius_m": 42.0,
    "position_m": (0.0, 0.0, 60.0),
}


class Tried(NamedTuple):
    """What views say about one rule or property."""

    judged: int
    """On how many views it could be judged; up to the one on which it fails."""
    complaint: str = ""
    view: FleetView | None = None
    """One on which it fails, made smaller; None if there is none."""


class NotJudged(Exception):
    """A rule cannot be judged on this view, because the policy gives no directives; another rule says so."""


Key = TypeVar("Key")
Complaint = Callable[[FleetView], str | None]
"""Judges a policy on a view: returns what is wrong, or None."""


def try_views(complaints: Mapping[Key, Complaint], views: Iterable[FleetView]) -> dict[Key, Tried]:
    """Judge a policy on views by several rules, by each up to the first on which it fails; that one is made smaller.

    Each view is judged by all rules before the next one: policies often keep what they computed for a view in a cache.
    """
    found = {key: Tried(0) for key in complaints}
    for view in views:
        for key, complaint in complaints.items():
            if found[key].view is not None:
                continue
            try:
                wrong = complaint(view)
            except NotJudged:
                continue
            found[key] = Tried(found[key].judged + 1)
            if wrong is not None:
                small = shrink(view, complaint)
                found[key] = Tried(found[key].judged, _complaint_again(complaint, small) or wrong, small)
    return found


def _complaint_again(complaint: Complaint, view: FleetView) -> str | None:
    try:
        return complaint(view)
    except NotJudged:
        return None


def shrink(view: FleetView, fails: Callable[[FleetView], Any]) -> FleetView:
    """A view that still fails, with fewer drones and plainer fields; not always the smallest.

    Args:
        view: a view that fails.
        fails: whether a view fails, or its complaint; called about twenty times for each drone that is left, on views of
            together at most `SHRUNK_DRONES` drones.
    """
    left = SHRUNK_DRONES

    def kept(candidate: FleetView) -> bool:
        nonlocal view, left
        left -= len(candidate.descriptors)
        try:
            if candidate == view or left < 0 or not fails(candidate):
                return False
        except NotJudged:
            return False
        view = candidate
        return True

    kept(view._replace(detached_after_periods=DETACHED_AFTER_PERIODS))
    kept(_renumbered(view))
    for _ in range(2):  # a peer may matter less once others are gone
        for part in _parts(len(view.peers)):
            if few := view.peers[part]:
                fewer = view._replace(descriptors=_without(view.descriptors, few), age_s=_without(view.age_s, few))
                renumbered = _renumbered(fewer)
                if not kept(renumbered) and renumbered is not fewer:
                    kept(fewer)
    drones = tuple(view.descriptors)
    each = [(i,) for i in drones] if len(drones) <= LISTED_IDS else []
    for few in (drones, *each):  # all at once, which is often enough, then each
        kept(view._replace(age_s={**view.age_s, **dict.fromkeys(few, 0.0)}))
        for field, plain in _PLAIN.items():
            if field != "roster" or max(drones, default=0) < LISTED_IDS:
                kept(_with(view, {i: view.descriptors[i]._replace(**{field: plain}) for i in few}))
        flat = {i: (100.0,) * len(view.descriptors[i].peer_goodput_mbps) for i in few}
        kept(_with(view, {i: view.descriptors[i]._replace(peer_goodput_mbps=flat[i]) for i in few}))
    return view


def _renumbered(view: FleetView) -> FleetView:
    """The view of a fleet of those alone who were heard, with ids from 0 on; one of a large fleet as it is."""
    if len(view.descriptors) > LISTED_IDS:
        return view
    names = {i: name for name, i in enumerate(sorted(view.descriptors))}
    descriptors = {
        names[i]: d._replace(
            agent_id=names[i], peer_goodput_mbps=tuple(d.goodput_to(peer) for peer in names if peer != i), roster=None
        )
        for i, d in view.descriptors.items()
    }
    ages_s = {names[i]: age_s for i, age_s in view.age_s.items()}
    return view._replace(ego=names.get(view.ego, view.ego), descriptors=descriptors, age_s=ages_s)


def _parts(count: int) -> Iterator[slice]:
    """All peers, then halves of them, quarters and so on, down to each by itself; of very many, down to some 64 parts.

    The last part comes first, so that leaving it out moves no other one.
    """
    size, most = count, LISTED_IDS if count <= LISTED_IDS else 64
    while size * most >= count > 0:
        yield from (slice(k, k + size) for k in range((count - 1) // size * size, -1, -size))
        if size == 1:
            return
        size = (size + 1) // 2


def _with(view: FleetView, changed: Mapping[int, Descriptor]) -> FleetView:
    return view._replace(descriptors={**view.descriptors, **changed})


def _without(mapping: Mapping[int, Any], keys: Sequence[int]) -> dict[int, Any]:
    gone = set(keys)
    return {k: v for k, v in mapping.items() if k not in gone}
