"""How often two drones' views lead to different choices: the definition, the causes, and the paper's bound."""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Callable, Sequence
from pathlib import Path

import pyarrow.compute as pc
import pytest
from cli_examples import command
from recorded import recorded

import sortie
from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.compact import FULL
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.fleet.trust import discounted
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Representation, nothing
from sortie.policies.damping import apply_hysteresis
from sortie.policies.registry import POLICIES, resolve
from sortie.policies.verification.kit.views import draw_view
from sortie.sim.results.disagreement import CAUSES, Pair, figures, measure, pairs_of, pairs_table
from sortie.sim.results.outcome import outcome
from sortie.sim.results.views import Decision

PERIOD_S = 0.1
BASE = draw_view(1, 1)


def descriptor(drone: int, soc: float = 0.9, stamp_ns: int = 0) -> Descriptor:
    return next(iter(BASE.descriptors.values()))._replace(
        agent_id=drone, battery_soc=soc, stamp_ns=stamp_ns, peer_goodput_mbps=(100.0, 100.0)
    )


def view(ego: int, *known: Descriptor, age_s: float = 0.0) -> FleetView:
    ages_s = {d.agent_id: 0.0 if d.agent_id == ego else age_s for d in known}
    return FleetView(ego, PERIOD_S, {d.agent_id: d for d in known}, ages_s)


def cautious(view: FleetView) -> list[Directive]:
    """Features while the ego and the peer have charge; nothing to a peer that was not heard lately."""
    full = view.descriptors[view.ego].battery_soc >= 0.5
    return [
        Directive(view.ego, p, Representation.FEATURES if full else Representation.DETECTIONS, rate_hz=2.0)
        if view.descriptors[p].battery_soc >= 0.2 and view.age_s[p] <= 0.35
        else nothing(view.ego, p, "low or old")
        for p in view.peers
    ]


def flight(*frames: Sequence[FleetView]) -> list[Decision]:
    """Each drone decides a moment after the one before it."""
    return [
        Decision(k * PERIOD_S + 0.001 * v.ego, v.ego, "cautious", v, ())
        for k, views in enumerate(frames)
        for v in views
    ]


def measured(*frames: Sequence[FleetView]) -> list[Pair]:
    return measure(flight(*frames), lambda _: cautious, PERIOD_S)


def test_the_definition_by_hand() -> None:
    a, b, low = descriptor(0), descriptor(1), descriptor(1, soc=0.4, stamp_ns=1)
    agree = view(0, a, b), view(1, a, b)
    lag = view(0, a, b), view(1, a, low)  # drone 1's charge fell, and drone 0 has not heard of it
    (pair,) = measured(agree, lag, lag, agree, lag)
    assert (pair.drone, pair.other) == (0, 1)
    assert pair.compared_s == pytest.approx(5 * 2 * PERIOD_S)  # both links in every frame
    assert [(e.source, e.destination, e.sends, e.cause) for e in pair.episodes] == [(1, 0, False, "descriptor")] * 2
    assert [(e.begin_s, e.duration_s) for e in pair.episodes] == [
        (pytest.approx(0.1), pytest.approx(0.2)),
        (pytest.approx(0.4), pytest.approx(0.1)),
    ]
    told = figures([pair])
    assert told["share"] == pytest.approx(0.3)
    assert told["sends_share"] == 0.0
    assert told["episodes"] == 2
    assert told["mean_s"] == pytest.approx(0.15)
    assert told["longest_s"] == pytest.approx(0.2)
    assert told["causes"] == {**dict.fromkeys(CAUSES, 0.0), "descriptor": pytest.approx(0.3)}
    assert pairs_of(pairs_table([pair])) == [pair]


def test_a_third_drone_decides_for_others_too_and_a_drone_that_left_is_no_source() -> None:
    a, b, c = descriptor(0), descriptor(1), descriptor(2, soc=0.1)
    pairs = measured([view(0, a, b, c), view(1, a, b, c), view(2, a, b, c)], [view(0, a, b, c), view(1, a, b, c)])
    assert [(p.drone, p.other) for p in pairs] == [(0, 1), (0, 2), (1, 2)]
    assert [p.compared_s / PERIOD_S for p in pairs] == pytest.approx([6 + 4, 6, 6])
    assert not any(p.episodes for p in pairs)


def test_a_small_move_of_a_disc_is_no_disagreement() -> None:
    def discs(away_m: float) -> Callable[[FleetView], list[Directive]]:
        return lambda v: [
            Directive(
                v.ego, p, Representation.FEATURES, 0.1, Disc(away_m * v.descriptors[v.ego].battery_soc, 0.0, 32.0), 10
            )
            for p in v.peers
        ]

    a, b, later = descriptor(0), descriptor(1, soc=0.5), descriptor(1, soc=0.4, stamp_ns=1)
    for away_m, disagree in ((15.0, False), (17.0, True)):
        decided = flight([view(0, a, b), view(1, a, later)])
        (pair,) = measure(decided, lambda _, d=away_m: discs(d), PERIOD_S)  # type: ignore[misc]
        assert bool(pair.episodes) == disagree


def test_a_pair_is_compared_about_the_links_of_all_who_decide() -> None:
    """Also of one whom neither of the two has heard: what it would send to each of them."""
    a, b, c = (descriptor(i) for i in range(3))
    pairs = {(p.drone, p.other): p for p in measured([view(0, a, b), view(1, a, b), view(2, c)])}
    assert pairs[0, 1].compared_s == pytest.approx(4 * PERIOD_S)  # 0 to 1, 1 to 0, 2 to both
    assert pairs[0, 2].compared_s == pairs[1, 2].compared_s == pytest.approx(6 * PERIOD_S)
    heard = {(p.drone, p.other): p for p in measured([view(i, a, b, c) for i in range(3)])}
    assert [p.compared_s for p in heard.values()] == pytest.approx([6 * PERIOD_S] * 3)


A, B, LOW = descriptor(0), descriptor(1), descriptor(1, soc=0.4)
CAUSE_OF: dict[str, tuple[FleetView, FleetView, bool]] = {
    "roster": (view(0, A, B), view(1, B), True),
    "trust": (view(0, A, discounted(LOW)), view(1, A, LOW), True),
    "values": (view(0, A, descriptor(1, soc=0.6)), view(1, A, LOW), False),
    "descriptor": (view(0, A, B), view(1, A, descriptor(1, soc=0.4, stamp_ns=9)), False),
    "age": (view(0, A, B, age_s=0.4), view(1, A, B), True),
}
"""By cause: two views that differ in it alone, and whether they disagree about sending at all."""


def test_the_cause_is_the_difference_that_decides() -> None:
    for cause, (one, other, sends) in CAUSE_OF.items():
        (pair,) = measured([one, other])
        assert {e.cause for e in pair.episodes} == {cause}
        assert (cause, sends) in {(e.cause, e.sends) for e in pair.episodes}
    old = view(0, A, B, age_s=0.2)  # an older descriptor, but no older than `cautious` minds
    (pair,) = measured([old, view(1, A, discounted(descriptor(1, stamp_ns=5)))])
    assert {e.cause for e in pair.episodes} == {"trust"}, "what does not decide is not the cause"


# --- the paper's bound: disagreement disappears once the views converge -----------------------------


def test_equal_and_fresh_descriptors_leave_nothing_to_disagree_about() -> None:
    wrong = []
    for policy in POLICIES:
        decide, rng = resolve(policy), random.Random(7)
        for number in range(20):
            drawn = draw_view(11, number)
            fresh = [
                drawn._replace(ego=i, age_s={k: rng.uniform(0.0, 3.0) * drawn.period_s for k in drawn.descriptors})
                for i in drawn.descriptors
            ]
            decisions = [Decision(0.001 * k, v.ego, policy, v, ()) for k, v in enumerate(fresh)]
            if any(pair.episodes for pair in measure(decisions, lambda _, d=decide: d, 1.0)):  # type: ignore[misc]
                wrong.append((policy, number))
    assert wrong == []


DRONES, CHANGES_UNTIL, FRAMES = 4, 10, 19


def rehearse(policy: str, seed: int, *, delay_s: float, loss: float = 0.0) -> float:
    """Drones of which contexts change at random in every frame until `CHANGES_UNTIL`, and packets are lost until then.

    Every descriptor that is not lost arrives within `delay_s`. The memories are those that fly. Returns when the last
    disagreement ended, s.
    """
    rng = random.Random(seed)
    rules = FleetRules(PERIOD_S, FRAMES, 3.0, 10.0, 1.0, 0.2, 0.03, form=FULL)
    memories = [PeerMemory(i, rules, DroneStatus()) for i in range(DRONES)]
    contexts = [_context(rng, i) for i in range(DRONES)]
    on_the_way: list[tuple[float, int, Descriptor]] = []
    decisions, latest = [], dict[tuple[int, int], int]()
    published: dict[int, Descriptor] = {}
    for frame in range(FRAMES):
        for i, memory in enumerate(memories):
            now_s = frame * PERIOD_S + 0.001 * i
            if frame <= CHANGES_UNTIL:
                contexts[i] = _context(rng, i)
            own = contexts[i]._replace(stamp_ns=round(frame * PERIOD_S * 1e9))
            own = published[i] = apply_hysteresis(published.get(i, own), own, rules.hysteresis)
            memory.hold(own, now_s)
            lost = loss if frame <= CHANGES_UNTIL else 0.0
            hearers = [j for j in range(DRONES) if j != i and rng.random() >= lost]
            on_the_way += [(now_s + rng.uniform(0.2, 1.0) * delay_s, j, own) for j in hearers]
            for arrives_s, j, heard in sorted(on_the_way, key=lambda each: each[0]):
                if arrives_s <= now_s and heard.stamp_ns > latest.get((j, heard.agent_id), -1):
                    latest[j, heard.agent_id] = heard.stamp_ns  # one that was overtaken is refused, as by its counter
                    memories[j].hold(heard, arrives_s)
            on_the_way = [each for each in on_the_way if each[0] > now_s]
            decisions.append(Decision(now_s, i, policy, memory.view(now_s), ()))
    decide = resolve(policy)
    pairs = measure(decisions, lambda _: decide, PERIOD_S)
    return max((e.begin_s + e.duration_s for pair in pairs for e in pair.episodes), default=0.0)


def _context(rng: random.Random, drone: int) -> Descriptor:
    """A drone in any state, near the others."""
    drawn = draw_view(rng.randrange(10**6), 3)
    one = rng.choice(list(drawn.descriptors.values()))
    x_m, y_m = rng.uniform(-60, 60), rng.uniform(-60, 60)
    return one._replace(
        agent_id=drone,
        position_m=(x_m, y_m, 60.0),
        footprint_radius_m=42.0,
        battery_soc=rng.choice([0.2, 0.45, 0.59, 0.61, 0.7, 1.0]),
        peer_goodput_mbps=tuple(rng.choice([0.0, 4.0, 5.5, 6.0, 80.0]) for _ in range(DRONES - 1)),
    )


def test_disagreement_ends_a_period_and_a_delay_after_the_last_change() -> None:
    """The change is published in its frame, and is read in the first frame after it arrived."""
    late = {}
    for policy in POLICIES:
        for delay_s in (0.08, 0.18):
            last_s = rehearse(policy, 5, delay_s=delay_s)
            bound_s = (CHANGES_UNTIL + math.ceil(delay_s / PERIOD_S)) * PERIOD_S
            disagrees = policy in ("worked", "best-2", "deputies")
            if last_s > bound_s + 1e-9 or (disagrees and last_s <= CHANGES_UNTIL * PERIOD_S - 0.5):
                late[policy, delay_s] = last_s
    assert late == {}


def test_packets_lost_before_leave_no_disagreement_behind() -> None:
    """Once every drone has heard a packet of every other one, what each missed before decides nothing."""
    ends_s = {
        (policy, seed): rehearse(policy, seed, delay_s=0.08, loss=0.3)
        for policy in ("worked", "deputies", "adaptive")
        for seed in range(4)
    }
    assert {key: s for key, s in ends_s.items() if s > (CHANGES_UNTIL + 2) * PERIOD_S + 1e-9} == {}
    assert min(ends_s.values()) > 0.0


# --- in flight -----------------------------------------------------------------------------------

SHORT = {"duration_s": 5, "perception.detector": "none", "record": {"disagreement": True, "views": True}}


@functools.cache
def with_a_fault() -> sortie.Run:
    """A flight of its own, of drones that hover: half of drone 1's energy is gone at 3 s, and nothing else changes."""
    fault = {"kind": "battery_fault", "at_s": 3.0, "drone": 1, "lost_fraction": 0.5}
    return sortie.fly("track_target", {**SHORT, "fleet.route.waypoints_m": [[0, 0]], "events": [fault]})


@functools.cache
def with_losses() -> sortie.Run:
    """A flight of its own, in which packets are lost; a doubted drone has no claims, so nobody is doubted."""
    lossy = {"fleet.formation.spacing_m": 150, "radio.bursts.good_to_bad": 0.3, "context.trust": False}
    return sortie.fly("track_target", {**SHORT, **lossy, "duration_s": 8})


def test_a_step_of_one_charge_is_disagreed_about_for_one_period() -> None:
    pairs = pairs_of(with_a_fault().tables["disagreement"])
    after = [(p.drone, p.other, e) for p in pairs for e in p.episodes if e.source == 1 and e.begin_s >= 3.0]
    assert after
    assert all(1 in (drone, other) for drone, other, _ in after), "the others heard the same"
    assert [e.begin_s for _, _, e in after] == pytest.approx([3.0] * len(after))
    assert [e.duration_s for _, _, e in after] == pytest.approx([0.1] * len(after))
    assert {e.cause for _, _, e in after} == {"descriptor"}


def test_all_who_hear_a_descriptor_read_the_same() -> None:
    """Whichever packets they lost before."""
    run = with_losses()
    read = run.tables["view_descriptors"].select(["agent_id", "stamp_ns"]).to_pylist()
    assert len({(d["agent_id"], d["stamp_ns"]) for d in read}) == len(read)
    assert max(pc.list_flatten(run.tables["views"]["ages_s"]).to_pylist()) > 1.0, "packets were lost"
    assert run.outcome["disagreement"]["causes"]["values"] == 0.0


def test_the_outcome_has_it_where_it_is_measured(tmp_path: Path) -> None:
    run = with_losses()
    assert outcome(recorded("base"))["disagreement"] == {
        **dict.fromkeys(("share", "sends_share", "episodes", "mean_s", "p99_s", "longest_s")),
        "causes": dict.fromkeys(CAUSES),
    }
    metrics = run.metrics
    assert 0.0 < metrics["disagreement.sends_share"] <= metrics["disagreement.share"] < 1.0
    assert sum(metrics[f"disagreement.causes.{c}"] for c in CAUSES) == pytest.approx(metrics["disagreement.share"])
    assert "by cause:" in str(run.summary())
    back = sortie.open_run(run.save(tmp_path / "run", recording=False))
    assert back.outcome["disagreement"] == run.outcome["disagreement"]


def test_a_replay_measures_it_too_and_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = with_a_fault()
    assert sortie.replay(run).disagreement is None
    assert sortie.replay(run, disagreement=True).disagreement == run.outcome["disagreement"]
    quiet = sortie.replay(run, "silence", disagreement=True).disagreement
    assert quiet is not None
    assert quiet["share"] == 0.0
    run.save(tmp_path / "run", recording=False)
    assert command("replay", tmp_path / "run", "--disagreement") == 0
    assert "of link-time" in capsys.readouterr().out


def test_a_policy_that_fails_for_another_ego_is_named() -> None:
    def own(view: FleetView) -> list[Directive]:
        assert view.age_s[view.ego] < 0.02, "not my own view"
        return []

    with pytest.raises(sortie.PolicyError, match=r"as drone \d, by the view of drone \d: AssertionError: not my own"):
        sortie.fly("track_target", {**SHORT, "duration_s": 1}, policy=own)
