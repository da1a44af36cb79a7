"""The fleet's links: once a second what each is worth, and which share of descriptors came over it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.frames import instant
from sortie.sim.results.record import Recorder

TABLE = "links"
COLUMNS: dict[str, pa.DataType] = dict(
    t_s=pa.float64(),
    sender=pa.int32(),
    receiver=pa.int32(),
    snr_db=pa.float64(),
    goodput_mbps=pa.float64(),
    delivered=pa.float64(),
    usable=pa.bool_(),
)
ABOUT = (
    "A directed link within earshot between drones in the air, or over which a descriptor came since the row before; once a "
    "second, in fleets of more than 200 drones every 10 s. "
    "`goodput_mbps` is what the link would carry alone on the channel, as its sender knows it. `delivered` is the share of "
    "the sender's descriptors since the row before that the receiver heard, NaN where it published none. `usable`: its SNR "
    "is at least 0 dB, or where a trace gives its loss or goodput, it carries anything."
)
LARGE_FLEET_S = 10.0
"""Between two rows of a link in fleets of more than `LISTED_IDS` drones."""


class LinkLog:
    """Counts the descriptors that came over each link, and writes the table's rows."""

    def __init__(self, drones: int, recorder: Recorder) -> None:
        """Args:
        drones: how many there are.
        recorder: gets the rows.
        """
        self._published = np.zeros(drones, np.int64)
        self._reached = np.zeros(drones, bool)
        self._heard = np.zeros((drones, drones), np.int32)
        self._every_s = 1.0 if drones <= LISTED_IDS else LARGE_FLEET_S
        self._due_s, self._recorder = 0.0, recorder
        recorder.define(TABLE, COLUMNS)

    def heard(self, sender: int, receivers: Sequence[int]) -> None:
        """A descriptor has ended on the air, and these drones heard it."""
        self._published[sender] += 1
        self._heard[sender, receivers] += 1
        self._reached[sender] |= len(receivers) > 0

    def heard_drones(self) -> int:
        """How many drones were heard by another since the last call."""
        count = int(self._reached.sum())
        self._reached[:] = False
        return count

    def is_due(self, t_s: float) -> bool:
        """Whether rows are wanted now."""
        return instant(t_s) >= instant(self._due_s)

    def write(
        self,
        t_s: float,
        flying: Sequence[int],
        snr_db: NDArray[np.float64],
        goodput_mbps: NDArray[np.float64],
        usable: NDArray[np.bool_],
        in_earshot: NDArray[np.bool_],
    ) -> None:
        """Write the rows of this moment, and begin to count anew.

        Args:
            t_s: the time.
            flying: the drones in the air, ascending.
            snr_db, goodput_mbps, usable, in_earshot: [N, N], sender by receiver.
        """
        in_the_air = np.zeros_like(in_earshot)
        in_the_air[np.ix_(flying, flying)] = True
        np.fill_diagonal(in_the_air, False)
        wanted = (in_the_air & in_earshot) | (self._heard > 0)
        sender, receiver = np.nonzero(wanted)
        published = self._published[sender]
        share = np.where(published > 0, self._heard[sender, receiver] / np.maximum(published, 1), np.nan)
        columns = (
            np.full(len(sender), t_s),
            sender.astype(np.int32),
            receiver.astype(np.int32),
            snr_db[sender, receiver],
            goodput_mbps[sender, receiver],
            share,
            (usable & in_the_air)[sender, receiver],
        )
        arrays = [pa.array(column, kind) for column, kind in zip(columns, COLUMNS.values(), strict=True)]
        self._recorder.add_batch(TABLE, pa.RecordBatch.from_arrays(arrays, names=list(COLUMNS)))
        self._published[:], self._heard[:] = 0, 0
        self._due_s = t_s + self._every_s
