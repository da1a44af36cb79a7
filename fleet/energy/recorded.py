"""A pack's charge, voltage and current as a context trace recorded them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BatteryTrace:
    """One drone's charge over time; lists, because single values are asked for once a frame."""

    time_s: list[float]
    soc: list[float]
    energy: list[float]
    """Energy fraction of the charge."""
    voltage_time_s: list[float]
    voltage_v: list[float]
    current_time_s: list[float]
    current_a: list[float]

    def soc_at(self, t_s: float) -> float:
        """State of charge, 0 … 1."""
        return _between(self.time_s, self.soc, t_s)

    def energy_fraction_at(self, t_s: float) -> float:
        """Share of a full pack's energy that is left."""
        return _between(self.time_s, self.energy, t_s)

    def voltage_at(self, t_s: float) -> float | None:
        """Terminal voltage, or None where the trace has none."""
        return _between(self.voltage_time_s, self.voltage_v, t_s) if self.voltage_v else None

    def current_at(self, t_s: float) -> float | None:
        """Current, or None where the trace has none."""
        return _between(self.current_time_s, self.current_a, t_s) if self.current_a else None


def _between(time_s: Sequence[float], values: Sequence[float], t_s: float) -> float:
    """Linear between samples, held beyond them."""
    k = bisect_right(time_s, t_s)
    if k == 0:
        return values[0]
    if k == len(time_s):
        return values[-1]
    share = (t_s - time_s[k - 1]) / (time_s[k] - time_s[k - 1])
    return values[k - 1] + share * (values[k] - values[k - 1])
