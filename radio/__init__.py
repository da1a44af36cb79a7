"""The air between the drones: bytes and positions in, fates out; never what is in the bytes."""

from sortie.radio.air import Air
from sortie.radio.counters import Counters
from sortie.radio.settings import AirSettings, BurstSettings
from sortie.radio.transmission import Status, Transmission

__all__ = ["Air", "AirSettings", "BurstSettings", "Counters", "Status", "Transmission"]
