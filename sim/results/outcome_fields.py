"""The fields of `outcome.json` and what each is computed from; `outcome.md` is made from them.

A section is one line here: its model computes it. A figure that is in no section has a field and a line in `FIGURES`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.sim.results.accuracy import Ap50, ByClass
from sortie.sim.results.connectivity import ConnectivityOutcome
from sortie.sim.results.context_outcome import ContextOutcome
from sortie.sim.results.disagreement import Disagreement
from sortie.sim.results.drones_outcome import Drone, battery, drones, energy_j
from sortie.sim.results.mission_outcome import MissionOutcome
from sortie.sim.results.people_outcome import PeopleOutcome
from sortie.sim.results.phases_outcome import PhaseOutcome, phases
from sortie.sim.results.section import (
    Amount,
    Count,
    Flown,
    Joules,
    Mbps,
    Microseconds,
    OutcomeSection,
    PerMinute,
    Seconds,
    Share,
    figure,
    ratio,
)
from sortie.sim.results.selection import percentiles
from sortie.sim.results.spool import batches
from sortie.sim.results.tracking_outcome import TrackingOutcome
from sortie.sim.results.traffic import BytesOutcome, traffic_of
from sortie.sim.results.transitions import PoliciesOutcome, Transition, all_transitions


class Ages(OutcomeSection):
    p50: Seconds | None = figure("Median.")
    p99: Seconds | None = figure("99th percentile.")


class DecisionTimes(OutcomeSection):
    p50: Microseconds | None = figure("Median.")
    p99: Microseconds | None = figure("99th percentile.")


class Event(OutcomeSection):
    t_s: Seconds = figure("When.")
    drone: int = figure("Whose; −1 is the fleet's.")
    kind: str = figure("What kind.")
    text: str = figure("In words.")


class Outcome(OutcomeSection):
    """All of `outcome.json`; what is a ratio of nothing is null."""

    scenario: str = figure("Its name.")
    policy: str = figure("The policy that flew, by name; a callable by its `name`, or module and function.")
    seed: Count = figure("Of every random draw.")
    replication: Count = figure("Which draw of a campaign.")
    version: str = figure("The code that made the record: release, plus sign, digest of the package and its libraries.")
    own_files: dict[str, str] = figure(
        "Digests of own files: policies, detector and fusion with modules they import, weights, recordings, traces."
    )
    fingerprint: str = figure("SHA-256 over the record's values; equal inputs give equal fingerprints.")
    duration_s: Seconds = figure("Length of the sortie.")
    frame_s: Seconds = figure("From one frame to the next.")
    ap50: Ap50 = figure("Average precision of cars, of the drones that fly.")
    ap_by_class: ByClass = figure(
        "AP by class; a box counts for its own alone. Null of classes not looked for, of all if cars are the only one."
    )
    tracking: TrackingOutcome = figure("How well each drone that flies follows the cars, beside `ap50`.")
    mission: MissionOutcome = figure("The mission of the whole fleet; null without a region, a target or a detector.")
    people: PeopleOutcome = figure("People and thermal cameras; null without both, and where nobody was in a region.")
    bytes: BytesOutcome = figure("What was sent.")
    context: ContextOutcome = figure("What the context plane lost.")
    connectivity: ConnectivityOutcome = figure("The graph of usable links (table `links`), every 10 s from take-off.")
    context_share: Share | None = figure("Context bytes over all bytes.")
    data_rate_mbps: Mbps = figure("Payload bytes handed to the radio over the whole sortie, as Mb/s.")
    deadline_miss_rate: Share | None = figure(
        "Payloads that expired or were replaced before all was delivered, over those of known fate; without handshakes."
    )
    payload_fates: dict[str, Count] = figure("Counts of payloads by status and reason, without handshakes.")
    medium_busy_fraction: Share = figure("Share of the time in which the channel was busy.")
    age_s: Ages = figure(
        "Age of peers' descriptors when a policy read them; the last one of a drone that fell silent grows ever older."
    )
    data_age_s: Ages = figure("Age of peers' captures when they were fused.")
    data_age_mean_s: Seconds | None = figure("Its mean; it follows the mean over time, at any rate of sending.")
    descriptor_drops: dict[str, Count] = figure("Descriptors refused at receivers, by reason.")
    battery: dict[str, Share] = figure("State of charge as the last frame begins, by drone.")
    drones: dict[str, Drone] = figure("Each as the last frame begins.")
    energy_j: dict[str, Joules] = figure("By cause, and `total`; hover outweighs the radio about a hundredfold.")
    policies: PoliciesOutcome = figure("Who decided, and how often it was put right.")
    switches: PerMinute | None = figure("Changes of what a link carries, per link and minute; each link counts.")
    transitions: list[Transition] = figure("Each change of what links carry.")
    phases: list[PhaseOutcome] = figure("By mission phase.")
    distrusted_by: dict[str, Count] = figure("Of each drone that any came to doubt (`fleet/trust.py`), by how many.")
    events: list[Event] = figure("What happened to the fleet: scenario events, landings, policies that took over.")
    disagreement: Disagreement = figure("Views that lead to different choices; null without `record.disagreement`.")
    metrics: dict[str, float | None] = figure("Figures of the user's own, by the names in `metrics`.")
    policy_eval_us: DecisionTimes = figure("Wall time of a decision; no part of the fingerprint.")
    wall_s: Seconds | None = figure("Wall time of the flight; no part of the fingerprint.")
    realtime_factor: Amount | None = figure("Simulated over wall time; no part of the fingerprint.")


WALL = ("policy_eval_us", "wall_s", "realtime_factor")
"""Those that measure the computer; they are no part of the fingerprint."""


def _context_share(flown: Flown) -> float | None:
    sent = BytesOutcome.compute(flown)
    return ratio(sent["context_sent"], sent["context_sent"] + sent["data_sent"])


def _switches(flown: Flown) -> float | None:
    """Changes of each link in a minute; None for one drone."""
    links = flown.scenario.fleet.drones * (flown.scenario.fleet.drones - 1)
    changes = sum(len(change["peers"]) for change in all_transitions(flown))
    return ratio(changes, links * (flown.scenario.duration_s / 60.0))


def _distrusted_by(flown: Flown) -> dict[str, int]:
    """For each doubted drone, how many drones doubted it."""
    pairs = {
        (row["peer"], row["drone"])
        for batch in batches(flown.tables, "trust", ["drone", "peer", "trust"])
        for row in batch.to_pylist()
        if row["trust"] < 1.0
    }
    counts = Counter(peer for peer, _ in pairs)
    return {str(peer): counts[peer] for peer in sorted(counts)}


def _descriptor_drops(flown: Flown) -> dict[str, int]:
    """How often each reason comes, in the order in which they first come."""
    counts: Counter[str] = Counter()
    for batch in batches(flown.tables, "drops", ["reason"]):
        for each in pc.value_counts(batch.column(0)).to_pylist():
            counts[str(each["values"])] += each["counts"]
    return dict(counts)


def _numbers(flown: Flown, table: str, column: str) -> Iterator[NDArray[np.float64]]:
    """The numbers of a column, or of its lists, piece after piece."""
    for batch in batches(flown.tables, table, [column]):
        values = batch.column(0)
        yield (values.flatten() if pa.types.is_list(values.type) else values).to_numpy()


def _ages(flown: Flown, table: str, column: str) -> dict[str, float | None]:
    found = percentiles(lambda: _numbers(flown, table, column), (50.0, 99.0))
    return dict(zip(Ages.model_fields, found or (None, None), strict=True))


def _data_age_mean_s(flown: Flown) -> float | None:
    ages_s = [np.zeros(0), *_numbers(flown, "fusions", "ages_s")]
    return cast("float | None", pc.mean(pa.array(np.concatenate(ages_s))).as_py())


FIGURES: dict[str, Callable[[Flown], Any]] = {
    name: field.annotation.compute  # type: ignore[union-attr]
    for name, field in Outcome.model_fields.items()
    if hasattr(field.annotation, "compute")
} | {
    **{n: attrgetter(f"record.{n}") for n in ("policy", "seed", "replication", "version", "fingerprint")},
    **{n: attrgetter(f"scenario.{n}") for n in ("duration_s", "frame_s")},
    "scenario": lambda flown: flown.scenario.name,
    "own_files": lambda flown: dict(flown.record.own_files),
    "context_share": _context_share,
    "data_rate_mbps": lambda flown: traffic_of(flown)[0].sent_bytes * 8e-6 / flown.scenario.duration_s,
    "deadline_miss_rate": lambda flown: traffic_of(flown)[0].miss_rate(),
    "payload_fates": lambda flown: traffic_of(flown)[0].fates(),
    "medium_busy_fraction": lambda flown: flown.record.totals["medium_busy_fraction"],
    "age_s": lambda flown: _ages(flown, "ages", "age_s"),
    "data_age_s": lambda flown: _ages(flown, "fusions", "ages_s"),
    "data_age_mean_s": _data_age_mean_s,
    "descriptor_drops": _descriptor_drops,
    "battery": battery,
    "drones": drones,
    "energy_j": energy_j,
    "switches": _switches,
    "transitions": all_transitions,
    "phases": phases,
    "distrusted_by": _distrusted_by,
    "events": lambda flown: flown.tables["events"].to_pylist(),
    "metrics": lambda flown: dict(flown.record.metrics),
    "policy_eval_us": lambda flown: {
        p: flown.record.wall.get(f"policy_eval_us_{p}") for p in DecisionTimes.model_fields
    },
    "wall_s": lambda flown: flown.record.wall.get("wall_s"),
    "realtime_factor": lambda flown: ratio(flown.scenario.duration_s, flown.record.wall.get("wall_s", 0.0)),
}
"""What computes each field of `Outcome`: the model of a section, or a function of the flown sortie."""
