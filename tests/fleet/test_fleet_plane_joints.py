"""What one part of a drone hands to another: its make, its capture, its clock, and what it knows of its peers.

1. The computer of a drone's own make, and what slows it.
2. A look stands for a second from its capture, moved to where the drone is; a blocked camera gives none.
3. A payload is made of its capture, however late it is sent: cells, boxes and people by the pose of then.
4. What a payload says of itself: classes, codes and codebooks, tracks, tiles.
5. Clocks: an offset is told by the own clock, and is forgotten when it is gone.
6. What is counted of a payload: maps, and the newest one of each peer.
7. Forms of descriptors: what rounding takes, no doubt comes of it.
8. Faults of sensors: when they begin and end, and that they add up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from agent_rig import Rig, capture, descriptor, memory, payload

from sortie.fleet.chart import Chart
from sortie.fleet.clock import WINDOW, PeerClocks, oscillators
from sortie.fleet.coverage import NOTHING_SEEN, Poses, View, footprint_radius_m, placed, views
from sortie.fleet.flight.motion import fly
from sortie.fleet.gate import Gate, make_payload
from sortie.fleet.lies import falsified
from sortie.fleet.memory import PeerMemory, Received, hear
from sortie.fleet.messages.auth import Opened
from sortie.fleet.messages.compact import Form
from sortie.fleet.messages.wire import decode_descriptor
from sortie.fleet.peers import PeerTable
from sortie.fleet.plane import DroneStatus, Equipment, FleetRules, codebooks
from sortie.fleet.senses import FlightSenses, Sensed, believed
from sortie.fleet.sensor_faults import sensor_errors
from sortie.fleet.standings import Standing
from sortie.fleet.trust import Arrival, battery_doubt, coverage_doubt, goodput_doubt, judge
from sortie.perception import budget
from sortie.perception.geometry import USUAL
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Clocks, Fleet, Scene

PLAIN = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (-100.0, -100.0, 100.0, 100.0)).height_field
FEATURES = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, 0.1, 1.0)


def to_all(directive: Directive) -> Any:
    return lambda view: [directive._replace(destination=p) for p in view.peers]


# --- looks and payloads --------------------------------------------------------------------------------


def test_a_drone_computes_as_long_as_its_make_does() -> None:
    """Another drone's make, or the fleet's own time, is not its own."""
    rig = Rig(to_all(FEATURES), dwell_s=0.0, compute_delay_s=0.02, makes={0: Equipment(0.07), 1: Equipment(0.03)})
    rig.hear(1)
    rig.env.run(until=0.099)
    assert [t_s for t_s, *_ in rig.sent] == pytest.approx([0.01 + 0.07])


class Moves(Rig):
    """Flies a cell north in each frame; its cameras see one cell, poorly."""

    def sense(self, frame: int) -> Sensed:
        return super().sense(frame)._replace(view=View(frame, 0, b"\x01" + bytes(63)))


def test_a_look_stands_for_a_second_from_its_capture_where_it_saw() -> None:
    """The first look, and no other: its camera is blocked from then on. Its grid is told on the cells of each new place."""
    rig = Moves(lambda view: [], dwell_s=0.0)
    rig.env.run(until=0.05)
    rig.memory.status.blocked = {3}
    rig.env.run(until=1.35)
    grids = [decode_descriptor(datagram).coverage_grid for _, datagram in rig.published]
    seen = View(0, 0, b"\x01" + bytes(63))
    assert grids[:11] == [NOTHING_SEEN, *(placed(seen, row, 0) for row in range(1, 11))]
    assert grids[11:] == [NOTHING_SEEN] * 3
    assert rig.memory.status.work.looks == 1
    north = View(5, 0, b"\x01" + bytes(63))
    assert placed(north, 4, 0) == bytes(4) + b"\x01" + bytes(
        59
    )  # a row further north in a grid that begins further south


def test_new_ground_is_new_where_it_was_seen() -> None:
    """A grid that is told from another place marks the cells of the ground, not those of the grid: nothing is new twice."""

    class Sees(Rig):
        def sense(self, frame: int) -> Sensed:
            return super().sense(frame)._replace(view=View(frame // 2, 0, bytes(32) + b"\xaa" * 4 + bytes(28)))

    rig = Sees(lambda view: [], dwell_s=0.0)
    rig.env.run(until=0.05)
    rig.memory.status.blocked = {0}
    rig.env.run(until=0.75)
    flags = [decode_descriptor(datagram).novelty_flags for _, datagram in rig.published]
    assert flags == [0, 1, 0, 0, 0, 0, 0, 0]


class Late(Rig):
    """Flies east, 30 m a frame, and computes for two and a half frames; writes down what it is asked of which capture."""

    def sense(self, frame: int) -> Sensed:
        at = (30.0 * frame, 0.0, 60.0)
        now = capture(0, frame * 0.1)._replace(position_m=at, est_position_m=at)
        return super().sense(frame)._replace(capture=now)

    asked: list[tuple[str, float]]

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        self.asked.append(("boxes", capture.t_s))
        return 3

    def tracks_in(self, capture: Capture, roi: Disc | None) -> None:
        self.asked.append(("tracks", capture.t_s))

    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes:
        self.asked.append(("people", capture.t_s))
        return Boxes.empty()


@pytest.mark.parametrize("rung", [Representation.FEATURES, Representation.TRACKS, Representation.DETECTIONS])
def test_a_payload_is_of_its_capture_however_late_it_is_sent(rung: Representation) -> None:
    roi = Disc(0.0, 0.0, 60.0)
    rig = Late(
        to_all(FEATURES._replace(representation=rung, roi=roi)), dwell_s=0.0, compute_delay_s=0.25, people=True,
        detached_after_periods=50.0, degraded_after_periods=40.0,
    )  # fmt: skip
    rig.asked = []
    rig.hear(1)
    rig.env.run(until=0.8)
    assert [c.t_s for _, _, _, c in rig.sent] == pytest.approx([0.1 * k for k in range(len(rig.sent))])
    if rung == Representation.FEATURES:
        cells = [budget.cells_sent(1.0, roi, 30.0 * k, 0.0, 0.0) for k in range(len(rig.sent))]
        assert [p.cells for _, _, p, _ in rig.sent] == cells
        assert len(set(cells)) > 2
    else:
        kinds = {"boxes", "people"} | ({"tracks"} if rung == Representation.TRACKS else set())
        for kind in kinds:
            times_s = [t_s for what, t_s in rig.asked if what == kind]
            assert times_s == pytest.approx([0.1 * k for k in range(len(times_s))])
            assert times_s


def test_a_handshake_is_of_use_for_a_frame_however_seldom_descriptors_are_published() -> None:
    class Shakes(Rig):
        deadlines: list[float]

        def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None:
            self.deadlines.append(deadline_s)

    rig = Shakes(lambda view: [], handshake=64, dwell_s=0.0, publish_every=5)
    rig.deadlines = []
    rig.hear(1)
    rig.env.run(until=0.35)
    assert rig.deadlines == [0.1] * 3


# --- what a payload says of itself -----------------------------------------------------------------------


def test_a_payload_of_codes_names_its_codebook_and_others_do_not() -> None:
    for rung, codebook in ((Representation.FEATURES, ""), (Representation.CODES, "ab" * 7), (Representation.RAW, "")):
        rig = Rig(to_all(FEATURES._replace(representation=rung)), dwell_s=0.0)
        rig.memory.status.codebook, rig.memory.status.feature_space = "ab" * 7, "own"
        rig.hear(1)
        rig.env.run(until=0.09)
        ((_, _, sent, _),) = rig.sent
        assert (sent.feature_space, sent.codebook) == ("own", codebook)


def test_detections_that_name_their_class_are_larger() -> None:
    sizes = []
    for classes in (False, True):
        rig = Rig(to_all(FEATURES._replace(representation=Representation.DETECTIONS)), dwell_s=0.0, classes=classes)
        rig.hear(1)
        rig.env.run(until=0.09)
        sizes.append(rig.sent[0][2].size_bytes)
    assert sizes[1] == sizes[0] + 3 * (
        budget.content_bytes("detections", boxes=1, classes=True) - budget.content_bytes("detections", boxes=1)
    )
    assert sizes[1] > sizes[0]


def people(n: int) -> Boxes:
    return Boxes(np.zeros((n, 2)), np.ones((n, 2)), np.zeros(n), np.full(n, 0.9))


def test_people_of_the_region_are_among_the_detections() -> None:
    """They count as boxes, of the region alone, where no tracker tells of the region."""
    roi, asked = Disc(5.0, 5.0, 30.0), []

    def told(what: str, answer: Any) -> Any:
        return lambda where: asked.append((what, where)) or answer

    of = {"count_boxes": told("boxes", 4), "tracks_in": told("tracks", None), "people_in": told("people", people(2))}
    made = make_payload(FEATURES._replace(representation=Representation.TRACKS, roi=roi), 0.0, 0.0, 0.0, **of)
    alone = make_payload(
        FEATURES._replace(representation=Representation.TRACKS, roi=roi), 0.0, 0.0, 0.0, lambda where: 6
    )
    assert made is not None
    assert alone is not None
    assert made.people is not None
    assert (made.boxes, len(made.people), made.size_bytes) == (6, 2, alone.size_bytes)
    assert dict(asked) == dict.fromkeys(("boxes", "tracks", "people"), roi)


def test_codes_are_one_sample_also_where_features_are_tiles() -> None:
    for rung, tiled in ((Representation.FEATURES, True), (Representation.CODES, False)):
        made = make_payload(
            FEATURES._replace(representation=rung, rho=0.5), 0.0, 0.0, 0.0, lambda roi: 0, 1344, code_bytes=4
        )
        assert made is not None
        assert (made.tile_bytes is not None, made.tile_cells > 0) == (tiled, tiled)
        assert made.code_bytes == (0 if tiled else 4)
        if not tiled:
            more = make_payload(
                FEATURES._replace(representation=rung, rho=0.5), 0.0, 0.0, 0.0, lambda roi: 0, code_bytes=9
            )
            assert more is not None
            assert more.size_bytes - made.size_bytes == 5 * made.cells


@pytest.mark.parametrize("left_s", [0.2, 1.0], ids=["an upgrade waited", "features were in force"])
def test_a_drone_that_comes_back_begins_its_links_with_nothing(left_s: float) -> None:
    """Also where it hears a peer before it decides for the first time, so that age reduces nothing."""
    rig = Rig(lambda view: [FEATURES] if 1 in view.peers else [])
    for k in range(round(10 * left_s)):
        rig.hear(1)
        rig.env.run(until=0.1 * (k + 1))
    rig.agent.status.airborne = False
    rig.env.run(until=3.005)
    rig.agent.status.airborne = True
    granted_s = []
    for k in range(4):
        rig.hear(1)
        rig.env.run(until=3.02 + 0.1 * k)
        directive = rig.gate.in_force(1)
        assert directive is not None
        if directive.representation == Representation.FEATURES:
            granted_s.append(rig.env.now)
    assert granted_s[0] == pytest.approx(3.32)  # the dwell time of 0.3 s after its first decision


def test_a_link_that_a_shown_view_began_rests_once_its_peer_is_heard() -> None:
    """The policy asks for features in the shown view alone; in the heard view with this peer it names no link."""
    shown_memory = memory()
    for drone in (0, 1):
        shown_memory.hold(descriptor(drone), 0.0)
    shown = shown_memory.view(0.0)
    rig = Rig(lambda view: [FEATURES] if view is shown else [], dwell_s=0.0)
    rig.agent._reads = lambda heard: shown if rig.env.now < 0.1 else heard
    rig.env.run(until=0.35)
    rig.hear(1)
    rig.env.run(until=0.65)
    sent_s = [t_s for t_s, *_ in rig.sent]
    assert sent_s
    assert max(sent_s) < 0.4
    assert not rig.gate.due(0.7)


def test_a_drone_looks_as_often_as_any_of_its_links_asks_also_one_that_carries_nothing() -> None:
    gate = Gate()
    gate.enforce(FEATURES._replace(duty_percent=20))
    gate.enforce(Directive(0, 2, duty_percent=70))
    assert gate.duty_percent == 70
    gate.enforce(Directive(0, 2, duty_percent=10))
    assert gate.duty_percent == 20


def test_a_link_that_pauses_keeps_its_slots() -> None:
    """Asking for nothing and for the same again within a slot lets nothing more through."""
    gate = Gate()
    gate.enforce(FEATURES._replace(rate_hz=1.0))
    assert len(gate.due(10.0)) == 1
    gate.enforce(Directive(0, 1))
    gate.enforce(FEATURES._replace(rate_hz=1.0))
    assert gate.due(10.5) == []
    assert len(gate.due(11.0)) == 1


def test_a_codebook_that_a_make_shares_with_the_fleet_is_the_fleet_s() -> None:
    """It has no name of its own, wherever it lies; the file need not be there to see that."""
    shared = loads(
        "name: shared\nperception: {codebook: none/c.safetensors}\n"
        "fleet: {makes: [{name: own, drones: [1], codebook: none/c.safetensors}]}"
    )
    assert codebooks(shared) == ("",) * 5


def test_what_was_told_is_known_although_a_peer_knew_it_first() -> None:
    """The peer may be out of hearing by the next look."""
    grid, chart = b"\xaa" * 64, Chart()
    claim = descriptor(1, position_m=(0.0, 0.0, 60.0), coverage_grid=grid)
    at = (-8, -8)
    assert chart.mark(grid, *at, lambda: [claim], False) == (grid, False)
    assert chart.mark(grid, *at, lambda: [], False)[1]  # it was not told yet
    assert chart.mark(grid, *at, lambda: [claim], True) == (grid, False)
    assert chart.mark(grid, *at, lambda: [], True) == (grid, False)


# --- clocks ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mine_s", [0.0, 3.0, -2.0])
@pytest.mark.parametrize("theirs_s", [0.0, 5.0])
def test_an_offset_shows_by_the_listener_s_own_clock(mine_s: float, theirs_s: float) -> None:
    """Of datagrams as they come in, at two listeners of one table whose clocks differ."""
    table = PeerTable(2, 10, 0)
    rules = FleetRules(0.1, 100, 3.0, 10.0, 0.3, 0.2, 0.04)
    true, wrong = (
        PeerMemory(i, rules, DroneStatus(clock_skew_s=skew_s), table) for i, skew_s in ((0, 0.0), (1, mine_s))
    )
    for k in range(WINDOW + 2):
        now_s = 20 + 0.1 * k
        assert hear([true, wrong], Opened(descriptor(3, now_s + theirs_s), None, 0), now_s + 0.03) == []
    for mine, skew_s in ((true, 0.0), (wrong, mine_s)):
        assert mine.clocks.offset_s.get(3, 0.0) == pytest.approx(skew_s - theirs_s, abs=0.051)
        assert (3 in mine.clocks.offset_s) == (skew_s != theirs_s)
        assert mine.ages_s(now_s + 0.4)[3] == pytest.approx(0.4, abs=0.051)


@pytest.mark.parametrize("begins", [3, 15])
def test_a_listener_s_clock_that_goes_wrong_in_flight_shows_too(begins: int) -> None:
    """Its peers' stamps and arrivals are as before; its own clock is what makes their lags unusual."""
    mine = memory()
    for k in range(begins + WINDOW + 2):
        now_s = 20 + 0.1 * k
        mine.status.clock_skew_s = 2.0 if k >= begins else 0.0
        assert mine.hear(Opened(descriptor(3, now_s), None, 0), now_s + 0.03) is None
        if k == begins - 1:
            assert mine.clocks.offset_s == {}
    assert mine.clocks.offset_s == {3: pytest.approx(2.0, abs=0.051)}
    assert mine.ages_s(now_s + 0.4)[3] == pytest.approx(0.4, abs=0.051)


def test_a_clock_that_agrees_again_is_no_longer_watched() -> None:
    watched = np.zeros(256, np.uint8)
    clocks = PeerClocks(0.1, np.zeros(256), watched)
    for _ in range(WINDOW):
        clocks.heard(4, 1.5)
    assert (clocks.offset_s[4], watched[4]) == (pytest.approx(1.45), 1)
    clocks.heard(4, 0.05)
    assert (clocks.offset_s, watched[4], clocks._ahead_s[4]) == ({}, 0, 0.0)


def test_the_smallest_lag_tells_the_offset_and_only_peers_that_are_asked_for_count() -> None:
    clocks = PeerClocks(0.1)
    for k in range(WINDOW):
        clocks.heard(1, 2.0 + 0.09 * (k % 2) + 0.1 * (k == 3))
        clocks.heard(2, 5.0)
    assert clocks.offset_s == {1: pytest.approx(1.95), 2: pytest.approx(4.95)}
    assert clocks.own_offset_s([1]) == pytest.approx(1.95 / 2)  # the median of it and of none
    assert clocks.own_offset_s([1, 2]) == pytest.approx(1.95)
    assert clocks.own_offset_s([3]) == 0.0


class Reports(Rig):
    """Keeps its events: when, and the text."""

    def __init__(self, *given: Any, **rules: Any) -> None:
        self.reported: list[tuple[float, str]] = []
        super().__init__(*given, dwell_s=0.0, **rules)

    def event(self, t_s: float, drone: int, kind: str, text: str) -> None:
        assert (drone, kind) == (0, "clock")
        self.reported.append((round(t_s, 2), text))


AGREES = "clock agrees with the fleet's again"


def off(way: str) -> str:
    return f"clock {way} the fleet's, ± 0.05 s: ages are corrected for it"


@pytest.mark.parametrize(
    ("offsets_s", "reported"),
    [
        # an offset is known to half a frame: up to 0.05 s on either side is no fault
        ([0.0, 0.05, -0.05, 0.049], {}),
        ([0.06], {0: off("0.06 s ahead of")}),
        ([-0.06], {0: off("0.06 s behind")}),
        # it is reported again once it has changed by more than that, and not before
        ([0.06, 0.1, 0.11, 0.12, 0.12], {0: off("0.06 s ahead of"), 3: off("0.12 s ahead of")}),
        ([-0.2, -0.16, -0.24, -0.26], {0: off("0.20 s behind"), 3: off("0.26 s behind")}),
        ([0.06, -0.06, 0.0], {0: off("0.06 s ahead of"), 1: off("0.06 s behind"), 2: AGREES}),
        # its end is reported, and then the begin of the next fault
        ([3.0, 0.0, 0.0, 0.05, 0.06], {0: off("3.00 s ahead of"), 1: AGREES, 4: off("0.06 s ahead of")}),
    ],
)
def test_a_drone_reports_its_clock_once_it_is_off_by_more_than_can_be_measured(
    offsets_s: list[float], reported: dict[int, str]
) -> None:
    """By second, as the descriptors of three peers show it; half a frame is 0.05 s."""
    rig = Reports(lambda view: [])
    for second, offset_s in enumerate(offsets_s):
        rig.hear(1, 2, 3)
        rig.memory.clocks.offset_s = dict.fromkeys((1, 2, 3), offset_s)
        rig.env.run(until=second + 0.95)
    assert rig.reported == [(second + 0.01, text) for second, text in reported.items()]


@pytest.mark.parametrize(("peers", "offset_s"), [(1, 0.0), (2, 0.5), (3, 1.0)])
def test_the_offset_of_a_clock_is_the_median_over_itself_and_its_peers(peers: int, offset_s: float) -> None:
    """It is a second ahead of some of three peers, and agrees with the others and with itself."""
    rig = Reports(lambda view: [])
    rig.hear(1, 2, 3)
    rig.memory.clocks.offset_s = dict.fromkeys(range(1, peers + 1), 1.0)
    rig.env.run(until=0.5)
    assert rig.reported == [(0.01, off(f"{offset_s:.2f} s ahead of"))] * (offset_s > 0.0)


@pytest.mark.parametrize(
    ("stamps_s", "reported"),
    [
        # a descriptor may take a frame; one that comes older than that, and old enough to reduce the link, is reported
        ([0.0, 0.1, 0.29], []),
        ([0.0, 0.32], [1]),
        ([1.05], [0]),
        # once while it lasts, and again after it was over
        ([0.32, 0.35, 0.4], [0]),
        ([0.32, 0.0, 0.32], [0, 2]),
        # stamps of the future make nothing old
        ([-0.5, -3.0], []),
    ],
)
def test_a_link_that_a_faulty_clock_reduces_is_reported_once(stamps_s: list[float], reported: list[int]) -> None:
    """A peer's descriptors, each so old by its stamp when it comes. A link that silence reduces is not reported."""
    rig = Reports(lambda view: [FEATURES] if 1 in view.peers else [])
    for k, late_s in enumerate(stamps_s):
        rig.env.run(until=0.1 * k + 0.004)
        rig.memory.hold(descriptor(1, rig.env.now - late_s), rig.env.now)
    rig.env.run(until=0.1 * len(stamps_s))
    of_clocks = len(rig.reported)
    if stamps_s[-1] <= 0.1:  # else age adds to what its clock makes of it
        rig.env.run(until=3.0)
        assert len(rig.reported) == of_clocks
    wanted = []
    for k in reported:
        link, old_s = "detached" if stamps_s[k] > 1.0 else "degraded", stamps_s[k] + 0.006
        came = f"link to 1 {link}: its descriptor came 0.01 s ago and is {old_s:.2f} s old by its stamp: "
        wanted.append((round(0.1 * k + 0.01, 2), f"{came}a clock is wrong, or it waited for the channel"))
    assert rig.reported[:of_clocks] == wanted


@pytest.mark.parametrize("gnss", [True, False])
def test_a_clock_begins_with_its_offset_and_drifts_without_gnss_alone(gnss: bool) -> None:
    (oscillator,) = oscillators(Clocks(offset_s=2.0, drift_ppm=50.0), 1, 3, 0)
    clock = oscillator.at_start(gnss)
    assert clock.error_s(0.0) == oscillator.offset_s != 0.0
    assert (clock.error_s(600.0) != clock.error_s(0.0)) is not gnss


# --- payloads that came ------------------------------------------------------------------------------------


def came(rung: Representation, t_s: float, t_done_s: float, size: int = 20_000, **of: Any) -> Received:
    return Received(capture(1, t_s), payload(size, rung)._replace(**of), t_done_s, t_s)


def test_every_map_that_came_is_one_to_fuse() -> None:
    mine = memory()
    for k, rung in enumerate(
        (Representation.FEATURES, Representation.CODES, Representation.RAW, Representation.TRACKS)
    ):
        mine.receive(came(rung, 0.1 * k, 0.1 * k + 0.05, 100))
    assert (mine.status.work.maps, mine.status.work.payload_bytes) == (3, 400)


def test_of_two_payloads_of_one_capture_the_later_is_held() -> None:
    mine = memory()
    first, second = came(Representation.FEATURES, 1.0, 1.05), came(Representation.RAW, 1.0, 1.08)
    mine.receive(first)
    mine.receive(second)
    assert mine.held[1] is second
    mine.status.airborne = False
    mine.receive(came(Representation.RAW, 2.0, 2.05))
    assert mine.held[1] is second


@pytest.mark.parametrize("rung", [Representation.FEATURES, Representation.CODES])
def test_a_map_of_another_network_cannot_be_fused(rung: Representation) -> None:
    mine = memory()
    assert mine.can_fuse(payload(rung=rung))
    assert not mine.can_fuse(payload(rung=rung)._replace(feature_space="own"))
    mine.status.feature_space = "own"
    assert mine.can_fuse(payload(rung=rung)._replace(feature_space="own"))
    assert not mine.can_fuse(payload(rung=rung))
    assert mine.can_fuse(payload(rung=Representation.RAW))


def test_what_a_view_calls_detached_is_in_periods_of_a_descriptor() -> None:
    mine = memory(publish_every=4)
    mine.hold(descriptor(0, 0.0), 0.0)
    mine.hold(descriptor(1, 0.0), 0.0)
    views_at = {t_s: mine.view(t_s) for t_s in (3.9, 4.1)}
    assert isinstance(views_at[3.9], FleetView)
    assert [1 in view.members for view in views_at.values()] == [True, False]


# --- claims and forms --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 10])
def test_a_charge_may_stand_still_for_three_steps_of_its_form(bits: int) -> None:
    """Against a fleet that fell by less than that and by more, of one that told its charge finely before."""
    step = Form(number_bits=bits).soc_step
    flat = descriptor(1, coverage_grid=bytes(64), battery_soc=0.9)
    for fallen, doubted in ((2.5 * step, False), (3.5 * step + 0.006, True)):
        known = {i: descriptor(i, coverage_grid=bytes(64), battery_soc=0.9 - fallen) for i in (0, 2, 3, 4)}
        known[1] = flat
        standings = {i: Standing(0, "", 60, 0.9, 0.9 - fallen if i != 1 else 0.9, fine=True) for i in known}
        after = judge(standings, 0, known, {}, Form(number_bits=bits))
        assert (after[1].strikes > 0) is doubted


def test_a_goodput_may_be_rounded_up_by_a_step() -> None:
    slow = [Arrival(20_000, 0.1, 2.0, 1.0)]  # frames at 2 Mb/s
    assert goodput_doubt(4.0, slow)
    assert not goodput_doubt(4.0, slow, 1.5)
    assert goodput_doubt(5.0, slow, 1.5)
    assert battery_doubt(0.9, 0.86, 0.95, 0.0)


@pytest.mark.parametrize("cells", [16, 8])
def test_speed_and_blur_each_excuse_cells_of_their_own(cells: int) -> None:
    """The same grid and place is judged anew for another speed and another form, whichever was judged first."""
    lying = falsified(descriptor(1, velocity_mps=(0.0, 0.0, 0.0), position_m=(3.0, 4.0, 20.0), orientation_xyzw=(0.0, 0.0, 0.0, 1.0)), "coverage", "much")  # fmt: skip
    fast = lying._replace(velocity_mps=(200.0, 0.0, 0.0))
    turned = lying._replace(orientation_xyzw=(0.0, np.sin(0.4), 0.0, np.cos(0.4)))
    blur_m = Form(grid_cells=cells).blur_m
    before = coverage_doubt(lying, blur_m)
    assert before
    assert coverage_doubt(fast, blur_m) == ""
    assert coverage_doubt(lying, 300.0) == ""
    assert coverage_doubt(turned, blur_m) != before
    assert coverage_doubt(lying, blur_m) == before


def test_who_looks_and_sees_nothing_is_doubted_in_any_form_that_has_a_grid() -> None:
    known = {i: descriptor(i, coverage_grid=bytes(64)) for i in (0, 1)}
    for form, doubted in ((Form(), True), (Form(grid_cells=8), True), (Form(grid_cells=0), False)):
        assert (judge({}, 0, known, {}, form, {1})[1].strikes == 1) is doubted


def test_a_steep_fall_begins_a_new_watch_at_the_highest_bound_however_long_nobody_heard() -> None:
    """A fall of six percent between two claims far apart: the charge is watched from there on."""
    known = {i: descriptor(i, coverage_grid=bytes(64), battery_soc=0.84) for i in (0, 1)}
    (after,) = (judge({1: Standing(0, "", 30, 0.95, 0.9, True, 9)}, 0, known, {})[1],)
    assert (after.seconds, after.first_soc, after.least_soc) == (1, 0.84, 0.84)
    assert after.reason == ""
    kept = judge(
        {1: Standing(2, "battery: of before", 30, 0.95, 0.9, True)},
        0,
        known | {1: known[1]._replace(battery_soc=0.895)},
        {},
    )
    assert kept[1].reason == "battery: of before"


# --- faults of sensors ---------------------------------------------------------------------------------------


def errors(events: str, fleet: str = "", frames: int = 40) -> Any:
    scenario = loads(f"name: faults\nduration_s: 4\nfleet: {{drones: 3{fleet}}}\nevents: [{events}]")
    return sensor_errors(scenario, np.zeros((frames, 3, 3)), 1, 0)


def test_a_fault_begins_in_its_frame_and_is_over_in_the_frame_of_its_end() -> None:
    found = errors("{kind: position_fault, drone: 1, at_s: 0.5, until_s: 1.2, offset_m: [3, 0, -2]}")
    assert list(found) == [1]
    assert np.flatnonzero(found[1].any(axis=1)).tolist() == list(range(5, 12))


def test_faults_of_one_drone_add_up_and_drifts_begin_at_nothing() -> None:
    found = errors(
        "{kind: position_fault, drone: 1, at_s: 1, offset_m: [3, 0, 0]}, {kind: position_fault, drone: 1, at_s: 2, drift_mps: [0, 2, 1]}, "
        "{kind: heading_fault, drone: 1, at_s: 1, offset_deg: 90}"
    )
    np.testing.assert_allclose(found[1][35], [3.0, 3.0, 1.5, np.pi / 2])
    np.testing.assert_allclose(found[1][20], [3.0, 0.0, 0.0, np.pi / 2])


@pytest.mark.parametrize("rate_hz", [2.0, 10.0])
def test_dead_reckoning_walks_as_far_at_every_frame_rate(rate_hz: float) -> None:
    """Its variance grows by the square of position_walk_m a second."""
    scenario = loads(
        f"name: walk\nduration_s: 1800\ncontext: {{rate_hz: {rate_hz}}}\nfleet: {{drones: 20}}\n"
        "events: [{kind: gnss_loss, at_s: 0, position_walk_m: 2}]"
    )
    walks = sensor_errors(scenario, np.zeros((round(400 * rate_hz), 20, 3)), 3, 0)
    steps = np.concatenate([np.diff(walk[:, :2], axis=0).ravel() for walk in walks.values()])
    assert np.std(steps) * np.sqrt(rate_hz) == pytest.approx(2.0, rel=0.05)


def test_a_false_height_is_believed_and_changes_the_footprint_that_is_told() -> None:
    """Beyond the first block of frames too, and each frame's own error."""
    motion = fly(Fleet(drones=2), 5.0, 0.1, 1)
    error = np.zeros((50, 4))
    error[:, 2], error[:, 3] = np.arange(50) / 5, np.arange(50) / 100
    senses = FlightSenses(motion, 0.1, PLAIN, [USUAL] * 2, {1: error}, blind=(0,))
    position_m, yaw_rad = believed(motion, {1: error}, slice(0, 50))
    for frame in (0, 20, 31, 32, 49):
        here = senses.at(frame)
        assert [h.footprint_radius_m for h in here] == [
            0.0, pytest.approx(footprint_radius_m(float(position_m[frame, 1, 2]), USUAL)),
        ]  # fmt: skip
        assert here[1].capture.est_position_m == pytest.approx(position_m[frame, 1])
        assert here[1].capture.est_position_m[2] == pytest.approx(motion.position_m[frame, 1, 2] + frame / 5)
        told = here[1].orientation_xyzw
        yaw = 2 * np.arctan2(told[2], told[3])
        true = here[1].capture.orientation_xyzw
        apart = (yaw - 2 * np.arctan2(true[2], true[3]) - frame / 100 + np.pi) % (2 * np.pi) - np.pi
        assert apart == pytest.approx(0.0, abs=0.02)
        assert yaw_rad[frame, 1] == pytest.approx(motion.est_yaw_rad[frame, 1] + frame / 100)


def test_what_cameras_see_follows_from_the_true_height() -> None:
    """Cells are placed where the drone believes to be; how well they are seen is a matter of where it is."""
    level, yaw = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (1, 1, 4)), np.zeros((1, 1))

    def grid(true_z: float, believed_z: float) -> bytes:
        at, est = (np.array([[[3.0, 4.0, z]]]) for z in (true_z, believed_z))
        ((seen,),) = views(Poses(at, level, yaw, est, yaw), PLAIN)
        return seen.grid

    assert grid(30.0, 30.0) == grid(30.0, 90.0) != grid(90.0, 90.0)
