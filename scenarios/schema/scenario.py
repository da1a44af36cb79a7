"""`Scenario`: one sortie, and the JSON Schema of it for editors."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

from pydantic import Field, model_validator

from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.schema.base import Section, inconsistent
from sortie.scenarios.schema.context import Context
from sortie.scenarios.schema.events import AnyEvent
from sortie.scenarios.schema.events.base import Event
from sortie.scenarios.schema.expect import DecisionExpectation, Expectation
from sortie.scenarios.schema.fleet import Camera, Fleet, Make, Network
from sortie.scenarios.schema.limits import Limits
from sortie.scenarios.schema.metric import Metric
from sortie.scenarios.schema.mission import Mission
from sortie.scenarios.schema.perception import Perception
from sortie.scenarios.schema.policy import PolicyChange, PolicyCommand, PolicySection, ViewReplay
from sortie.scenarios.schema.radio import Radio
from sortie.scenarios.schema.record import RecordSection

LEARNED = ("torch", "surrogate")
"""Detectors with weights, which makes may name."""
NO_NETWORK = "none"
"""The feature space of drones without a network: makes without a detector, ground stations without cameras."""
GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0


class Scenario(Section):
    """One sortie: who flies, why, over which air, seeing what, by which policy."""

    name: str = Field(pattern=r"^[a-z0-9_]+$", max_length=64, description="Short name, as in the file's name.")
    description: str = Field("", max_length=2000, description="One paragraph for people.")
    seed: int = Field(1, ge=0, lt=2**63, description="Every random draw follows from it.")
    duration_s: float = Field(120.0, ge=1e-3, le=7200, description="Length of the sortie; the end is exclusive.")
    fleet: Fleet = Fleet()
    mission: Mission = Mission()
    radio: Radio = Radio()
    context: Context = Context()
    perception: Perception = Perception()
    policy: PolicySection = PolicySection()
    record: RecordSection = RecordSection()
    limits: Limits = Limits()
    events: tuple[AnyEvent, ...] = Field((), max_length=1000, description="What goes wrong, and when.")
    metrics: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")], Metric] = Field(
        {}, description="Figures of one's own, by name; in the outcome as metrics.NAME (docs/guide/metric.md)."
    )
    expect: tuple[Expectation, ...] = Field(
        (), max_length=1000, description="What the outcome must satisfy; asserted by `sortie check`."
    )
    expect_decisions: tuple[DecisionExpectation, ...] = Field(
        (), max_length=1000, description="What the gates must take up, and when; asserted by `sortie check`."
    )
    expect_no_other_changes: bool = Field(
        False, description="Whether each change of what a link carries must be one that `expect_decisions` lists."
    )

    @property
    def publishes_rosters(self) -> bool:
        """Whether descriptors say which members of the fleet their drone knows: where the scenario wants it, and in large fleets."""
        return self.context.roster or self.fleet.drones > LISTED_IDS

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        n = self.fleet.drones
        for where, who in self._drones_named():
            if who >= n:
                raise inconsistent(where, f"{who}", f"below fleet.drones = {n}")
        for i, event in enumerate(self.events):
            drone = getattr(event, "drone", None)
            misfit = event.misfit(None if drone is None else self.fleet.station(drone))
            if misfit is not None:
                field, value, bound = misfit
                raise inconsistent(("events", i, field), value, bound)
        self._maps_can_bring_boxes()
        self._stations_stay()
        # What is done at an instant must have its instant. Phases and expected decisions may lie beyond the end: missions
        # are flown shortened, and an expectation of a time that was not flown fails.
        policy = self.policy
        instants: dict[tuple[str, ...], Sequence[Event | PolicyChange | PolicyCommand | ViewReplay]] = {
            ("events",): self.events,
            ("policy", "changes"): policy.changes,
            ("policy", "commands"): policy.commands,
            ("policy", "replays"): policy.replays,
        }
        for section, each in instants.items():
            for i, one in enumerate(each):
                if one.at_s is not None and one.at_s >= self.duration_s:
                    bound = f"below duration_s = {self.duration_s:g}"
                    raise inconsistent((*section, i, "at_s"), f"{one.at_s:g}", bound)
        self._makes_fit()
        degraded, detached = self.context.degraded_after_periods, self.context.detached_after_periods
        if detached <= degraded:
            bound = f"above degraded_after_periods = {degraded:g}"
            raise inconsistent(("context", "detached_after_periods"), f"{detached:g}", bound)
        return self

    def _maps_can_bring_boxes(self) -> None:
        """Check that boxes are wanted with maps only where receivers fuse whole maps by the torch detector."""
        perception = self.perception
        unsupported = [
            *(f"a drone's detector is {n.detector}" for n in self.networks if n.detector not in ("torch", "none")),
            *([f"fusion is {perception.fusion}"] if perception.fusion in ("none", "late") else []),
            *(["radio.framing is tiles"] if self.radio.framing == "tiles" else []),
        ]
        # without compensation, what a drone finds depends on which drones are scored at the moment
        here_only = [] if perception.motion_compensation else ["motion_compensation is false"]
        for option, refused in (("match_poses", unsupported), ("maps_bring_boxes", unsupported + here_only)):
            if getattr(perception, option) and refused:
                raise inconsistent(("perception", option), "true", f"false where {refused[0]}")

    def _stations_stay(self) -> None:
        """Check that no ground station is in a group with a reserve, which may send it home."""
        for k, group in enumerate(self.mission.groups):
            for i, drone in enumerate(group.drones):
                if group.reserve and self.fleet.station(drone) is not None:
                    bound = "a drone that flies where there is a reserve, it is a ground station"
                    raise inconsistent(("mission", "groups", k, "drones", i), f"{drone}", bound)

    def _makes_fit(self) -> None:
        """Check what makes say against the other sections."""
        fleets = self.perception.detector
        for i, make in enumerate(self.fleet.makes):
            at = ("fleet", "makes", i)
            if make.detector is not None and fleets not in LEARNED:
                raise inconsistent(
                    (*at, "detector"), repr(make.detector), f"left out where perception.detector is {fleets}"
                )
            own = make.detector or fleets
            if make.weights is not None and own not in LEARNED:
                raise inconsistent((*at, "weights"), repr(make.weights), f"left out for {own}")
            for name in ("tx_power_dbm", "antenna"):
                value = getattr(make, name)
                if value is not None and self.radio.trace is not None:
                    bound = "left out where radio.trace says what links are worth"
                    shown = f"{value:g}" if isinstance(value, float) else repr(value)
                    raise inconsistent((*at, name), shown, bound)
        first: dict[str, int] = {}
        networks, spaces = self.networks, self.feature_spaces
        for drone, (network, space, blind) in enumerate(zip(networks, spaces, self.context_only, strict=True)):
            if blind:
                continue
            other, reserved = first.setdefault(space, drone), space == NO_NETWORK
            if reserved or not network.maps_like(networks[other]):
                which = next(d for d in (drone, other) if self.fleet.make_of(d) is not None)
                i = next(k for k, make in enumerate(self.fleet.makes) if which in make.drones)
                named = "drones without a network" if reserved else f"drone {drone + other - which}"
                bound = f"another name than that of {named}" + ("" if reserved else ", which has another network")
                raise inconsistent(("fleet", "makes", i, "feature_space"), repr(space), bound)
        for drone, (network, camera) in enumerate(zip(networks, self.fleet.cameras, strict=True)):
            if network.detector == "surrogate" and camera.width_px != Camera().width_px:
                bound = f"{Camera().width_px} for the surrogate, which was fitted to such pictures"
                makes = [k for k, m in enumerate(self.fleet.makes) if drone in m.drones and m.camera is not None]
                where = ("fleet", "makes", makes[0], "camera") if makes else ("fleet", "camera")
                raise inconsistent((*where, "width_px"), f"{camera.width_px}", bound)

    @property
    def networks(self) -> tuple[Network, ...]:
        """Each drone's network."""
        common = Network(self.perception.detector, self.perception.weights, self.perception.codebook)
        return tuple(common if make is None else self._network(make) for make in self.fleet.make_of_each)

    def _network(self, make: Make) -> Network:
        common = self.perception
        detector = make.detector or common.detector
        weights = common.weights if make.weights is None and detector == common.detector else make.weights
        own = make.codebook or (common.codebook if (detector, weights) == (common.detector, common.weights) else None)
        return Network(detector, weights, own)

    @property
    def feature_spaces(self) -> tuple[str, ...]:
        """Each drone's feature space; empty is the fleet's common one, and `NO_NETWORK` that of drones without a network."""
        common = Network(self.perception.detector, self.perception.weights)

        def space(make: Make | None, blind: bool) -> str:
            if blind:
                return NO_NETWORK
            if make is None:
                return ""
            if make.feature_space is not None:
                return make.feature_space
            return "" if self._network(make).maps_like(common) else make.name

        return tuple(map(space, self.fleet.make_of_each, self.context_only))

    @property
    def context_only(self) -> tuple[bool, ...]:
        """Whether each drone is of a make without a detector, or a ground station without cameras."""
        blind = self.fleet.without_camera
        makes = enumerate(self.fleet.make_of_each)
        return tuple(i in blind or (make is not None and make.detector == "none") for i, make in makes)

    @property
    def compute_delays_s(self) -> tuple[float, ...]:
        """Each drone's time from sensing to features ready to send."""
        common = self.perception.compute_delay_s
        own = [None if make is None else make.compute_delay_s for make in self.fleet.make_of_each]
        return tuple(common if delay_s is None else delay_s for delay_s in own)

    def _drones_named(self) -> Iterator[tuple[tuple[str | int, ...], int]]:
        """Every drone that a section outside of `fleet` names, and where."""
        ends: dict[str, Sequence[Event | DecisionExpectation]] = {
            "events": self.events,
            "expect_decisions": self.expect_decisions,
        }
        for section, each in ends.items():
            for i, one in enumerate(each):
                for end in ("drone", "peer"):
                    who = getattr(one, end, None)
                    if who is not None:
                        yield (section, i, end), who
        for i, replay in enumerate(self.policy.replays):
            yield ("policy", "replays", i, "drone"), replay.drone
        several = {
            ("policy", "commands"): [command.drones for command in self.policy.commands],
            ("mission", "groups"): [group.drones for group in self.mission.groups],
        }
        for where, lists in several.items():
            for i, drones in enumerate(lists):
                for k, who in enumerate(drones):
                    yield (*where, i, "drones", k), who

    @property
    def frame_s(self) -> float:
        """Length of a frame, the descriptor period, s."""
        return 1.0 / self.context.rate_hz

    @property
    def frames(self) -> int:
        """Frames that begin before the end (end exclusive)."""
        return math.ceil(round(self.duration_s * self.context.rate_hz, 9))

    @property
    def scoring_periods(self) -> list[range]:
        """The frames of each scoring period; there are `perception.sample_rate_hz` periods a second."""
        share = min(1.0, self.perception.sample_rate_hz / self.context.rate_hz)
        before = [math.floor(round((frame - 1) * share, 9)) for frame in range(self.frames + 1)]
        begins = [frame for frame in range(self.frames) if before[frame + 1] > before[frame]]
        return [range(begin, end) for begin, end in zip(begins, [*begins[1:], self.frames], strict=True)]

    @property
    def scored_frames(self) -> list[int]:
        """The frames in which accuracy is scored: one of each scoring period, and the first frame of all.

        A frame's place in its period follows the multiples of the golden ratio. They fill the period evenly and keep time
        with no rate, so payloads of every rate are met at every age. All policies are scored in the same frames.
        """
        return [period[int(k * GOLDEN_RATIO % 1.0 * len(period))] for k, period in enumerate(self.scoring_periods)]

    @property
    def scorable_drones(self) -> list[int]:
        """The drones that may be scored: all but ground stations that are not."""
        unscored = {station.drone for station in self.fleet.ground if not station.scored}
        return [drone for drone in range(self.fleet.drones) if drone not in unscored]

    @property
    def scored_drones(self) -> int:
        """How many of them are scored at each scored moment."""
        perception, every = self.perception, len(self.scorable_drones)
        return min(perception.egos, every) if perception.motion_compensation else every

    @property
    def takes_turns(self) -> bool:
        """Whether the fleet is too large to score all drones at each scored moment."""
        return self.scored_drones < len(self.scorable_drones)

    @property
    def tracked_frames(self) -> list[int]:
        """The frames from which trackers take in a look, `perception.tracking_rate_hz` of them a second.

        One in each period: the first scored frame in it, where images are computed anyway, or else its first frame.
        """
        each = max(1.0, self.context.rate_hz / self.perception.tracking_rate_hz)
        scored = self.scored_frames
        frames = []
        for k in range(math.ceil(round(self.frames / each, 9))):
            first, last = math.ceil(round(k * each, 9)), math.ceil(round((k + 1) * each, 9))
            at = bisect_left(scored, first)
            frames.append(scored[at] if at < len(scored) and scored[at] < last else first)
        return frames


def json_schema() -> dict[str, Any]:
    """The JSON Schema of a scenario, for editors."""
    return Scenario.model_json_schema()
