"""The air between the drones: carries bytes between positions, whatever the bytes mean."""

from sortie.radio.air import Air
from sortie.radio.counters import Counters
from sortie.radio.settings import AirSettings, BurstSettings
from sortie.radio.transmission import Status, Transmission

__all__ = ["Air", "AirSettings", "BurstSettings", "Counters", "Status", "Transmission"]
