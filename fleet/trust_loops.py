"""The compiled loop over claims of charge (`sortie.fleet.trust`); it rounds as Python does."""

from __future__ import annotations

import numpy as np

from sortie.scenarios.compiled import compiled, part

# constants of the file itself: kept machine code does not see that another file has changed
_RISE, _PERCENT, _FALL, _FALL_SHARE, _LONG_SILENCE = 0.03, 0.01, 0.005, 0.1, 30  # those of `sortie.fleet.trust`
_JUMP, _MOST_JUMP = 0.015, 0.05
"""A fall by so much a second, or by the second at once, is a fault, or a lie that begins; either way the charge is watched
anew. Above a step of whole percents, and no higher: in a fleet of two or three a fault below it passes for the fleet's
fall. A small pack that is heard every ten seconds falls by more than the first between two claims."""


@part
def _median_without(ascending, value):
    """The median of the others, where `value` is one of several; 0 where it is the only one."""
    at, rest = np.searchsorted(ascending, value), len(ascending) - 1
    if rest <= 0:
        return 0.0
    middle = rest // 2
    high = ascending[middle + (middle >= at)]
    return high if rest % 2 else (ascending[middle - 1 + (middle > at)] + high) / 2


@compiled
def watch_charge(rows, ids, claimed_soc, flies, soc_step):
    """Age standings by a second, and hold claims of charge against them and against the fleet's fall.

    Args:
        rows: [ids], of all standings (`Standings.rows`); changed, but for the strikes.
        ids: [K], who was heard, ascending.
        claimed_soc: [K], what they claim.
        flies: [K], whether they do. Only their charge is one of the fleet's.
        soc_step: the step in which charge is written.

    Returns:
        [K], whether a claim is a doubt; and [K], by how much the charge of the others fell since it was first judged.
    """
    for i in range(len(rows)):  # who was not heard drains on: its fall, once it is heard again, is over this second too
        rows[i].seconds += rows[i].is_there
        rows[i].unheard += rows[i].is_there
    fell_per_s = np.empty(len(ids))
    for k in range(len(ids)):
        row, soc = rows[ids[k]], claimed_soc[k]
        percents = soc / _PERCENT
        row.fine |= abs(percents - np.rint(percents)) > 1e-4
        unheard = max(row.unheard - 1, 0)
        if row.seconds <= 1 or unheard >= _LONG_SILENCE or soc < row.least_soc - min(_JUMP * (1 + unheard), _MOST_JUMP):
            row.seconds, row.first_soc = 1, soc
        row.is_there, row.unheard = True, 0
        fell_per_s[k] = (row.first_soc - soc) / max(row.seconds - 1, 1)
    ascending = np.sort(fell_per_s[flies])
    doubted, others_fell = np.zeros(len(ids), np.bool_), np.zeros(len(ids))
    for k in range(len(ids)):
        row, soc = rows[ids[k]], claimed_soc[k]
        if flies[k]:
            others_fell[k] = _median_without(ascending, fell_per_s[k]) * (row.seconds - 1)
        unseen = max(3 * soc_step, 0.0 if row.fine else _PERCENT)
        doubted[k] = soc > row.least_soc + _RISE or (
            others_fell[k] >= _FALL + unseen and row.first_soc - soc < _FALL_SHARE * others_fell[k]
        )
        row.least_soc = min(row.least_soc, soc)
    return doubted, others_fell
