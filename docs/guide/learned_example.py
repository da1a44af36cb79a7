"""What to send on each link, by linear scores of what the drone observes."""

import numpy as np

import sortie
from sortie.policies.observation import directives, observe

X, Y, CHARGE, GOODPUT, TRACKING, SEEN_WELL = 2, 3, 9, 12, 16, 23  # columns of an observation
OPTIONS = np.array([[0, 0, 1, 1], [1, 0, 1, 1], [3, 0, 1, 1], [2, 1, 1, 1]])
"""Actions: nothing, boxes, boxes with uncertainty, a tenth of the cells; 5 Hz, the region alone if there is one."""
SHAPE = (len(OPTIONS) - 1, 6)
"""Of the weights: a row for each option but the first, which scores zero."""


def choose(weights, seen):
    """An action [others, 4] from an observation [1 + others, 25]."""
    own, others = seen[0], seen[1:]
    distance = np.hypot(others[:, X], others[:, Y])
    same = np.tile([1.0, own[CHARGE], own[TRACKING], own[SEEN_WELL]], (len(others), 1))
    scores = np.column_stack([same, distance, others[:, GOODPUT]]) @ np.transpose(weights)
    return OPTIONS[np.column_stack([np.zeros(len(others)), scores]).argmax(axis=1)]


def decide(weights, view):
    """The same for a policy: directives from a view."""
    peers = sorted(view.peers)
    return directives(view, peers, choose(weights, observe(view, peers)))


WEIGHTS = [
    [-1.187, 0.117, 2.897, -1.059, -0.675, -0.89],
    [1.196, 1.252, 1.629, 0.514, 1.917, 0.525],
    [-2.825, 1.618, -1.374, -2.912, 0.201, -0.225],
]
"""Trained by train.py."""


@sortie.boxes_across_networks
def learned(view):
    """The option with the highest score on each link."""
    return decide(WEIGHTS, view)
