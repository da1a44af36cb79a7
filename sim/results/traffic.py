"""What became of payloads: counts and bytes by kind and fate, from one pass over the record's `transmissions`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.radio.transmission import Status
from sortie.sim.results.record import HANDSHAKE
from sortie.sim.results.section import Bytes, Flown, OutcomeSection, Span, figure, once
from sortie.sim.results.selection import percentiles
from sortie.sim.results.spool import batches

REASONS = {
    Status.DELIVERED: ("", "other_feature_space"),
    Status.LOST: ("fragment_lost", "no_link", "receiver_gone", "sender_gone"),
    Status.EXPIRED: ("deadline_in_service", "deadline_queued", "replaced"),
    Status.IN_FLIGHT: ("",),
}
"""By fate: the reasons that the radio gives, and that of a payload that its receiver cannot use; what arrived in part has those of what was lost or expired."""
REST = {reason: status for status in (Status.LOST, Status.EXPIRED) for reason in REASONS[status]}
"""What the rest of a payload that arrived in part came to, by its reason."""
_BY = ["representation", "status", "reason"]


class Fate(NamedTuple):
    """What payloads of one kind came to."""

    representation: str
    status: str
    reason: str


class Sums(NamedTuple):
    """Over payloads."""

    payloads: int
    payload_bytes: int
    arrived_bytes: int


class Traffic:
    """The payloads that were captured in a time, by their fate."""

    def __init__(self, sums: Mapping[Fate, Sums]) -> None:
        self._sums = sums

    @property
    def sent_bytes(self) -> int:
        """Of all payloads."""
        return sum(s.payload_bytes for s in self._sums.values())

    @property
    def handshake_bytes(self) -> int:
        """Of methods' requests and answers."""
        return sum(s.payload_bytes for fate, s in self._sums.items() if fate.representation == HANDSHAKE)

    def bytes_by_status(self) -> dict[str, int]:
        """Payload bytes by what they came to. Of a payload that arrived in part, the rest came to what its reason says."""
        out = dict.fromkeys(map(str, REASONS), 0)
        for fate, s in self._sums.items():
            if fate.status == Status.PARTIAL:
                out[Status.DELIVERED] += s.arrived_bytes
                out[REST[fate.reason]] += s.payload_bytes - s.arrived_bytes
            else:
                out[fate.status] += s.payload_bytes
        return out

    @property
    def _payloads(self) -> dict[Fate, Sums]:
        """Without a method's requests and answers: a handshake carries no payload."""
        return {fate: s for fate, s in self._sums.items() if fate.representation != HANDSHAKE}

    def fates(self) -> dict[str, int]:
        """How many payloads came to each `status/reason`."""
        counts: defaultdict[tuple[str, str], int] = defaultdict(int)
        for fate, s in self._payloads.items():
            counts[fate.status, fate.reason] += s.payloads
        ordered = sorted(counts.items(), key=lambda item: item[0][0])
        return {f"{status}{'/' + reason if reason else ''}": count for (status, reason), count in ordered}

    def miss_rate(self) -> float | None:
        """Payloads that missed their deadline or were replaced before it, over those with a known fate.

        One of tiles that was cut short is one, whatever of it had come: it is `partial`, with the reason of an expired one.
        """
        payloads = self._payloads.items()
        known = sum(s.payloads for fate, s in payloads if fate.status != Status.IN_FLIGHT)
        missed = sum(s.payloads for fate, s in payloads if fate.reason in REASONS[Status.EXPIRED])
        return missed / known if known else None


class BytesOutcome(OutcomeSection):
    context_sent: Bytes = figure("Descriptors and directives.")
    context_descriptors: Bytes = figure("Descriptors as sent, 28 B of authentication included.")
    context_directives: Bytes = figure("Directives at 36 B, counted when they change.")
    data_sent: Bytes = figure("Payloads handed to the radio: delivered + lost + expired + in flight.")
    handshakes_sent: Bytes = figure("Requests and answers of methods (`policies.catalogue.prior`), in of `data_sent`.")
    data_delivered: Bytes = figure("Arrived; of payloads that came in part, that part.")
    data_lost: Bytes = figure("Lost on the air.")
    data_expired: Bytes = figure("Past their deadline, or replaced by a newer one before they were through.")
    data_in_flight: Bytes = figure("On the way at the end.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, int]:
        sent, totals = traffic_of(flown)[0], flown.record.totals
        descriptors, directives = (int(totals[f"context_{what}_bytes"]) for what in ("descriptor", "directive"))
        return {
            "context_sent": descriptors + directives,
            "context_descriptors": descriptors,
            "context_directives": directives,
            "data_sent": sent.sent_bytes,
            "handshakes_sent": sent.handshake_bytes,
            **{f"data_{status}": count for status, count in sent.bytes_by_status().items()},
        }


@once
def traffic_of(flown: Flown) -> list[Traffic]:
    """The traffic of a sortie, and then that of each phase of its mission."""
    return traffic(flown.tables, [span for span, _ in flown.phases])


def traffic(tables: Mapping[str, pa.Table], spans: Sequence[Span]) -> list[Traffic]:
    """All payloads, and then those that were captured in each span."""
    sums: list[dict[Fate, Sums]] = [{} for _ in range(1 + len(spans))]
    for batch in batches(tables, "transmissions", ["captured_s", *_BY, "payload_bytes", "arrived_bytes"]):
        whole = pa.Table.from_batches([batch])
        for into, part in zip(sums, [whole, *(_within(whole, span) for span in spans)], strict=True):
            totals = [([], "count_all"), ("payload_bytes", "sum"), ("arrived_bytes", "sum")]
            for row in part.group_by(_BY, use_threads=False).aggregate(totals).to_pylist():
                fate, before = Fate(*(row[c] for c in _BY)), into.get(Fate(*(row[c] for c in _BY)), Sums(0, 0, 0))
                now = row["count_all"], row["payload_bytes_sum"], row["arrived_bytes_sum"]
                into[fate] = Sums(*(a + b for a, b in zip(before, now, strict=True)))
    return [Traffic(each) for each in sums]


def settled(transmissions: pa.Table) -> tuple[list[str], NDArray[np.float64]]:
    """What became of payloads, for plots. One that arrived in part is two pieces: what arrived, and the rest.

    Returns:
        Of each piece: representation and status (`features delivered`); when it was settled (NaN in flight) and bytes [K, 2].
    """
    what, status, reason = (transmissions[k].to_pylist() for k in _BY)
    t_s, size, arrived = (
        transmissions[k].to_numpy().astype(float) for k in ("t_done_s", "payload_bytes", "arrived_bytes")
    )
    partial = np.array([s == Status.PARTIAL for s in status], bool)
    kinds = [f"{w} {REST[r] if s == Status.PARTIAL else s}" for w, s, r in zip(what, status, reason, strict=True)]
    kinds += [f"{what[k]} {Status.DELIVERED}" for k in np.flatnonzero(partial).tolist()]
    rest = np.where(partial, size - arrived, size)
    return kinds, np.concatenate([np.column_stack([t_s, rest]), np.column_stack([t_s, arrived])[partial]])


def feature_payload_p50(tables: Mapping[str, pa.Table], span: Span) -> float | None:
    """The median size of feature payloads that were captured in a span, bytes."""

    def sizes() -> Iterator[NDArray[np.float64]]:
        for batch in batches(tables, "transmissions", ["captured_s", "representation", "payload_bytes"]):
            rows = _within(pa.Table.from_batches([batch]), span)
            yield rows.filter(pc.equal(rows["representation"], "features"))["payload_bytes"].to_numpy().astype(float)

    found = percentiles(sizes, (50.0,))
    return None if found is None else found[0]


def _within(rows: pa.Table, span: Span) -> pa.Table:
    captured_s: Any = rows["captured_s"]
    return rows.filter(pc.and_(pc.greater_equal(captured_s, span[0]), pc.less(captured_s, span[1])))
