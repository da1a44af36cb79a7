"""Warp, fusion, decoding and weights: what must come out whatever the network has learned."""

import math

import numpy as np
import pytest
import torch

from research.train.learn import loss_of, targets
from sortie.perception.network.decode import decode


def perfect(cars: np.ndarray) -> torch.Tensor:
    """The head output that says exactly what `targets` asks for."""
    labels = targets([cars])
    out = torch.zeros(7, 128, 128)
    out[0] = torch.logit(labels.heat[0].clamp(1e-4, 1 - 1e-4))
    order = labels.weight.argsort(stable=True)  # where two cars claim a cell the nearer one has it
    out[1:].flatten(1)[:, labels.cell[order]] = labels.values[order].T
    return out


def test_decoding_inverts_the_targets() -> None:
    cars = np.array([(10.3, -20.1, 4.4, 1.8, 0.3), (-99.0, 60.0, 5.5, 2.0, 1.5), (50.0, 50.0, 4.0, 1.7, -0.8)])
    found = decode(perfect(cars), 0.5).numpy()
    assert len(found) == 3
    for car in cars:
        nearest = found[np.argmin(np.hypot(*(found[:, :2] - car[:2]).T))]
        assert nearest[:4] == pytest.approx(car[:4], abs=1e-3)
        assert math.sin(nearest[4] - car[4]) == pytest.approx(0, abs=1e-3)
    assert len(decode(perfect(cars), 1.0)) == 0


def test_the_loss_knows_right_from_wrong() -> None:
    cars = np.array([(10.3, -20.1, 4.4, 1.8, 0.3), (-60.0, 60.0, 5.5, 2.0, 1.5)])
    right = loss_of(perfect(cars)[None], targets([cars]))
    shifted = cars + np.array([1.6, 0, 0, 0, 0])
    assert right < 0.6
    assert loss_of(perfect(shifted)[None], targets([cars])) > right + 1
    assert loss_of(perfect(cars * [1, 1, 1.2, 1, 1])[None], targets([cars])) > right + 0.03
    assert torch.isfinite(loss_of(torch.zeros(1, 7, 128, 128), targets([cars[:0]])))
