"""`perception`: the scene, the detector, fusion and scoring."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import MOST_DRONES, ModelName, Params, Section, inconsistent
from sortie.scenarios.schema.mission import Target


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
    trucks: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Share of the moving vehicles that are trucks, 7 to 9 m long; vans give way first, and none park.",
    )
    sun_azimuth_deg: float = Field(212.5, ge=0, le=360, description="Where the sun stands, from east towards north.")
    sun_elevation_deg: float = Field(56.9, ge=20, le=90, description="How high it stands; low suns cast long shadows.")
    overcast: float = Field(0.0, ge=0, le=1, description="Cloud: 0 casts dark shadows, 1 casts none.")
    brightness: float = Field(1.0, ge=0.1, le=1.5, description="Exposure: a factor on every image.")


class Person(Target):
    """Walks from `begin_s` on; stands before, and at the end of the way."""

    speed_mps: float = Field(1.4, gt=0, le=10, description="Walking speed.")
    begin_s: float = Field(0.0, ge=0, description="When the person begins to walk.")


class Thermal(Section):
    """A declared sensor model (`perception/thermal.py`); its defaults are assumptions, not measurements."""

    field_of_view_deg: float = Field(70.0, gt=0, lt=170, description="Full angle of its cone, straight down.")
    near_probability: float = Field(0.9, ge=0, le=1, description="Probability of finding a near person in one frame.")
    half_range_m: float = Field(90.0, gt=0, le=2000, description="Distance at which that probability is halved.")
    range_width_m: float = Field(12.0, gt=0, le=500, description="Over which distance the probability falls.")
    false_alarms_per_min: float = Field(0.05, ge=0, le=600, description="False alarms of a drone a minute.")
    position_error_m: float = Field(
        1.0, ge=0, le=50, description="Standard deviation of a person's place, along each axis."
    )
    remembers_s: float = Field(
        3.0, gt=0, le=600, description="So long after a detection a drone takes the person to be there."
    )


FUSIONS = ("none", "late", "fcooper", "v2vnet", "disconet", "when2com", "where2comm")
"""The built-in ones. The others need the torch detector."""


class Perception(Section):
    detector: Annotated[str, ModelName("detector", ("torch", "surrogate", "recorded", "none"))] = Field(
        "torch",
        description="The detector: the network, its fast surrogate, a recording of another model, one of one's own (docs/guide), or none: the traffic alone.",
    )
    detector_params: Params = Field({}, description="Keyword arguments of a detector of one's own.")
    fusion: Annotated[str, ModelName("fusion", FUSIONS)] = Field(
        "disconet",
        description="How what peers sent is fused, or a fusion of one's own (docs/guide); weights belong to a fusion, none, late and one's own take any; the surrogate takes its calibration's, or none.",
    )
    fusion_params: Params = Field({}, description="Keyword arguments of a fusion of one's own.")
    weights: str | None = Field(
        None,
        description="A safetensors file: a network's. The surrogate takes the calibration beside it (`NAME.surrogate.safetensors`), or the file if it is one. Left out, the default network of the fusion; `disconet.safetensors` names the coarse one, which was the default before and was trained as those of other fusions were.",
    )
    codebook: str | None = Field(
        None,
        description="A safetensors file by which features become codes (`python -m research fit codebook`); left out, the one that lies beside the weights.",
    )
    code_bytes: int = Field(10, ge=1, le=20, description="Bytes of a feature cell that is sent as a code.")
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
        2.0,
        ge=1e-3,
        le=10,
        description="How often accuracy is scored, at times that keep time with no rate; traffic runs at context.rate_hz.",
    )
    egos: int = Field(
        50,
        ge=1,
        le=MOST_DRONES,
        description="How many drones are scored at each scored moment. A larger fleet takes turns in a random order; it is scored whole where motion_compensation is false, as a drone's boxes then depend on where all others are.",
    )
    tracking_rate_hz: float = Field(
        2.0,
        ge=1e-3,
        le=10,
        description="How often a drone's tracker takes in the drone's own detections; at scored frames, where there are enough.",
    )
    compute_delay_s: float = Field(0.03, ge=0, le=5, description="From sensing to features ready to send.")
    fusion_delay_s: float = Field(0.095, ge=0, le=5, description="From a frame's begin to its fusion and scoring.")
    max_age_s: float = Field(
        0.5,
        gt=0,
        le=60,
        description="Received payloads older than this are not fused; a drone that rested longer has no look of its own.",
    )
    motion_compensation: bool = Field(
        True, description="Late features lie where their sender was when it looked; false: where it is at fusion."
    )
    join: Literal["nms", "average"] = Field(
        "average",
        description="How boxes of several drones become one list: of those that overlap, their weighted mean (average), or only the best (nms).",
    )
    maps_bring_boxes: bool = Field(
        False,
        description="With each feature map, or codes of one, go the boxes that its sender found when it last fused the maps that it held (perception/README.md says what this needs).",
    )
    match_poses: bool = Field(
        False,
        description="Receivers correct the poses of all drones that they hear, and their own, by the cars that these have in common, before they fuse; boxes of the sender's own detection go with its maps for that (perception/README.md says what this needs).",
    )
    score_threshold: float = Field(0.25, ge=0, le=1, description="Detections below this score are dropped.")
    unsent_cells: Literal["masked", "zero"] = Field(
        "masked",
        description="Cells that were not sent: out of the fusion softmax, or zeros in it (as in the paper's instrument).",
    )
    people: tuple[Person, ...] = Field((), max_length=100, description="People who walk about.")
    thermal: Thermal | None = Field(
        None, description="A thermal camera on every drone, which finds people; left out, nobody finds them."
    )
    scene: Scene = Scene()

    @property
    def classes(self) -> tuple[str, ...]:
        """The classes of targets that drones look for."""
        return "car", *(["truck"] if self.scene.trucks > 0.0 else []), *(["person"] if self.thermal is not None else [])

    @model_validator(mode="after")
    def _recording_where_recorded(self) -> Perception:
        recorded = self.detector == "recorded"
        if recorded and self.recording is None:
            raise inconsistent(("recording",), "missing", "given where detector is recorded")
        for name in ("recording", "recorded_fusion"):
            if not recorded and getattr(self, name) is not None:
                raise inconsistent((name,), f"{getattr(self, name)!r}", f"left out where detector is {self.detector}")
        if self.fusion not in FUSIONS and self.detector not in ("torch", "none"):
            raise inconsistent(("fusion",), f"{self.fusion!r}", f"built in where detector is {self.detector}")
        return self
