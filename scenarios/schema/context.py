"""`context`: rate, staleness and form of the descriptors."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import PresetSection, Section


class DescriptorForm(PresetSection):
    """How finely a descriptor is written: the paper's form, or one with fewer bytes."""

    presets: ClassVar = {
        "paper": {},
        "grid_8": {"grid_cells": 8},
        "grid_4": {"grid_cells": 4},
        "no_grid": {"grid_cells": 0},
        "cells_1_bit": {"grid_bits": 1},
        "numbers_16_bit": {"number_bits": 16},
        "numbers_12_bit": {"number_bits": 12},
        "numbers_8_bit": {"number_bits": 8},
        "small": {"grid_cells": 8, "grid_bits": 1, "number_bits": 16},
    }
    """`paper` is the paper's schema in CDR. `fleet/README.md` measures the others against it."""

    grid_cells: Literal[0, 4, 8, 16] = Field(16, description="Coverage cells a side on the air; 0 leaves the grid out.")
    grid_bits: Literal[1, 2] = Field(2, description="Bits of a coverage cell on the air; 1 is seen well or not.")
    number_bits: Literal[8, 10, 12, 16, 24, 32] = Field(
        32,
        description="Bits of a descriptor's number on the air: fixed point over its field's range, or 32-bit floats.",
    )


class Context(Section):
    rate_hz: float = Field(
        10.0,
        ge=1e-3,
        le=10,
        description="Descriptors a second and drone, at most 10 (the plane's bound); also the frame rate.",
    )
    degraded_after_periods: float = Field(
        3.0, gt=0, le=100, description="A descriptor older than this marks the link degraded."
    )
    detached_after_periods: float = Field(
        10.0, gt=0, le=1000, description="A descriptor older than this marks the peer detached."
    )
    authentication: bool = Field(True, description="HMAC-SHA256 and a replay counter on every descriptor (28 B).")
    publish_every: int = Field(
        1, ge=1, le=100, description="A descriptor every so many frames; ages count in periods of that length."
    )
    form: DescriptorForm = Field(
        DescriptorForm(),
        description="Form of descriptors on the air: a preset or its values; small is 8 × 8 cells of 1 bit and 16-bit numbers.",
        json_schema_extra=DescriptorForm.names_in_schema,
    )
    roster: bool = Field(
        False,
        description="Drones publish which members of the fleet they know, by id, and goodput to those alone (8 B and a bit for each drone).",
    )
    trust: bool = Field(
        True,
        description="Drones hold each other's claims against poses, arrivals and the fleet, and discount whom they doubt.",
    )
