"""Draws of the radio that must be independent: of senders, receivers, pairs, purposes, seeds and replications."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from radio_examples import CROSS_M
from radio_flights import Hover

from sortie.radio.channel.bursts import PairStates
from sortie.radio.channel.draws import StreamShadowing
from sortie.radio.settings import AirSettings, BurstSettings

Array = np.ndarray[Any, Any]
CALM = AirSettings(shadowing_sigma_db=0.0)
LOSSY = AirSettings(shadowing_sigma_db=0.0, retry_limit=0, bursts=BurstSettings(loss_good=0.5))


def lost_pieces(sender: int, receiver: int, seed: int = 1, replication: int = 0) -> Array:
    """Which pieces of 40 samples were lost, one bit each, where a link loses half of them and nobody else sends."""
    flight = Hover(LOSSY, n=4, seed=seed, replication=replication)
    flight.fly(4.0, lambda k: flight.send(sender, receiver, 60 * 200, piece_bytes=200))
    lost = np.zeros((40, 60), bool)
    assert len(flight.rows) == 40
    for k, row in enumerate(flight.rows):
        lost[k, list(row.missing) if row.arrived_bytes else slice(None)] = True
    return lost[lost.mean(axis=1) < 1].ravel()[: 60 * 20]


def test_losses_are_drawn_for_each_sender_direction_seed_and_replication() -> None:
    """Also between senders with the same history: neither shares its losses with the way back."""
    flights = {
        "there": lost_pieces(0, 1),
        "back": lost_pieces(1, 0),
        "other pair": lost_pieces(2, 3),
        "other receiver": lost_pieces(0, 2),
        "other seed": lost_pieces(0, 1, seed=2),
        "other replication": lost_pieces(0, 1, replication=1),
    }
    assert np.array_equal(flights["there"], lost_pieces(0, 1))
    for (a, one), (b, other) in combinations(flights.items(), 2):
        if {a, b} == {"there", "other receiver"}:
            continue  # one sender with one history
        n = min(len(one), len(other))
        assert n > 500
        assert 0.3 < one.mean() < 0.7
        agree = float(np.mean(one[:n] == other[:n]))
        assert agree == pytest.approx(0.5, abs=0.09), (a, b)


def test_receivers_lose_a_descriptor_each_by_a_draw_of_its_own() -> None:
    flight = Hover(LOSSY, n=5)
    flight.fly(60.0, lambda k: flight.publish(k % 2))
    for sender in (0, 1):
        others = [j for j in range(5) if j != sender]
        heard = np.array([[j in ids for j in others] for _, who, ids in flight.heard if who == sender])
        assert heard.mean() == pytest.approx(0.5, abs=0.06)
        off = np.corrcoef(heard.T)[~np.eye(4, dtype=bool)]
        assert np.abs(off).max() < 0.25


def columns(n: int, seed: int = 1, replication: int = 0) -> Iterator[tuple[str, Array]]:
    """Shadowing and bursts of every pair of n drones, frame by frame."""
    frames, pairs = 3000, np.triu_indices(n, 1)
    settings = AirSettings(shadowing_time_s=0.02)  # hardly any memory
    shadow = StreamShadowing(settings, seed, replication, n, 0.1).block(frames)
    states = PairStates(BurstSettings(good_to_bad=0.5, bad_to_good=0.5, step_s=0.1), n, seed, replication, 0.1)
    bad = np.array([states.advance() for _ in range(frames)])
    for i, j in zip(*pairs, strict=True):
        yield f"shadowing {i} {j} {seed} {replication}", shadow[:, i, j]
        yield f"bursts {i} {j} {seed} {replication}", bad[:, i, j]


def test_pairs_purposes_seeds_and_replications_share_no_draws() -> None:
    each = dict([*columns(3), *columns(3, seed=2), *columns(3, replication=1)])
    values = np.array(list(each.values()), float)
    assert (values.std(axis=1) > 0).all()
    correlation = np.corrcoef(values)
    np.fill_diagonal(correlation, 0.0)
    worst = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    assert np.abs(correlation).max() < 0.1, [list(each)[k] for k in worst]


def test_drones_publish_at_moments_of_their_own() -> None:
    def moments(seed: int, replication: int = 0) -> list[float]:
        flight = Hover(CALM, CROSS_M, seed=seed, replication=replication)
        flight.fly(0.3, lambda k: [flight.publish(i) for i in range(6)] if k == 1 else None)
        at = {sender: t_s - 0.1 for t_s, sender, _ in flight.heard}
        assert 0.0 < min(at.values()) < max(at.values()) < 0.09
        return [at[i] for i in range(6)]

    all_of_them = [*moments(1), *moments(2), *moments(1, replication=1)]
    gaps = np.diff(np.sort(all_of_them))
    assert gaps.min() > 1e-6
    assert np.ptp(all_of_them) > 0.05
