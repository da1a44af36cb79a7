"""What is to be flown: every scenario field, its unit in its name, its bounds and its default.

The descriptions below are the reference (`sortie list schema` exports them as JSON Schema).
Frames: world is ENU (x east, y north, z up, metres), bodies are FLU (x forward, y left, z up).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

PointM = tuple[Annotated[float, Field(ge=-5000, le=5000)], Annotated[float, Field(ge=-5000, le=5000)]]
Soc = Annotated[float, Field(gt=0, le=1)]
DroneId = Annotated[int, Field(ge=0, le=254)]
PhaseName = Literal["transit", "search", "track", "return"]


def _inconsistent(at: tuple[str | int, ...], value: str, bound: str) -> PydanticCustomError:
    """An error between fields: `at` is the offending field's path below the section that checks it."""
    path = "".join(f"{part}." for part in at)[:-1] + ": " * bool(at)
    context = {"path": path, "value": value, "bound": bound, "at": at}
    return PydanticCustomError("inconsistent", "{path}{value}, must be {bound}", context)


class Section(BaseModel):
    """A frozen section of a scenario; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


# --- fleet ---------------------------------------------------------------------------------------


class Formation(Section):
    shape: Literal["cross", "line", "wedge", "grid", "circle"] = Field(
        "cross", description="Slots around the moving reference point."
    )
    spacing_m: float = Field(
        20.0, gt=0, le=500, description="Distance between neighbouring slots (arc length for circle)."
    )
    altitude_m: float = Field(60.0, ge=10, le=400, description="Height of the formation above the ground.")


class Route(Section):
    waypoints_m: tuple[PointM, ...] = Field(
        ((0.0, 0.0),),
        min_length=1,
        max_length=1000,
        description="Ground track of the reference point, ENU (x, y); one point hovers.",
    )
    speed_mps: float = Field(5.0, gt=0, le=30, description="Ground speed along the route.")
    turn_time_s: float = Field(4.0, gt=0, le=60, description="Time over which a corner is rounded.")


class Motion(Section):
    wind_mps: tuple[Annotated[float, Field(ge=-40, le=40)], Annotated[float, Field(ge=-40, le=40)]] = Field(
        (2.0, 1.0), description="Mean wind, the velocity of the air, ENU (x, y)."
    )
    gust_sigma_mps: float = Field(0.8, ge=0, le=15, description="Standard deviation of each gust component.")
    gust_time_s: float = Field(3.0, gt=0, le=120, description="Correlation time of gusts.")
    pose_jitter_m: float = Field(
        0.4, ge=0, le=20, description="Standard deviation of each drone's true offset from its slot, per axis."
    )
    pose_jitter_time_s: float = Field(2.5, gt=0, le=120, description="Correlation time of the offset.")
    pose_error_m: float = Field(
        0.2, ge=0, le=20, description="Standard deviation of the horizontal position estimate's error, per axis."
    )
    heading_error_deg: float = Field(
        0.2,
        ge=0,
        le=45,
        description="Standard deviation of the heading estimate's error; 0.2° is a dual-antenna receiver, a magnetometer has degrees.",
    )


class Viewpoints(Section):
    """How far the formation gives way to a policy that chooses viewpoints; the others are asked nothing."""

    reach_m: float = Field(
        40.0, ge=0, le=50, description="How far from its slot a drone may stand when its policy asks; 0: nowhere else."
    )
    speed_mps: float = Field(3.0, gt=0, le=15, description="Fastest that it moves within the formation.")
    acceleration_mps2: float = Field(1.0, gt=0, le=5, description="Most that it accelerates for it.")
    separation_m: float = Field(
        10.0, gt=0, le=500, description="No two drones closer than this, unless their slots are."
    )
    fence_m: tuple[float, float, float, float] | None = Field(
        None, description="Geofence that every drone keeps within, ENU (x_min, y_min, x_max, y_max); left out, none."
    )

    @model_validator(mode="after")
    def _fence_holds_something(self) -> Viewpoints:
        if self.fence_m is not None:
            x_min, y_min, x_max, y_max = self.fence_m
            if not (x_min < x_max and y_min < y_max):
                raise _inconsistent(("fence_m",), f"{self.fence_m}", "x_min < x_max and y_min < y_max")
        return self


class Airframe(Section):
    mass_kg: float = Field(2.04, gt=0, le=100, description="All-up mass without payload, battery included.")
    payload_kg: float = Field(0.0, ge=0, le=100, description="What is carried besides.")
    disc_area_m2: float = Field(0.503, gt=0, le=50, description="Area that all rotors sweep.")
    figure_of_merit: float = Field(
        0.478,
        ge=0.1,
        le=0.9,
        description="Ideal over true power at the rotors in hover; real small propellers 0.5 to 0.7.",
    )
    tip_speed_mps: float = Field(120.0, ge=10, le=300, description="Speed of the blades' tips in hover, no payload.")
    drag_area_m2: float = Field(0.01509, ge=0, le=5, description="Drag over dynamic pressure.")
    air_density_kgpm3: float = Field(1.225, ge=0.3, le=1.5, description="1.225 at sea level, 1.11 at 1,000 m.")
    power_model: Literal["level", "momentum"] = Field(
        "level",
        description="level: the formula for level flight, and m·g·v_z while climbing; momentum: momentum theory with climb's inflow, vertical gusts and acceleration.",
    )


class Battery(Section):
    capacity_wh: float = Field(130.0, gt=0, le=5000, description="Energy of a full pack at rest (open circuit).")
    cells: int = Field(4, ge=1, le=24, description="LiPo cells in series.")
    initial_soc: Soc = Field(0.95, description="State of charge at take-off.")
    cell_resistance_mohm: float = Field(
        13.0, ge=0, le=500, description="Internal resistance of one cell with its wiring."
    )
    drivetrain_efficiency: float = Field(0.8, gt=0, le=1, description="Rotor power over electric power.")
    avionics_w: float = Field(8.0, ge=0, le=500, description="Flight controller, sensors, cameras.")
    compute_idle_w: float = Field(10.0, ge=0, le=200, description="Companion computer at rest.")
    compute_active_w: float = Field(
        40.0,
        ge=0,
        le=200,
        description="Companion computer while it runs perception, the whole draw.",
    )
    radio_idle_w: float = Field(2.0, ge=0, le=50, description="Radio while it listens.")
    radio_tx_w: float = Field(6.0, ge=0, le=50, description="Radio while it sends, the whole draw.")
    landing_soc: float = Field(0.1, ge=0, lt=1, description="The drone lands when its charge reaches this.")
    cutoff_cell_v: float = Field(
        0.0, ge=0, le=4.2, description="It also lands when a cell's mean voltage under load falls below this; 0: never."
    )
    polarisation_mohm: float = Field(
        0.0, ge=0, le=500, description="Resistance of one cell that builds up over polarisation_time_s under load."
    )
    polarisation_time_s: float = Field(20.0, gt=0, le=3600, description="Time constant of polarisation.")
    ambient_c: float | None = Field(
        None,
        ge=-40,
        le=60,
        description="Temperature of the air, and of the pack at take-off; left out, packs stay at 25 °C.",
    )
    cycles: float = Field(0.0, ge=0, le=10000, description="Full cycles behind the pack, which age it.")
    life_cycles: float = Field(
        300.0, gt=0, le=10000, description="Cycles to a pack's end of life: 80 % of its capacity, twice its resistance."
    )

    @model_validator(mode="after")
    def _still_a_pack(self) -> Battery:
        if self.cycles > 2 * self.life_cycles:
            bound = f"at most twice life_cycles = {self.life_cycles:g}"
            raise _inconsistent(("cycles",), f"{self.cycles:g}", bound)
        return self


class DroneOverride(Section):
    drone: DroneId = Field(description="Whose battery or load differs.")
    initial_soc: Soc | None = Field(None, description="As fleet.battery.initial_soc.")
    capacity_wh: float | None = Field(None, gt=0, le=5000, description="As fleet.battery.capacity_wh.")
    cell_resistance_mohm: float | None = Field(None, ge=0, le=500, description="As fleet.battery.cell_resistance_mohm.")
    cycles: float | None = Field(None, ge=0, le=10000, description="As fleet.battery.cycles.")
    payload_kg: float | None = Field(None, ge=0, le=100, description="As fleet.airframe.payload_kg.")


class Fleet(Section):
    drones: int = Field(5, ge=1, le=200, description="Number of drones; ids are 0 … drones − 1.")
    formation: Formation = Formation()
    route: Route = Route()
    motion: Motion = Motion()
    viewpoints: Viewpoints = Viewpoints()
    airframe: Airframe = Airframe()
    battery: Battery = Battery()
    overrides: tuple[DroneOverride, ...] = Field(
        (), description="Drones whose battery or payload differs from the fleet's."
    )
    trace: str | None = Field(
        None,
        description="CSV or Parquet (fleet/traces.py): drones named in it take pose or battery from it, not from the models.",
    )

    @model_validator(mode="after")
    def _overrides_fit(self) -> Fleet:
        seen: set[int] = set()
        for i, override in enumerate(self.overrides):
            at = ("overrides", i, "drone")
            if override.drone >= self.drones:
                raise _inconsistent(at, f"{override.drone}", f"below fleet.drones = {self.drones}")
            if override.drone in seen:
                raise _inconsistent(at, f"{override.drone}", "named once, it has an override above")
            seen.add(override.drone)
            if override.cycles is not None and override.cycles > 2 * self.battery.life_cycles:
                bound = f"at most twice fleet.battery.life_cycles = {self.battery.life_cycles:g}"
                raise _inconsistent(("overrides", i, "cycles"), f"{override.cycles:g}", bound)
        return self


# --- mission -------------------------------------------------------------------------------------


class Target(Section):
    waypoints_m: tuple[PointM, ...] = Field(
        min_length=1, max_length=1000, description="Path of the target car, ENU (x, y)."
    )
    speed_mps: float = Field(5.0, gt=0, le=40, description="Speed of the target car.")


class Region(Section):
    radius_m: float = Field(32.0, gt=0, le=2000, description="Radius of the mission disc.")
    centre_m: PointM | None = Field(None, description="Its centre, ENU (x, y); left out, the disc follows the target.")


class Phase(Section):
    at_s: float = Field(0.0, ge=0, description="When the phase begins.")
    phase: PhaseName = Field("search", description="What the fleet is doing.")
    region: Region | None = Field(None, description="Region of responsibility during the phase.")


class Mission(Section):
    phases: tuple[Phase, ...] = Field(
        (Phase(),), min_length=1, max_length=100, description="Phases in order of time; the first begins at 0."
    )
    target: Target | None = Field(None, description="The car to track.")

    @model_validator(mode="after")
    def _ordered(self) -> Mission:
        first = self.phases[0].at_s
        if first != 0:
            raise _inconsistent(("phases", 0, "at_s"), f"{first:g}", "0, the first phase begins the sortie")
        for i, (before, after) in enumerate(pairwise(self.phases), start=1):
            if after.at_s <= before.at_s:
                bound = f"above {before.at_s:g}, when the phase before begins"
                raise _inconsistent(("phases", i, "at_s"), f"{after.at_s:g}", bound)
        for i, phase in enumerate(self.phases):
            if phase.region is not None and phase.region.centre_m is None and self.target is None:
                bound = "given where there is no mission.target to follow"
                raise _inconsistent(("phases", i, "region", "centre_m"), "missing", bound)
        return self


# --- radio ---------------------------------------------------------------------------------------


MIN_TILE_BYTES = 206
"""A fragment that is usable alone: 44 B of header, and one cell of 160 B with its index (fleet/tiles.py)."""


class Bursts(Section):
    good_to_bad: float = Field(
        0.0, ge=0, le=1, description="Probability that a good pair of drones turns bad, a step; 0: no bursts."
    )
    bad_to_good: float = Field(0.28, gt=0, le=1, description="Probability that a bad pair turns good again, a step.")
    step_s: float = Field(
        1.0, ge=0.01, le=60, description="Length of a step; flown links gave 0.05 and 0.28 over steps of 1 s."
    )
    loss_good: float = Field(
        0.0, ge=0, le=1, description="Probability that a good pair loses a frame at a try, besides what SNR loses."
    )
    loss_bad: float = Field(1.0, ge=0, le=1, description="The same of a bad pair.")


class Radio(Section):
    standard: Literal["n", "ac", "ax"] = Field(
        "ax", description="802.11 generation, one spatial stream: rates, preamble, aggregation."
    )
    carrier_ghz: float = Field(5.2, ge=0.4, le=7.2, description="Carrier frequency.")
    bandwidth_mhz: Literal[20, 40, 80] = Field(80, description="Channel width; 802.11n has no 80 MHz.")
    tx_power_dbm: float = Field(20.0, ge=-20, le=36, description="Transmit power, antenna gains included.")
    noise_figure_db: float = Field(7.0, ge=0, le=30, description="Receiver noise figure.")
    antenna: Literal["isotropic", "dipole"] = Field(
        "isotropic", description="Pattern of every drone's antenna; a dipole stands along the airframe's z axis."
    )
    path_loss: Literal["log_distance", "free_space", "two_ray"] = Field(
        "log_distance", description="Path loss; two_ray adds the ground's reflection (ground is z = 0) to free space."
    )
    path_loss_exponent: float = Field(2.1, ge=1.5, le=6, description="Log-distance exponent beyond 1 m.")
    ground_roughness_m: float = Field(
        0.05, ge=0, le=10, description="Standard deviation of the ground's height, for two_ray: rough ground scatters."
    )
    shadowing_sigma_db: float = Field(3.5, ge=0, le=20, description="Standard deviation of shadowing.")
    shadowing_time_s: float = Field(
        4.5, gt=0, le=600, description="Correlation time of shadowing (4.5 s is 0.8 at 1 s)."
    )
    shadowing_distance_m: float | None = Field(
        None,
        gt=0,
        le=5000,
        description="Correlation distance of shadowing, for both ends of a link; left out, every pair has its own, in time alone.",
    )
    rician_k_db: float = Field(12.0, ge=-10, le=40, description="Rician factor of small-scale fading.")
    group_rate_mbps: float = Field(6.0, ge=1, le=54, description="Basic rate of group-addressed frames (descriptors).")
    rate_control: Literal["ideal", "minstrel"] = Field(
        "ideal", description="Who picks the MCS: the SNR of the frame before, or statistics of what got through."
    )
    retry_limit: int = Field(7, ge=0, le=32, description="MAC retries of a unicast frame.")
    max_ampdu_frames: int = Field(64, ge=1, le=256, description="Frames aggregated into one A-MPDU.")
    fragment_bytes: int = Field(1344, ge=64, le=65000, description="DDS fragment payload.")
    framing: Literal["sample", "tiles"] = Field(
        "sample",
        description="Feature maps as one sample, which a lost fragment loses, or as tiles: fragments of whole cells, usable alone.",
    )
    relay_max_hops: int = Field(
        1, ge=1, le=8, description="Most hops of a payload's route; 1 sends directly, whatever the link is worth."
    )
    bursts: Bursts = Bursts()
    trace: str | None = Field(
        None,
        description="CSV or Parquet (radio/channel/traces.py): links named in it take SNR, loss or goodput from it, not from the models.",
    )
    heartbeat_s: float = Field(0.02, gt=0, le=10, description="Heartbeat period of the reliable writer.")
    nack_delay_s: float = Field(0.005, ge=0, le=10, description="The reader's delay before it asks for a repair.")

    @model_validator(mode="after")
    def _width_exists(self) -> Radio:
        if self.standard == "n" and self.bandwidth_mhz == 80:
            raise _inconsistent(("bandwidth_mhz",), "80", "20 or 40 where standard is n")
        return self

    @model_validator(mode="after")
    def _a_tile_fits(self) -> Radio:
        if self.framing == "tiles" and self.fragment_bytes < MIN_TILE_BYTES:
            bound = f"at least {MIN_TILE_BYTES} where framing is tiles, for a header and one cell"
            raise _inconsistent(("fragment_bytes",), f"{self.fragment_bytes}", bound)
        return self


# --- context plane -------------------------------------------------------------------------------


class Context(Section):
    rate_hz: float = Field(
        10.0,
        gt=0,
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
    grid_cells: Literal[0, 4, 8, 16] = Field(16, description="Coverage cells a side on the air; 0 leaves the grid out.")
    grid_bits: Literal[1, 2] = Field(2, description="Bits of a coverage cell on the air; 1 is seen well or not.")
    number_bits: Literal[8, 10, 12, 16, 24, 32] = Field(
        32,
        description="Bits of a descriptor's number on the air: fixed point over its field's range, or 32-bit floats.",
    )
    trust: bool = Field(
        True,
        description="Drones hold each other's claims against poses, arrivals and the fleet, and discount whom they doubt.",
    )


# --- perception ----------------------------------------------------------------------------------


class Scene(Section):
    seed: int = Field(7, ge=0, description="Layout of the town; separate from the sortie's seed.")
    style: Literal["town", "old_town", "suburb", "yard"] = Field(
        "town",
        description="Lots and houses: a town's, a dense old town's, a suburb's with gardens, a works yard's halls.",
    )
    block_m: float = Field(80.0, ge=40, le=400, description="Distance between parallel roads.")
    building_density: float = Field(0.6, ge=0, le=1, description="Fraction of building lots that are built on.")
    building_height_m: float = Field(10.0, ge=3, le=25, description="Mean height of buildings.")
    tree_density: float = Field(0.5, ge=0, le=1, description="Fraction of tree spots along roads that hold a tree.")
    parked_density: float = Field(0.35, ge=0, le=1, description="Fraction of kerb spots with a parked car.")
    moving_cars_per_km: float = Field(10.0, ge=0, le=100, description="Moving cars per kilometre of lane.")
    moving_speed_mps: float = Field(8.0, gt=0, le=40, description="Mean speed of moving cars.")
    sun_azimuth_deg: float = Field(212.5, ge=0, le=360, description="Where the sun stands, from east towards north.")
    sun_elevation_deg: float = Field(56.9, ge=20, le=90, description="How high it stands; low suns cast long shadows.")
    overcast: float = Field(0.0, ge=0, le=1, description="Cloud: 0 casts dark shadows, 1 casts none.")
    brightness: float = Field(1.0, ge=0.1, le=1.5, description="Exposure: a factor on every image.")


class Perception(Section):
    detector: Literal["torch", "surrogate", "recorded", "none"] = Field(
        "torch",
        description="The detector: the network, its fast surrogate, a recording of another model, or none: the traffic alone.",
    )
    fusion: Literal["none", "late", "fcooper", "v2vnet", "disconet", "where2comm"] = Field(
        "disconet",
        description="How what peers sent is fused; weights belong to a fusion, none and late take any; the surrogate takes its calibration's, or none.",
    )
    weights: str | None = Field(
        None,
        description="A safetensors file: the network's, or the surrogate's calibration; left out, the shipped one.",
    )
    recording: str | None = Field(
        None, description="What the recorded detector saw: an npz file or a Zarr folder (perception/outside)."
    )
    recorded_fusion: str | None = Field(
        None,
        description="path/to/file.py:function that fuses recorded features; left out, boxes arrive where their cells were sent.",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        "float32",
        description="What the torch detector's encoder and head reckon in; bfloat16 may be faster on processors with AMX, is as fast on those with AVX-512 BF16 alone, and far slower on others.",
    )
    sample_rate_hz: float = Field(
        2.0, gt=0, le=10, description="How often accuracy is scored; traffic runs at context.rate_hz."
    )
    compute_delay_s: float = Field(0.03, ge=0, le=5, description="From sensing to features ready to send.")
    fusion_delay_s: float = Field(0.095, ge=0, le=5, description="From a frame's begin to its fusion and scoring.")
    max_age_s: float = Field(
        0.5,
        gt=0,
        le=60,
        description="Received payloads older than this are not fused; a drone that rested longer sees nothing.",
    )
    motion_compensation: bool = Field(
        True, description="Late features lie where their sender was when it looked; false: where it is at fusion."
    )
    join: Literal["nms", "average"] = Field(
        "nms",
        description="How boxes of several drones become one list: the best of those that overlap, or their weighted mean.",
    )
    score_threshold: float = Field(0.1, ge=0, le=1, description="Detections below this score are dropped.")
    cells_by: Literal["confidence", "norm"] = Field("confidence", description="What ranks the cells under a budget.")
    unsent_cells: Literal["masked", "zero"] = Field(
        "masked",
        description="Cells that were not sent: out of the fusion softmax, or zeros in it (as in the paper's instrument).",
    )
    scene: Scene = Scene()

    @model_validator(mode="after")
    def _recording_where_recorded(self) -> Perception:
        recorded = self.detector == "recorded"
        if recorded and self.recording is None:
            raise _inconsistent(("recording",), "missing", "given where detector is recorded")
        for name in ("recording", "recorded_fusion"):
            if not recorded and getattr(self, name) is not None:
                raise _inconsistent((name,), f"{getattr(self, name)!r}", f"left out where detector is {self.detector}")
        return self


# --- policy, events, expectations ----------------------------------------------------------------


class PolicyChange(Section):
    at_s: float | None = Field(None, ge=0, description="Takes over at this time …")
    phase: PhaseName | None = Field(None, description="… or whenever a drone's own phase turns to this …")
    command: str | None = Field(None, min_length=1, description="… or on this command; one of the three is given.")
    name: str = Field(min_length=1, description="The policy that takes over, as policy.name.")
    params: dict[str, float | int | bool | str] = Field({}, description="Its keyword arguments.")

    @model_validator(mode="after")
    def _one_trigger(self) -> PolicyChange:
        given = [n for n in ("at_s", "phase", "command") if getattr(self, n) is not None]
        if len(given) != 1:
            raise _inconsistent((), " and ".join(given) or "no trigger", "one of at_s, phase and command")
        return self


class PolicyCommand(Section):
    at_s: float = Field(ge=0, description="When the ground gives it.")
    command: str = Field(min_length=1, description="The word that a change of policy.changes waits for.")
    drones: tuple[DroneId, ...] = Field((), description="Whom it reaches; left out, all.")


class ViewReplay(Section):
    at_s: float = Field(ge=0, description="From when the drone's next decision is made on this view.")
    drone: DroneId = Field(description="Whose policy sees it; the view's ego.")
    view: str = Field(min_length=1, description="A fleet view as JSON, as `sortie verify` writes counterexamples.")


class Policy(Section):
    name: str = Field("worked", min_length=1, description="A registered policy, or path/to/file.py:function.")
    params: dict[str, float | int | bool | str] = Field({}, description="Keyword arguments of the policy.")
    dwell_s: float = Field(1.0, ge=0, le=60, description="How long an upgrade must be asked for before it is made.")
    hysteresis: float = Field(
        0.2, ge=0, le=10, description="By which share goodput, charge or headroom must rise before policies read it."
    )
    changes: tuple[PolicyChange, ...] = Field(
        (),
        max_length=100,
        description="Policies that take over in flight; where two do at once, the later in the list.",
    )
    commands: tuple[PolicyCommand, ...] = Field((), max_length=1000, description="Commands from the ground.")
    invariants: str = Field(
        "",
        max_length=10000,
        description="What directives must keep, one line each (policies/verification/invariants.py); counted.",
    )
    shield: bool = Field(
        False, description="Directives that break an invariant are replaced by the nearest that keep it."
    )
    replays: tuple[ViewReplay, ...] = Field(
        (), max_length=100, description="Views that a policy is shown instead of what its drone heard."
    )

    @model_validator(mode="after")
    def _fits_together(self) -> Policy:
        known = [c.command for c in self.changes if c.command is not None]
        for i, given in enumerate(self.commands):
            if given.command not in known:
                bound = f"one that a change waits for: {', '.join(known) or 'none does'}"
                raise _inconsistent(("commands", i, "command"), repr(given.command), bound)
        if self.shield and not self.invariants.strip():
            raise _inconsistent(("invariants",), "missing", "given where there is a shield")
        return self


class _Event(Section):
    at_s: float = Field(ge=0, description="When it begins.")


class LinkDrop(_Event):
    kind: Literal["link_drop"]
    drone: DroneId = Field(description="Whose links fade.")
    peer: DroneId | None = Field(None, description="The other end; left out, every link of the drone.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    loss_db: float = Field(30.0, gt=0, le=200, description="Extra loss, both directions.")


class Jam(_Event):
    kind: Literal["jam"]
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    position_m: tuple[float, float, float] = Field(description="The jammer, ENU (x, y, z).")
    power_dbm: float = Field(20.0, ge=-50, le=60, description="Its power in the channel.")


class DroneLost(_Event):
    kind: Literal["drone_lost"]
    drone: DroneId = Field(description="Who falls silent and leaves.")


class BatteryFault(_Event):
    kind: Literal["battery_fault"]
    drone: DroneId = Field(description="Whose battery fails.")
    lost_fraction: float = Field(gt=0, le=1, description="Fraction of the remaining energy that is gone at once.")


class CellFailure(_Event):
    kind: Literal["cell_failure"]
    drone: DroneId = Field(description="Whose pack loses a cell: its voltage and its energy are gone.")


class ClockSkew(_Event):
    kind: Literal["clock_skew"]
    drone: DroneId = Field(description="Whose clock is off.")
    skew_s: float = Field(
        ge=-3600, le=3600, description="Added to its stamps; negative makes its descriptors look old."
    )


class Spoof(_Event):
    kind: Literal["spoof"]
    drone: DroneId = Field(description="Whose descriptors are imitated.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    attack: Literal["forged", "replayed", "malformed", "oversized"] = Field(
        "forged", description="What is put on the air."
    )
    rate_hz: float = Field(10.0, gt=0, le=1000, description="Datagrams a second.")


class Lie(_Event):
    kind: Literal["lie"]
    drone: DroneId = Field(description="Who lies, in its own descriptors.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    about: Literal["coverage", "goodput", "battery"] = Field("coverage", description="What is false.")
    claim: Literal["much", "little"] = Field(
        "much",
        description="All cells new, 500 Mb/s to everyone, a full battery; or nothing seen, 0.1 Mb/s, an empty one.",
    )


Event = Annotated[
    LinkDrop | Jam | DroneLost | BatteryFault | CellFailure | ClockSkew | Spoof | Lie, Field(discriminator="kind")
]


class Expectation(Section):
    metric: str = Field(min_length=1, description="A dotted field of outcome.json, for example ap50.mission.")
    at_least: float | None = Field(None, description="Lower bound, inclusive.")
    at_most: float | None = Field(None, description="Upper bound, inclusive.")
    equals: float | str | bool | None = Field(None, description="The exact value.")
    tolerance: float = Field(
        0.0, ge=0, description="How far a number may lie beyond its bound, or off its exact value."
    )
    replications: int | None = Field(
        None, ge=2, le=10_000, description="Fly so many and hold their mean to the bounds; left out, the one sortie."
    )
    confidence: float | None = Field(
        None,
        ge=0.5,
        le=0.9999,
        description="How sure the mean must be within each bound (one-sided, Student); goes with replications.",
    )
    because: str = Field("", description="Why it is expected; shown when it fails.")

    @model_validator(mode="after")
    def _bounded(self) -> Expectation:
        if (self.replications is None) != (self.confidence is None):
            missing, given = ("confidence", "replications")[:: 1 if self.confidence is None else -1]
            raise _inconsistent((missing,), "missing", f"given where {given} is")
        if self.replications is not None and self.equals is not None:
            raise _inconsistent(("equals",), f"{self.equals}", "at_least or at_most where replications is given")
        if self.at_least is None and self.at_most is None and self.equals is None:
            raise _inconsistent((), "no bound", "at_least, at_most or equals")
        if self.at_least is not None and self.at_most is not None and self.at_least > self.at_most:
            raise _inconsistent(("at_least",), f"{self.at_least:g}", f"≤ at_most = {self.at_most:g}")
        return self


class DecisionExpectation(Section):
    """Some directive that a drone's gate takes up within a window."""

    drone: DroneId = Field(description="Whose gate.")
    peer: DroneId | None = Field(None, description="The link's other end; left out, any.")
    from_s: float = Field(ge=0, description="Begin of the window, inclusive.")
    until_s: float = Field(ge=0, description="End of the window, inclusive.")
    representation: Literal["none", "tracks", "detections", "features", "raw"] | None = Field(
        None, description="What the link is to carry."
    )
    rate_at_most_hz: float | None = Field(None, ge=0, le=30, description="Its highest rate.")
    roi: bool | None = Field(None, description="Whether it is confined to a region.")
    reason: str = Field("", description="Text that its reason contains.")
    because: str = Field("", description="Why it is expected; shown when it fails.")

    @model_validator(mode="after")
    def _window(self) -> DecisionExpectation:
        if self.until_s < self.from_s:
            raise _inconsistent(("until_s",), f"{self.until_s:g}", f"at least from_s = {self.from_s:g}")
        return self


class Scenario(Section):
    """One sortie: who flies, why, over which air, seeing what, by which policy."""

    name: str = Field(pattern=r"^[a-z0-9_]+$", max_length=64, description="Short name, as in the file's name.")
    description: str = Field("", max_length=2000, description="One paragraph for people.")
    seed: int = Field(1, ge=0, lt=2**63, description="Every random draw follows from it.")
    duration_s: float = Field(120.0, gt=0, le=7200, description="Length of the sortie; the end is exclusive.")
    fleet: Fleet = Fleet()
    mission: Mission = Mission()
    radio: Radio = Radio()
    context: Context = Context()
    perception: Perception = Perception()
    policy: Policy = Policy()
    events: tuple[Event, ...] = Field((), max_length=1000, description="What goes wrong, and when.")
    expect: tuple[Expectation, ...] = Field(
        (), max_length=1000, description="What the outcome must satisfy; asserted by `sortie check`."
    )
    expect_decisions: tuple[DecisionExpectation, ...] = Field(
        (), max_length=1000, description="What the gates must take up, and when; asserted by `sortie check`."
    )

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        n = self.fleet.drones
        for i, event in enumerate(self.events):
            for end in ("drone", "peer"):
                who = getattr(event, end, None)
                if who is not None and who >= n:
                    raise _inconsistent(("events", i, end), f"{who}", f"below fleet.drones = {n}")
            if isinstance(event, LinkDrop) and event.peer == event.drone:
                raise _inconsistent(("events", i, "peer"), f"{event.peer}", "another drone than drone")
            until_s = getattr(event, "until_s", None)
            if until_s is not None and until_s <= event.at_s:
                raise _inconsistent(("events", i, "until_s"), f"{until_s:g}", f"above at_s = {event.at_s:g}")
        # What is done at an instant must have its instant. Phases and expected decisions may lie beyond the end: missions
        # are flown shortened, and an expectation of a time that was not flown fails.
        policy = self.policy
        instants: dict[tuple[str, ...], Sequence[_Event | PolicyChange | PolicyCommand | ViewReplay]] = {
            ("events",): self.events,
            ("policy", "changes"): policy.changes,
            ("policy", "commands"): policy.commands,
            ("policy", "replays"): policy.replays,
        }
        for where, each in instants.items():
            for i, one in enumerate(each):
                if one.at_s is not None and one.at_s >= self.duration_s:
                    bound = f"below duration_s = {self.duration_s:g}"
                    raise _inconsistent((*where, i, "at_s"), f"{one.at_s:g}", bound)
        for i, command in enumerate(self.policy.commands):
            for k, who in enumerate(command.drones):
                if who >= n:
                    at = ("policy", "commands", i, "drones", k)
                    raise _inconsistent(at, f"{who}", f"below fleet.drones = {n}")
        for i, replay in enumerate(self.policy.replays):
            if replay.drone >= n:
                raise _inconsistent(("policy", "replays", i, "drone"), f"{replay.drone}", f"below fleet.drones = {n}")
        for i, decision in enumerate(self.expect_decisions):
            for end in ("drone", "peer"):
                who = getattr(decision, end)
                if who is not None and who >= n:
                    raise _inconsistent(("expect_decisions", i, end), f"{who}", f"below fleet.drones = {n}")
        degraded, detached = self.context.degraded_after_periods, self.context.detached_after_periods
        if detached <= degraded:
            bound = f"above degraded_after_periods = {degraded:g}"
            raise _inconsistent(("context", "detached_after_periods"), f"{detached:g}", bound)
        return self

    @property
    def frame_s(self) -> float:
        """Length of a frame, the descriptor period, s."""
        return 1.0 / self.context.rate_hz

    @property
    def frames(self) -> int:
        """Frames that begin before the end (end exclusive)."""
        return math.ceil(round(self.duration_s * self.context.rate_hz, 9))


def json_schema() -> dict[str, Any]:
    """The JSON Schema of a scenario, for editors."""
    return Scenario.model_json_schema()
