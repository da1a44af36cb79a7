"""The fields of `outcome.json` and their meanings; `outcome.md` is made from them.

A number is an amount, 0 or more, unless its range stands after its meaning.

A test holds `sortie.sim.results.outcome.outcome` to these types, field by field; `check_number` holds the names of metrics to them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import UnionType
from typing import Annotated, Any, TypedDict, get_args, get_origin, get_type_hints, is_typeddict

from sortie.fleet.energy.battery import CAUSES, RECORDED
from sortie.fleet.messages.auth import DropReason
from sortie.radio.transmission import Status
from sortie.scenarios.intervals import AMOUNT, ANY, FLAG, SHARE, Range
from sortie.scenarios.reading.nodes import nearest
from sortie.sim.folders import RunError


class Percentiles(TypedDict):
    p50: Annotated[float | None, "Median."]
    p99: Annotated[float | None, "99th percentile."]


class Accuracy(TypedDict):
    full_scene: Annotated[
        float | None, "AP@0.5 over all cars within range, rotated BEV IoU, pooled over egos and scored fusions.", SHARE
    ]
    mission: Annotated[
        float | None,
        "The same of detections and cars whose centres lie in the mission disc, while there is one.",
        SHARE,
    ]


class Ap50(Accuracy):
    detector: Annotated[
        str, "The detector that flew: `perception.detector`, or for one passed in its `name` or module and class."
    ]
    fusion: Annotated[
        str | None,
        "`perception.fusion` or `perception.recorded_fusion`; null where the scenario's detector did not fly.",
    ]
    calibration: Annotated[str | None, "Which fit a surrogate detector is of."]
    grounded_blind: Annotated[
        Accuracy,
        "The same with every drone that left the air, or has not joined yet, counted as blind: at each scored instant it detects nothing, and "
        "the cars about the place that it would have in the formation count as missed. Equal where all fly to the end.",
    ]
    sample_rate_hz: Annotated[float, "Accuracy is sampled at this rate while traffic runs at the full one."]
    scored_fusions: Annotated[int, "How many fusions were scored."]
    scored_drones: Annotated[
        int,
        "How many drones are scored at each scored instant (`perception.egos`), 0 without a detector. Where they are fewer than "
        "`scorable_drones`, drones take turns in a random order, and accuracy is an estimate for the whole fleet.",
    ]
    scorable_drones: Annotated[int, "How many drones may be scored: all but ground stations that are not."]


class ClassAccuracy(TypedDict):
    full_scene: Annotated[
        float | None, "AP of that class over all within range, pooled over egos and scored fusions.", SHARE
    ]
    mission: Annotated[float | None, "The same in the mission disc, while there is one.", SHARE]


class ByClass(TypedDict):
    car: Annotated[ClassAccuracy, "As `ap50`: AP@0.5 by rotated BEV IoU."]
    truck: Annotated[ClassAccuracy, "Trucks, likewise. The shipped detectors call every vehicle a car."]
    person: Annotated[
        ClassAccuracy,
        "People, by distance: a box may be of a person within 2 m of it. Boxes are those of the ego's own thermal camera "
        "joined with those that its peers sent; everybody in the ego's square counts, hidden or not.",
    ]


class TrackingOutcome(TypedDict):
    hota: Annotated[
        float | None,
        "HOTA (higher order tracking accuracy, Luiten et al. 2021), the mean over 19 limits of overlap, 0.05 to 0.95. A "
        "tracker follows each drone's boxes after fusion; its confirmed tracks are judged by rotated IoU on the ground, "
        "over all cars within range. Null where the detector does not know which car is which, and where drones take turns "
        "at being scored: a tracker needs all boxes of its drone.",
        SHARE,
    ]
    det_a: Annotated[float | None, "DetA, its part that judges detection.", SHARE]
    ass_a: Annotated[float | None, "AssA, its part that judges whether tracks keep to their cars.", SHARE]


class MissionOutcome(TypedDict):
    flown_share: Annotated[
        float,
        "Share of drone-seconds flown, 0 … 1: 1 where all fly from beginning to end. Ground stations do not count.",
        SHARE,
    ]
    region_observed_share: Annotated[
        float | None,
        "Share of the mission region's area in view, 0 … 1, averaged over the time in which there is a region. A place is "
        "in view where it lies in the picture of one of the five cameras of a drone, on flat ground without houses and "
        "trees, and in the square of the drone's feature map. The drone flies, and its perception ran within the last second.",
        SHARE,
    ]
    target_in_view_share: Annotated[
        float | None,
        "Share of the time of phase `track`, 0 … 1, in which the target's place is in view, as above.",
        SHARE,
    ]
    target_longest_out_of_view_s: Annotated[
        float | None, "Longest unbroken time of phase `track` in which no drone has the target in view, s."
    ]
    target_detected_share: Annotated[
        float | None,
        "Share of the time of phase `track`, 0 … 1, in which a box of at least one drone overlaps the target with an "
        "IoU of at least 0.5. Each scored instant stands for its scoring period. Null where drones take turns at being "
        "scored: a drone that is not scored may have the target.",
        SHARE,
    ]
    target_longest_undetected_s: Annotated[
        float | None, "Longest unbroken time of phase `track` in which no drone's boxes hold the target, s."
    ]


class PeopleOutcome(TypedDict):
    ap_2m: Annotated[
        float | None,
        "AP of people, pooled over drones and frames: what a drone's thermal camera reports, against everybody in its cone, "
        "hidden or not. A detection may be of a person within 2 m of it. `ap_by_class.person` is that of people after sharing.",
        SHARE,
    ]
    located_share: Annotated[
        float | None,
        "Of the people in a drone's region at a scored fusion, the share of which the drone had a box within 2 m, its own or "
        "a peer's, 0 … 1.",
        SHARE,
    ]
    located_alone_share: Annotated[
        float | None, "The same by the drone's own thermal camera in that frame, without its peers.", SHARE
    ]
    in_region_drone_s: Annotated[
        float | None,
        "Time in which a person truly was in a flying drone's region, summed over drones, s. Ground stations do not count.",
    ]
    unknown_share: Annotated[
        float | None,
        "Share of that time, 0 … 1, in which the drone did not know it, from its own camera or from attached peers.",
        SHARE,
    ]
    unknown_longest_s: Annotated[float | None, "Longest unbroken time of one drone in which it did not know it, s."]
    false_alert_share: Annotated[
        float | None,
        "Share of the time in which a drone had a region and nobody was there, 0 … 1, in which it took somebody to be there.",
        SHARE,
    ]


class Bytes(TypedDict):
    context_sent: Annotated[int, "Descriptors and directives."]
    context_descriptors: Annotated[int, "Descriptors as sent, 28 B of authentication included."]
    context_directives: Annotated[int, "Directives at 36 B, counted when they change."]
    data_sent: Annotated[int, "Payloads handed to the radio: delivered + lost + expired + in flight."]
    handshakes_sent: Annotated[
        int, "What a method put on its links before payloads (`sortie.policies.catalogue.prior`), part of `data_sent`."
    ]
    data_delivered: Annotated[int, "Arrived; of payloads that came in part, that part."]
    data_lost: Annotated[int, "Lost on the air."]
    data_expired: Annotated[int, "Past their deadline, or replaced by a newer one before they were through."]
    data_in_flight: Annotated[int, "On the way at the end."]


class DroneAccuracy(TypedDict):
    full_scene: Annotated[float | None, "AP@0.5 of cars over all of its own scored fusions.", SHARE]
    mission: Annotated[float | None, "The same in the mission disc, while there is one.", SHARE]


class Drone(TypedDict):
    soc: Annotated[float, "State of charge, 0 … 1.", SHARE]
    voltage_v: Annotated[float, "At the pack's terminals."]
    airborne: Annotated[bool, "Whether it still flew; of a ground station, whether it was on.", FLAG]
    energy_j: Annotated[float, "Spent to the very end, all causes."]
    ap50: Annotated[DroneAccuracy, "How well this drone saw; null where it had no scored fusion, or no car was there."]


class Violations(TypedDict):
    policy: Annotated[int, "The policy's decision, after its shield."]
    staleness: Annotated[int, "The caps on links to peers with old descriptors."]
    damping: Annotated[int, "A link that waited for its dwell time."]
    no_peer: Annotated[int, "No peer was attached, and the line is over all links."]


class Policies(TypedDict):
    decisions: Annotated[dict[str, int], "By policy."]
    changes: Annotated[int, "How often a drone's policy was replaced in flight."]
    shield_interventions: Annotated[
        int,
        "Directives of policies that the shield replaced or could not put right, and changes that it made at gates.",
    ]
    invariant_violations: Annotated[
        int,
        "Violations of invariants by what the gates enforced, after staleness rules and damping; one that lasts counts once.",
    ]
    violated_ticks: Annotated[int, "Decisions of all drones at which the enforced directives broke an invariant."]
    violations_by_cause: Annotated[Violations, "`invariant_violations`, by the step that broke the line."]


Transition = TypedDict(
    "Transition",
    {
        "t_s": Annotated[float, "When."],
        "drone": Annotated[int, "Whose links."],
        "peers": Annotated[list[int], "To whom; links that change alike share an entry."],
        "from": Annotated[str, "What they carried, in words."],
        "to": Annotated[str, "What they carry now."],
        "reason": Annotated[str, "The reason that decided it."],
    },
)


class Causes(TypedDict):
    roster: Annotated[float | None, "One of them has not heard a drone.", SHARE]
    trust: Annotated[float | None, "One of them doubts a drone.", SHARE]
    values: Annotated[
        float | None,
        "They read other values in one descriptor: its author does not believe the lie that it publishes.",
        SHARE,
    ]
    descriptor: Annotated[float | None, "One of them has a later descriptor of a drone, with other contents.", SHARE]
    age: Annotated[float | None, "A descriptor is too old for one of them: packets were lost, or clocks differ.", SHARE]


class Disagreement(TypedDict):
    share: Annotated[
        float | None,
        "Share of the time in which two drones' views lead to different directives for a link, over all pairs of drones "
        "and all links. Both take the policy of the link's source, and put the source in the ego's place. A disc that "
        "moved by less than damping ignores is no difference.",
        SHARE,
    ]
    sends_share: Annotated[
        float | None, "The part of it in episodes where one would send and the other would not.", SHARE
    ]
    episodes: Annotated[int | None, "How often such a disagreement began, for one pair and link."]
    mean_s: Annotated[float | None, "How long one lasts on average, in whole frames."]
    p99_s: Annotated[float | None, "99th percentile of that."]
    longest_s: Annotated[float | None, "The longest."]
    causes: Annotated[
        Causes, "The share by cause: which difference between the two views must go for the choices to agree."
    ]


class LostTo(TypedDict):
    collision_context: Annotated[float | None, "It met another descriptor on the air.", SHARE]
    collision_data: Annotated[float | None, "It met a payload's frame, or the answer to one.", SHARE]
    hidden: Annotated[float | None, "A sender that could not hear the first one spoilt it at the receiver.", SHARE]
    weak_signal: Annotated[
        float | None, "Distance, shadowing, fading, a burst or an event made the link too bad.", SHARE
    ]
    half_duplex: Annotated[float | None, "The receiver was sending itself.", SHARE]


class ContextOutcome(TypedDict):
    lost: Annotated[
        float | None,
        "Share of descriptor receptions that were lost on the air, 0 … 1. Each descriptor counts once for each other drone "
        "in the air.",
        SHARE,
    ]
    lost_to: Annotated[LostTo, "The part of it that each cause has; together they are `lost`."]


class Bottleneck(TypedDict):
    sender: Annotated[int | None, "Whose link it is."]
    receiver: Annotated[int | None, "To whom."]
    mbps: Annotated[float | None, "What it would carry alone on the channel, Mb/s."]


class ConnectivityOutcome(TypedDict):
    connected_share: Annotated[
        float | None,
        "Share of the moments at which every drone in the air reaches every other, over hops if need be.",
        SHARE,
    ]
    partitioned_s: Annotated[float | None, "The rest of them, as time: for how long the fleet was in parts."]
    mean_hops: Annotated[
        float | None,
        "Links on the shortest route, the mean over all pairs with one; in fleets of more than 200 drones from some 200 of them.",
    ]
    bottleneck: Annotated[
        Bottleneck,
        "The link that limited the worst-off pair that was connected, at the worst moment. Null in fleets of more than 200 drones.",
    ]
    articulation: Annotated[
        dict[str, float],
        "Share of the moments at which the fleet, or its part, would have fallen apart without the drone; of drones with any.",
        SHARE,
    ]


class PhaseOutcome(TypedDict):
    phase: Annotated[
        str, "A phase of `mission.phases`. Its figures are of the whole fleet, also of drones in `mission.groups`."
    ]
    begin_s: Annotated[float, "From when."]
    end_s: Annotated[float, "Until when, exclusive."]
    ap50: Annotated[Accuracy, "Accuracy within it."]
    context: Annotated[ContextOutcome, "Losses of descriptors in the frames that begin within it."]
    data_rate_mbps: Annotated[float, "Payload bytes captured in it, as Mb/s."]
    feature_payload_bytes: Annotated[float | None, "Median size of a feature payload."]
    deadline_miss_rate: Annotated[float | None, "As for the whole sortie.", SHARE]


class Event(TypedDict):
    t_s: Annotated[float, "When."]
    drone: Annotated[int, "Whose; −1 is the fleet's.", ANY]
    kind: Annotated[str, "What kind."]
    text: Annotated[str, "In words."]


class Outcome(TypedDict):
    """All of `outcome.json`; what is a ratio of nothing is null."""

    scenario: Annotated[str, "Its name."]
    policy: Annotated[
        str, "The policy that flew, by its name; one passed as a callable by its `name` or module and function."
    ]
    seed: Annotated[int, "Of every random draw."]
    replication: Annotated[int, "Which draw of a campaign."]
    version: Annotated[
        str, "The code that made the record: release, plus sign, digest of the package and its libraries."
    ]
    own_files: Annotated[
        dict[str, str],
        "Digest of each file beside the package that flew: policies, detector and fusion with the modules that they "
        "import, weights, recordings, traces.",
    ]
    fingerprint: Annotated[str, "SHA-256 over the record's values; equal inputs give equal fingerprints."]
    duration_s: Annotated[float, "Length of the sortie."]
    frame_s: Annotated[float, "From one frame to the next."]
    ap50: Annotated[Ap50, "Accuracy of the drones that fly."]
    ap_by_class: Annotated[
        ByClass,
        "AP of each class of targets. A box counts for its own class alone. Null for classes that drones do not look for, "
        "and for all where cars are the only class.",
    ]
    tracking: Annotated[TrackingOutcome, "How well each drone that flies follows the cars, beside `ap50`."]
    mission: Annotated[
        MissionOutcome, "The mission of the whole fleet; null where there is no region, no target or no detector."
    ]
    people: Annotated[PeopleOutcome, "People and thermal cameras; null without both, and where nobody was in a region."]
    bytes: Annotated[Bytes, "What was sent."]
    context: Annotated[ContextOutcome, "What the context plane lost."]
    connectivity: Annotated[
        ConnectivityOutcome, "The fleet's graph of usable links (table `links`), looked at every 10 s from take-off on."
    ]
    context_share: Annotated[float | None, "Context bytes over all bytes.", SHARE]
    data_rate_mbps: Annotated[float, "Payload bytes handed to the radio over the whole sortie, as Mb/s."]
    deadline_miss_rate: Annotated[
        float | None,
        "Payloads that expired or were replaced before all of them was delivered, over those whose fate is known. Handshakes "
        "are no payloads.",
        SHARE,
    ]
    payload_fates: Annotated[dict[str, int], "Counts of payloads by status and reason, without handshakes."]
    medium_busy_fraction: Annotated[float, "Share of the time in which the channel was busy.", SHARE]
    age_s: Annotated[
        Percentiles,
        "Age of peers' descriptors when a policy read them. The last one of a drone that fell silent grows older to the end.",
    ]
    data_age_s: Annotated[Percentiles, "Age of peers' captures when they were fused."]
    data_age_mean_s: Annotated[float | None, "Its mean; it follows the mean over time, at any rate of sending."]
    descriptor_drops: Annotated[dict[str, int], "Descriptors refused at receivers, by reason."]
    battery: Annotated[dict[str, float], "State of charge as the last frame begins, by drone.", SHARE]
    drones: Annotated[dict[str, Drone], "Each as the last frame begins."]
    energy_j: Annotated[dict[str, float], "By cause, and `total`; hover outweighs the radio about a hundredfold."]
    policies: Annotated[Policies, "Who decided, and how often it was put right."]
    switches: Annotated[
        float | None, "Changes of what a link carries, per link and minute; links that change alike count each."
    ]
    transitions: Annotated[list[Transition], "Each change of what links carry."]
    phases: Annotated[list[PhaseOutcome], "By mission phase."]
    distrusted_by: Annotated[
        dict[str, int], "For each drone that anyone came to doubt (`fleet/trust.py`), how many did."
    ]
    events: Annotated[list[Event], "What happened to the fleet: scenario events, landings, policies that took over."]
    disagreement: Annotated[
        Disagreement, "How often drones' views lead to different choices; null without `record.disagreement`."
    ]
    metrics: Annotated[dict[str, float | None], "Figures of the user's own, by the names in `metrics`.", ANY]
    policy_eval_us: Annotated[Percentiles, "Wall time of a decision; no part of the fingerprint."]
    wall_s: Annotated[float | None, "Wall time of the flight; no part of the fingerprint."]
    realtime_factor: Annotated[float | None, "Simulated over wall time; no part of the fingerprint."]


# --- names of numbers ----------------------------------------------------------------------------

WALL = ("wall_s", "realtime_factor", "policy_eval_us")
REASONS = {
    Status.DELIVERED: ("", "other_feature_space"),
    Status.LOST: ("fragment_lost", "no_link", "receiver_gone", "sender_gone"),
    Status.EXPIRED: ("deadline_in_service", "deadline_queued", "replaced"),
    Status.IN_FLIGHT: ("",),
}
"""By fate: the reasons that the radio gives, and that of a payload that its receiver cannot use; what arrived in part has those of what was lost or expired."""

COUNTS = ("payload_fates.", "descriptor_drops.", "distrusted_by.", "policies.decisions.")
"""Where an outcome counts by key: a key that is not there was counted 0 times."""


def is_zero_count(name: str, drones: int) -> bool:
    """Whether a dotted name that an outcome of so many drones does not have is a count of 0; policies are not known here."""
    section, _, key = name.partition(".")
    return name.startswith(COUNTS[:-1]) and key in open_keys(drones, 0, (), traced=False)[section]


def metric(result: dict[str, Any], dotted: str) -> Any:
    """A field of an outcome by its dotted name; list items by number. A count that is not there is 0.

    Raises:
        KeyError: no such field, naming the fields that there are.
    """
    value: Any = result
    for depth, part in enumerate(dotted.split(".")):
        if isinstance(value, list) and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        elif isinstance(value, dict) and part in value:
            value = value[part]
        elif is_zero_count(dotted, len(result.get("battery", ()))):
            return 0
        else:
            known = (
                ", ".join(value)
                if isinstance(value, dict)
                else f"0 … {len(value) - 1}"
                if isinstance(value, list)
                else "nothing"
            )
            where = ".".join(dotted.split(".")[:depth]) or "the outcome"
            raise KeyError(f"{dotted}: {where} has no {part!r}, it has {known}")
    return value


def lacking(name: str, drones: int) -> int | None:
    """What a run of so many drones has of a number that another run has and its own outcome lacks: 0 of a count, but for
    one of a drone that is not there; else None.

    Example:
        >>> lacking("distrusted_by.1", 2), lacking("distrusted_by.7", 2), lacking("policies.decisions.silence", 2)
        (0, None, 0)
    """
    of_nobody = name.startswith("distrusted_by.") and not is_zero_count(name, drones)
    return 0 if name.startswith(COUNTS) and not of_nobody else None


def open_keys(
    drones: int, phases: int, policies: Collection[str], *, traced: bool, metrics: Collection[str] = ()
) -> dict[str, Collection[str]]:
    """What the objects of an outcome that are open (`*` in the reference) may be keyed by, and how many phases there are.

    Args:
        drones, phases: at most so many.
        policies: those that may decide, as the record names them.
        traced: whether drones may follow a trace.
        metrics: names of the user's own.
    """
    ids = tuple(map(str, range(drones)))
    part = {Status.PARTIAL: (*REASONS[Status.LOST], *REASONS[Status.EXPIRED])}
    return {
        "payload_fates": tuple(f"{s}/{r}" if r else str(s) for s, reasons in (REASONS | part).items() for r in reasons),
        "descriptor_drops": tuple(map(str, DropReason)),
        "battery": ids,
        "drones": ids,
        "connectivity.articulation": ids,
        "distrusted_by": ids,
        "energy_j": (*CAUSES, *([RECORDED] if traced else []), "total"),
        "policies.decisions": tuple(name for name in policies if "." not in name),  # a dot would lead further
        "phases": tuple(map(str, range(phases))),
        "metrics": metrics,
        "own_files": (),  # digests are no numbers
    }


def check_number(name: str, keys: Mapping[str, Collection[str]]) -> None:
    """Hold a dotted name against the reference: some run's outcome may have a number there.

    Args:
        keys: as `open_keys` gives them; a list that is not among them may be of any length.

    Raises:
        RunError: it never has one: no such field, wall clock, or no number; with what could have been meant.
    """
    if name.partition(".")[0] in WALL:
        raise RunError(f"{name}: is wall clock, a metric must follow from the run alone")
    if what := _no_number(kind_at(name, keys)):
        raise RunError(f"{name}: is {what}, a metric must be a number")


def kind_at(name: str, keys: Mapping[str, Collection[str]]) -> Any:
    """The type of a field of an outcome, by its dotted name.

    Args:
        keys: as `open_keys` gives them; a list that is not among them may be of any length.

    Raises:
        RunError: no outcome has it; with what could have been meant.
    """
    kind: Any = Outcome
    parts = name.split(".")
    for depth, part in enumerate(parts):
        above = ".".join(parts[:depth])
        below = _below(kind, part, keys.get(above))
        if below is None:
            raise RunError(f"{name}: {above or 'the outcome'} has no {part!r}, {_instead(kind, part, keys.get(above))}")
        kind = below
    return kind


def possible(name: str) -> Range:
    """The values that a metric can have, by its dotted name; any value where the reference does not have it.

    Example:
        >>> possible("drones.2.soc"), possible("bytes.data_sent")
        (Range(low=0.0, high=1.0, yes_or_no=False), Range(low=0.0, high=inf, yes_or_no=False))
    """
    kind: Any = Outcome
    within = AMOUNT
    for part in name.split("."):
        fields = get_type_hints(kind, include_extras=True) if is_typeddict(kind) else {}
        if part in fields:
            kind, _, *ranges = get_args(fields[part])
            within = ranges[0] if ranges else AMOUNT
        elif get_origin(kind) in (dict, list):
            kind = get_args(kind)[-1]
        else:
            return ANY
    return within


def _below(kind: Any, part: str, keys: Collection[str] | None) -> Any:
    """The kind of what stands under a key or number; None where nothing can."""
    if is_typeddict(kind):
        return get_type_hints(kind).get(part)
    if get_origin(kind) is dict:
        return get_args(kind)[1] if part in (keys or ()) else None
    if get_origin(kind) is list and part.isdecimal() and part.isascii():
        return get_args(kind)[0] if keys is None or part in keys else None
    return None


def _instead(kind: Any, part: str, keys: Collection[str] | None) -> str:
    """What could have been meant by a key that is not there, or what there is."""
    what = _no_number(kind)
    if what in ("", "text"):
        return f"it is {what or 'a number'}"
    if what == "a list" and keys is None:
        return "it has entries by number"
    known = list(get_type_hints(kind) if is_typeddict(kind) else keys or ())
    if all(key.isdecimal() for key in known):
        return f"it has {known[0]} … {known[-1]}" if known else "it has none that can be named"
    near = nearest(part, known)
    return f"did you mean {near}?" if near else f"it has {', '.join(known)}"


def _no_number(kind: Any) -> str:
    """What a field is that is no number, in words; empty where it is one."""
    if is_typeddict(kind) or get_origin(kind) is dict:
        return "a section"
    if get_origin(kind) is list:
        return "a list"
    members = get_args(kind) if get_origin(kind) is UnionType else (kind,)
    return "text" if str in members else ""
