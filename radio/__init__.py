"""The air between the drones: bytes and positions in, fates out; never what is in the bytes."""

from radio.air import Air
from radio.counters import Counters
from radio.transmission import Status, Transmission

__all__ = ["Air", "Counters", "Status", "Transmission"]
