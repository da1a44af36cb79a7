"""What the air has carried so far."""

from __future__ import annotations

from dataclasses import dataclass, field

CAUSES = ("collision_context", "collision_data", "hidden", "weak_signal", "half_duplex")
"""Why a drone did not hear a broadcast: it met another broadcast, or a unicast frame or its answer; a sender that could
not hear the first spoilt it; signal, fade or burst; the drone was sending itself."""


@dataclass(slots=True)
class Counters:
    """Totals so far. Data bytes are payload: sent = delivered + lost + expired + in flight."""

    data_sent_bytes: int = 0
    data_delivered_bytes: int = 0
    data_lost_bytes: int = 0
    data_expired_bytes: int = 0
    data_wire_bytes: int = 0
    broadcasts: int = 0
    receptions: int = 0
    """Broadcasts heard, counted per receiver."""
    missed: int = 0
    """Broadcasts that a living drone did not hear."""
    lost_to: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CAUSES, 0))
    """The same by cause, `CAUSES`; their sum is `missed`."""
    collided: int = 0
    """Broadcasts that a collision kept from at least one living drone."""
