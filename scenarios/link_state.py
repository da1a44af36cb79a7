"""What a drone knows of an outgoing link. A goodput's value says it, so that a descriptor needs no further field.

| goodput | state |
|---|---|
| 0 | never measured: nothing was sent over the link yet |
| above 0, at most `SILENT_MBPS` | silent: measured, and nothing got through the last time |
| above `SILENT_MBPS` | measured |

The paper's descriptor has one 32-bit float for each peer and 0 for a link without a measurement. A silent link is
therefore written as a rate that carries nothing. A reader without this table takes both for a link that carries nothing.
"""

from __future__ import annotations

from enum import IntEnum

SILENT_MBPS = 2.0**-10
"""What a measured link reads at least: about 1 kb/s, exact as a 32-bit float."""


WAITING_MBPS = 2 * SILENT_MBPS
"""What a link reads at least if its payloads only waited behind others: nothing was tried, so it is not silent."""


class LinkState(IntEnum):
    """What is known of an outgoing link."""

    NEVER_MEASURED = 0
    SILENT = 1
    MEASURED = 2


def state_of(goodput_mbps: float) -> LinkState:
    """The state that a goodput says, Mb/s."""
    if goodput_mbps <= 0.0:
        return LinkState.NEVER_MEASURED
    return LinkState.SILENT if goodput_mbps <= SILENT_MBPS else LinkState.MEASURED
