"""One agent: when it looks, decides and sends, what its payloads carry, and what it publishes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
from agent_rig import Rig, capture, descriptor, memory

from sortie.fleet.agent import Alone
from sortie.fleet.coverage import NOTHING_SEEN, View, placed
from sortie.fleet.lies import falsified
from sortie.fleet.messages.wire import decode_descriptor
from sortie.fleet.plane import Equipment
from sortie.fleet.senses import Sensed
from sortie.perception import budget
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.policies.staleness import LinkHealth

FULL = Directive(0, 1, Representation.FEATURES, 0.5, None, 10.0)
FEATURES = FULL._replace(rho=1.0, deadline_s=0.1)
Policy = Callable[[FleetView], list[Directive]]


def to_all(directive: Directive = FULL) -> Policy:
    return lambda view: [directive._replace(destination=p) for p in view.peers]


def silent(view: FleetView) -> list[Directive]:
    return []


def flags_of(rig: Rig) -> list[int]:
    return [decode_descriptor(datagram).novelty_flags for _, datagram in rig.published]


# --- when it computes, sends and publishes ----------------------------------------------------------------


def test_a_drone_computes_as_long_as_its_make_does_and_what_slows_it_adds_up() -> None:
    """Another drone's make, or the fleet's own time, is not its own."""
    makes = {0: Equipment(0.07), 1: Equipment(0.03)}
    for rules, slower_s, takes_s in (
        ({"compute_delay_s": 0.02, "makes": makes}, {}, 0.07),
        ({"compute_delay_s": 0.04}, {3: 0.01, 7: 0.03}, 0.04 + 0.01 + 0.03),
    ):
        rig = Rig(to_all(), dwell_s=0.0, **rules)
        rig.memory.status.slower_s = slower_s
        rig.hear(1)
        rig.env.run(until=0.18)
        assert rig.sent[0][0] == pytest.approx(0.01 + takes_s)  # it acts 10 ms after its look


def test_a_capture_that_is_ready_after_a_later_one_is_dropped() -> None:
    """The computer takes half a second longer up to a moment: captures of shortly before it are overtaken."""
    rig = Rig(lambda view: [FULL], dwell_s=0.0, compute_delay_s=0.04, degraded_after_periods=20)
    rig.memory.status.slower_s = {3: 0.5}
    rig.hear(1)
    rig.env.run(until=0.35)  # after four looks
    del rig.memory.status.slower_s[3]
    rig.env.run(until=0.8)
    assert [round(c.t_s, 9) for _, _, _, c in rig.sent] == [0.4, 0.5, 0.6, 0.7]
    assert rig.agent.latest == rig.sent[-1][3]


def test_a_stamp_is_of_the_moment_of_sensing_by_the_own_clock() -> None:
    """Not of the moment of publishing, which is a little later."""
    for skew_s in (0.0, 2.5):
        rig = Rig(silent, dwell_s=0.0)
        rig.memory.status.clock_skew_s = skew_s
        rig.env.run(until=0.55)
        stamps = [decode_descriptor(datagram).stamp_ns * 1e-9 for _, datagram in rig.published]
        assert stamps == pytest.approx([0.1 * k + skew_s for k in range(6)], abs=1e-6)
        assert [t_s for t_s, _ in rig.published] == pytest.approx([0.1 * k + 0.01 for k in range(6)])


def test_a_drone_that_left_sends_and_publishes_nothing_more() -> None:
    """Also what it looked at before and was about to send."""
    for leaves_s in (0.0, 0.045, 0.3, 0.33):
        rig = Rig(to_all(), dwell_s=0.0, handshake=100, compute_delay_s=0.04)
        rig.hear(1, 2)
        rig.env.run(until=leaves_s + 1e-6)
        before = len(rig.sent), len(rig.shaken), len(rig.published)
        rig.memory.status.leave()
        rig.env.run(until=1.0)
        assert (len(rig.sent), len(rig.shaken), len(rig.published)) == before, leaves_s
        rig.memory.status.airborne = True
        rig.hear(1, 2)
        rig.env.run(until=1.2)
        assert len(rig.sent) > before[0]
        assert all(c.t_s >= 1.0 - 1e-9 for t_s, _, _, c in rig.sent if t_s > 1.0)


def test_a_drone_that_comes_back_begins_its_links_with_nothing() -> None:
    """Also where it hears a peer before it decides for the first time. It left as an upgrade waited, or in features."""
    for left_s in (0.2, 1.0):
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


def test_a_drone_without_a_detector_publishes_and_never_looks() -> None:
    rig = Rig(to_all(), dwell_s=0.0)
    rig.memory.status.looks = False
    rig.hear(1, 2)
    rig.env.run(until=0.5)
    assert (rig.sent, rig.memory.status.work.looks, rig.memory.status.perceiving) == ([], 0, False)
    assert rig.published


class Told(Rig):
    """An agent with what its log heard of its link to drone 1."""

    def __init__(self, **rules: Any) -> None:
        self.told: list[tuple[float, LinkHealth]] = []
        super().__init__(to_all(), dwell_s=0.0, hysteresis=0.0, trust=False, **rules)

    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None:
        if not self.told or self.told[-1][1] != link:
            self.told.append((t_s, link))


def test_thresholds_of_age_are_periods_of_a_descriptor() -> None:
    """A peer is heard once: its link is degraded, then detached after so many of its periods, and gets no handshake."""
    for every, degraded in product((1, 2, 3), (3.0, 5.0)):
        rig = Told(publish_every=every, degraded_after_periods=degraded, detached_after_periods=10.0)
        rig.agent._pilot = replace(rig.agent._pilot, handshake_bytes=64)  # type: ignore[type-var]
        rig.hear(1)
        rig.env.run(until=4.0)
        period_s, frame_s = 0.1 * every, 0.1 + 1e-9
        assert [link for _, link in rig.told] == [LinkHealth.FRESH, LinkHealth.DEGRADED, LinkHealth.DETACHED]
        for (t_s, _), periods in zip(rig.told[1:], (degraded, 10.0), strict=True):
            assert periods * period_s < t_s <= periods * period_s + frame_s
        assert max(t_s for t_s, _ in rig.shaken) == pytest.approx(10.0 * period_s, abs=0.1)
        features_s = [t_s for t_s, _, p, _ in rig.sent if p.representation == Representation.FEATURES]
        assert max(features_s) <= degraded * period_s + frame_s


def test_peers_are_judged_once_a_second_however_often_they_publish(monkeypatch: pytest.MonkeyPatch) -> None:
    for every in (1, 3):
        rig, judged = Rig(silent, dwell_s=0.0, publish_every=every), list[float]()
        monkeypatch.setattr(rig.memory, "judge", lambda now_s, judged=judged: judged.append(now_s) or [])
        rig.env.run(until=4.5)
        assert judged == pytest.approx([0.01, 1.01, 2.01, 3.01, 4.01])


def test_a_link_that_a_shown_view_began_rests_once_its_peer_is_heard() -> None:
    """The policy asks for features in the shown view alone; in the heard view with this peer it names no link."""
    shown_memory = memory()
    for drone in (0, 1):
        shown_memory.hold(descriptor(drone), 0.0)
    shown = shown_memory.view(0.0)
    rig = Rig(lambda view: [FEATURES] if view is shown else [], dwell_s=0.0)

    class Shown(Alone):
        def read(self, heard: FleetView) -> FleetView:
            return shown if rig.env.now < 0.1 else heard

    rig.agent._pilot = Shown(rig.agent._pilot)
    rig.env.run(until=0.35)
    rig.hear(1)
    rig.env.run(until=0.65)
    sent_s = [t_s for t_s, *_ in rig.sent]
    assert sent_s
    assert max(sent_s) < 0.4
    assert not rig.gate.due(0.7)


# --- handshakes and work ----------------------------------------------------------------------------------


def test_a_handshake_goes_to_peers_that_are_attached() -> None:
    rig = Rig(silent, handshake=64, dwell_s=0.0)
    rig.hear(1, 2)
    for k in range(30):
        rig.env.run(until=0.1 * (k + 1) - 0.001)
        rig.hear(2)
    last_1, last_2 = (max(t for t, peer in rig.shaken if peer == p) for p in (1, 2))
    assert last_1 == pytest.approx(1.0, abs=0.15)  # ten periods
    assert last_2 > 2.8


def test_a_handshake_is_of_use_for_a_frame_however_seldom_descriptors_are_published() -> None:
    class Shakes(Rig):
        deadlines: list[float]

        def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None:
            self.deadlines.append(deadline_s)

    rig = Shakes(silent, handshake=64, dwell_s=0.0, publish_every=5)
    rig.deadlines = []
    rig.hear(1)
    rig.env.run(until=0.35)
    assert rig.deadlines == [0.1] * 3


def test_every_byte_that_a_drone_sends_is_work() -> None:
    """Payloads and handshakes, to each peer; what it looked at and decided as well."""
    for handshake in (0, 132):
        rig = Rig(to_all(), dwell_s=0.0, handshake=handshake)
        rig.hear(1, 2)
        rig.env.run(until=0.25)
        work = rig.memory.status.work
        assert len(rig.sent) == 2 * 2
        assert len(rig.shaken) == (2 * 2 if handshake else 0)
        assert work.payload_bytes == sum(p.size_bytes for _, _, p, _ in rig.sent) + handshake * len(rig.shaken)
        assert (work.looks, work.decisions, work.maps) == (3, 3, 0)


# --- payloads ---------------------------------------------------------------------------------------------


def test_links_that_differ_in_one_field_get_payloads_of_their_own() -> None:
    detections, raw = ({"representation": r} for r in (Representation.DETECTIONS, Representation.RAW))
    for changed in ({"fusion_weight": 0.25}, {"rho": 0.1}, {"roi": Disc(0, 0, 20)}, detections, raw):
        asked = [FULL, FULL._replace(destination=2, **changed), FULL._replace(destination=3)]
        rig = Rig(lambda view, asked=asked: [d for d in asked if d.destination in view.peers], dwell_s=0.0)
        rig.hear(1, 2, 3)
        rig.env.run(until=0.09)
        by_peer = {peer: p for _, peer, p, _ in rig.sent}
        for directive in asked:
            sent = by_peer[directive.destination]
            assert (sent.representation, sent.roi) == (directive.representation, directive.roi)
            assert (sent.rho, sent.fusion_weight) == pytest.approx((directive.rho, directive.fusion_weight))
        assert by_peer[1] is by_peer[3]
        assert by_peer[1] is not by_peer[2], changed


class Late(Rig):
    """Flies east, 30 m a frame, computes for two and a half frames, and notes what it is asked of which capture."""

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


def test_a_payload_is_of_its_capture_however_late_it_is_sent() -> None:
    roi = Disc(0.0, 0.0, 60.0)
    for rung, kinds in (
        (Representation.FEATURES, set()),
        (Representation.TRACKS, {"boxes", "people", "tracks"}),
        (Representation.DETECTIONS, {"boxes", "people"}),
    ):
        stale = {"detached_after_periods": 50.0, "degraded_after_periods": 40.0}
        policy = to_all(FEATURES._replace(representation=rung, roi=roi))
        rig = Late(policy, dwell_s=0.0, compute_delay_s=0.25, people=True, **stale)
        rig.asked = []
        rig.hear(1)
        rig.env.run(until=0.8)
        frames = range(len(rig.sent))
        assert [c.t_s for _, _, _, c in rig.sent] == pytest.approx([0.1 * k for k in frames])
        if not kinds:
            cells = [budget.cells_sent(1.0, roi, 30.0 * k, 0.0, 0.0) for k in frames]
            assert [p.cells for _, _, p, _ in rig.sent] == cells
            assert len(set(cells)) > 2
        for kind in kinds:
            times_s = [t_s for what, t_s in rig.asked if what == kind]
            assert times_s == pytest.approx([0.1 * k for k in range(len(times_s))])
            assert times_s


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
        rig = Rig(to_all(FULL._replace(representation=Representation.DETECTIONS)), dwell_s=0.0, classes=classes)
        rig.hear(1)
        rig.env.run(until=0.09)
        sizes.append(rig.sent[0][2].size_bytes)
    plain, named = (budget.content_bytes("detections", boxes=1, classes=c) for c in (False, True))
    assert sizes[1] == sizes[0] + 3 * (named - plain) > sizes[0]


# --- what it publishes ------------------------------------------------------------------------------------


class Moves(Rig):
    """Flies a cell north in each frame; its cameras see one cell, poorly."""

    def sense(self, frame: int) -> Sensed:
        return super().sense(frame)._replace(view=View(frame, 0, b"\x01" + bytes(63)))


def test_a_look_stands_for_a_second_from_its_capture_where_it_saw() -> None:
    """The first look, and no other: its camera is blocked from then on. Grids are of the cells of each new place."""
    rig = Moves(silent, dwell_s=0.0)
    rig.env.run(until=0.05)
    rig.memory.status.blocked = {3}
    rig.env.run(until=1.35)
    grids = [decode_descriptor(datagram).coverage_grid for _, datagram in rig.published]
    seen = View(0, 0, b"\x01" + bytes(63))
    assert grids[:11] == [NOTHING_SEEN, *(placed(seen, row, 0) for row in range(1, 11))]
    assert grids[11:] == [NOTHING_SEEN] * 3
    assert rig.memory.status.work.looks == 1
    # it is a row further north in a grid that begins further south
    assert placed(View(5, 0, seen.grid), 4, 0) == bytes(4) + b"\x01" + bytes(59)


class Sees(Rig):
    """Sees the same cells well; it flies a cell north in every `frames` frames."""

    frames = 10**9

    def sense(self, frame: int) -> Sensed:
        well = bytes(32) + b"\xaa" * 4 + bytes(28)
        return super().sense(frame)._replace(view=View(frame // self.frames, 0, well))


def test_new_ground_is_new_where_it_was_seen_and_once() -> None:
    """A grid of another place marks the cells of the ground, not those of the grid."""
    rig = Sees(silent, dwell_s=0.0)
    rig.frames = 2
    rig.env.run(until=0.05)
    rig.memory.status.blocked = {0}
    rig.env.run(until=0.75)
    assert flags_of(rig) == [0, 1, 0, 0, 0, 0, 0, 0]


def test_what_was_not_published_stays_new() -> None:
    """Ground that is first seen in a frame without a descriptor is new in the next descriptor, and in no other."""
    for every in (1, 3):
        rig = Sees(silent, dwell_s=0.0, publish_every=every)
        rig.env.run(until=1.0)
        flags = flags_of(rig)
        assert flags == [0, 1] + [0] * (len(flags) - 2)


def test_a_drone_that_lies_decides_by_the_truth_and_publishes_the_lie() -> None:
    seen: list[FleetView] = []
    rig = Rig(lambda view: seen.append(view) or [], dwell_s=0.0)  # type: ignore[func-returns-value]
    rig.memory.status.lies[0] = lambda d: d._replace(battery_soc=0.05)
    rig.env.run(until=0.35)
    assert {round(decode_descriptor(datagram).battery_soc, 6) for _, datagram in rig.published} == {0.05}
    assert {round(view.me.battery_soc, 6) for view in seen if view.me is not None} == {0.9}


def test_lies_of_several_events_are_all_told() -> None:
    lies = [("coverage", "much"), ("goodput", "little"), ("battery", "little")]
    for order in ((0, 1, 2), (2, 0, 1)):
        rig = Rig(silent, dwell_s=0.0)
        for index in order:
            rig.memory.status.lies[index] = lambda d, lie=lies[index]: falsified(d, *lie)  # type: ignore[misc]
        rig.env.run(until=0.05)
        told = decode_descriptor(rig.published[-1][1])
        assert told.battery_soc == pytest.approx(0.05)
        assert told.peer_goodput_mbps == pytest.approx((0.1,) * 4)
        assert told.coverage_grid == b"\xff" * 64
        del rig.memory.status.lies[1]
        rig.env.run(until=0.15)
        told = decode_descriptor(rig.published[-1][1])
        assert told.battery_soc == pytest.approx(0.05)
        assert told.peer_goodput_mbps == (50.0,) * 4
