"""What a sender knows of its links: goodput from what was acknowledged while its samples were in service.

**A measurement.** While a sample is in service the sender sees its frames acknowledged. Per exchange there
are fixed costs (preamble, backoff, block ack) that would make a 150 B sample look slow on the best link, so
acknowledged data are counted as *the time they would have taken alone* × *the payload rate of full A-MPDUs*
at the MCS in use, retries included. Divided by the time in service (which holds contention, other senders'
turns and context frames) that is a rate in Mb/s. For a sample of many full A-MPDUs it equals acknowledged
payload bits over time in service.

**The estimate** of a link falls to a lower measurement at once and rises to a higher one by `RISE` of the gap.
A sample that expires or is replaced half-way counts with what was acknowledged so far. One that never came to
be served was held up by its own sender's queue, and the rate at which that queue moved bounds the estimate.
A measurement counts for `MEASURED_FOR_S`. A link without one reports 0. A measured link reports at least `SILENT_MBPS`,
which says that nothing got through (`sortie.scenarios.link_state`).

**Bias and lag** were measured (`research/validation/link.py`, see the README): about one per cent on a still link; 5 to 7 % low under
shadowing, because falling is quicker than rising; a drop shows in the next frame, a recovery in eight.
"""

from __future__ import annotations

from typing import Final

from sortie.scenarios.link_state import MEASURED_FOR_S, SILENT_MBPS, WAITING_MBPS

RISE: Final = 0.3


class Goodput:
    """The estimates of every ordered link, Mb/s; 0 is a link without a measurement of the last `MEASURED_FOR_S`."""

    def __init__(self, n_drones: int) -> None:
        self._mbps: list[dict[int, float]] = [
            {} for _ in range(n_drones)
        ]  # by sender and receiver, links that are not 0
        self._measured_at_s: list[dict[int, float]] = [{} for _ in range(n_drones)]  # of the same links

    def measured(self, sender: int, receiver: int, mbps: float, now_s: float) -> None:
        """A measurement: down at once, up by `RISE` of the gap; one without another lately is taken as it is."""
        row, measured_at_s = self._mbps[sender], self._measured_at_s[sender]
        before = row[receiver] if receiver in row and now_s - measured_at_s[receiver] <= MEASURED_FOR_S else 0.0
        measured_at_s[receiver] = now_s
        row[receiver] = before + RISE * (mbps - before) if 0.0 < before < mbps else max(mbps, SILENT_MBPS)

    def bounded(self, sender: int, receiver: int, mbps: float) -> None:
        """A link cannot be said to be better than this now; state and age stay, since nothing was tried over it."""
        row = self._mbps[sender]
        if receiver in row:
            row[receiver] = min(row[receiver], max(mbps, WAITING_MBPS))

    def read(self, sender: int, now_s: float) -> dict[int, float]:
        """The estimates by receiver, of those to which something was measured lately."""
        measured_at_s = self._measured_at_s[sender]
        for receiver in [i for i, t_s in measured_at_s.items() if now_s - t_s > MEASURED_FOR_S]:
            del measured_at_s[receiver], self._mbps[sender][receiver]
        return self._mbps[sender].copy()
