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
    [-1.413, -0.067, 2.613, -0.675, -0.141, -1.004],
    [0.966, 1.763, 1.384, 0.22, 1.147, 1.013],
    [-3.295, 1.553, -1.67, -3.324, 0.377, -1.011],
]
"""Trained by train.py."""


@sortie.boxes_across_networks
def learned(view):
    """The option with the highest score on each link."""
    return decide(WEIGHTS, view)
