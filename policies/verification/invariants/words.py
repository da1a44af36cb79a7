"""The words of the language of invariants: what each one means, how its value is read, and a line that uses it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol

from sortie.policies.contract import PERSON_FLAG, Descriptor, Directive, FleetView, TaskPhase
from sortie.scenarios.representation import LEVELS, NAME_OF

Kind = Literal["number", "truth"]
Span = float | Literal["dwell"]
"""A time in s, or the dwell time of the flight."""


class Counts(Protocol):
    """Knows how often a link changed lately."""

    def count(self, change: str, peer: int, span: Span) -> int: ...


class Scope(NamedTuple):
    """The values that an expression is evaluated on: a view, all its directives, and one link if the line needs a link."""

    view: FleetView
    me: Descriptor
    directives: Sequence[Directive]
    fresh: Mapping[int, Directive]
    link: Directive | None = None
    past: Counts | None = None
    """None outside a flight; words about time cannot be evaluated then."""


class Word(NamedTuple):
    """A name of the language; `of_link` if it needs a link."""

    about: str
    kind: Kind
    of_link: bool
    value: Callable[[Scope], Any]
    example: str
    raw: Callable[..., Any] | None = None
    """Of a directive's field: from the directive. Of a peer: from the scope and the peer's id."""


def _view_word(about: str, value: Callable[[Scope], Any], example: str, kind: Kind = "number") -> Word:
    return Word(about, kind, False, value, example)


def _decided(about: str, value: Callable[[Directive], Any], example: str, kind: Kind = "number") -> Word:
    return Word(about, kind, True, lambda s: value(link_of(s)), example, value)


def _of_peer(about: str, value: Callable[[Scope, int], Any], example: str, kind: Kind = "number") -> Word:
    return Word(about, kind, True, lambda s: value(s, link_of(s).destination), example, value)


def link_of(scope: Scope) -> Directive:
    """The link that an expression is evaluated for."""
    assert scope.link is not None, "the parser binds link words to a link"  # noqa: S101
    return scope.link


DECISIONS: dict[str, Word] = {
    "representation": _decided(
        "the rung: none, tracks, detections, uncertain_boxes, codes, features or raw",
        lambda d: LEVELS.get(d.representation, d.representation),
        "representation <= features",
    ),
    "rho": _decided("share of the sender's feature cells, 0 … 1", lambda d: d.rho, "rho <= 0.5"),
    "rate_hz": _decided("rate, Hz", lambda d: d.rate_hz, "when battery < 0.6: rate_hz <= 5"),
    "deadline_s": _decided("deadline, s", lambda d: d.deadline_s, "deadline_s <= 0.5"),
    "fusion_weight": _decided("weight at the receiver, 0 … 1", lambda d: d.fusion_weight, "fusion_weight >= 0.2"),
    "duty": _decided(
        "share of frames in which perception runs, 0 … 1", lambda d: d.duty_percent / 100, "when human: duty == 1"
    ),
    "roi": _decided(
        "whether it is confined to a region",
        lambda d: d.roi is not None,
        "when phase == track and region and representation > none: roi",
        "truth",
    ),
}
"""The fields of a directive, as names of the language."""

WORDS: dict[str, Word] = {
    "battery": _view_word(
        "the ego's state of charge, 0 … 1", lambda s: s.me.battery_soc, "when battery < 0.3: rate_hz <= 2"
    ),
    "cpu": _view_word("the ego's CPU headroom, 0 … 1", lambda s: s.me.cpu_headroom, "when cpu < 0.1: duty <= 0.5"),
    "gpu": _view_word("the ego's GPU headroom, 0 … 1", lambda s: s.me.gpu_headroom, "when gpu < 0.1: duty <= 0.5"),
    "phase": _view_word(
        "the ego's: transit, search, track, returning or landing",
        lambda s: s.me.task_phase,
        "when phase == landing: representation <= detections",
    ),
    "peers": _view_word(
        "how many peers are attached",
        lambda s: len(s.view.attached.peers),
        "when peers >= 1: any_link(representation >= detections)",
    ),
    "region": _view_word(
        "the ego has a region of responsibility",
        lambda s: s.me.region is not None,
        "when region and peers >= 1: any_link(representation > none)",
        "truth",
    ),
    "targets": _view_word(
        "the ego reports priority targets, which are cars",
        lambda s: bool(s.me.priority_target_ids),
        "when targets and peers >= 1: any_link(rate_hz >= 2)",
        "truth",
    ),
    "target_in_region": _view_word(
        "the ego has a region and reports targets, which are cars",
        lambda s: s.me.region is not None and bool(s.me.priority_target_ids),
        "when target_in_region and peers >= 1: any_link(representation >= detections)",
        "truth",
    ),
    "human": _view_word(
        "the ego's own thermal camera found a person in its region",
        lambda s: s.me.novelty_flags & PERSON_FLAG != 0,
        "when human and peers >= 1: any_link(representation >= detections)",
        "truth",
    ),
    "human_in_region": _view_word(
        "the ego has a region, and its thermal camera or an attached peer's found a person there",
        lambda s: s.view.human_in_region,
        "when human_in_region and peers >= 1: within 0.5 s: any_link(representation >= detections)",
        "truth",
    ),
    "goodput_mbps": _of_peer(
        "to the link's peer, as the ego measured it",
        lambda s, p: s.me.goodput_to(p),
        "when goodput_mbps < 5: representation <= detections",
    ),
    "age_s": _of_peer("age of the peer's descriptor", lambda s, p: s.view.age_s[p], "when age_s > 1: rate_hz <= 2"),
    "age_periods": _of_peer(
        "the same in periods", lambda s, p: s.view.age_s[p] / s.view.period_s, "when age_periods > 10: rate_hz == 0"
    ),
    "peer_battery": _of_peer(
        "the peer's state of charge, 0 … 1",
        lambda s, p: s.view.descriptors[p].battery_soc,
        "when peer_battery < 0.1: representation <= detections",
    ),
    "peer_human": _of_peer(
        "the peer's thermal camera found a person in the peer's region",
        lambda s, p: s.view.descriptors[p].novelty_flags & PERSON_FLAG != 0,
        "when peer_human: representation >= detections",
        "truth",
    ),
    "peer_phase": _of_peer(
        "the peer's phase",
        lambda s, p: s.view.descriptors[p].task_phase,
        "when peer_phase == landing: representation == none",
    ),
    "same_network": _of_peer(
        "the peer has the ego's network, so it can fuse the ego's maps",
        lambda s, p: s.view.shares_features_with(p),
        "when not same_network: representation != features",
        "truth",
    ),
    "same_codebook": _of_peer(
        "the peer has the ego's network and codebook, so it can read the ego's codes",
        lambda s, p: s.view.shares_codes_with(p),
        "when not same_codebook: representation != codes",
        "truth",
    ),
    **DECISIONS,
}
"""Every name that an invariant may use."""

CONSTANTS: dict[str, float] = {name: r.level for r, name in NAME_OF.items()} | {
    "transit": TaskPhase.TRANSIT,
    "search": TaskPhase.SEARCH,
    "track": TaskPhase.TRACK,
    "returning": TaskPhase.RETURN,  # `return` is a Python keyword
    "landing": TaskPhase.LANDING,
}
LINK_FUNCTIONS: dict[str, tuple[Kind, Kind]] = {
    "any_link": ("truth", "truth"),
    "every_link": ("truth", "truth"),
    "count_links": ("truth", "number"),
    "sum_links": ("number", "number"),
}
"""Functions over all links: the kind of the argument, and of the result."""

DWELL: Literal["dwell"] = "dwell"


def seconds(span: Span, dwell_s: float) -> float:
    """A time in s, where the dwell time of the flight is known."""
    return dwell_s if span == DWELL else span


CHANGES = ("climbs_in", "switches_in")
"""Words that count changes of a link in the last so many seconds."""
TIME_WORDS: dict[str, tuple[str, str]] = {
    "within T s": (
        "as long as the condition holds, the requirement is never broken for more than T s without a break",
        "when human_in_region and peers >= 1: within 0.5 s: any_link(representation >= detections)",
    ),
    "climbs_in(T)": (
        "how often the link rose in the last T s, in any part that damping would hold back (of each link)",
        "climbs_in(dwell) <= 1",
    ),
    "switches_in(T)": (
        "how often the link changed in the last T s, by more than a small move of its region (of each link)",
        "when battery < 0.3: switches_in(10) <= 2",
    ),
    "dwell": ("in place of a time: the flight's dwell time, `policy.dwell_s`", "climbs_in(dwell) <= 1"),
}
"""Words about time: what each means, and a line that uses it."""
ELSEWHERE: dict[str, str] = {
    "car": "`targets` are cars",
    "person": "a person is `human`",
    "truck": "no descriptor says whether a truck was seen",
}
"""Classes of targets whose names are no words, and what to write."""
