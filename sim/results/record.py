"""The record of a sortie: what happened, as tables, and its fingerprint.

Rows are gathered as plain tuples while the sortie flies. They become Arrow batches, which leave memory
(`sortie.sim.results.spool`), so that an hour takes no more of it than a minute. The column lists
below are those of the Parquet files, and `ABOUT` says what a row is; `outcome.md` shows both. Wall-clock figures are
kept apart, so that the fingerprint is a function of (scenario, policy, seed, version) alone.
"""

from __future__ import annotations

import hashlib
import struct
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sortie.fleet.agent import Ages
from sortie.fleet.messages.wire import directive_bytes
from sortie.fleet.standings import Standing
from sortie.policies.contract import PHASE_NAMES, Descriptor, Directive
from sortie.policies.staleness import LinkHealth
from sortie.radio.counters import CAUSES as LOSS_CAUSES
from sortie.scenarios import scratch
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.representation import NAME_OF
from sortie.scenarios.schema import Scenario
from sortie.sim.results.rosters import RosterLog
from sortie.sim.results.spool import BATCH_BYTES, FIRST_ROWS, Spool, SpooledTables, Unfold, batches, schema_of

NAN = float("nan")
DECISIONS_OF = "decisions_of "
"""Prefix of the totals that count each policy's decisions."""
VIOLATIONS_OF = "violations_of "
"""Prefix of the totals that count violations by cause."""
_FINGERPRINT = "0.1.0"
"""The rule of the fingerprint, which hashes it first. It is named after the release that began it; later releases keep it."""
HANDSHAKE = "handshake"
"""The `representation` of transmissions that carry a method's requests and answers, and no payload."""
_LINKS = {link: link.name.lower() for link in LinkHealth}
_NO_DISC = (NAN, NAN, NAN)
_EVAL_STEP_NS = 100
"""Wall times of decisions are counted in steps of this."""
F, I, S, B = pa.float64(), pa.int32(), pa.string(), pa.bool_()  # noqa: E741 - read as a column of types below

pa.array(())  # pyarrow looks for pandas at its first array; at import, that is no part of a flight's time


def _floats(*names: str) -> dict[str, pa.DataType]:
    return dict.fromkeys(names, F)


TABLES: dict[str, dict[str, pa.DataType]] = {
    "states": dict(
        t_s=F,
        drone=I,
        **_floats("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
        **_floats("vx_mps", "vy_mps", "vz_mps", "p_radps", "q_radps", "r_radps"),
        **_floats("soc", "voltage_v", "current_a", "spent_j"),
        looks=I,
        airborne=B,
    ),
    "descriptors": dict(
        t_s=F,
        drone=I,
        stamp_ns=pa.int64(),
        wire_bytes=I,
        **_floats("soc", "cpu_headroom", "gpu_headroom"),
        goodput_mbps=pa.list_(F),
        phase=S,
        **_floats("region_x_m", "region_y_m", "region_radius_m"),
        novelty_flags=I,
        coverage_grid=pa.binary(),
    ),
    "receptions": dict(t_s=F, heard=I, **dict.fromkeys(LOSS_CAUSES, I)),
    "drops": dict(t_s=F, receiver=I, reason=S),
    "directives": dict(
        t_s=F,
        drone=I,
        peer=I,
        representation=S,
        **_floats("rho", "roi_x_m", "roi_y_m", "roi_radius_m", "rate_hz", "deadline_s", "fusion_weight"),
        duty_percent=I,
        asked=S,
        asked_rate_hz=F,
        link=S,
        reason=S,
        policy=S,
    ),
    "interventions": dict(t_s=F, drone=I, peer=I, policy=S, kind=S, text=S),
    "violations": dict(t_s=F, until_s=F, drone=I, peer=I, policy=S, cause=S, line=S, text=S),
    "transmissions": dict(
        t_sent_s=F,
        drone=I,
        peer=I,
        representation=S,
        captured_s=F,
        rho=F,
        cells=I,
        boxes=I,
        index_bytes=I,
        payload_bytes=I,
        wire_bytes=I,
        **_floats("deadline_s", "t_start_s", "t_done_s"),
        status=S,
        reason=S,
        fragments=I,
        fragments_lost=I,
        repairs=I,
        mcs=I,
        snr_db=F,
        airtime_s=F,
        hops=I,
        arrived_bytes=I,
    ),
    "fusions": dict(
        t_s=F,
        drone=I,
        peers=pa.list_(I),
        representations=pa.list_(S),
        ages_s=pa.list_(F),
        weights=pa.list_(F),
        detections=I,
        truths=I,
    ),
    "detections": dict(t_s=F, drone=I, x_m=F, y_m=F, length_m=F, width_m=F, yaw_rad=F, score=F),
    "truths": dict(t_s=F, drone=I, x_m=F, y_m=F, length_m=F, width_m=F, yaw_rad=F, car=I),
    "mission": dict(
        t_s=F,
        group=I,
        phase=S,
        **_floats("region_x_m", "region_y_m", "region_radius_m"),
        target=I,
        target_x_m=F,
        target_y_m=F,
    ),
    "people": dict(t_s=F, person=I, x_m=F, y_m=F),
    "sightings": dict(t_s=F, drone=I, x_m=F, y_m=F, score=F, person=I),
    "alerts": dict(t_s=F, drone=I, known=B),
    "medium": dict(t_s=F, busy_fraction=F, connected_drones=I),
    "topology": dict(
        t_s=F,
        connected=B,
        cut_drones=pa.list_(I),
        bottleneck_sender=I,
        bottleneck_receiver=I,
        bottleneck_mbps=F,
    ),
    "energy": dict(drone=I, cause=S, energy_j=F),
    "events": dict(t_s=F, drone=I, kind=S, text=S),
    "trust": dict(t_s=F, drone=I, peer=I, trust=F, reason=S),
    "ages": dict(t_s=F, drone=I, age_s=F),
}
CLASS_COLUMN = {"kind": pa.int8()}
"""What `detections` and `truths` have too, where a scenario has targets of several classes."""
OF_CLASSES = ("detections", "truths")
ABOUT = {
    "states": "A drone in a frame. Position and velocity ENU, attitude FLU in ENU (x, y, z, w), rates FLU. "
    "Voltage and current are at the pack's terminals; `spent_j` is what left the pack since take-off, all causes of `energy`; "
    "`looks` counts the frames before this one in which perception ran.",
    "descriptors": "A descriptor published, with the hysteresis band of `policy.hysteresis`. Goodput to each other drone by ascending id, in fleets of more than 200 to the other members of its roster (table `rosters`), Mb/s; 0 is unknown, at most 2⁻¹⁰ is silent, at most 2⁻⁹ has no payload lately but descriptors arrive.",
    "receptions": "What became of descriptors on the air in the frame that begins at `t_s`, counted for each drone in the "
    "air that could receive one: heard, or lost to a cause. It met another descriptor (`collision_context`) or a payload's "
    "frame or its answer (`collision_data`), a sender that could not hear the first spoilt it (`hidden`), the signal was too "
    "weak (`weak_signal`), or the receiver was sending itself (`half_duplex`).",
    "drops": "A descriptor refused at a receiver, with the reason.",
    "directives": "A change of what a gate enforces, with the reason that decided it.",
    "interventions": "A directive that the shield replaced, or could not put right: `kind` is `policy` for each of the "
    "policy's output, and `gate` for each change of what the shield makes of the enforced state.",
    "violations": "A time in which the directives that a drone's gates enforce break an invariant; from the first to the last "
    "decision at which they did. Peer −1: its links together. `cause` is the step that broke the line: `policy`, `staleness`, "
    "`damping`, or `no peer` (a line over all links while no peer is attached).",
    "transmissions": "A payload handed to the radio, with its fate. `boxes` of a map came with it (`perception.match_poses`, `perception.maps_bring_boxes`). "
    "`partial`: some of its tiles arrived, "
    "`arrived_bytes` of it. The reason `other_feature_space`: delivered feature maps that the receiver's network cannot fuse, or codes of another codebook.",
    "fusions": "A scored fusion: an ego, and the peers whose payloads it held. A weight is the directive's times trust.",
    "detections": "A box that an ego detected, ENU. People among them are from thermal cameras, its own and its peers'.",
    "truths": "A car within an ego's range at a scored fusion, ENU; of a drone that left the air, about the place that "
    "it would have in the formation. Such a drone has no row in `fusions`. `car` is the car's number, the targets first, the "
    "same at all times; −1 where the detector does not know.",
    "mission": "The mission of a group of drones in a frame: 0 are those in no group, k those of `mission.groups[k - 1]`. NaN "
    "where there is no region or target; `target` is the car's id, −1 without one.",
    "people": "Where a person is in a frame, ENU.",
    "sightings": "What a drone's thermal camera took for a person, where the drone places it, ENU; `score` is the probability "
    "of finding a person at that distance, `person` −1 a false alarm.",
    "alerts": "A drone begins or ceases to know of a person in its region, from its own thermal camera or its peers.",
    "medium": "Once a second: how busy the channel was since the row before, and how many drones others heard since then "
    "(0 in the first row, at take-off). What follows the last row is in `medium_busy_fraction` alone.",
    "topology": "Once a second where payloads are relayed: whether all drones reach all, who is outside the largest such "
    "group, and the link that limits the worst-off pair (−1 and NaN where there is none).",
    "energy": "What a drone spent on a cause.",
    "events": "What happened to the fleet: scenario events, landings, policies that took over; drone −1 is the fleet.",
    "trust": "A change of what a drone thinks of a peer (`sortie.fleet.trust`); 1 is undoubted.",
    "ages": "Age of a peer's descriptor when a policy read it.",
}
"""What a row of each table is; units stand in the columns' names."""


@dataclass(frozen=True)
class SortieRecord:
    """Everything that one sortie left behind."""

    scenario: Scenario
    policy: str
    seed: int
    replication: int
    version: str
    """Of the code that made it, as `sortie.sim.identity.code_version`."""
    detector: str
    """The detector that flew, as `sortie.sim.identity.name_of` names it; `none` without one."""
    tables: Mapping[str, pa.Table]
    """Those of `TABLES`. Where the scenario keeps views, also those of `sortie.sim.results.views`; where drones publish
    rosters, also that of `sortie.sim.results.rosters`; with `record.beliefs`, that of `sortie.sim.results.beliefs`. Those are no part of the fingerprint: what is kept changes nothing
    that flies."""
    totals: Mapping[str, float]
    """Counts that are no table: context bytes, medium utilisation, ..."""
    calibration: str | None = None
    """Which fit a surrogate detector is of; None with any other."""
    own_files: Mapping[str, str] = field(default_factory=dict)
    """Digests of the files beside the package, as `sortie.sim.identity.own_files`; no part of the fingerprint."""
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    """Figures of the user's own, by name; no part of the fingerprint."""
    wall: Mapping[str, float] = field(default_factory=dict)
    """Wall-clock figures (seconds, microseconds); no part of the fingerprint."""

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over policy, seed and every table's values; equal records have equal fingerprints.

        The version stays out of it: a change of code that leaves every value as it was leaves the fingerprint too.
        """
        digest = hashlib.sha256(f"{_FINGERPRINT}/{self.policy}/{self.seed}/{self.replication}".encode())
        for name in sorted(self.tables.keys() & TABLES.keys()):
            digest.update(name.encode())
            for column in schema_of(self.tables, name).names:
                digest.update(column.encode())
                _digest_column(digest, self.tables, name, column)
        for name in sorted(self.totals):
            digest.update(f"{name}={self.totals[name]!r}".encode())
        return digest.hexdigest()


def _digest_column(digest: Any, tables: Mapping[str, pa.Table], name: str, column: str) -> None:
    """Hash a column's values, not its buffers: their padding and chunking may differ."""
    is_list = pa.types.is_list(schema_of(tables, name).field(column).type)
    if is_list:
        for batch in batches(tables, name, [column]):
            digest.update(np.asarray(batch.column(0).value_lengths(), np.int64).tobytes())
    for batch in batches(tables, name, [column]):
        array = batch.column(0).flatten() if is_list else batch.column(0)
        if pa.types.is_string(array.type) or pa.types.is_binary(array.type):
            if len(array):  # all values as one text, a zero behind each
                together = pa.ListArray.from_arrays([0, len(array)], array.cast(pa.binary()))
                digest.update(pc.binary_join(together, b"\0")[0].as_py() + b"\0")
        else:
            digest.update(np.ascontiguousarray(array.to_numpy(zero_copy_only=False)).tobytes())


def classes_in(table: pa.Table) -> np.ndarray:
    """The class of each box of `detections` or `truths`; cars where the record does not name classes."""
    return table["kind"].to_numpy() if "kind" in table.column_names else np.zeros(table.num_rows, np.int8)


class Recorder:
    """Gathers rows by table; `rows["events"].append((...))` in the column order of `TABLES`.

    A table that many rows go to at once may gather something terser instead, and put into `unfold` how that
    becomes columns. `spill` moves gathered rows out of memory.
    """

    def __init__(self, *, classes: bool = False) -> None:
        """Args: `classes`: whether boxes name their class."""
        self.classes = classes
        self.rows: dict[str, list[tuple[Any, ...]]] = {name: [] for name in TABLES}
        self.unfold: dict[str, Unfold] = {}
        self.spool = Spool()
        for name, columns in TABLES.items():
            self.spool.define(name, columns | CLASS_COLUMN if classes and name in OF_CLASSES else columns)
        self._taken = dict.fromkeys(TABLES, 0)
        self._due = dict.fromkeys(TABLES, FIRST_ROWS)
        self._fresh: dict[str, list[pa.RecordBatch]] = {}

    def define(self, name: str, columns: Mapping[str, pa.DataType]) -> None:
        """A table beside `TABLES`, which gets its rows by `add_batch`."""
        self.spool.define(name, columns)
        self._fresh[name] = []

    def add_batch(self, name: str, batch: pa.RecordBatch) -> None:
        """Many rows at once of a table that `define` named.

        Raises:
            ScratchError: the disk refuses.
        """
        self.spool.add(name, batch)
        self._fresh[name].append(batch)

    def take_new(self) -> dict[str, pa.Table]:
        """The rows since the last call, for a viewer that follows the flight. Each call comes before the next `spill`."""
        new = {}
        for name, rows in self.rows.items():
            new[name] = pa.Table.from_batches([self._batch(name, rows[self._taken[name] :])])
            self._taken[name] = len(rows)
        for name, added in self._fresh.items():
            new[name] = pa.Table.from_batches(added, self.spool.schema(name))
            added.clear()
        return new

    def spill(self) -> None:
        """Move the rows of tables that have gathered a batch out of memory; called once a simulated second.

        Raises:
            ScratchError: the disk refuses.
        """
        for name, rows in self.rows.items():
            if len(rows) >= self._due[name]:
                self._due[name] = max(1, len(rows) * BATCH_BYTES // max(1, self._spill(name, rows)))
        for added in self._fresh.values():
            added.clear()
        scratch.release()

    def finish(self) -> SpooledTables:
        """All tables. They hold nothing of the flight's parts; nothing can be gathered any more.

        Raises:
            ScratchError: the disk refuses.
        """
        for name, rows in self.rows.items():
            if rows:
                self._spill(name, rows)
        return self.spool.finish()

    def _spill(self, name: str, rows: list[tuple[Any, ...]]) -> int:
        """Returns the batch's size."""
        batch = self._batch(name, rows)
        self.spool.add(name, batch)
        rows.clear()  # whoever gathers has this list
        self._taken[name] = 0
        return int(batch.nbytes)

    def _batch(self, name: str, rows: Sequence[tuple[Any, ...]]) -> pa.RecordBatch:
        if not rows:
            return self.spool.batch(name, None)
        return self.spool.batch(name, self.unfold.get(name, _columns)(rows))


def _columns(rows: Sequence[tuple[Any, ...]]) -> Sequence[Any]:
    return list(zip(*rows, strict=True))


def _unfold_descriptors(rows: Sequence[tuple[Any, ...]], drones: int) -> Sequence[Any]:
    t_s, wire_bytes, descriptors = zip(*rows, strict=True)
    d = dict(zip(Descriptor._fields, zip(*descriptors, strict=True), strict=True))
    region = zip(*(disc or _NO_DISC for disc in d["region"]), strict=True)
    return [
        t_s,
        d["agent_id"],
        d["stamp_ns"],
        wire_bytes,
        d["battery_soc"],
        d["cpu_headroom"],
        d["gpu_headroom"],
        _lists([one.goodput_by_id(drones) if drones <= LISTED_IDS else one.peer_goodput_mbps for one in descriptors]),
        [PHASE_NAMES[phase] for phase in d["task_phase"]],
        *region,
        d["novelty_flags"],
        d["coverage_grid"],
    ]


def _lists(rows: Sequence[Sequence[float]]) -> pa.Array:
    """Lists of numbers as an array; of so many numbers, Arrow makes one far more slowly."""
    ends = np.cumsum([0, *map(len, rows)], dtype=np.int32)
    values = np.frombuffer(b"".join([struct.pack(f"{len(row)}d", *row) for row in rows]))
    return pa.ListArray.from_arrays(ends, values)


def _unfold_ages(rows: Sequence[tuple[Any, ...]]) -> Sequence[Any]:
    """A decision's ages stand in one row."""
    t_s, drones, ages_s = zip(*rows, strict=True)
    counts = [len(ages) for ages in ages_s]
    return [np.repeat(t_s, counts), np.repeat(drones, counts), np.concatenate(ages_s)]


class HasName(Protocol):
    @property
    def name(self) -> str: ...


class HasPolicy(Protocol):
    """What decides for a drone now, and its name."""

    @property
    def policy(self) -> HasName: ...


class AgentNotes:
    """Writes agents' acts into a recorder (sortie.fleet.agent.AgentLog)."""

    def __init__(self, recorder: Recorder, pilots: Sequence[HasPolicy]) -> None:
        """Args: `pilots` decide, by drone."""
        self._rows, self._pilots, drones = recorder.rows, pilots, len(pilots)
        recorder.unfold |= {"descriptors": partial(_unfold_descriptors, drones=drones), "ages": _unfold_ages}
        self.rosters = RosterLog()
        self._eval_steps: defaultdict[int, int] = defaultdict(int)  # decisions by their wall time
        self._descriptor_bytes = self._directives = self._directive_bytes = self._decisions = 0

    def descriptor(self, t_s: float, d: Descriptor, wire_bytes: int) -> None:
        """One descriptor was published."""
        self._descriptor_bytes += wire_bytes
        self._rows["descriptors"].append((t_s, wire_bytes, d))
        if d.roster is not None:
            self.rosters.published(t_s, d.agent_id, d.roster)

    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None:
        """A gate enforces something new."""
        self._directives += 1
        self._directive_bytes += directive_bytes(enforced)
        roi = enforced.roi or _NO_DISC
        self._rows["directives"].append(
            (
                t_s,
                enforced.source,
                enforced.destination,
                NAME_OF[enforced.representation],
                enforced.rho,
                *roi,
                enforced.rate_hz,
                enforced.deadline_s,
                enforced.fusion_weight,
                enforced.duty_percent,
                NAME_OF[asked.representation],
                asked.rate_hz,
                _LINKS[link],
                reason,
                self._pilots[enforced.source].policy.name,
            )
        )

    def trust(self, t_s: float, drone: int, peer: int, standing: Standing) -> None:
        """A drone thinks otherwise of a peer than before."""
        self._rows["trust"].append((t_s, drone, peer, standing.trust, standing.reason))

    def decision(self, t_s: float, drone: int, elapsed_ns: int, peer_ages_s: Ages) -> None:
        """A policy decided, reading peers' descriptors of these ages."""
        self._eval_steps[elapsed_ns // _EVAL_STEP_NS] += 1
        self._decisions += 1
        self._rows["ages"].append((t_s, drone, peer_ages_s))

    def event(self, t_s: float, drone: int, kind: str, text: str) -> None:
        """Something that a drone found out."""
        self._rows["events"].append((t_s, drone, kind, text))

    def alert(self, t_s: float, drone: int, known: bool) -> None:
        """A drone begins or ceases to know of a person in its region."""
        self._rows["alerts"].append((t_s, drone, known))

    def totals(self) -> dict[str, float]:
        """Context-plane bytes: descriptors on the air, directives to the gates."""
        return {
            "context_descriptor_bytes": self._descriptor_bytes,
            "context_directive_bytes": self._directive_bytes,
            "directives": self._directives,
            "decisions": self._decisions,
        }

    def policy_eval_us(self) -> dict[str, float]:
        """Wall time of a policy decision, µs, median and 99th percentile."""
        if not self._eval_steps:
            return {}
        steps, counts = np.array(sorted(self._eval_steps.items())).T
        at = np.searchsorted(np.cumsum(counts), np.array([0.50, 0.99]) * self._decisions)
        p50, p99 = (float(step) * _EVAL_STEP_NS * 1e-3 for step in steps[at])
        return {"policy_eval_us_p50": p50, "policy_eval_us_p99": p99}
