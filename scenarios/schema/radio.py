"""`radio`: standard, channel, losses, framing and transport."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import ModelName, Params, Section, inconsistent

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


AccessName = Literal["voice", "video", "best_effort", "background"]


def _aifsn(slots: int) -> Any:
    return Field(slots, ge=1, le=15, description="Slots of idle medium, after a SIFS, before the backoff counts down.")


def _window(slots: int, when: str) -> Any:
    return Field(slots, ge=0, le=32767, description=f"Largest backoff {when}, in slots.")


class Access(Section):
    """How a class of traffic gets at the medium."""

    aifsn: int = _aifsn(3)
    cw_min: int = _window(15, "at a first try")
    cw_max: int = _window(1023, "after failures")

    @model_validator(mode="after")
    def _grows(self) -> Access:
        if self.cw_max < self.cw_min:
            raise inconsistent(("cw_max",), f"{self.cw_max}", f"at least cw_min = {self.cw_min}")
        return self


class Voice(Access):
    aifsn: int = _aifsn(2)
    cw_min: int = _window(3, "at a first try")
    cw_max: int = _window(7, "after failures")


class Video(Access):
    aifsn: int = _aifsn(2)
    cw_min: int = _window(7, "at a first try")
    cw_max: int = _window(15, "after failures")


class Background(Access):
    aifsn: int = _aifsn(7)


class Edca(Section):
    voice: Voice = Voice()
    video: Video = Video()
    best_effort: Access = Access()
    background: Background = Background()


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
    path_loss: Annotated[str, ModelName("path_loss", ("log_distance", "free_space", "two_ray"))] = Field(
        "log_distance", description="Path loss; two_ray adds the ground's reflection (ground is z = 0) to free space."
    )
    path_loss_params: Params = Field({}, description="Keyword arguments of a path loss of one's own.")
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
    fading: Literal["exchange", "frame"] = Field(
        "exchange", description="A link's fade is drawn anew for each transmission, or once a frame."
    )
    preamble_detection_dbm: float = Field(
        -82.0,
        ge=-120,
        le=-30,
        description="Weakest frame that is received, and that holds others back (carrier sense).",
    )
    group_rate_mbps: float = Field(6.0, ge=1, le=54, description="Basic rate of group-addressed frames (descriptors).")
    rate_control: Literal["ideal", "minstrel"] = Field(
        "ideal", description="Who picks the MCS: the SNR of the frame before, or statistics of what got through."
    )
    context_class: AccessName = Field("voice", description="EDCA class of group-addressed frames (descriptors).")
    payload_class: AccessName = Field("best_effort", description="EDCA class of unicast frames.")
    edca: Edca = Edca()
    rts: bool = Field(False, description="Whether RTS and CTS precede each A-MPDU.")
    block_ack_window: Literal[64, 256] = Field(
        64, description="Frames that may wait for their block acknowledgement; at least max_ampdu_frames."
    )
    retry_limit: int = Field(
        7, ge=0, le=32, description="MAC retries of a unicast frame whose block ack says that it is missing."
    )
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
    link: Annotated[str, ModelName("link")] | None = Field(
        None, description="A model of one's own that changes the SNR of every link, frame by frame (docs/guide)."
    )
    link_params: Params = Field({}, description="Its keyword arguments.")
    trace: str | None = Field(
        None,
        description="CSV or Parquet (radio/channel/traces.py): links named in it take SNR, loss or goodput from it, not from the models.",
    )
    heartbeat_s: float = Field(0.02, gt=0, le=10, description="Heartbeat period of the reliable writer.")
    nack_delay_s: float = Field(0.005, ge=0, le=10, description="The reader's delay before it asks for a repair.")

    @model_validator(mode="after")
    def _width_exists(self) -> Radio:
        if self.standard == "n" and self.bandwidth_mhz == 80:
            raise inconsistent(("bandwidth_mhz",), "80", "20 or 40 where standard is n")
        return self

    @model_validator(mode="after")
    def _a_tile_fits(self) -> Radio:
        if self.framing == "tiles" and self.fragment_bytes < MIN_TILE_BYTES:
            bound = f"at least {MIN_TILE_BYTES} where framing is tiles, for a header and one cell"
            raise inconsistent(("fragment_bytes",), f"{self.fragment_bytes}", bound)
        return self
