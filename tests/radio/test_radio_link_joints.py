"""Parts of the air by hand: who is counted as having missed a descriptor, what a sender knows and for how long, which links hold.

1. Descriptors: every living drone but the sender has heard one or missed it for a reason.
2. What senders know: measurements and their age, rates that were tried, traces and bursts beside the models.
3. The channel: jammers, attitudes, other ways, models of one's own, fleets of any size.
4. Frames of a sample: their lengths, their rates, and what they count for.
5. How a fleet hangs together, and how far anything is heard.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from radio_examples import CROSS_M, still
from radio_flights import Hover, trace

from sortie.radio.channel.antenna import antenna_loss_db
from sortie.radio.channel.bursts import PairStates, bad_share
from sortie.radio.channel.earshot import near_pairs
from sortie.radio.channel.pathloss import free_space_loss_db, path_loss_db, range_m, two_ray_loss_db
from sortie.radio.channel.snr import Channel, earshot_m, noise_dbm
from sortie.radio.channel.traces import LinkTrace
from sortie.radio.counters import CAUSES, Counters
from sortie.radio.goodput import Goodput
from sortie.radio.mac.broadcasts import Broadcasts
from sortie.radio.mac.rate_control import INTERVAL_S, Minstrel
from sortie.radio.overrides import LinkNow, Overrides
from sortie.radio.rates import LEGACY_CURVES, STANDARDS, group_curve
from sortie.radio.relay import Routes, cheapest
from sortie.radio.sample import UNUSED, Sample, Service
from sortie.radio.settings import AccessSettings, AirSettings, BurstSettings, EdcaSettings
from sortie.radio.topology import connectivity, linked_drones
from sortie.radio.transmission import Status
from sortie.scenarios.link_state import MEASURED_FOR_S, SILENT_MBPS, WAITING_MBPS

CALM = AirSettings(shadowing_sigma_db=0.0)
HEARD = len(CAUSES) + 1


# --- descriptors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_lists", [True, False])
@pytest.mark.parametrize("gone", [set(), {3}, {0, 3}])
@pytest.mark.parametrize("far", [False, True])
def test_every_living_drone_hears_a_descriptor_or_misses_it_for_a_reason(
    as_lists: bool, gone: set[int], far: bool
) -> None:
    """Drone 0 sends; 1 hears it, 2 meets another, 3 sends itself, 4 is too weak, or out of reach and not named at all."""
    counters, heard = Counters(), []
    casts = Broadcasts(
        6.0, 6, counters, gone, seed=1, replication=0, frame_s=0.1, publish_spread=0.8, as_lists=as_lists
    )
    names = ("collision_data", "half_duplex", "weak_signal")
    fates = [0, HEARD, *(1 + CAUSES.index(name) for name in names), HEARD]
    receivers = np.arange(6)
    if far:
        receivers, fates = np.delete(receivers, 4), [*fates[:4], fates[5]]
    casts.end(casts.frame(0, 180, heard.append), receivers, bytes(fates))
    assert heard == [[1, 5]]
    missed = 3 - (3 in gone)
    assert (counters.receptions, counters.missed, counters.collided) == (2, missed, 1)
    wanted = dict.fromkeys(CAUSES, 0) | {"collision_data": 1, "half_duplex": int(3 not in gone), "weak_signal": 1}
    assert counters.lost_to == wanted
    assert sum(counters.lost_to.values()) == counters.missed


def test_a_descriptor_that_meets_several_others_is_one_that_collided() -> None:
    counters = Counters()
    casts = Broadcasts(6.0, 4, counters, set(), seed=1, replication=0, frame_s=0.1, publish_spread=0.8, as_lists=True)
    casts.end(casts.frame(2, 100, lambda ids: None), np.arange(4), bytes([1, 2, 0, 3]))
    casts.end(casts.frame(2, 100, lambda ids: None), np.arange(4), bytes([4, 5, 0, 4]))
    assert (counters.collided, counters.missed, counters.broadcasts) == (1, 6, 2)


# --- what senders know ---------------------------------------------------------------------------------


def test_a_measurement_counts_for_as_long_as_it_says() -> None:
    known = Goodput(3)
    known.measured(0, 1, 40.0, 1.0)
    assert known.read(0, 1.0 + MEASURED_FOR_S)[1] == 40.0
    known.measured(0, 2, 10.0, 1.0 + MEASURED_FOR_S)
    assert known.read(0, 1.0 + MEASURED_FOR_S + 1e-6) == {2: 10.0}
    known.measured(0, 2, 60.0, 2.0 + 2 * MEASURED_FOR_S)  # the one before is too old to rise from
    assert known.read(0, 2.0 + 2 * MEASURED_FOR_S)[2] == 60.0
    assert known.read(1, 1.0) == {}


def test_a_wait_bounds_what_is_known_and_says_nothing_of_what_is_not() -> None:
    known = Goodput(2)
    known.bounded(0, 1, 5.0)
    assert known.read(0, 0.0) == {}
    known.measured(0, 1, 20.0, 0.0)
    known.bounded(0, 1, 50.0)
    assert known.read(0, 0.0)[1] == 20.0
    known.bounded(0, 1, 0.0)
    assert known.read(0, 0.0)[1] == WAITING_MBPS
    known.measured(0, 1, 0.0, 0.1)
    assert known.read(0, 0.1)[1] == SILENT_MBPS


RATES = (10.0, 20.0, 40.0)


def weighed(*exchanges: list[tuple[int, int]]) -> int:
    """The rate after intervals in which so many frames were sent and acknowledged at each rate."""
    minstrel, now_s = Minstrel(RATES), 0.0
    assert minstrel.mcs(0, 1, now_s) == 0
    for counts in exchanges:
        minstrel.sent(0, 1, now_s, counts)
        now_s += INTERVAL_S
        best = minstrel.mcs(0, 1, now_s)
    return best


def test_rates_are_weighed_by_what_came_through() -> None:
    """A tenth is enough, less is not; nothing that came through counts too; above nine tenths the faster one wins."""
    none = (0, 0)
    assert weighed([none, none, (100, 10)]) == 2
    assert weighed([none, none, (100, 9)]) == 0
    assert weighed([(10, 10), none, (100, 26)]) == 2  # 10.4 Mb/s beat 9
    assert weighed([(10, 10), none, (100, 22)]) == 0
    assert weighed([none, (10, 10), (10, 10)], [none, none, (10, 0)]) == 2  # 30 beat 18
    assert weighed([none, (10, 10), (10, 10)], *[[none, none, (10, 0)]] * 3) == 1  # 16.9 do not
    assert weighed([(10, 10), (100, 95), none]) == 1


def test_an_interval_begins_when_the_last_was_weighed() -> None:
    minstrel = Minstrel(RATES)
    minstrel.sent(0, 1, 0.0, [(0, 0), (10, 10), (0, 0)])
    assert minstrel.mcs(0, 1, 5.0) == 1  # long after
    minstrel.sent(0, 1, 5.0, [(0, 0), (10, 0), (10, 10)])
    assert minstrel.mcs(0, 1, 5.0 + 0.5 * INTERVAL_S) == 1
    assert minstrel.mcs(0, 1, 5.0 + INTERVAL_S) == 2
    assert minstrel.mcs(1, 0, 5.0 + INTERVAL_S) == 0  # each direction by itself


def overrides(trace: LinkTrace | None = None, n: int = 3, **bursts: float) -> Overrides:
    settings = AirSettings(bursts=BurstSettings(**bursts))
    return Overrides(settings, trace, n, seed=2, replication=0, frame_s=0.1)


def given(**qualities: tuple[list[float], list[float]]) -> LinkTrace:
    """A trace of the link from 0 to 1."""
    return LinkTrace({(0, 1): {name: (np.array(t), np.array(v)) for name, (t, v) in qualities.items()}})


def test_a_traced_snr_is_known_a_frame_later() -> None:
    both = overrides(given(snr_db=([0.0, 1.0], [10.0, 20.0])))
    modelled = np.full((3, 3), 5.0)
    for frame in range(4):
        both.advance(None)
        now, before = 10.0 + frame, 10.0 + max(frame - 1, 0)
        assert both.snr_db(modelled)[0, 1] == pytest.approx(now)
        assert both.known_snr_db(modelled)[0, 1] == pytest.approx(before)
        assert both.snr_of(0, 1, 1.0, 2.0) == pytest.approx((before, now))
        assert both.snr_of(1, 0, 1.0, 2.0) == (1.0, 2.0)
        assert both.known_snr_db(modelled)[1, 0] == 5.0


def test_jammers_lift_the_noise_of_who_receives() -> None:
    both = overrides(LinkTrace({link: {"snr_db": (np.zeros(1), np.full(1, 30.0))} for link in ((0, 1), (1, 0))}))
    loss_db = np.zeros((3, 3))
    loss_db[1, 0] = 4.0
    both.advance(loss_db, np.array([1.0, 7.0, 0.0]))
    assert both.snr_db(loss_db)[[0, 1], [1, 0]].tolist() == [23.0, 25.0]


def test_a_traced_loss_stands_in_place_of_bursts_and_a_goodput_alone_loses_nothing() -> None:
    lossy = overrides(given(loss=([0.0], [0.2])), loss_good=0.5)
    lossy.advance(None)
    assert lossy.group_loss()[0, 1] == 0.2
    assert lossy.group_loss()[1, 0] == 0.5
    assert lossy.link(0, 1) == (0.5, 0.2, pytest.approx(math.nan, nan_ok=True))
    at = given(goodput_mbps=([0.0, 1.0], [8.0, 0.0]), loss=([0.0], [0.3])).at(0.0, 2)
    assert (at.loss[0, 1], at.goodput_mbps[0, 1]) == (0.3, 8.0)
    alone = given(goodput_mbps=([0.0, 1.0], [8.0, 0.0]))
    assert [alone.at(t_s, 2).loss[0, 1] for t_s in (0.0, 0.5, 1.0)] == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("bursts", "wanted"), [({"loss_good": 0.1}, True), ({"good_to_bad": 0.1}, True), ({"loss_bad": 1.0}, False)]
)
def test_good_pairs_that_lose_are_bursts_too(bursts: dict[str, float], wanted: bool) -> None:
    assert Overrides.wanted(AirSettings(bursts=BurstSettings(**bursts))) is wanted
    both = overrides(**bursts)
    both.advance(None)
    if "good_to_bad" not in bursts:
        assert bool(both.group_loss()[0, 1]) is wanted


def test_pairs_change_once_a_step_and_lose_by_their_state() -> None:
    """Steps of three frames, of which the last begins by rounding a little late."""
    bursts = BurstSettings(good_to_bad=0.3, bad_to_good=0.3, step_s=0.3, loss_good=0.25, loss_bad=0.75)
    pairs = PairStates(bursts, 12, 5, 0, 0.1)
    rows = [pairs.advance() for _ in range(30)]
    for frame in range(1, 30):
        assert np.array_equal(rows[frame], rows[frame - 1]) is (frame % 3 != 0)
    assert set(np.unique(np.array(rows))) == {0.25, 0.75}
    first = [PairStates(bursts, 40, seed, 0, 0.1).advance() for seed in range(3)]
    upper = np.triu_indices(40, 1)
    bad = np.mean([(row[upper] == 0.75).mean() for row in first])
    assert bad == pytest.approx(bad_share(0.3, 0.3), abs=0.04)


def test_a_step_as_long_as_a_frame_is_one_in_every_frame() -> None:
    """However the multiples of a tenth are rounded: pairs that change at each step change a hundred times."""
    pairs = PairStates(BurstSettings(good_to_bad=1.0, bad_to_good=1.0, step_s=0.1), 3, 1, 0, 0.1)
    states = [bool(pairs.advance()[0, 1]) for _ in range(101)]
    assert [a != b for a, b in pairwise(states)] == [True] * 100


@pytest.mark.parametrize("rows", [("0,0,1,,0,", "0,1,0,,0,"), ("0,0,1,,,30", "0,1,0,,,30")])
def test_descriptors_of_links_that_are_traced_both_ways_go_by_the_trace(rows: tuple[str, ...], tmp_path: Path) -> None:
    """However weak the model's signal is there: neither link is the other's way back."""
    settings = AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=-60.0, trace=trace(tmp_path, *rows))
    flight = Hover(settings)
    flight.fly(1.0, lambda k: [flight.publish(i) for i in (0, 1)])
    assert [ids for _, _, ids in flight.heard] == [(1 - who,) for _, who, _ in flight.heard]
    assert len(flight.heard) == 20


# --- the channel ---------------------------------------------------------------------------------------


def test_a_jammer_is_heard_by_the_antenna_as_the_drone_holds_it() -> None:
    """A dipole on its side, with the jammer along it, hears least; one upright hears it broadside."""
    up = np.tile([0.0, 0.0, 1.0], (3, 2, 1))
    up[:, 1] = (1.0, 0.0, 0.0)
    at = np.array([[0.0, 0.0, 60.0], [0.0, 20.0, 60.0]])
    jammers = [((0.0, 0.0, 60.0 + 1e-9), 20.0), ((300.0, 20.0, 60.0), 20.0)]
    channel = Channel(AirSettings(antenna="dipole", shadowing_sigma_db=0.0), still(at, 3), 1, 0, 0.1, up)
    channel.advance()
    mw = 10 ** (channel.noise_dbm / 10)
    far = 10 ** (channel.noise_rise_db(jammers[1:]) / 10) * mw - mw
    loss_db = path_loss_db(CALM, np.hypot([300.0, 300.0], [20.0, 0.0]), 60.0, 60.0)
    lost_db = antenna_loss_db("dipole", np.array([0.0, 1.0]))
    np.testing.assert_allclose(10 * np.log10(far), 20.0 - loss_db - lost_db, atol=1e-6)


def test_a_jammer_on_the_ground_is_heard_from_there() -> None:
    settings = AirSettings(path_loss="two_ray", ground_roughness_m=0.0, shadowing_sigma_db=0.0)
    channel = Channel(settings, still(CROSS_M[:1], 2), 1, 0, 0.1)
    channel.advance()
    rise_db = channel.noise_rise_db([((500.0, 0.0, 1.5), 30.0)])[0]
    loss_db = float(two_ray_loss_db(math.hypot(500.0, 58.5), 60.0, 1.5, 5.2))
    mw = 10 ** (channel.noise_dbm / 10)
    assert 10 * math.log10(10 ** (rise_db / 10) * mw - mw) == pytest.approx(30.0 - loss_db)


@pytest.mark.parametrize("at_frame", [3, 20])
@pytest.mark.parametrize("distance_m", [None, 30.0])
def test_another_way_changes_no_shadow_that_was_drawn(at_frame: int, distance_m: float | None) -> None:
    """In the middle of a block: each frame keeps the moment that it is of."""
    settings = AirSettings(shadowing_distance_m=distance_m)
    here, there = still(CROSS_M[:3], 60), still(CROSS_M[:3] + np.array([50.0, 0.0, 0.0]), 60)
    flown = np.concatenate([here[: at_frame + 1], there[at_frame + 1 :]])
    changed, planned = Channel(settings, here, 1, 0, 0.1), Channel(settings, flown, 1, 0, 0.1)
    for frame in range(40):
        for channel in (changed, planned):
            channel.advance()
        np.testing.assert_allclose(changed.snr_db, planned.snr_db, atol=1e-9)
        np.testing.assert_allclose(changed.shadow_db, planned.shadow_db, atol=1e-9)
        if frame == at_frame:
            changed.reroute(flown)


def test_a_link_model_is_shown_each_frame_s_own_places_and_no_link_to_oneself() -> None:
    seen: list[tuple[float, np.ndarray, np.ndarray]] = []

    class Shown:
        def __init__(self, drones: int, frame_s: float, rng: np.random.Generator) -> None: ...

        def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
            seen.append((t_s, positions_m, snr_db))
            return np.nan_to_num(snr_db)

    at = np.array(still(CROSS_M[:3], 5))
    at += np.arange(5.0)[:, None, None]
    channel = Channel(AirSettings(link=Shown), at, 1, 0, 0.1)
    for _ in range(5):
        channel.advance()
    for frame, (t_s, places_m, snr_db) in enumerate(seen):
        assert t_s == pytest.approx(0.1 * frame)
        np.testing.assert_array_equal(places_m, at[frame])
        assert np.isnan(np.diag(snr_db)).all()


@pytest.mark.parametrize("n", [5, 40])
def test_power_and_antennas_act_on_fleets_of_any_size(n: int) -> None:
    """Of both ends: a dipole that looks down on its peer loses there, an isotropic antenna nowhere."""
    at = np.zeros((1, n, 3)) + np.arange(n)[:, None] * np.array([25.0, 0.0, 0.0])
    at[..., 2] = 60.0 + 40.0 * (np.arange(n) % 2)
    found = {}
    for power_dbm, own in ((20.0, {}), (13.0, {}), (20.0, {0: "dipole"})):
        settings = AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=power_dbm, own_antennas=own)  # type: ignore[arg-type]
        channel = Channel(settings, np.repeat(at, 3, axis=0), 1, 0, 0.1)
        channel.advance()
        found[power_dbm, len(own)] = channel.snr_db
    np.testing.assert_allclose(found[13.0, 0][0, 1:3], found[20.0, 0][0, 1:3] - 7.0, atol=1e-4)
    lost_db = found[20.0, 0] - found[20.0, 1]
    cosine = 40.0 / math.hypot(25.0, 40.0)
    assert lost_db[0, 1] == pytest.approx(float(antenna_loss_db("dipole", cosine)), abs=1e-4)
    assert lost_db[1, 0] == pytest.approx(lost_db[0, 1], abs=1e-4)
    assert abs(lost_db[1, 2]) < 1e-4
    assert abs(lost_db[0, 2]) < 1e-4


# --- frames of a sample ----------------------------------------------------------------------------------


def sample(payload: int, fragments: int, piece_bytes: int = 0, *, reliable: bool = False) -> Sample:
    return Sample(
        0, 0, 1, "k", payload, reliable, 0.0, 1.0, lambda row: None, fragments, (0, UNUSED, 20.0, 0), 0.0, piece_bytes
    )


@pytest.mark.parametrize(
    ("payload", "fragments", "piece", "reliable", "left", "frames"),
    [
        # fragments have 150 B around them; in a repair any of three is a fragment still, and may be a long one
        (3000, 3, 0, False, 3, (1494, 462, 3450)),
        (3000, 3, 0, False, 2, (1494, 1494, 2988)),
        (3000, 3, 0, False, 1, (1494, 1494, 1494)),
        # a sample of one frame has 142 B, and so has each piece that is of use alone
        (1000, 1, 0, False, 1, (1142, 1142, 1142)),
        (2500, 3, 1000, False, 3, (1142, 642, 2926)),
        (2500, 3, 1000, False, 2, (1142, 1142, 2284)),
        (700, 1, 1000, False, 1, (842, 842, 842)),
        # a heartbeat and its answer of 268 B take time behind the last frame, and are counted elsewhere
        (1000, 1, 0, True, 1, (1142, 1142 + 268, 1142)),
        (3000, 3, 0, True, 3, (1494, 462 + 268, 3450)),
        (2500, 3, 1000, True, 2, (1142, 1142 + 268, 2284)),
    ],
)
def test_frames_are_as_long_as_what_they_carry(
    payload: int, fragments: int, piece: int, reliable: bool, left: int, frames: tuple[int, int, int]
) -> None:
    """Each frame but the last, the last one, and all of them on the wire, by hand."""
    s = sample(payload, fragments, piece, reliable=reliable)
    s.left = left
    Service(CALM, -88.0).prepare(s)
    assert (s.frames, s.full_bytes, s.last_bytes, s.pass_wire * left) == (left, *frames[:2], pytest.approx(frames[2]))


@pytest.mark.parametrize(("unreachable", "frames"), [("", 10), ("no_link", 4), ("receiver_gone", 4)])
@pytest.mark.parametrize("passes", [0, 2])
def test_tries_of_a_dead_link_put_no_bytes_on_the_wire(unreachable: str, frames: int, passes: int) -> None:
    """Of ten frames four were sent before the link died. Passes that are over count likewise."""
    s = sample(3000, 3)
    Service(CALM, -88.0).prepare(s)
    for k in range(passes + 1):
        s.sent_frames, s.sent_before, s.unreachable = 10, 4, unreachable
        if k < passes:
            s.end_pass()
    assert s.row_of(Status.LOST, "", 1.0).wire_bytes == (passes + 1) * frames * 1150


def test_pieces_and_fragments_of_one_length_count_for_the_time_that_each_takes() -> None:
    """A piece has a header of its own, and a fragment another: asked for in turn, each gets its own figure."""
    found = []
    for first in (True, False):
        service = Service(CALM, -88.0)
        pieces, fragments = sample(1344 * 60, 60, 1344), sample(1344 * 60, 60)
        for s in (pieces, fragments):
            service.prepare(s)
            s.mcs, s.full_mbps = 3, 50.0
        order = (pieces, fragments) if first else (fragments, pieces)
        figures = {id(s): service.bits_of_a_frame(s) for s in order}
        found.append((figures[id(pieces)], figures[id(fragments)]))
    assert found[0] == found[1]
    assert found[0][0] != found[0][1]


def test_what_a_link_is_used_at_follows_what_stands_beside_the_models() -> None:
    """A loss alone has some rate however weak the signal; a goodput of nothing is no link; nobody there is not no link."""
    service = Service(CALM, -88.0)
    nan = math.nan

    def use(snr_db: float, given: LinkNow | None, gone: bool = False) -> Any:
        return service.use(0, 1, 0.0, snr_db, gone, given)

    assert use(-50.0, None).unreachable == "no_link"
    assert use(-50.0, LinkNow(0.0, 0.3, nan)).link[:2] == (0, False)
    assert use(-50.0, LinkNow(0.3, nan, nan)).unreachable == "no_link"
    assert use(50.0, LinkNow(0.0, nan, 0.0)).unreachable == "no_link"
    assert use(50.0, None, gone=True).unreachable == "receiver_gone"
    assert use(50.0, LinkNow(0.1, nan, nan)).link.burst_loss == 0.1
    assert math.isnan(use(50.0, None).link.loss)


def test_a_sender_without_a_link_tries_no_rate() -> None:
    service = Service(AirSettings(rate_control="minstrel"), -88.0)
    assert service.use(0, 1, 0.0, -50.0, False).unreachable == "no_link"
    assert service.use(0, 1, 0.0, 50.0, False).link.mcs == 0  # it knows of none yet


@pytest.mark.parametrize("name", ["voice", "background"])
def test_a_traced_goodput_is_that_of_its_own_class_of_traffic(name: str) -> None:
    """Whose frames wait longer for the medium need a higher data rate for the same goodput."""
    rates = {}
    for payload_class in ("best_effort", name):
        settings = AirSettings(payload_class=payload_class, max_ampdu_frames=4)  # type: ignore[arg-type]
        rates[payload_class] = Service(settings, -88.0).use(0, 1, 0.0, 30.0, False, LinkNow(0.0, math.nan, 20.0)).link
    assert (rates[name].rate_mbps < rates["best_effort"].rate_mbps) is (name == "voice")
    assert rates[name].frames == 4
    few = AirSettings(
        standard="n", bandwidth_mhz=20, max_ampdu_frames=256, edca=EdcaSettings(background=AccessSettings(7, 15, 1023))
    )
    assert Service(few, -88.0).use(0, 1, 0.0, 30.0, False, LinkNow(0.0, math.nan, 300.0)).link.frames <= 64


def test_a_sample_was_given_the_channel_in_all_its_passes(tmp_path: Path) -> None:
    """Repairs included: what its sender has transmitted, it was given at least, and no more than passed meanwhile."""
    settings = AirSettings(retry_limit=0, trace=trace(tmp_path, "0,0,1,,0.5,", "0,1,0,,0,"))
    flight = Hover(settings)
    flight.air.advance()
    flight.send(0, 1, 40_000, reliable=True, deadline_s=2.0)
    flight.env.run(until=2.0)
    (row,) = flight.rows
    assert row.repairs > 1
    assert flight.air.airtime_s[0] <= row.airtime_s < row.t_done_s - row.t_start_s


def test_a_measurement_begins_anew_with_another_rate_alone() -> None:
    service = Service(CALM, -88.0)
    s = sample(3000, 3)
    good, weak = (service.use(0, 1, 0.0, db, False) for db in (40.0, 12.0))
    s.use = 0, good, 40.0, 0
    service.begin(s, 1.0)
    s.mark_bits = 500.0
    s.use = 0, good, 39.0, 1
    service.begin(s, 2.0, fresh=False)
    assert (s.mark_s, s.mark_bits, s.snr_db, s.t_first_s) == (1.0, 500.0, 39.0, 1.0)
    s.use = 0, weak, 12.0, 2
    service.begin(s, 3.0, fresh=False)
    assert (s.mark_s, s.mark_bits, s.t_first_s, s.begun_s) == (3.0, 0.0, 1.0, 1.0)
    s.forward(1, 2, 4.0, 77.0)
    assert (s.t_queued_s, s.drained_bits, s.hops, s.t_sent_s) == (4.0, 77.0, 2, 0.0)
    assert s.row_of(Status.LOST, "no_link", 5.0).sender == 0


# --- how far anything is heard -----------------------------------------------------------------------------


def test_a_fleet_s_largest_group_is_the_one_with_the_lowest_id_of_equals() -> None:
    quality = np.zeros((5, 5))
    for i, j in ((0, 3), (3, 0), (1, 2), (2, 1), (1, 4)):
        quality[i, j] = 9.0
    found = connectivity(quality, 5.0)
    assert (found.connected, found.cut) == (False, (1, 2, 4))
    assert linked_drones(quality, 5.0) == [0, 1, 2, 3, 4]
    assert linked_drones(np.where(np.arange(5) == 4, 0.0, quality), 5.0) == [0, 1, 2, 3]
    one_way = np.zeros((3, 3))
    one_way[0, 1] = one_way[1, 2] = 9.0
    assert connectivity(one_way, 5.0).cut == (1, 2)
    assert linked_drones(one_way, 5.0) == [0, 1, 2]


def test_a_route_has_no_more_hops_than_are_left_and_a_direct_link_wins_a_tie() -> None:
    cost = np.array([[0.0, 1.0, 2.0, 9.0], [1.0, 0.0, 1.0, 3.0], [2.0, 1.0, 0.0, 1.0], [9.0, 3.0, 1.0, 0.0]])
    assert cheapest(cost, 2)[1][1][0, 2] == 2  # two hops of 1 are no cheaper than one of 2
    routes = Routes(3)
    routes.renew(np.divide(1.0, cost, out=np.zeros((4, 4)), where=cost > 0))
    assert routes.path(0, 3) == [0, 2, 3]
    routes.renew(np.where(cost == 1.0, 50.0, np.where(cost > 0, 1.0, 0.0)))
    assert routes.path(0, 3) == [0, 1, 2, 3]
    row = np.array([[{0: 0.0, 1: 100.0, 2: 12.0, 3: 5.0, 4: 2.0}[abs(i - j)] for j in range(5)] for i in range(5)])
    routes.renew(row)
    path, left = [0], 3
    while path[-1] != 4:
        path.append(routes.next_hop(path[-1], 4, left))
        left -= 1
    assert routes.path(0, 4) == path
    assert len(path) == 4
    two = Routes(2)
    two.renew(np.where(cost == 1.0, 50.0, np.where(cost > 0, 1.0, 0.0)))
    assert len(two.path(0, 3)) <= 3


@pytest.mark.parametrize("model", ["free_space", "log_distance", "two_ray"])
def test_beyond_its_range_a_path_loses_more(model: Any) -> None:
    settings = AirSettings(path_loss=model, path_loss_exponent=3.0, ground_roughness_m=0.0)
    far = range_m(settings, 110.0) * np.linspace(1.0, 20.0, 4000)
    for height_m in (2.0, 30.0, 120.0):
        assert (path_loss_db(settings, far, height_m, height_m) >= 110.0 - 1e-9).all()
    if model == "two_ray":  # 6 dB may come of two rays that add up
        assert range_m(settings, 110.0) == pytest.approx(
            10 ** ((116.1 - float(free_space_loss_db(1.0, 5.2))) / 20), rel=1e-6
        )


def test_rough_ground_scatters_for_the_model_of_the_settings_as_well() -> None:
    d = np.linspace(30.0, 300.0, 50)
    for roughness_m in (0.0, 0.3):
        settings = AirSettings(path_loss="two_ray", ground_roughness_m=roughness_m)
        np.testing.assert_array_equal(
            path_loss_db(settings, d, 20.0, 30.0), two_ray_loss_db(d, 20.0, 30.0, 5.2, roughness_m)
        )


@pytest.mark.parametrize("bandwidth_mhz", [20, 80])
def test_whatever_the_bandwidth_a_descriptor_is_heard_no_farther_than_earshot(bandwidth_mhz: int) -> None:
    """Its frames fill 20 MHz: over the noise of these they stand higher than over that of a whole wide channel."""
    settings = AirSettings(bandwidth_mhz=bandwidth_mhz, shadowing_sigma_db=0.0, group_rate_mbps=54.0)
    snr_db = 20.0 - float(path_loss_db(settings, earshot_m(settings), 60.0, 60.0)) - noise_dbm(bandwidth_mhz, 7.0)
    in_its_band_db = snr_db + 10 * math.log10(bandwidth_mhz / 20.0)
    assert group_curve(54.0).per(in_its_band_db + 3.0) > 0.5
    narrow, wide = (earshot_m(AirSettings(bandwidth_mhz=w, shadowing_sigma_db=0.0)) for w in (20, 80))
    assert narrow > wide * 0.99


def test_a_basic_rate_has_the_curve_of_its_own_or_of_the_next_above() -> None:
    for rate, wanted in ((1.0, 6.0), (6.0, 6.0), (6.5, 12.0), (9.0, 12.0), (12.0, 12.0), (53.0, 54.0), (54.0, 54.0)):
        assert group_curve(rate) == LEGACY_CURVES[wanted]
    assert STANDARDS["n"].max_ampdu_frames == 64


def test_pairs_that_meet_in_some_frame_are_near() -> None:
    """Two that fly past each other from afar, towards and away: they are near in the frame in which they are."""
    flight = np.zeros((9, 3, 3))
    flight[:, 0, 0], flight[:, 1, 0] = np.linspace(-400, 400, 9), np.linspace(400, -400, 9)
    flight[:, 1, 1], flight[:, 2, 1] = 10.0, 3000.0
    flight[[0, 8], 2, 1] = 30.0
    flight[[0, 8], 2, 0] = flight[[0, 8], 0, 0]
    low, high, apart = near_pairs(flight, 50.0)
    assert list(zip(low.tolist(), high.tolist(), strict=True)) == [(0, 1), (0, 2)]
    assert apart[4, 0] == pytest.approx(10.0)
