"""How a playback is laid out, so that it tells the sortie's story without a click, and how to read it."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sortie.fleet.coverage import cameras_of, footprint_radius_m
from sortie.perception.scene.scene_model import MARGIN_M
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.formation import slots
from sortie.scenarios.schema import Jammer, Scenario
from sortie.sim.playback.canvas import SIM_TIME, SPAN_M
from sortie.sim.playback.charts import phase_lane

SEEN = """
**Boxes**: what drone {ego} makes of the scene: green, a car found; yellow, missed; red, a false alarm; the darker,
the less sure. **Hatching**: cells of feature maps that peers sent to drone {ego} in the last second, in the peer's
colour; a thin **square**: a whole map. Other drones' are under `world/seen` and `world/received`.
"""

OF_CLASSES = """
Boxes of **trucks** are teal (found), brown (missed) and orange (false alarm); those of **people** violet, white and pink.
Pale spheres are the people themselves.
"""

OF_TURNS = """
Drones take **turns** at detecting, {scored} of {drones} at a time: one that waits shows no boxes.
"""

EGO = 0
"""Whose detections are shown until another's are switched on."""
LEGEND_SHARE = 0.3
"""Of the sortie's time, to the right of it."""
MAP_EDGE_M = 50.0
"""The map shows so much around the fleet's way."""
MAX_LANES = 8
"""Lanes of more drones than this would push the plots out."""

LEGEND = """
**{name}**: {description}

Each drone has one colour, here and in the plots; its label is its number and charge, the **ring** on the ground
what its camera sees straight below. Drones are drawn {span:.0f} m wide, and grey while they are down. The **map** has
north up.{regions}{jammers}
{links}
**Marks** on the plots' floors: yellow, something happened to the fleet{phases}.
{seen}
"""
OF_REGIONS = """ The **pink ring** is the mission region, on the ground and once more above the roofs."""
OF_JAMMERS = """ An **orange ball** is a jammer that is on."""
OF_PHASES = """; pink, the phase changed"""
OF_LINKS = """
**Arrows** are links: as wide as the traffic of the last second; green carries 100 Mb/s or more, yellow 10,
red 1 or less; grey: nothing is sent; a **red cross**: all but gone. In the **matrix of links** green means that the drone
across heard all descriptors of the one down the side, yellow half of them, red none; grey: out of earshot.
"""


def blueprint(
    scenario: Scenario, *, live: bool = False, spread_m: float | None = None, town_m: tuple[float, float] | None = None
) -> rrb.Blueprint:
    """Scene, decisions and map on the left, causes and costs over time on the right.

    Args:
        scenario: what flies.
        live: whether it is still flying.
        spread_m: how far drones fly from the fleet's middle; None: as in the formation.
        town_m: width and height of the town that is drawn; the map then shows the middle of it, where the fleet flies.
    """
    axis = time_axis(scenario)

    def plot(name: str, folder: str, y: tuple[float, float] | None = None) -> rrb.View:
        return rrb.TimeSeriesView(
            name=name,
            contents=[f"/plots/{folder}/**"],
            axis_x=axis,
            axis_y=None if y is None else rrb.ScalarAxis(range=y),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        )

    plots: list[rrb.View | rrb.Container] = [
        lanes_view(scenario),
        rrb.Tabs(
            plot("goodput, mean of a drone's links, Mb/s", "goodput"),
            plot("battery, %", "battery", (0.0, 104.0)),
            plot("energy spent, kJ", "energy"),
        ),
        plot("traffic by what became of it, Mb/s", "traffic"),
        rrb.Tabs(
            plot("age of descriptors, 99th percentile, ms", "age"),
            plot("descriptors lost, %", "lost", (0.0, 104.0)),
            plot("channel busy, %", "medium", (0.0, 104.0)),
        ),
    ]
    shares = [1.2, 1.2, 1.0]
    if scenario.perception.detector != "none":
        seen = (plot("AP@0.5, last 5 s", "ap", (0.0, 1.0)), plot("AP@0.5 of each drone", "ap_of", (0.0, 1.0)))
        plots.insert(1, rrb.Tabs(*seen))
        shares.insert(0, 1.2)
    lanes_height = 0.07 + 0.048 * (
        min(scenario.fleet.drones, MAX_LANES) + 2
    )  # part of the window that shows every lane
    shares.insert(0, sum(shares) * lanes_height / (1.0 - lanes_height))
    about = rrb.TextDocumentView(name="how to read this", contents=["/about"])
    above = rrb.Spatial2DView(
        name="map",
        origin="/map",
        contents="/map/**",
        background=(20, 24, 30, 255),
        visual_bounds=None if town_m is None else _middle(town_m),
    )
    left = rrb.Vertical(
        scene_view(scenario, spread_m=spread_m),
        rrb.Horizontal(log_view(), rrb.Tabs(above, *_link_matrix(scenario.fleet.drones), about), column_shares=[5, 4]),
        row_shares=[11, 8],
    )
    body = rrb.Horizontal(left, rrb.Vertical(*plots, row_shares=shares), column_shares=[3, 2])
    return sheet(body, live=live)


def _link_matrix(drones: int) -> list[rrb.View]:
    """The matrix of links, of a fleet that has one."""
    if not 2 <= drones <= LISTED_IDS:
        return []
    bounds = rrb.VisualBounds2D(x_range=(-1.5, drones + 0.5), y_range=(-1.5, drones + 0.5))
    name = "descriptors heard: sender down, receiver across"
    return [rrb.Spatial2DView(name=name, origin="/links", contents="/links/**", visual_bounds=bounds)]


def _middle(town_m: tuple[float, float]) -> rrb.VisualBounds2D:
    """The town but for its margin, and a little of that."""
    edge_m = MARGIN_M - MAP_EDGE_M
    (width_m, height_m) = town_m
    return rrb.VisualBounds2D(x_range=(edge_m, width_m - edge_m), y_range=(edge_m, height_m - edge_m))


def sheet(body: rrb.Container, *, live: bool = False) -> rrb.Blueprint:
    """A layout with nothing beside it but the time line."""
    return rrb.Blueprint(
        body,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed",
            timeline=SIM_TIME,
            playback_speed=1.0 if live else 2.0,
            play_state="following" if live else "playing",
            loop_mode="off",
        ),
        auto_layout=False,
        auto_views=False,
    )


def scene_view(
    scenario: Scenario, root: str = "", name: str = "the fleet over the town", spread_m: float | None = None
) -> rrb.View:
    """The 3-D scene below `root`, from an eye that flies along and sees all drones and what they see on the ground."""
    fleet, n = scenario.fleet, scenario.fleet.drones
    altitude_m = fleet.formation.altitude_m
    offsets = slots(fleet.formation.shape, max(1, len(fleet.in_formation)), fleet.formation.spacing_m)
    widest_m = max(
        footprint_radius_m(height_m, cameras)
        for height_m, cameras in zip(fleet.altitudes_m, cameras_of(fleet), strict=True)
    )
    reach_m = (float(np.abs(offsets).max()) if spread_m is None else spread_m) + widest_m
    hidden: dict[str | rr.encodings.EntityPath, Any] = {
        f"{root}/world/{what}/{i}": rrb.EntityBehavior(visible=False)
        for what in ("seen", "received")
        for i in range(n)
        if i != EGO
    }
    return rrb.Spatial3DView(
        name=name,
        origin=f"{root}/world/fleet",
        contents=f"{root}/world/**",
        overrides=hidden,
        background=(20, 24, 30, 255),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(-1.4 * reach_m, -1.0 * reach_m, altitude_m + 0.95 * reach_m),
            look_target=(0.0, -0.1 * reach_m, 0.3 * altitude_m),
            eye_up=(0.0, 0.0, 1.0),
        ),
    )


def log_view(root: str = "", name: str = "who decided what, and why") -> rrb.View:
    """Decisions and events in words."""
    return rrb.TextLogView(
        name=name,
        contents=[f"{root}/log/**"],
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn(SIM_TIME)], text_log_columns=["Body"]
        ),
    )


def lanes_view(
    scenario: Scenario, root: str = "", name: str = "events, phase, and what each drone sends on its best link"
) -> rrb.View:
    """Events, phase and drones as lanes."""
    drones = range(min(scenario.fleet.drones, MAX_LANES))
    phases = (f"{root}/{phase_lane(group)}" for group in range(len(scenario.mission.phases_of)))
    lanes = [f"{root}/lanes/events", *phases, *(f"{root}/lanes/drone_{i}" for i in drones)]
    return rrb.StateTimelineView(name=name, contents=lanes, time_view=time_axis(scenario))


def time_axis(scenario: Scenario) -> rrb.TimeAxis:
    """The whole sortie, whatever other views show, and room beside it where a legend hides no curve."""
    return rrb.TimeAxis(
        link="Independent",
        view_range=rrb.TimeRange(
            start=rrb.TimeRangeBoundary.absolute(seconds=0.0),
            end=rrb.TimeRangeBoundary.absolute(seconds=(1.0 + LEGEND_SHARE) * scenario.duration_s),
        ),
    )


def legend(scenario: Scenario) -> rr.TextDocument:
    """How to read the playback, for someone who has never seen one."""
    seen = "" if scenario.perception.detector == "none" else SEEN.format(ego=EGO)
    if seen and len(scenario.perception.classes) > 1:
        seen += OF_CLASSES
    if seen and scenario.takes_turns:
        seen += OF_TURNS.format(scored=scenario.scored_drones, drones=len(scenario.scorable_drones))
    told = {"name": scenario.name, "description": " ".join(scenario.description.split()) or "no description."}
    phases = [phase for several in scenario.mission.phases_of for phase in several]
    occurs = {
        "regions": OF_REGIONS if any(phase.region for phase in phases) else "",
        "jammers": OF_JAMMERS if any(isinstance(event, Jammer) for event in scenario.events) else "",
        "phases": OF_PHASES if any(0 < phase.at_s < scenario.duration_s for phase in phases) else "",
        "links": OF_LINKS if scenario.fleet.drones > 1 else "",
    }
    text = LEGEND.format(span=SPAN_M, seen=seen, **told, **occurs)
    return rr.TextDocument(text.strip(), media_type=rr.MediaType.MARKDOWN)
