"""The settings of the air as plain values: what `Air` and its parts need, with no scenario file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from sortie.radio.own_links import LinkModel, OwnPathLoss
from sortie.radio.rates import STANDARDS, StandardName

AntennaName = Literal["isotropic", "dipole"]
PathLossName = Literal["log_distance", "free_space", "two_ray"]
RateControlName = Literal["ideal", "minstrel"]
FadingName = Literal["exchange", "frame"]
AccessName = Literal["voice", "video", "best_effort", "background"]
_CHOICES = {
    "standard": tuple(STANDARDS),
    "antenna": get_args(AntennaName),
    "path_loss": get_args(PathLossName),
    "rate_control": get_args(RateControlName),
    "fading": get_args(FadingName),
    "context_class": get_args(AccessName),
    "payload_class": get_args(AccessName),
    "block_ack_window": (64, 256),
}


@dataclass(frozen=True, slots=True)
class BurstSettings:
    """Burst loss of each pair of drones: a good and a bad state, drawn step by step."""

    good_to_bad: float = 0.0
    """Probability a step that a good pair turns bad; 0: no bursts."""
    bad_to_good: float = 0.28
    """Probability a step that a bad pair turns good."""
    step_s: float = 1.0
    loss_good: float = 0.0
    """Probability that a good pair loses a frame at a try, in addition to the losses that follow from the SNR."""
    loss_bad: float = 1.0
    """The same for a bad pair."""


@dataclass(frozen=True, slots=True)
class AccessSettings:
    """How one class of traffic gets at the medium (EDCA)."""

    aifsn: int
    """Slots of idle medium, after a SIFS, before the backoff counts down."""
    cw_min: int
    """Largest backoff at a first try, in slots; one less than a power of two."""
    cw_max: int
    """Largest backoff after failures."""


@dataclass(frozen=True, slots=True)
class EdcaSettings:
    """The four classes of 802.11, highest priority first; defaults are the standard's."""

    voice: AccessSettings = AccessSettings(2, 3, 7)
    video: AccessSettings = AccessSettings(2, 7, 15)
    best_effort: AccessSettings = AccessSettings(3, 15, 1023)
    background: AccessSettings = AccessSettings(7, 15, 1023)


@dataclass(frozen=True, slots=True)
class AirSettings:
    """Radio, channel and transport of a whole fleet.

    Fields, units and defaults are those of a scenario's `radio` section; `own_antennas` are those of its makes. The exception
    is `framing`: there the caller of `Air.send` decides, with `piece_bytes`. The section checks every bound; this class
    checks names and channel widths only.

    Raises:
        ValueError: a field with a fixed set of values has another value.
    """

    standard: StandardName = "ax"
    """802.11 generation, one spatial stream."""
    carrier_ghz: float = 5.2
    bandwidth_mhz: int = 80
    """20, 40 or 80; 802.11n has no 80 MHz."""
    tx_power_dbm: float = 20.0
    """Transmit power, antenna gains included."""
    noise_figure_db: float = 7.0
    antenna: AntennaName = "isotropic"
    """Of every drone that `own_antennas` does not name."""
    own_antennas: Mapping[int, AntennaName] = field(default_factory=dict, hash=False)
    """Antennas of single drones, by id."""
    path_loss: PathLossName | OwnPathLoss = "log_distance"
    """A name, or a function of one's own (`sortie.radio.own_links`)."""
    path_loss_exponent: float = 2.1
    """Exponent of `log_distance` beyond 1 m."""
    ground_roughness_m: float = 0.05
    """Standard deviation of the ground's height, for `two_ray`."""
    shadowing_sigma_db: float = 3.5
    shadowing_time_s: float = 4.5
    """Correlation time of shadowing."""
    shadowing_distance_m: float | None = None
    """Correlation distance of shadowing; None: every pair has its own shadowing, correlated in time only."""
    rician_k_db: float = 12.0
    fading: FadingName = "exchange"
    """A link's fade is drawn anew for each transmission (`exchange`), or once a frame (`frame`)."""
    preamble_detection_dbm: float = -82.0
    """Weakest frame that is received, and that holds others back (carrier sense)."""
    group_rate_mbps: float = 6.0
    """Basic rate of group-addressed frames."""
    rate_control: RateControlName = "ideal"
    """`ideal` picks the rate by the SNR of the frame before, `minstrel` by statistics of acknowledged frames."""
    context_class: AccessName = "voice"
    """EDCA class of group-addressed frames."""
    payload_class: AccessName = "best_effort"
    """EDCA class of unicast frames."""
    edca: EdcaSettings = EdcaSettings()
    rts: bool = False
    """Whether a request and a clearance to send (RTS/CTS) precede each A-MPDU."""
    block_ack_window: int = 64
    """Frames that may wait for their block acknowledgement: 64 or 256."""
    retry_limit: int = 7
    """MAC retries of a unicast frame."""
    max_ampdu_frames: int = 64
    """Frames that are aggregated into one A-MPDU."""
    fragment_bytes: int = 1344
    """Payload of a DDS fragment."""
    relay_max_hops: int = 1
    """Most hops of a payload's route; 1 sends directly."""
    bursts: BurstSettings = BurstSettings()
    link: Callable[..., LinkModel] | None = None
    """Makes a model of one's own that changes the SNR of every link, frame by frame; called with the number of drones, the
    time between two frames, and a random generator."""
    trace: str | None = None
    """CSV or Parquet file of links whose SNR, loss or goodput replaces the models' (`radio/channel/traces.py`)."""
    heartbeat_s: float = 0.02
    """Heartbeat period of the reliable writer."""
    nack_delay_s: float = 0.005
    """The reader's delay before it requests a repair."""

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            self._check(name, allowed)
        for drone, pattern in self.own_antennas.items():
            if pattern not in _CHOICES["antenna"]:
                raise ValueError(f"own_antennas[{drone}] is {pattern!r}, must be one of {list(_CHOICES['antenna'])}")
        self._check("bandwidth_mhz", STANDARDS[self.standard].rates_mbps)

    def _check(self, name: str, allowed: Iterable[object]) -> None:
        value, choices = getattr(self, name), list(allowed)
        if value not in choices and not (name == "path_loss" and callable(value)):
            raise ValueError(f"{name} is {value!r}, must be one of {choices}")

    def antennas(self, drones: int) -> tuple[AntennaName, ...]:
        """Each drone's antenna."""
        return tuple(self.own_antennas.get(drone, self.antenna) for drone in range(drones))

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> AirSettings:
        """Settings from a mapping, such as a scenario's `radio` section; `bursts` and `edca` are mappings too.

        Raises:
            TypeError: an unknown name.
            ValueError: see the class.
        """
        edca = {name: AccessSettings(**each) for name, each in values.get("edca", {}).items()}
        parts = {"bursts": BurstSettings(**values.get("bursts", {})), "edca": EdcaSettings(**edca)}
        return cls(**{**values, **parts})
