"""Where on the globe a fleet's ENU (0, 0, 0) lies."""

from __future__ import annotations

from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.traces import flown_at
from sortie.scenarios.schema import Fleet
from sortie.sim.folders import RunError

ORIGIN = Origin(47.397742, 8.545594, 488.0)
"""Where ENU (0, 0, 0) lies where nobody says otherwise: the field in Zurich at which PX4's simulators start."""


def origin_of(fleet: Fleet) -> Origin:
    """Where a fleet flies: at `fleet.origin`, else where its trace in latitude and longitude begins, else at `ORIGIN`.

    Raises:
        TraceError: its trace cannot be read.
    """
    at = flown_at(fleet)
    return ORIGIN if at is None else Origin(**at.model_dump())


def given_origin(fleet: Fleet) -> Origin | None:
    """`fleet.origin`, if there is one."""
    return None if fleet.origin is None else Origin(**fleet.origin.model_dump())


def parse_origin(text: str) -> Origin:
    """`latitude,longitude[,altitude]` in degrees and metres.

    Raises:
        RunError: it is none, naming it.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
        if len(numbers) not in (2, 3):
            raise ValueError(f"{len(numbers)} numbers")
        return Origin(*numbers)
    except ValueError as error:
        raise RunError(
            f"origin is {text!r}, must be latitude,longitude or latitude,longitude,altitude: {error}"
        ) from error
