"""A layout for Foxglove: the fleet in 3-D and on a map, batteries, and decisions as a log, for a bag of `sortie.sim.export.bag`."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from sortie.sim.results.palette import drone_colour

LAYOUT = "foxglove_layout.json"


def layout(drones: int) -> dict[str, Any]:
    """The layout for a fleet of so many drones; import it in Foxglove by *Import from file*. It shows the boxes of drone 0."""
    made: dict[str, Any] = json.loads((files("sortie.sim") / "export" / LAYOUT).read_text("utf-8"))
    panels = made["configById"]
    for i in range(drones):
        colour = "#{:02x}{:02x}{:02x}".format(*drone_colour(i)[:3])
        panels["3D!fleet"]["topics"][f"/drone_{i}/boxes"] = {"visible": i == 0}
        panels["3D!fleet"]["topics"][f"/drone_{i}/pose"] = {"visible": False}
        panels["map!fleet"]["topicColors"][f"/drone_{i}/fix"] = colour
        panels["Plot!battery"]["paths"].append(
            {
                "value": f"/drone_{i}/battery.percentage",
                "label": f"drone {i}",
                "color": colour,
                "enabled": True,
                "timestampMethod": "headerStamp",
            }
        )
    return made
