"""How often two drones would choose differently about the same link, for how long, and why.

Policies read local copies of the fleet's context, and no drone asks another one. But a policy is a function of a view,
so every drone can compute what any other drone would decide: it puts the other one in the ego's place. In every frame
each drone does this for each source that decides in that frame. Two drones disagree about a link while their directives
for it differ by more than damping would ignore (`sortie.policies.damping.is_switch`). A view without the source, or
without the destination, sends nothing there.

This is computed after the flight, from the views that the policies read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations, groupby, product
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from sortie.fleet.trust import discounted
from sortie.policies.contract import Directive, FleetView, Policy, PolicyError, Representation, nothing
from sortie.policies.damping import is_switch
from sortie.policies.registry import describe_error
from sortie.scenarios.frames import frame_at
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.plugins.user_calls import is_guarded
from sortie.sim.results.arrow_types import columns_of, from_table, to_table
from sortie.sim.results.section import Count, Flown, OutcomeSection, Seconds, Share, figure
from sortie.sim.results.views import Decision

TABLE = "disagreement"
CAUSES = ("roster", "trust", "values", "descriptor", "age")
"""What differs between two views, in the order in which one view is turned into the other to find a cause."""
ABOUT = (
    "A pair of drones that both decided: how long they could be compared, summed over links, and each time in which "
    "their views led to different directives for the link from `source` to `destination`. `sends`: one would send and "
    "the other would not. `cause`: `roster` (one has not heard a drone), `trust` (one doubts it), `values` (one descriptor "
    "read differently: its author does not believe the lie that it publishes), `descriptor` (one has a later one), "
    "`age` (the descriptors' ages alone)."
)


class Episode(NamedTuple):
    """Successive frames in which two drones disagree about one link."""

    source: int
    destination: int
    begin_s: float
    duration_s: float
    """Frames times the length of a frame."""
    sends: bool
    """Whether in some frame one of them would send and the other would not."""
    cause: str
    """Of the first frame, one of `CAUSES`."""


class Pair(NamedTuple):
    """Two drones over a sortie."""

    drone: int
    other: int
    compared_s: float
    """Time in which both decide, summed over the links that are compared."""
    episodes: tuple[Episode, ...]
    """By their end."""


COLUMNS = columns_of(Pair)


def pairs_table(pairs: Sequence[Pair]) -> pa.Table:
    """A row a pair."""
    return to_table(Pair, pairs)


def pairs_of(table: pa.Table) -> list[Pair]:
    """What `pairs_table` wrote."""
    return from_table(Pair, table)


class Causes(OutcomeSection):
    roster: Share | None = figure("One of them has not heard a drone.")
    trust: Share | None = figure("One of them doubts a drone.")
    values: Share | None = figure("They read one descriptor differently: its author does not believe its own lie.")
    descriptor: Share | None = figure("One of them has a later descriptor of a drone, with other contents.")
    age: Share | None = figure("A descriptor is too old for one of them: packets were lost, or clocks differ.")


class Disagreement(OutcomeSection):
    share: Share | None = figure(
        "Share of the time in which two drones' views lead to different directives for a link, over all pairs of "
        "drones and all links. Both take the policy of the link's source, and put the source in the ego's place. A "
        "disc that moved by less than damping ignores is no difference."
    )
    sends_share: Share | None = figure("The part of it in episodes where one would send and the other would not.")
    episodes: Count | None = figure("How often such a disagreement began, for one pair and link.")
    mean_s: Seconds | None = figure("How long one lasts on average, in whole frames.")
    p99_s: Seconds | None = figure("99th percentile of that.")
    longest_s: Seconds | None = figure("The longest.")
    causes: Causes = figure("The share by cause: which difference between views must go for choices to agree.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, Any]:
        return figures(pairs_of(flown.tables[TABLE]) if TABLE in flown.tables else ())


def figures(pairs: Iterable[Pair]) -> dict[str, Any]:
    """The figures of `Disagreement`; all null where nothing was compared."""
    pairs = list(pairs)
    compared_s = plain_sum(pair.compared_s for pair in pairs)
    episodes = [episode for pair in pairs for episode in pair.episodes]
    lasted_s = np.array([e.duration_s for e in episodes])

    def share(chosen: Callable[[Episode], bool]) -> float | None:
        return plain_sum(e.duration_s for e in episodes if chosen(e)) / compared_s if compared_s else None

    return {
        "share": share(lambda e: True),
        "sends_share": share(lambda e: e.sends),
        "episodes": len(episodes) if compared_s else None,
        "mean_s": float(lasted_s.mean()) if episodes else None,
        "p99_s": float(np.percentile(lasted_s, 99)) if episodes else None,
        "longest_s": float(lasted_s.max()) if episodes else None,
        "causes": {cause: share(lambda e, cause=cause: e.cause == cause) for cause in CAUSES},  # type: ignore[misc]
    }


def measure(decisions: Iterable[Decision], policy_of: Callable[[Decision], Policy], frame_s: float) -> list[Pair]:
    """Compare all drones' choices in every frame.

    Args:
        decisions: of a sortie, in order of time.
        policy_of: from the source's own decision in that frame to the policy that all drones take it to have.
        frame_s: from one frame to the next; a drone decides once in each.

    Returns:
        Each pair of drones that decided in a common frame, ascending.

    Raises:
        PolicyError: a policy fails on a view in which another drone is the ego.
    """
    compared: dict[tuple[int, int], int] = {}
    running: dict[tuple[int, int, int, int], tuple[int, int, bool, str]] = {}  # since, until, sends, cause
    ended: dict[tuple[int, int], list[Episode]] = {}

    def end(link: tuple[int, int, int, int]) -> None:
        since, until, sends, cause = running.pop(link)
        episode = Episode(*link[2:], since * frame_s, (until - since) * frame_s, sends, cause)
        ended.setdefault(link[:2], []).append(episode)

    for frame, group in groupby(decisions, key=lambda d: frame_at(d.t_s, frame_s)):
        decided = {d.drone: d for d in group}
        views = {drone: d.view for drone, d in sorted(decided.items())}
        for a, b in combinations(views, 2):
            heard = views[a].descriptors.keys() | views[b].descriptors.keys()
            links = len(views) * len(heard) - len(views.keys() & heard)  # from each that decides to all others heard
            compared[a, b] = compared.get((a, b), 0) + links
        for source, decision in decided.items():
            policy = policy_of(decision)
            answers = {drone: _answer(policy, source, view) for drone, view in views.items()}
            for (a, b), (peer, sends) in _disagreeing(answers, source):
                since, _, sent, cause = running.get((a, b, source, peer), (frame, frame, False, ""))
                cause = cause or _cause(policy, source, peer, views[a], views[b], answers[b])
                running[a, b, source, peer] = since, frame + 1, sent or sends, cause
        for link in [link for link, (_, until, _, _) in running.items() if until <= frame]:
            end(link)
    for link in list(running):
        end(link)
    return [Pair(*pair, n * frame_s, tuple(ended.get(pair, ()))) for pair, n in sorted(compared.items())]


Answer = Mapping[int, Directive]
"""Directives by destination."""


def _answer(policy: Policy, source: int, view: FleetView) -> Answer:
    """What a drone with this view takes the source to decide; nothing where it has not heard the source."""
    if source not in view.descriptors:
        return {}
    try:
        return {d.destination: d for d in policy(view._replace(ego=source))}
    except PolicyError:
        raise
    except Exception as error:
        if not is_guarded(policy):  # a built-in one
            raise
        raise PolicyError(f"as drone {source}, by the view of drone {view.ego}: {describe_error(error)}") from error


def _disagreeing(answers: Mapping[int, Answer], source: int) -> Iterator[tuple[tuple[int, int], tuple[int, bool]]]:
    """Each pair of drones that disagrees about a link of the source, with the link as `_differing` gives it."""
    alike: dict[tuple[Directive, ...], list[int]] = {}
    for drone, answer in answers.items():
        alike.setdefault(tuple(answer.values()), []).append(drone)
    for some, others in combinations(alike.values(), 2):
        for link in _differing(answers[some[0]], answers[others[0]], source):
            for a, b in product(some, others):
                yield (min(a, b), max(a, b)), link


def _differing(a: Answer, b: Answer, source: int) -> Iterator[tuple[int, bool]]:
    """The destinations about which two answers differ, and whether one of them sends and the other does not."""
    for peer in a.keys() | b.keys():
        one, other = (answer.get(peer) or nothing(source, peer, "") for answer in (a, b))
        if is_switch(one, other):
            yield peer, _sends(one) != _sends(other)


def _sends(directive: Directive) -> bool:
    return directive.representation != Representation.NONE and directive.rate_hz > 0


def _cause(policy: Policy, source: int, peer: int, a: FleetView, b: FleetView, last: Answer) -> str:
    """Turn view `a` into view `b`, one kind of difference after the other: the cause is the one that ends the disagreement."""
    kinds = {i: _kind(a, b, i) for i in a.descriptors.keys() | b.descriptors.keys()}
    for k in range(len(CAUSES) - 1, 0, -1):  # with the first k kinds taken from b, and the others and all ages from a
        if k < len(CAUSES) - 1 and CAUSES[k] not in kinds.values():
            continue
        taken = {i: b if kind in CAUSES[:k] else a for i, kind in sorted(kinds.items())}
        known = {i: view.descriptors[i] for i, view in taken.items() if i in view.descriptors}
        mixed = a._replace(descriptors=known, age_s={i: a.age_s.get(i, b.age_s.get(i, 0.0)) for i in known})
        if any(differing == peer for differing, _ in _differing(_answer(policy, source, mixed), last, source)):
            return CAUSES[k]
    return CAUSES[0]


def _kind(a: FleetView, b: FleetView, drone: int) -> str:
    """How two views differ about one drone's descriptor; empty where they do not."""
    one, other = a.descriptors.get(drone), b.descriptors.get(drone)
    if one is None or other is None:
        return "roster"
    if one == other:
        return ""
    if (discounted(one) == one) != (discounted(other) == other):
        return "trust"
    return "values" if one.stamp_ns == other.stamp_ns else "descriptor"
