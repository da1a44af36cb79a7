"""What the air has carried so far."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Counters:
    """Totals so far. Data bytes are payload: sent = delivered + lost + expired + in flight."""

    data_sent_bytes: int = 0
    data_delivered_bytes: int = 0
    data_lost_bytes: int = 0
    data_expired_bytes: int = 0
    data_wire_bytes: int = 0
    context_sent_bytes: int = 0
    context_wire_bytes: int = 0
    broadcasts: int = 0
    receptions: int = 0
    """Broadcasts heard, counted per receiver."""
    missed: int = 0
    """Broadcasts that a living drone did not hear."""
    collided: int = 0
    """Broadcasts lost to a collision with another."""
