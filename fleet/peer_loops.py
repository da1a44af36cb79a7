"""Compiled loops over what drones heard of each other (`sortie.fleet.peers`); each rounds as Python does."""

from __future__ import annotations

from functools import partial

import numpy as np

from sortie.scenarios.compiled import compiled, part

within = partial(compiled, allocates=False)

# constants of the file itself: kept machine code does not see that another file has changed
REFUSED, TAKEN, UNUSUAL, OWN = range(4)
"""What a datagram is to one receiver: a replay; usual; from a new peer or one with another clock; its own."""
WORD = 64
_ROUNDING_PERIODS = 1e-6
_ONE = np.uint64(1)


@part
def _arrived(words, window, since):
    """Move a series of periods on by `since`, and set the latest one's bit, the lowest of the first word."""
    by, bits, last = since // WORD, since % WORD, len(words) - 1
    for k in range(last, -1, -1):
        moved = np.uint64(0)
        if k >= by:
            moved = words[k - by] << np.uint64(bits)
        if k > by and bits > 0:
            moved |= words[k - by - 1] >> np.uint64(WORD - bits)
        words[k] = moved
    words[0] |= _ONE
    rest = window - last * WORD
    if rest < WORD:
        words[last] &= (_ONE << np.uint64(rest)) - _ONE


@part
def _count(words, window):
    """How many of the latest `window` bits are set."""
    found = 0
    for k in range(len(words)):
        word, left = words[k], window - k * WORD
        if left <= 0:
            break
        if left < WORD:
            word &= (_ONE << np.uint64(left)) - _ONE
        while word:
            word &= word - _ONE
            found += 1
    return found


@compiled
def hear(
    rows,
    first,
    skews_s,
    sender,
    stamp_s,
    circle,
    now_s,
    is_counted,
    counter,
    delay_s,
    period_s,
    window,
    counters,
    heard_s,
    stamps_s,
    circles,
    watched,
    bits,
):
    """Take a datagram in at several receivers, drones `first` + `rows` [K]; returns what it is to each, [K]."""
    found = np.empty(len(rows), np.uint8)
    for k in range(len(rows)):
        row = rows[k]
        if is_counted:
            if counter <= counters[row, sender]:
                found[k] = REFUSED
                continue
            counters[row, sender] = counter
        if row + first == sender:
            found[k] = OWN
            continue
        lag_s = now_s + skews_s[k] - stamp_s
        words = bits[row, sender]
        if words[0] == 0:
            found[k] = UNUSUAL
            words[0] = _ONE
        else:
            found[k] = TAKEN if watched[row, sender] == 0 and 0.0 <= lag_s <= delay_s else UNUSUAL
            _arrived(words, window, min(int((now_s - heard_s[row, sender]) / period_s + 0.5), window))
        heard_s[row, sender] = now_s
        stamps_s[row, sender] = stamp_s
        for axis in range(3):
            circles[row, sender, axis] = circle[axis]
    return found


@within
def fill(now_s, period_s, window, peers, heard_s, bits, mbps, known):
    """Let probes stand where nothing was measured: changes `known`, [K] goodputs to `peers`."""
    for k in range(len(peers)):
        peer = peers[k]
        words = bits[peer]
        if words[0] == 0 or known[k] > 0.0:
            continue
        missed = int((now_s - heard_s[peer]) / period_s - 0.5)
        known[k] = mbps[_count(words, window - max(0, min(missed, window)))]


@compiled
def ages(clock_s, now_s, ids, heard_s, stamps_s, ahead_s):
    """Age of every descriptor, [K] s: by its stamp and the offset of the peer's clock, and at least the time since it came."""
    found = np.empty(len(ids))
    for k in range(len(ids)):
        i = ids[k]
        found[k] = max(clock_s - stamps_s[i] - ahead_s[i], now_s - heard_s[i])
    return found


@compiled
def near(ids, circles, x_m, y_m, reach_m):
    """Places in `ids` of the circles, [..., 3], with their middle in the square of side 2 `reach_m` about a place."""
    found = np.empty(len(ids), np.int64)
    count = 0
    for k in range(len(ids)):
        circle = circles[ids[k]]
        if abs(circle[0] - x_m) <= reach_m and abs(circle[1] - y_m) <= reach_m:
            found[count] = k
            count += 1
    return found[:count]


@within
def overdue(
    me,
    now_s,
    fresh_s,
    period_s,
    degraded,
    delay_s,
    ids,
    ages_s,
    heard_s,
    busy,
    at_rest,
    blamed,
    found,
):
    """Peers whose links' directives must be looked at although nothing new was asked of them, to the front of `found`; returns
    how many.

    Those that are busy, those that are aged and not at rest, and those where a clock begins or ceases to be to blame.
    """
    count = 0
    for k in range(len(ids)):
        i = ids[k]
        if i == me:
            continue
        age_s = ages_s[k]
        is_stale = age_s / period_s - _ROUNDING_PERIODS > degraded
        is_blamed = is_stale and age_s - (now_s - heard_s[i]) > delay_s
        if busy[i] or (age_s > fresh_s and not at_rest[i]) or is_blamed != (blamed[i] > 0):
            found[count] = i
            count += 1
    return count
