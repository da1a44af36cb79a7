"""`fleet`: drones, how they move, airframe, battery, computer and cameras."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import (
    MOST_DRONES,
    DroneId,
    ModelName,
    Params,
    PresetSection,
    Section,
    Soc,
    inconsistent,
)
from sortie.scenarios.schema.movement import (
    FlightGroup,
    Formation,
    GroundStation,
    Mobility,
    Motion,
    Origin,
    Route,
    Steering,
    Viewpoints,
)


class Airframe(PresetSection):
    presets: ClassVar = {
        "zeng_2019": {},
        "solo": {
            "mass_kg": 1.88,
            "disc_area_m2": 0.2027,
            "figure_of_merit": 0.674,
            "tip_speed_mps": 71.8,
            "power_model": "momentum",
        },
    }
    """`zeng_2019`: the rotary-wing machine of Zeng, Xu & Zhang 2019. `solo`: a 3DR Solo with gimbal and camera, as in
    `research/validation/energy.py`, which names its sources and compares it with a recorded flight."""

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
    power_model: Annotated[str, ModelName("power", ("level", "momentum"))] = Field(
        "level",
        description="level: the formula for level flight, and m·g·v_z while climbing; momentum: momentum theory with climb's inflow, vertical gusts and acceleration.",
    )
    power_params: Params = Field({}, description="Keyword arguments of a power model of one's own.")


class Polarisation(Section):
    resistance_mohm: float = Field(
        0.0, ge=0, le=500, description="Resistance of one cell that builds up over time_s under load; 0: none."
    )
    time_s: float = Field(20.0, gt=0, le=3600, description="Time constant of polarisation.")


class Battery(Section):
    capacity_wh: float = Field(130.0, gt=0, le=5000, description="Energy of a full pack at rest (open circuit).")
    cells: int = Field(4, ge=1, le=24, description="LiPo cells in series.")
    initial_soc: Soc = Field(0.95, description="State of charge at take-off.")
    cell_resistance_mohm: float = Field(
        13.0, ge=0, le=500, description="Internal resistance of one cell with its wiring."
    )
    cell_model: Annotated[str, ModelName("cell", ("lipo",))] = Field(
        "lipo",
        description="Voltage of a cell at rest by its charge: a lithium-polymer cell's, or one of one's own (docs/guide/power_model.md).",
    )
    cell_params: Params = Field({}, description="Keyword arguments of a cell of one's own.")
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
    polarisation: Polarisation = Polarisation()
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
            raise inconsistent(("cycles",), f"{self.cycles:g}", bound)
        return self


class Computer(Section):
    """The companion computer: what its headrooms follow from (fleet/computer.py); a Jetson AGX Orin, as the paper's."""

    cpu_cores: int = Field(12, ge=1, le=256, description="Cores of the processor.")
    decision_s: float = Field(
        0.0001, ge=0, le=1, description="Processor time of a decision; the paper's median on the Orin."
    )
    payload_mbps: float = Field(
        19500.0,
        gt=0,
        description="Payload that one core sends or receives; from the paper's prototype on the Orin (fleet/README.md).",
    )
    driving_cores: float = Field(
        1.0, ge=0, le=256, description="Cores that are busy while the accelerator works, feeding it and waiting for it."
    )
    fusion_s: float = Field(
        0.00032,
        ge=0,
        le=1,
        description="Accelerator time to fuse one received feature map; a look takes compute_delay_s.",
    )


class Camera(Section):
    """A drone's five cameras: front, left, right, back and straight down. All are alike; the defaults are UAV3D's."""

    field_of_view_deg: float = Field(
        70.0, ge=20, le=110, description="Horizontal field of view of each camera; pictures are 16:9."
    )
    pitch_deg: float = Field(
        45.0,
        ge=20,
        le=70,
        description="How far the four that look to the sides are pitched down; the fifth looks down.",
    )
    width_px: int = Field(160, ge=32, le=640, description="Width of a picture, a multiple of 16.")

    @model_validator(mode="after")
    def _whole_rows(self) -> Camera:
        if self.width_px % 16:
            raise inconsistent(("width_px",), f"{self.width_px}", "a multiple of 16, as pictures are 16:9")
        return self


class Clocks(Section):
    """The drones' clocks (fleet/clock.py). With GNSS and no offset they are perfect."""

    gnss: bool = Field(True, description="Clocks follow GNSS at take-off; false lets them run freely.")
    offset_s: float = Field(
        0.0, ge=0, le=60, description="Standard deviation of each clock's constant error; 0 is perfect."
    )
    drift_ppm: float = Field(
        20.0,
        ge=0,
        le=100000,
        description="Standard deviation of a clock's rate error without GNSS; 20 is a plain crystal.",
    )
    drift_growth_ppm_per_min: float = Field(
        1.0,
        ge=0,
        le=100000,
        description="Standard deviation of the growth of that rate, as the crystal's heat changes.",
    )


class DroneOverride(Section):
    drone: DroneId = Field(description="Whose battery or load differs.")
    initial_soc: Soc | None = Field(None, description="As fleet.battery.initial_soc.")
    capacity_wh: float | None = Field(None, gt=0, le=5000, description="As fleet.battery.capacity_wh.")
    cell_resistance_mohm: float | None = Field(None, ge=0, le=500, description="As fleet.battery.cell_resistance_mohm.")
    cycles: float | None = Field(None, ge=0, le=10000, description="As fleet.battery.cycles.")
    payload_kg: float | None = Field(None, ge=0, le=100, description="As fleet.airframe.payload_kg.")


def _or_a_preset(schema: dict[str, Any]) -> None:
    """Let editors accept a preset's name beside the section and nothing."""
    schema["anyOf"].insert(0, {"enum": list(Airframe.presets)})


class Make(Section):
    """Drones of one kind within a fleet. What is left out is the fleet's."""

    name: str = Field(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", description="Its name.")
    drones: tuple[DroneId, ...] = Field(min_length=1, description="Which drones are of this make.")
    airframe: Airframe | None = Field(
        None,
        description="In place of fleet.airframe, as a whole.",
        json_schema_extra=_or_a_preset,
    )
    battery: Battery | None = Field(None, description="In place of fleet.battery, as a whole.")
    computer: Computer | None = Field(None, description="In place of fleet.computer, as a whole.")
    camera: Camera | None = Field(None, description="In place of fleet.camera, as a whole.")
    altitude_offset_m: float = Field(
        0.0, ge=-390, le=390, description="How much higher than fleet.formation.altitude_m its drones fly."
    )
    tx_power_dbm: float | None = Field(None, ge=-20, le=36, description="In place of radio.tx_power_dbm.")
    antenna: Literal["isotropic", "dipole"] | None = Field(None, description="In place of radio.antenna.")
    policy: str | None = Field(
        None,
        min_length=1,
        description="A policy of its own: a registered one, or path/to/file.py:function.",
    )
    policy_params: Params = Field({}, description="Keyword arguments of that policy.")
    detector: Literal["torch", "surrogate", "none"] | None = Field(
        None,
        description="In place of perception.detector. With none its drones send context alone, and use the boxes that they are sent.",
    )
    weights: str | None = Field(
        None, description="A network of its own, as perception.weights. Its maps are of another feature space."
    )
    codebook: str | None = Field(
        None, description="A codebook of its own, as perception.codebook. Only drones with the same one read its codes."
    )
    compute_delay_s: float | None = Field(None, ge=0, le=5, description="In place of perception.compute_delay_s.")
    feature_space: str | None = Field(
        None,
        max_length=32,
        pattern=r"^([A-Za-z0-9][A-Za-z0-9_.+-]*)?$",
        description="What its feature maps are called; only maps of one name can be fused. Left out, the make's name where its network is another than the fleet's, else the fleet's common one, which has no name.",
    )


class Network(NamedTuple):
    """What makes a drone's feature maps and boxes."""

    detector: str
    """A value of `perception.detector`; `none` for a drone that sends context alone."""
    weights: str | None
    """None takes the shipped ones."""
    codebook: str | None = None
    """None takes the one that lies beside the weights."""

    def maps_like(self, other: Network) -> bool:
        """Whether both make the same feature maps."""
        return self[:2] == other[:2]


class Fleet(Section):
    drones: int = Field(5, ge=1, le=MOST_DRONES, description="Number of drones; ids are 0 … drones − 1.")
    formation: Formation = Formation()
    route: Route = Route()
    groups: tuple[FlightGroup, ...] = Field(
        (), max_length=MOST_DRONES, description="Drones that fly apart from the formation, on ways of their own."
    )
    ground: tuple[GroundStation, ...] = Field(
        (),
        max_length=MOST_DRONES,
        description="Members of the fleet that stand on the ground: ground stations and relays.",
    )
    mobility: Mobility = Field(
        "formation",
        description="What moves the drones that are in no group: formation and route, a random model, or one of one's own (docs/guide/mobility.md), which begins in the formation's slots.",
    )
    mobility_params: Params = Field({}, description="Keyword arguments of the mobility model.")
    steering: Steering = Steering()
    motion: Motion = Motion()
    viewpoints: Viewpoints = Viewpoints()
    airframe: Airframe = Field(
        Airframe(),
        description="A preset or its values; zeng_2019 is the published power model's machine, solo a 3DR Solo with camera.",
        json_schema_extra=Airframe.names_in_schema,
    )
    battery: Battery = Battery()
    computer: Computer = Computer()
    camera: Camera = Camera()
    clock: Clocks = Clocks()
    sensor: Annotated[str, ModelName("sensor")] | None = Field(
        None,
        description="A model of one's own that adds errors to what drones believe of their pose (docs/guide/sensor.md).",
    )
    sensor_params: Params = Field({}, description="Its keyword arguments.")
    makes: tuple[Make, ...] = Field(
        (), description="Kinds of drones that differ from the fleet's; other drones are as the fleet says."
    )
    overrides: tuple[DroneOverride, ...] = Field(
        (), description="Drones whose battery or payload differs from their make's."
    )
    trace: str | None = Field(
        None,
        description="CSV or Parquet (fleet/traces.py): drones named in it take pose or battery from it, not from the models.",
    )
    origin: Origin | None = Field(
        None,
        description="Where a trace in latitude and longitude has its ENU (0, 0, 0); left out, at its first place, at its lowest altitude.",
    )

    @model_validator(mode="after")
    def _overrides_fit(self) -> Fleet:
        seen: set[int] = set()
        for i, override in enumerate(self.overrides):
            at = ("overrides", i, "drone")
            if override.drone >= self.drones:
                raise inconsistent(at, f"{override.drone}", f"below fleet.drones = {self.drones}")
            if override.drone in seen:
                raise inconsistent(at, f"{override.drone}", "named once, it has an override above")
            seen.add(override.drone)
            life_cycles = self.batteries[override.drone].life_cycles
            if override.cycles is not None and override.cycles > 2 * life_cycles:
                bound = f"at most twice the drone's battery.life_cycles = {life_cycles:g}"
                raise inconsistent(("overrides", i, "cycles"), f"{override.cycles:g}", bound)
        return self

    @model_validator(mode="after")
    def _everyone_moves_in_one_way(self) -> Fleet:
        seen: dict[int, str] = {}
        for at, drone in self._apart():
            if drone >= self.drones:
                raise inconsistent(at, f"{drone}", f"below fleet.drones = {self.drones}")
            if drone in seen:
                raise inconsistent(at, f"{drone}", f"named once, it is in {seen[drone]} already")
            seen[drone] = f"{at[0]}.{at[1]}"
        return self

    def _apart(self) -> Iterator[tuple[tuple[str | int, ...], int]]:
        """Every drone that is not in the fleet's formation, and where that is written."""
        for k, group in enumerate(self.groups):
            yield from ((("groups", k, "drones", i), drone) for i, drone in enumerate(group.drones))
        for k, station in enumerate(self.ground):
            yield ("ground", k, "drone"), station.drone

    @model_validator(mode="after")
    def _makes_fit(self) -> Fleet:
        names: set[str] = set()
        made: dict[int, str] = {}
        for i, make in enumerate(self.makes):
            if make.name in names:
                raise inconsistent(("makes", i, "name"), repr(make.name), "given once, it is a make above")
            names.add(make.name)
            for k, drone in enumerate(make.drones):
                at = ("makes", i, "drones", k)
                if drone >= self.drones:
                    raise inconsistent(at, f"{drone}", f"below fleet.drones = {self.drones}")
                if drone in made:
                    raise inconsistent(at, f"{drone}", f"of one make, it is of {made[drone]!r} already")
                made[drone] = make.name
            for drone in make.drones:
                for field, altitude_m in self._levels_m(drone).items():
                    if not 10.0 <= altitude_m + make.altitude_offset_m <= 400.0:
                        bound = f"such that its drones fly at 10 to 400 m, {field} is {altitude_m:g}"
                        raise inconsistent(("makes", i, "altitude_offset_m"), f"{make.altitude_offset_m:g}", bound)
        return self

    def make_of(self, drone: int) -> Make | None:
        """The make that names a drone; None for one that is as the fleet says."""
        return next((make for make in self.makes if drone in make.drones), None)

    @property
    def make_of_each(self) -> tuple[Make | None, ...]:
        """Each drone's make, as `make_of`."""
        return tuple(self.make_of(drone) for drone in range(self.drones))

    @property
    def airframes(self) -> tuple[Airframe, ...]:
        """Each drone's airframe, with its payload."""
        own = [self.airframe] * self.drones
        for make in self.makes:
            for drone in make.drones:
                own[drone] = make.airframe or self.airframe
        for override in self.overrides:
            if override.payload_kg is not None:
                own[override.drone] = own[override.drone].model_copy(update={"payload_kg": override.payload_kg})
        return tuple(own)

    @property
    def batteries(self) -> tuple[Battery, ...]:
        """Each drone's pack, overrides not included."""
        return tuple(self.battery if make is None else make.battery or self.battery for make in self.make_of_each)

    @property
    def computers(self) -> tuple[Computer, ...]:
        """Each drone's companion computer."""
        return tuple(self.computer if make is None else make.computer or self.computer for make in self.make_of_each)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Each drone's cameras."""
        return tuple(self.camera if make is None else make.camera or self.camera for make in self.make_of_each)

    @property
    def altitudes_m(self) -> tuple[float, ...]:
        """The height at which each drone flies first; of a ground station, that of its antenna."""
        heights = []
        for drone, make in enumerate(self.make_of_each):
            station = self.station(drone)
            group = self.group_of(drone) or self
            level_m = group.formation.altitude_m if station is None else station.position_m[2]
            heights.append(level_m if make is None or station else level_m + make.altitude_offset_m)
        return tuple(heights)

    def group_of(self, drone: int) -> FlightGroup | None:
        """The group in which a drone flies apart from the fleet's formation; None for one that does not."""
        return next((group for group in self.groups if drone in group.drones), None)

    def station(self, drone: int) -> GroundStation | None:
        """The ground station that a member of the fleet is; None for one that flies."""
        return next((station for station in self.ground if station.drone == drone), None)

    @property
    def without_camera(self) -> frozenset[int]:
        """The ground stations that have no camera."""
        return frozenset(station.drone for station in self.ground if not station.camera)

    @property
    def in_formation(self) -> tuple[int, ...]:
        """The drones of the fleet's own formation, in the order of its slots."""
        apart = {drone for _, drone in self._apart()}
        return tuple(drone for drone in range(self.drones) if drone not in apart)

    def _levels_m(self, drone: int) -> dict[str, float]:
        """The heights at which a drone flies, but for what its make adds, by field; none for a ground station."""
        if self.station(drone) is not None:
            return {}
        group = self.group_of(drone)
        if group is None:
            return {"formation.altitude_m": self.formation.altitude_m}
        at = f"groups.{self.groups.index(group)}"
        climbs = ((k, leg.altitude_m) for k, leg in enumerate(group.legs) if leg.altitude_m is not None)
        legs = {f"{at}.legs.{k}.altitude_m": altitude_m for k, altitude_m in climbs}
        return {f"{at}.formation.altitude_m": group.formation.altitude_m, **legs}
