"""802.11's channel access (EDCA), exchange by exchange: the compiled state machine behind `sortie.radio.mac.medium`.

Every station has its own view of the medium. It senses frames whose preamble it detects, and energy; it counts its
backoff down while the medium is idle; its frames overlap others' at each receiver, whose signal-to-interference ratio
(SINR) decides what is received. Times are integers, in nanoseconds. One event is the begin or the end of a frame, never
a fragment of it.

State lives in plain arrays, so that a copy can be run ahead and thrown away (`Medium` does so). Random numbers are a
hash of a station's key and of how many it has drawn, so a replay draws the same. The rows of the arrays are stations,
jobs (a group frame or a sample) and flows (a link with unicast traffic); the columns are the constants below.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numba import carray, types
from numba.core.cgutils import raw_memcpy, voidptr_t
from numba.extending import intrinsic

from sortie.scenarios.compiled import compiled, part

# constants of the file itself: kept machine code does not see that another file has changed
SLOT, SIFS = 9_000, 16_000
LEGACY_PREAMBLE = 20_000
CCA = 4_000
"""How long a preamble takes to be detected; within it the strongest of several frames is taken."""
EIFS_EXTRA = SIFS + 44_000
"""After a frame that could not be read: SIFS and an ack at 6 Mb/s, before the AIFS."""
FAR = 1 << 62
BLOCK = 32
"""So many stations are passed over at once if none of them has something to do."""
ACK, BLOCK_ACK, BLOCK_ACK_LONG, REQUEST_NS, CONTROL = 28_000, 32_000, 40_000, 32_000, 28_000
"""At 24 Mb/s: ack (14 B), block ack of 64 and of 256 frames (32 and 56 B); request (24 B); RTS and CTS (20 and 14 B)."""
GROUP_CURVE, CONTROL_CURVE = 12, 13
"""Packet error rates: of HE MCS 0 … 11, of group frames, of control frames at 24 Mb/s."""
CENTRE_DB, SLOPE, WEIGHT, SURE, EVEN = range(5)
"""Columns of a curve; the last two are the SINR from which every frame is received, and that at which half of them are."""
CONTROL_BYTES = 32.0
REFERENCE_BYTES = 1458.0
OVERLAPS = 12
"""Changes of interference within one reception that are kept apart; later ones count as the strongest."""

# what a station sends
NOTHING, GROUP, DATA, BLOCK_REQUEST, RTS, CTS, ANSWER = range(7)

# columns of a station; first come all those that a frame changes at those who only hear it
TX_END, RESPONSE_AT, TIMEOUT_AT, GRANT, GRANT_LOW, ARRIVE_AT, LOCK, DEAF = range(8)
LOOKED_AT, IS_BUSY, CANDIDATE, CANDIDATE_AT, CANDIDATE_LINK, TOUCHED, EIFS_UNTIL, SEGMENTS = range(8, 16)
LOCK_AT, LOCK_LINK, NAV, IDLE_AT, BEGIN, BEGIN_LOW, SLOTS, SLOTS_LOW = range(16, 24)
TX_KIND, TX_TO, TX_ACCESS, TX_COUNT, TX_MCS, TX_NAV, TX_BEGIN, TX_JOB = range(24, 32)
RESPONSE_KIND, RESPONSE_TO, RESPONSE_NS, AWAITS, ACCESS, WINDOW, WINDOW_LOW, FAILS = range(32, 40)
FAILS_LOW, HEAD, HEAD_LOW, TAIL, TAIL_LOW, REQUEST, SENT, DRAWN = range(40, 48)
COMING, TRANSMITTED_NS = range(48, 50)
HEARING_COLUMNS, STATION_COLUMNS = 24, 56
"""Whole lines of a processor's cache; the last columns are empty."""
HEARS, ACTS, SENDS = 1, 2, 3
"""What may differ between the two states at a station: its columns of hearing; its whole row and its jobs; its links too."""
NEXT_AT, INCIDENT = range(2)
"""Rows of what all stations are asked at once: when the next thing happens, and how many frames are on the air there."""

# columns of a job
KIND, STATION, FLOW, FOLLOWING, COUNT, FULL_BYTES, LAST_BYTES, DROPPED = range(8)
IS_LIVE, JOB_ACCESS, READY_AT, IS_TOLD, VAIN_TRIES, ANSWERS, LOW, HIGH = range(8, 16)
ARRIVED, AIR_NS, HEAD_AT = range(16, 19)
JOB_COLUMNS = 19

# columns of a flow
FLOW_TO, FLOW_MCS, FLOW_FRAMES, FLOW_DEAD = range(4)
FLOW_COLUMNS = 4
FLOW_RATE, FLOW_LOSS, FLOW_BURST = range(3)

# the settings, as integers and as floats
C_STATIONS, C_AIFSN, C_AIFSN_LOW, C_WINDOW, C_WINDOW_LOW, C_LARGEST, C_LARGEST_LOW, C_RETRIES = range(8)
C_BLOCK, C_RTS, C_FRAME, C_BY_FRAME, C_PREAMBLE_NS, C_SYMBOL_NS, C_LEARNS, C_EXTRA = range(8, 16)
# totals, and then who is on the air, by ascending id
G_SINCE, G_GROUPS, G_OTHERS, G_GROUP_NS, G_OTHER_NS, G_SENDERS, G_FIRST = range(7)

F_SENSED, F_PREAMBLE, F_LEGACY_NOISE, F_ENERGY, F_FAINT = range(5)
"""Powers over the noise of the whole channel: weakest preamble; SINR of a preamble; noise in 20 MHz; weakest energy; and
below which a frame is faint: its preamble cannot be detected, however it fades. It is energy, and interference for
receptions that begin later."""

# why a receiver did not hear a group frame, and that it did
UNKNOWN, COLLISION_CONTEXT, COLLISION_DATA, HIDDEN, WEAK, HALF_DUPLEX, HEARD, FAINT = range(8)

# what the run tells: kind, job
T_GROUP, T_ARRIVED, T_OVER, T_DEAD = range(4)

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11, _16 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11), np.uint64(16)
_LEVEL = np.uint64(0xFFFF)
_TRIES = 63
_RECEIVED, _RESOLVED = 64, 128
_PROBE_EVERY = 10
loop = partial(compiled, allocates=False)


@part
def mix(z):
    """SplitMix64's finaliser."""
    z = z * _GOLDEN
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)


@part
def uniform(bits):
    """A number in [0, 1)."""
    return np.float64(bits >> _11) * 2.0**-53


@part
def renew(s, S, N):
    """When the next thing happens at a station."""
    at = S[s, TX_END]
    for k in range(1, 6):
        at = min(at, S[s, k])
    N[NEXT_AT, s] = at


@part
def mark(s, what, D):
    """From now on the two states may differ at a station (see `HEARS`)."""
    flag = (D.shape[0] + 1) // 2 + s
    if D[flag] == 0:
        D[0] += 1
        D[D[0]] = s
    D[flag] = max(D[flag], what)


@part
def is_engaged(s, S):
    """Whether a station is sending or in an exchange of its own."""
    return S[s, TX_END] != FAR or S[s, AWAITS] != NOTHING


@part
def draw_backoff(s, a, S, keys):
    S[s, DRAWN] += 1
    u = uniform(mix(mix(keys[s]) + np.uint64(S[s, DRAWN])))
    S[s, SLOTS + a] = np.int64(u * (S[s, WINDOW + a] + 1))


@part
def fail_window(s, a, S, C):
    if S[s, FAILS + a] < C[C_RETRIES]:
        S[s, FAILS + a] += 1
        S[s, WINDOW + a] = min(C[C_LARGEST + a], ((C[C_WINDOW + a] + 1) << min(S[s, FAILS + a], 20)) - 1)
    else:
        S[s, FAILS + a] = 0
        S[s, WINDOW + a] = C[C_WINDOW + a]


@part
def count_down(s, t, S):
    """Take off the slots that have passed: one at the end of the AIFS and one after each idle slot."""
    if S[s, IS_BUSY] == 1 or is_engaged(s, S):
        return
    for a in range(2):
        if S[s, SLOTS + a] > 0 and S[s, BEGIN + a] <= t:
            passed = min(S[s, SLOTS + a], (t - S[s, BEGIN + a]) // SLOT + 1)
            S[s, SLOTS + a] -= passed
            S[s, BEGIN + a] += passed * SLOT


@part
def freeze(s, t, S):
    """The medium has become busy at t, which shows `CCA` later; who was to send by then does."""
    count_down(s, t + CCA, S)
    for a in range(2):
        if S[s, GRANT + a] > t + CCA:
            S[s, GRANT + a] = FAR


@part
def plan_access(s, S, C):
    """The medium is idle since IDLE_AT: when each class may send."""
    for a in range(2):
        S[s, BEGIN + a] = S[s, IDLE_AT] + SIFS + C[C_AIFSN + a] * SLOT
        S[s, GRANT + a] = S[s, BEGIN + a] + S[s, SLOTS + a] * SLOT if S[s, HEAD + a] >= 0 else FAR


@part
def link_of(s, r, begin, receiver, C):
    """Where the link stands in the list; −1 where none is listed. The fewer stations lack in a list, the less is searched."""
    lacking = C[C_STATIONS] - (begin[s + 1] - begin[s])
    low, high = begin[s] + max(0, r - lacking), min(begin[s] + r, begin[s + 1])
    while low < high:
        middle = (low + high) // 2
        if receiver[middle] < r:
            low = middle + 1
        else:
            high = middle
    return low if low < begin[s + 1] and receiver[low] == r else -1


@part
def sense(s, S, P, W, G, F, begin, receiver, C):
    """Whether the medium is busy.

    What began while a station itself was sending it notices by its energy alone. What it had waited for before (LOOKED_AT)
    goes on to count.
    """
    if S[s, TX_END] != FAR or S[s, LOCK] >= 0:
        return True
    if P[s] < F[F_SENSED]:
        return False
    if S[s, DEAF] == 0 or P[s] >= F[F_ENERGY]:
        return True
    known = 0.0
    for x in range(G_FIRST, G_FIRST + G[G_SENDERS]):
        i = G[x]
        if S[i, TX_BEGIN] <= S[s, LOOKED_AT] and i != s:
            link = link_of(i, s, begin, receiver, C)
            if link >= 0:
                known += W[link]
    return known >= F[F_SENSED]


@part
def crosses(less, more, sensed, energy):
    """Whether a change of the power at a station may change what it senses; no branch, because it is asked often and seldom so."""
    return ((less < sensed) & (more >= sensed)) | ((less < energy) & (more >= energy))


@part
def look(s, t, S, N, P, W, G, C, F, begin, receiver):
    """Bring a station's view of the medium up to now."""
    busy = sense(s, S, P, W, G, F, begin, receiver, C)
    if busy and S[s, IS_BUSY] == 0:
        freeze(s, t, S)
        S[s, IS_BUSY] = 1
        renew(s, S, N)
    elif not busy and S[s, IS_BUSY] == 1:
        S[s, IS_BUSY] = 0
        S[s, IDLE_AT] = max(t, S[s, NAV], S[s, EIFS_UNTIL])
        if not is_engaged(s, S):
            plan_access(s, S, C)
            renew(s, S, N)


@part
def enqueue(s, job, t, S, J, C, keys):
    """A job has come: behind its station's others of the same class, or at once to the access."""
    a = J[job, JOB_ACCESS]
    J[job, FOLLOWING] = -1
    if S[s, HEAD + a] >= 0:
        J[S[s, TAIL + a], FOLLOWING] = job
        S[s, TAIL + a] = job
        return
    S[s, HEAD + a] = S[s, TAIL + a] = job
    J[job, HEAD_AT] = t
    begin_access(s, a, t, S, C, keys)


@part
def begin_access(s, a, t, S, C, keys):
    """A class has something to send again."""
    engaged = is_engaged(s, S)
    count_down(s, t, S)
    if (
        S[s, SLOTS + a] == 0
        and (S[s, IS_BUSY] == 1 or engaged or S[s, NAV] > t)
        and not (engaged and S[s, ACCESS] == a)
    ):
        draw_backoff(s, a, S, keys)
    if not engaged and S[s, DEAF] == 0:
        S[s, LOOKED_AT] = t
    if engaged or S[s, IS_BUSY] == 1:
        return
    if S[s, SLOTS + a] == 0 and t > S[s, BEGIN + a]:  # operations begin at slot boundaries
        S[s, BEGIN + a] += (t - S[s, BEGIN + a] + SLOT - 1) // SLOT * SLOT
    S[s, GRANT + a] = S[s, BEGIN + a] + S[s, SLOTS + a] * SLOT


@part
def remove(job, t, S, J):
    """Take a job out of its station's queue; true if it was at the head."""
    s, a = J[job, STATION], J[job, JOB_ACCESS]
    J[job, IS_LIVE] = 0
    if S[s, TX_JOB] == job:
        S[s, TX_JOB] = -1
    if S[s, HEAD + a] == job:
        following = J[job, FOLLOWING]
        S[s, HEAD + a] = following
        if following < 0:
            S[s, TAIL + a] = -1
            S[s, GRANT + a] = FAR
        else:
            J[following, HEAD_AT] = t
        if J[job, KIND] != GROUP:
            S[s, REQUEST] = 0
        return True
    before = S[s, HEAD + a]
    while before >= 0 and J[before, FOLLOWING] != job:
        before = J[before, FOLLOWING]
    if before >= 0:
        J[before, FOLLOWING] = J[job, FOLLOWING]
        if S[s, TAIL + a] == job:
            S[s, TAIL + a] = before
    return False


@part
def release(s, t, S, N, P, W, G, C, F, begin, receiver):
    """An exchange of a station's own is over; the medium is watched again."""
    if S[s, DEAF] == 0:
        S[s, LOOKED_AT] = t
    S[s, AWAITS] = NOTHING
    S[s, TIMEOUT_AT] = FAR
    if sense(s, S, P, W, G, F, begin, receiver, C):
        S[s, IS_BUSY] = 1
        S[s, GRANT] = S[s, GRANT_LOW] = FAR
    else:
        S[s, IS_BUSY] = 0
        S[s, IDLE_AT] = max(t, S[s, NAV], S[s, EIFS_UNTIL])
        plan_access(s, S, C)
    renew(s, S, N)


@part
def log_success(sinr, mcs, curves):
    """Of a frame of `REFERENCE_BYTES`."""
    if sinr >= curves[mcs, SURE]:
        return 0.0
    if sinr <= 1e-9:
        return -700.0
    x = curves[mcs, SLOPE] * (10.0 * np.log10(sinr) - curves[mcs, CENTRE_DB])
    if x > 36.0:
        return 0.0
    return -curves[mcs, WEIGHT] * np.log1p(np.exp(-x)) if x > -200.0 else -700.0


@part
def blame(other, victim, begin, receiver, gain, S, C, F):
    """What a group frame of `victim` that `other` spoils is lost to."""
    link = link_of(victim, other, begin, receiver, C)
    if S[other, TX_BEGIN] - S[victim, TX_BEGIN] > CCA or S[victim, TX_BEGIN] - S[other, TX_BEGIN] > CCA:
        if link < 0 or gain[link] < F[F_SENSED]:
            return HIDDEN
    return COLLISION_CONTEXT if S[other, TX_KIND] == GROUP else COLLISION_DATA


@part
def add_segment(j, t, level, S, SEG_AT, SEG):
    """The interference of a running reception has changed."""
    k = S[j, SEGMENTS]
    if k > 0 and SEG_AT[j, k - 1] == t:
        SEG[j, k - 1] = level
    elif k < OVERLAPS:
        SEG_AT[j, k], SEG[j, k] = t, level
        S[j, SEGMENTS] = k + 1
    else:
        SEG[j, k - 1] = max(SEG[j, k - 1], level)


@part
def start(starters, count, t, S, N, D, P, W, WHY, G, J, SEG_AT, SEG, TOUCH, begin, receiver, gain, fade, keys, C, F):
    """Frames that begin at one instant reach the receivers."""
    touched = 0
    asked, incident = TOUCH[TOUCH.shape[0] // 3 :], N[INCIDENT]
    sensed, energy, faint = F[F_SENSED], F[F_ENERGY], F[F_FAINT]
    for x in range(count):
        s = starters[x]
        mark(s, SENDS, D)
        group = S[s, TX_KIND] == GROUP
        counter = np.uint64(C[C_FRAME] if C[C_BY_FRAME] == 1 else S[s, SENT])
        # three loops: in short ones the processor fetches many values from memory at once
        sent = mix(keys[s] + counter)
        for k in range(np.uint64(begin[s]), np.uint64(begin[s + 1])):
            W[k] = gain[k] * fade[mix((sent ^ keys[np.uint64(receiver[k])]) + np.uint64(1)) & _LEVEL]
        near = 0
        for k in range(np.uint64(begin[s]), np.uint64(begin[s + 1])):
            j = np.uint64(receiver[k])
            if j == np.uint64(s):
                continue
            power = P[j] + W[k]
            P[j] = power
            incident[j] += 1
            WHY[k] = FAINT
            asked[np.uint64(near)] = k
            near += (gain[k] >= faint) | crosses(power - W[k], power, sensed, energy)
        for y in range(near):
            k = asked[y]
            j, power = receiver[k], W[k]
            mark(j, HEARS, D)
            if gain[k] < faint:
                look(j, t, S, N, P, W, G, C, F, begin, receiver)
                continue
            WHY[k] = UNKNOWN
            if S[j, TX_END] != FAR:
                WHY[k] = HALF_DUPLEX
                continue
            if S[j, DEAF] == 0 and S[j, LOCK] < 0:
                S[j, LOOKED_AT] = t - CCA - 1
            S[j, DEAF] = 0
            if S[j, LOCK] >= 0 and t - S[j, LOCK_AT] > CCA:
                add_segment(j, t, max(0.0, P[j] - W[S[j, LOCK_LINK]]), S, SEG_AT, SEG)
                if group:
                    WHY[k] = blame(S[j, LOCK], s, begin, receiver, gain, S, C, F)
                if S[S[j, LOCK], TX_KIND] == GROUP:
                    mark(S[j, LOCK], SENDS, D)
                    WHY[S[j, LOCK_LINK]] = blame(s, S[j, LOCK], begin, receiver, gain, S, C, F)
                look(j, t, S, N, P, W, G, C, F, begin, receiver)
                continue
            if S[j, CANDIDATE] < 0 or t - S[j, CANDIDATE_AT] > CCA:
                S[j, CANDIDATE], S[j, CANDIDATE_LINK], S[j, CANDIDATE_AT] = s, k, t
            else:
                c, link = S[j, CANDIDATE], S[j, CANDIDATE_LINK]
                mark(c, SENDS, D)
                WHY[link] = blame(s, c, begin, receiver, gain, S, C, F)
                WHY[k] = blame(c, s, begin, receiver, gain, S, C, F)
                if power > W[link]:
                    S[j, CANDIDATE], S[j, CANDIDATE_LINK] = s, k
            if S[j, TOUCHED] == 0:
                S[j, TOUCHED] = 1
                TOUCH[touched] = j
                touched += 1
    for x in range(touched):
        j = TOUCH[x]
        S[j, TOUCHED] = 0
        link = S[j, CANDIDATE_LINK]
        power = W[link]
        others = max(0.0, P[j] - power)
        if power >= F[F_SENSED] and power >= F[F_PREAMBLE] * (F[F_LEGACY_NOISE] + others):
            S[j, LOCK], S[j, LOCK_LINK], S[j, LOCK_AT] = S[j, CANDIDATE], link, S[j, CANDIDATE_AT]
            S[j, SEGMENTS] = 1
            SEG_AT[j, 0], SEG[j, 0] = t, others
            S[j, EIFS_UNTIL] = 0
        else:
            S[j, LOCK] = -1
            if WHY[link] == UNKNOWN:
                mark(S[j, CANDIDATE], SENDS, D)
                WHY[link] = WEAK
                if power >= F[F_SENSED] and power >= F[F_PREAMBLE] * F[F_LEGACY_NOISE]:
                    c = S[j, CANDIDATE]
                    for y in range(G_FIRST, G_FIRST + G[G_SENDERS]):  # spoilt by a frame that it had not locked to
                        i = G[y]
                        if i != c and i != j:
                            other = link_of(i, j, begin, receiver, C)
                            if other >= 0 and W[other] * 4.0 >= others:
                                WHY[link] = blame(i, c, begin, receiver, gain, S, C, F)
                                break
        look(j, t, S, N, P, W, G, C, F, begin, receiver)
    for x in range(count):
        s = starters[x]
        if S[s, IS_BUSY] == 0:
            S[s, IS_BUSY] = 1
        renew(s, S, N)


@loop
def account(t, G):
    """Add up how long frames have been on the air."""
    if G[G_OTHERS] > 0:
        G[G_OTHER_NS] += t - G[G_SINCE]
    elif G[G_GROUPS] > 0:
        G[G_GROUP_NS] += t - G[G_SINCE]
    G[G_SINCE] = t


@part
def transmit(s, t, kind, to, duration, S, G):
    """A station's radio turns to sending; what it was receiving is lost."""
    count_down(s, t, S)
    S[s, GRANT] = S[s, GRANT_LOW] = FAR
    S[s, TX_KIND], S[s, TX_TO], S[s, TX_END], S[s, TX_BEGIN] = kind, to, t + duration, t
    S[s, TRANSMITTED_NS] += duration
    S[s, RESPONSE_AT] = FAR
    S[s, SENT] += 1
    S[s, EIFS_UNTIL] = 0
    S[s, CANDIDATE] = S[s, LOCK] = -1
    account(t, G)
    G[G_GROUPS if kind == GROUP else G_OTHERS] += 1
    x = G_FIRST + G[G_SENDERS]
    while x > G_FIRST and G[x - 1] > s:
        G[x] = G[x - 1]
        x -= 1
    G[x] = s
    G[G_SENDERS] += 1


@part
def build(s, job, S, J, M, T, LI, LF, RATES, LIMITS, C):
    """The fragments of the next A-MPDU of a job; returns the frame's duration."""
    flow = J[job, FLOW]
    mcs = S[s, TX_MCS]
    rate = LF[flow, FLOW_RATE] if LF[flow, FLOW_RATE] > 0.0 else RATES[mcs]
    most = LI[flow, FLOW_FRAMES] if LF[flow, FLOW_RATE] > 0.0 else LIMITS[mcs]
    if LI[flow, FLOW_DEAD] > 0:
        most = 1
    most = min(most, C[C_BLOCK])
    total, n = 0, 0
    index = J[job, LOW]
    beyond = min(J[job, COUNT], J[job, LOW] + C[C_BLOCK])
    while index < beyond and n < most:
        if index >= J[job, HIGH]:
            M[s, index % C[C_BLOCK]] = 0
            J[job, HIGH] = index + 1
        if M[s, index % C[C_BLOCK]] & _RESOLVED == 0:
            size = J[job, FULL_BYTES] if index < J[job, COUNT] - 1 else J[job, LAST_BYTES]
            total += (size + 7) // 4 * 4
            T[s, n] = index
            n += 1
        index += 1
    S[s, TX_COUNT] = n
    bits = 22.0 + 8.0 * total
    return C[C_PREAMBLE_NS] + C[C_SYMBOL_NS] * np.int64(np.ceil(bits / (rate * C[C_SYMBOL_NS]) - 1e-9))


@part
def choose_mcs(flow, LI, LS, ORDER, C):
    """The MCS of the next exchange: every tenth of a learning sender looks around."""
    if C[C_LEARNS] == 0 or LI[flow, FLOW_DEAD] > 0:
        return max(LI[flow, FLOW_MCS], 0)
    n = ORDER.shape[1]
    LS[flow, n, 0] += 1
    if LS[flow, n, 0] % _PROBE_EVERY != 0 or n < 2:
        return LI[flow, FLOW_MCS]
    at = ORDER[flow, LS[flow, n, 1] % n]
    LS[flow, n, 1] += 1
    if at == LI[flow, FLOW_MCS]:
        at = ORDER[flow, LS[flow, n, 1] % n]
        LS[flow, n, 1] += 1
    return at


@part
def answer_ns(s, S, C):
    if S[s, TX_KIND] == DATA and S[s, TX_COUNT] == 1:
        return ACK
    return BLOCK_ACK if C[C_BLOCK] <= 64 else BLOCK_ACK_LONG


@part
def send_data(s, t, job, S, J, M, T, LI, LF, RATES, LIMITS, C, G):
    duration = build(s, job, S, J, M, T, LI, LF, RATES, LIMITS, C)
    transmit(s, t, DATA, LI[J[job, FLOW], FLOW_TO], duration, S, G)
    S[s, TX_NAV] = SIFS + answer_ns(s, S, C)
    J[job, AIR_NS] += duration + S[s, TX_NAV]


@part
def access(s, t, S, N, J, M, T, LI, LS, LF, RATES, LIMITS, ORDER, C, G, keys):
    """A station's turn: the class of higher priority sends, the other one's equal counter is a collision within."""
    a = 0 if S[s, GRANT] <= t and S[s, HEAD] >= 0 else 1
    if S[s, HEAD + a] < 0:
        S[s, GRANT] = S[s, GRANT_LOW] = FAR
        renew(s, S, N)
        return False
    if a == 0 and S[s, GRANT_LOW] <= t and S[s, HEAD_LOW] >= 0:
        fail_window(s, 1, S, C)
        draw_backoff(s, 1, S, keys)
    job = S[s, HEAD + a]
    S[s, ACCESS], S[s, TX_JOB] = a, job
    S[s, SLOTS + a] = 0
    if J[job, KIND] == GROUP:
        transmit(s, t, GROUP, -1, J[job, AIR_NS], S, G)
        S[s, AWAITS] = GROUP
        S[s, TX_NAV] = 0
        return True
    flow = J[job, FLOW]
    to = LI[flow, FLOW_TO]
    if S[s, REQUEST] == 1:
        transmit(s, t, BLOCK_REQUEST, to, REQUEST_NS, S, G)
        S[s, TX_NAV] = SIFS + answer_ns(s, S, C)
        J[job, AIR_NS] += REQUEST_NS + S[s, TX_NAV]
        S[s, AWAITS] = BLOCK_REQUEST
        return True
    S[s, TX_MCS] = choose_mcs(flow, LI, LS, ORDER, C)
    if C[C_RTS] == 1 and LI[flow, FLOW_DEAD] == 0:
        duration = build(s, job, S, J, M, T, LI, LF, RATES, LIMITS, C)
        transmit(s, t, RTS, to, CONTROL, S, G)
        S[s, TX_NAV] = 3 * SIFS + CONTROL + duration + BLOCK_ACK
        J[job, AIR_NS] += 2 * (CONTROL + SIFS)
        S[s, AWAITS] = RTS
        return True
    send_data(s, t, job, S, J, M, T, LI, LF, RATES, LIMITS, C, G)
    S[s, AWAITS] = DATA
    return True


@part
def miss(s, t, S, N, J, M, T, OUT, told, DROPS, LS, LI, P, W, G, C, F, keys, begin, receiver):
    """No answer has come."""
    a, what, job = S[s, ACCESS], S[s, AWAITS], S[s, TX_JOB]
    fail_window(s, a, S, C)
    if job >= 0:
        is_dead, is_request = LI[J[job, FLOW], FLOW_DEAD] > 0, J[job, KIND] == BLOCK_REQUEST
        if is_dead or is_request:
            J[job, VAIN_TRIES] += 1
            in_vain = J[job, VAIN_TRIES] > C[C_RETRIES] if is_dead else J[job, ANSWERS] == 1 and not has_more(job, J)
            J[job, ANSWERS] = 1
            if in_vain:
                OUT[told, 0], OUT[told, 1] = T_DEAD, job
                told += 1
                remove(job, t, S, J)
        elif what == DATA:
            if C[C_LEARNS] == 1:
                LS[J[job, FLOW], S[s, TX_MCS], 0] += S[s, TX_COUNT]
            if S[s, TX_COUNT] == 1:
                told = settle(s, t, job, False, True, S, J, M, T, OUT, told, DROPS, C)
            else:  # ask what has arrived, for as long as it takes
                S[s, REQUEST] = 1
    draw_backoff(s, a, S, keys)
    release(s, t, S, N, P, W, G, C, F, begin, receiver)
    return told


@part
def has_more(job, J):
    """Whether another job of the same link waits behind a job."""
    other = J[job, FOLLOWING]
    while other >= 0 and J[other, FLOW] != J[job, FLOW]:
        other = J[other, FOLLOWING]
    return other >= 0


@part
def settle(s, t, job, is_answered, counts, S, J, M, T, OUT, told, DROPS, C):
    """The sender learns what has arrived of the fragments that it sent last; `counts`: a missing one has used up a try."""
    for x in range(S[s, TX_COUNT]):
        at = T[s, x] % C[C_BLOCK]
        state = M[s, at]
        if state & _RESOLVED:
            continue
        if is_answered and state & _RECEIVED:
            M[s, at] = state | _RESOLVED
        elif counts and (state & _TRIES) >= C[C_RETRIES]:
            M[s, at] = state | _RESOLVED
            if state & _RECEIVED == 0:
                DROPS[0, 0] += 1  # there is room: `run` stops before
                DROPS[DROPS[0, 0], 0], DROPS[DROPS[0, 0], 1] = job, T[s, x]
                J[job, DROPPED] += 1
        elif counts:
            M[s, at] = state + 1
    low = J[job, LOW]
    while low < J[job, HIGH] and M[s, low % C[C_BLOCK]] & _RESOLVED:
        low += 1
    J[job, LOW] = low
    if low == J[job, COUNT]:
        if J[job, IS_TOLD] == 0:
            OUT[told, 0], OUT[told, 1] = T_OVER, job
            told += 1
        J[job, IS_TOLD] = 2
        remove(job, t, S, J)
    return told


@part
def is_noticed(j, S, W, SEG, mcs, noise, curves):
    """Whether anything of a frame is received by one whom it is not meant for."""
    least = SEG[j, 0]
    for k in range(1, S[j, SEGMENTS]):
        least = min(least, SEG[j, k])
    return W[S[j, LOCK_LINK]] > curves[mcs, EVEN] * (noise + least)


@part
def is_read(j, t, S, W, SEG_AT, SEG, mcs, length, noise, curves, bits):
    """Whether a lone frame is received."""
    link = S[j, LOCK_LINK]
    n = S[j, SEGMENTS]
    total, span = 0.0, max(1, t - S[j, LOCK_AT])
    for k in range(n):
        until = SEG_AT[j, k + 1] if k + 1 < n else t
        begin_at = S[j, LOCK_AT] if k == 0 else SEG_AT[j, k]
        part = (until - begin_at) / span
        if part > 0.0:
            total += part * log_success(W[link] / (noise + SEG[j, k]), mcs, curves)
    total *= length / REFERENCE_BYTES
    return total > -1e-15 or uniform(bits) < np.exp(total)


@part
def receive_fragments(s, r, t, job, S, J, M, T, W, SEG_AT, SEG, LF, C, curves, keys):
    """Which fragments of an A-MPDU arrive; returns how many."""
    flow, mcs, n = J[job, FLOW], S[s, TX_MCS], S[s, TX_COUNT]
    link = S[r, LOCK_LINK]
    segments = S[r, SEGMENTS]
    burst, given = LF[flow, FLOW_BURST], LF[flow, FLOW_LOSS]
    seed = mix(mix(keys[s] ^ np.uint64(0x51)) + np.uint64(S[s, SENT]))
    body_at = S[s, TX_BEGIN] + C[C_PREAMBLE_NS]
    body_ns = max(1, S[s, TX_END] - body_at)
    full, last = J[job, FULL_BYTES], J[job, LAST_BYTES]
    arrived, each_ns = 0, body_ns / n
    for k in range(segments):  # of the interference that nobody asks for any more
        SEG[r, k] = log_success(W[link] / (1.0 + SEG[r, k]), mcs, curves)
    alike = SEG[r, 0] / REFERENCE_BYTES
    for x in range(n):
        index = T[s, x]
        length = full if index < J[job, COUNT] - 1 else last
        good = alike * length
        if segments > 1:
            good, from_ns, until_ns = 0.0, body_at + x * each_ns, body_at + (x + 1) * each_ns
            for k in range(segments):
                a = max(from_ns, np.float64(SEG_AT[r, k])) if k else from_ns
                b = min(until_ns, np.float64(SEG_AT[r, k + 1])) if k + 1 < segments else until_ns
                if b > a:
                    good += (b - a) / each_ns * SEG[r, k]
            good *= length / REFERENCE_BYTES
        if given >= 0.0:
            good = np.log1p(-given) if given < 1.0 else -700.0
        elif burst > 0.0:
            good += np.log1p(-burst) if burst < 1.0 else -700.0
        if good < -1e-12 and uniform(mix(seed + np.uint64(x))) >= np.exp(good):
            continue
        arrived += 1
        at = index % C[C_BLOCK]
        if M[s, at] & _RECEIVED == 0:
            M[s, at] |= _RECEIVED
            J[job, ARRIVED] += 1
    return arrived


@part
def finish(
    s,
    t,
    S,
    N,
    D,
    P,
    W,
    WHY,
    G,
    J,
    M,
    T,
    SEG_AT,
    SEG,
    OUT,
    told,
    DROPS,
    begin,
    receiver,
    gain,
    extra,
    LI,
    LF,
    LS,
    RATES,
    LIMITS,
    C,
    F,
    curves,
    keys,
    TOUCH,
):
    """A frame ends."""
    kind, to, a = S[s, TX_KIND], S[s, TX_TO], S[s, ACCESS]
    job = S[s, TX_JOB] if kind == GROUP or kind == DATA else -1
    seed = mix(mix(keys[s] ^ np.uint64(0x77)) + np.uint64(S[s, SENT]))
    touched = 0
    is_meant, is_answered = False, False
    mark(s, SENDS, D)
    if to >= 0:
        mark(to, ACTS, D)
    asked, incident, near = TOUCH[TOUCH.shape[0] // 3 :], N[INCIDENT], 0
    sensed, energy = F[F_SENSED], F[F_ENERGY]
    for k in range(np.uint64(begin[s]), np.uint64(begin[s + 1])):
        j = np.uint64(receiver[k])
        if j == np.uint64(s):
            continue
        before, others = P[j], incident[j] - 1
        incident[j] = others
        power = before - W[k] if others > 0 else 0.0
        P[j] = power
        asked[np.uint64(near)] = k
        near += (WHY[k] != FAINT) | crosses(power, before, sensed, energy)
    for y in range(near):
        k = asked[y]
        j = receiver[k]
        mark(j, HEARS, D)
        TOUCH[touched] = j
        touched += 1
        if WHY[k] == FAINT:
            continue
        if S[j, LOCK] == s:
            S[j, LOCK] = -1
            if kind == GROUP:
                bits = mix(seed ^ keys[j])
                length = np.float64(J[job, FULL_BYTES]) if job >= 0 else 334.0
                good = is_read(j, t, S, W, SEG_AT, SEG, GROUP_CURVE, length, F[F_LEGACY_NOISE], curves, bits)
                if good and C[C_EXTRA] == 1 and extra[k] > 0.0:
                    if uniform(mix(bits)) < extra[k]:
                        good = False
                        WHY[k] = WEAK
                if good:
                    WHY[k] = HEARD
                elif WHY[k] == UNKNOWN:
                    WHY[k] = WEAK
            elif j == to:
                is_meant = True
                if kind == DATA:
                    good = False
                    if job >= 0 and LI[J[job, FLOW], FLOW_DEAD] == 0:
                        good = receive_fragments(s, j, t, job, S, J, M, T, W, SEG_AT, SEG, LF, C, curves, keys) > 0
                else:
                    bits = mix(seed ^ keys[j])
                    good = is_read(
                        j, t, S, W, SEG_AT, SEG, CONTROL_CURVE, CONTROL_BYTES, F[F_LEGACY_NOISE], curves, bits
                    )
                if good and kind == BLOCK_REQUEST and S[s, TX_JOB] >= 0:
                    flow = J[S[s, TX_JOB], FLOW]
                    lost = LF[flow, FLOW_LOSS] if LF[flow, FLOW_LOSS] >= 0.0 else LF[flow, FLOW_BURST]
                    good = LI[flow, FLOW_DEAD] == 0 and uniform(mix(seed)) >= lost
                is_answered = good
            elif kind == DATA:
                good = is_noticed(j, S, W, SEG, S[s, TX_MCS], 1.0, curves)
            else:
                good = is_noticed(j, S, W, SEG, CONTROL_CURVE, F[F_LEGACY_NOISE], curves)
            S[j, EIFS_UNTIL] = 0 if good else t + EIFS_EXTRA
            if good and j != to and S[s, TX_NAV] > 0:
                S[j, NAV] = max(S[j, NAV], t + S[s, TX_NAV])
        elif kind == GROUP and WHY[k] == UNKNOWN:
            WHY[k] = HALF_DUPLEX  # it began to send meanwhile
        if S[j, CANDIDATE] == s:
            S[j, CANDIDATE] = -1
        if S[j, LOCK] >= 0:
            add_segment(j, t, max(0.0, P[j] - W[S[j, LOCK_LINK]]), S, SEG_AT, SEG)
    S[s, TX_END] = FAR
    S[s, DEAF] = 1
    account(t, G)
    G[G_GROUPS if kind == GROUP else G_OTHERS] -= 1
    G[G_SENDERS] -= 1
    x = G_FIRST
    while G[x] != s:
        x += 1
    while x < G_FIRST + G[G_SENDERS]:
        G[x] = G[x + 1]
        x += 1
    for x in range(touched):
        look(TOUCH[x], t, S, N, P, W, G, C, F, begin, receiver)
    if kind == GROUP:
        S[s, WINDOW + a], S[s, FAILS + a] = C[C_WINDOW + a], 0
        if job >= 0:
            OUT[told, 0], OUT[told, 1] = T_GROUP, job
            told += 1
            remove(job, t, S, J)
        draw_backoff(s, a, S, keys)
        release(s, t, S, N, P, W, G, C, F, begin, receiver)
    elif kind == ANSWER or kind == CTS:
        # the sender that waits for it
        if S[to, AWAITS] != NOTHING and S[to, TX_TO] == s and S[to, TX_END] == FAR and S[to, RESPONSE_AT] == FAR:
            if is_meant and is_answered:
                told = conclude(to, t, S, N, P, W, G, J, M, T, OUT, told, DROPS, LS, C, F, keys, begin, receiver)
            elif S[to, TIMEOUT_AT] == FAR:
                told = miss(to, t, S, N, J, M, T, OUT, told, DROPS, LS, LI, P, W, G, C, F, keys, begin, receiver)
        release(s, t, S, N, P, W, G, C, F, begin, receiver) if S[s, AWAITS] == NOTHING else renew(s, S, N)
    else:
        if job >= 0 and J[job, ARRIVED] == J[job, COUNT] and J[job, IS_TOLD] == 0:
            J[job, IS_TOLD] = 1
            OUT[told, 0], OUT[told, 1] = T_ARRIVED, job
            told += 1
        S[s, TIMEOUT_AT] = t + SIFS + SLOT + LEGACY_PREAMBLE
        if is_answered and not is_engaged(to, S):
            if kind == RTS:
                if S[to, NAV] <= t:
                    S[to, RESPONSE_AT], S[to, RESPONSE_KIND], S[to, RESPONSE_TO] = t + SIFS, CTS, s
                    S[to, RESPONSE_NS] = S[s, TX_NAV] - SIFS - CONTROL
            else:
                S[to, RESPONSE_AT], S[to, RESPONSE_KIND], S[to, RESPONSE_TO] = t + SIFS, ANSWER, s
                S[to, RESPONSE_NS] = S[s, TX_NAV] - SIFS
            renew(to, S, N)
        S[s, IS_BUSY] = 1
        renew(s, S, N)
    return told


@part
def conclude(s, t, S, N, P, W, G, J, M, T, OUT, told, DROPS, LS, C, F, keys, begin, receiver):
    """The answer has come."""
    a, what = S[s, ACCESS], S[s, AWAITS]
    S[s, TIMEOUT_AT] = FAR
    if what == RTS:  # clear to send
        S[s, RESPONSE_AT], S[s, RESPONSE_KIND] = t + SIFS, DATA
        renew(s, S, N)
        return told
    job = S[s, TX_JOB]
    S[s, WINDOW + a], S[s, FAILS + a] = C[C_WINDOW + a], 0
    if job >= 0 and J[job, KIND] == BLOCK_REQUEST:
        J[job, ANSWERS] -= 1
        if J[job, ANSWERS] == 0:
            remove(job, t, S, J)
    elif job >= 0:
        if what == DATA and C[C_LEARNS] == 1:
            flow = J[job, FLOW]
            LS[flow, S[s, TX_MCS], 0] += S[s, TX_COUNT]
            for x in range(S[s, TX_COUNT]):
                if M[s, T[s, x] % C[C_BLOCK]] & _RECEIVED:
                    LS[flow, S[s, TX_MCS], 1] += 1
        S[s, REQUEST] = 0
        told = settle(s, t, job, True, what == DATA, S, J, M, T, OUT, told, DROPS, C)
    draw_backoff(s, a, S, keys)
    release(s, t, S, N, P, W, G, C, F, begin, receiver)
    return told


@part
def run(
    until,
    S,
    N,
    P,
    W,
    WHY,
    G,
    J,
    M,
    T,
    SEG_AT,
    SEG,
    LS,
    DROPS,
    D,
    LI,
    LF,
    OUT,
    TOUCH,
    begin,
    receiver,
    gain,
    extra,
    fade,
    keys,
    RATES,
    LIMITS,
    ORDER,
    C,
    F,
    curves,
):
    """Run the stations until something has to be told, until a time, or until the table of drops must be read first.

    Returns: the time reached, and how many rows of OUT are to be told; −1 where the drops must be read.
    """
    n = C[C_STATIONS]
    due, starters = TOUCH[TOUCH.shape[0] // 3 :], TOUCH[TOUCH.shape[0] // 3 * 2 :]
    most_drops = DROPS.shape[0] - 1 - n * C[C_BLOCK]  # at one instant every station may give up a window of fragments
    while True:
        t = FAR
        for s in range(n):
            t = min(t, N[NEXT_AT, s])
        if t > until:
            return until, 0
        if DROPS[0, 0] > most_drops:
            return t - 1, -1
        told = 0
        x = G_FIRST
        while x < G_FIRST + G[G_SENDERS]:
            s = G[x]
            if S[s, TX_END] != t:
                x += 1
                continue
            told = finish(  # which takes it out
                s,
                t,
                S,
                N,
                D,
                P,
                W,
                WHY,
                G,
                J,
                M,
                T,
                SEG_AT,
                SEG,
                OUT,
                told,
                DROPS,
                begin,
                receiver,
                gain,
                extra,
                LI,
                LF,
                LS,
                RATES,
                LIMITS,
                C,
                F,
                curves,
                keys,
                TOUCH,
            )
        waiting = 0
        for first in range(0, n, BLOCK):
            soonest = FAR
            for s in range(first, min(first + BLOCK, n)):
                soonest = min(soonest, N[NEXT_AT, s])
            if soonest <= t:
                for s in range(first, min(first + BLOCK, n)):
                    due[waiting] = s
                    waiting += N[NEXT_AT, s] <= t
        count = 0
        for x in range(waiting):
            s = due[x]
            mark(s, ACTS, D)
            while S[s, ARRIVE_AT] <= t:
                job = S[s, COMING]
                S[s, COMING] = J[job, FOLLOWING]
                S[s, ARRIVE_AT] = J[S[s, COMING], READY_AT] if S[s, COMING] >= 0 else FAR
                enqueue(s, job, t, S, J, C, keys)
            if S[s, TIMEOUT_AT] <= t:
                if (
                    S[s, LOCK] == S[s, TX_TO]
                    and S[s, LOCK] >= 0
                    and S[S[s, LOCK], TX_KIND] >= CTS
                    and S[S[s, LOCK], TX_TO] == s
                ):
                    S[s, TIMEOUT_AT] = FAR
                else:
                    told = miss(s, t, S, N, J, M, T, OUT, told, DROPS, LS, LI, P, W, G, C, F, keys, begin, receiver)
            if S[s, RESPONSE_AT] <= t:
                if S[s, RESPONSE_KIND] == DATA:
                    job = S[s, TX_JOB]
                    if job >= 0:
                        send_data(s, t, job, S, J, M, T, LI, LF, RATES, LIMITS, C, G)
                        S[s, AWAITS] = DATA
                        starters[count] = s
                        count += 1
                    else:
                        S[s, RESPONSE_AT] = FAR
                        release(s, t, S, N, P, W, G, C, F, begin, receiver)
                else:
                    duration = CONTROL
                    if S[s, RESPONSE_KIND] == ANSWER:
                        duration = S[s, RESPONSE_NS]
                        for a in range(
                            2
                        ):  # a backoff that ends while it answers: it looks, and waits for what is there
                            turn = S[s, LOCK_AT] + S[s, SLOTS + a] * SLOT
                            if turn < t - SIFS:
                                turn = t + (C[C_AIFSN + a] + S[s, SLOTS + a]) * SLOT
                            if S[s, HEAD + a] >= 0 and turn < t + duration:
                                S[s, LOOKED_AT] = t
                    transmit(s, t, S[s, RESPONSE_KIND], S[s, RESPONSE_TO], duration, S, G)
                    S[s, TX_NAV] = S[s, RESPONSE_NS] if S[s, RESPONSE_KIND] == CTS else 0
                    starters[count] = s
                    count += 1
            elif min(S[s, GRANT], S[s, GRANT_LOW]) <= t:
                if access(s, t, S, N, J, M, T, LI, LS, LF, RATES, LIMITS, ORDER, C, G, keys):
                    starters[count] = s
                    count += 1
            renew(s, S, N)
        if count > 0:
            start(
                starters,
                count,
                t,
                S,
                N,
                D,
                P,
                W,
                WHY,
                G,
                J,
                SEG_AT,
                SEG,
                TOUCH,
                begin,
                receiver,
                gain,
                fade,
                keys,
                C,
                F,
            )
        if told > 0:
            return t, told


# --- from outside -------------------------------------------------------------------------------------


@part
def enter(entered, S, N, D, J):
    """Jobs come to their stations, at times that are not yet over; the row of the latest one names the one before it."""
    before = -1
    while entered >= 0:  # from here on each row names the one after it
        earlier = J[entered, FOLLOWING]
        J[entered, FOLLOWING] = before
        before, entered = entered, earlier
    while before >= 0:
        job, station = before, J[before, STATION]
        before = J[job, FOLLOWING]
        mark(station, ACTS, D)
        ahead_of, following = -1, S[station, COMING]
        while following >= 0 and J[following, READY_AT] <= J[job, READY_AT]:
            ahead_of, following = following, J[following, FOLLOWING]
        J[job, FOLLOWING] = following
        if ahead_of < 0:
            S[station, COMING], S[station, ARRIVE_AT] = job, J[job, READY_AT]
            renew(station, S, N)
        else:
            J[ahead_of, FOLLOWING] = job


@loop
def cancel(job, t, S, N, D, J, requests):
    """Take a job out, wherever it is; a frame of it that is on the air goes on to its end.

    With `requests`, one whose fragments are unanswered leaves a block-ack request at the head: the receiver must not wait
    for them any longer. If the sender was about to ask for them anyway, it takes two answers, as in ns-3: the first one says
    that they have not arrived, and only then the sender gives them up and says so. A last request that is not answered is
    repeated while there is more for that receiver.
    """
    s = J[job, STATION]
    mark(s, ACTS, D)
    before, at = -1, S[s, COMING]
    while at >= 0 and at != job:
        before, at = at, J[at, FOLLOWING]
    if at == job:
        J[job, IS_LIVE] = 0
        if before < 0:
            S[s, COMING] = J[job, FOLLOWING]
            S[s, ARRIVE_AT] = J[S[s, COMING], READY_AT] if S[s, COMING] >= 0 else FAR
        else:
            J[before, FOLLOWING] = J[job, FOLLOWING]
    elif requests and S[s, HEAD + J[job, JOB_ACCESS]] == job and J[job, LOW] < J[job, HIGH]:
        J[job, ANSWERS] = 2 if S[s, REQUEST] == 1 and not is_engaged(s, S) else 1
        J[job, KIND], S[s, REQUEST] = BLOCK_REQUEST, 1
        if S[s, TX_JOB] == job:
            S[s, TX_JOB] = -1
    else:
        remove(job, t, S, J)
    renew(s, S, N)


@loop
def substitute(old, job, S, D, J):
    """A job takes the place of one that waits in its station's queue; false if that one does not wait there."""
    station = J[old, STATION]
    mark(station, ACTS, D)
    is_first = S[station, COMING] == old
    before = S[station, HEAD + J[old, JOB_ACCESS]]
    while before >= 0 and J[before, FOLLOWING] != old:
        before = J[before, FOLLOWING]
    if before < 0 and not is_first:  # it has come at this very instant
        before = S[station, COMING]
        while before >= 0 and J[before, FOLLOWING] != old:
            before = J[before, FOLLOWING]
        if before < 0:
            return False
    J[job, FOLLOWING], J[job, READY_AT] = J[old, FOLLOWING], J[old, READY_AT]
    if is_first:
        S[station, COMING] = job
    else:
        J[before, FOLLOWING] = job
    J[old, IS_LIVE] = 0
    if S[station, TAIL + J[old, JOB_ACCESS]] == old:
        S[station, TAIL + J[old, JOB_ACCESS]] = job
    return True


def _copy_bytes(_, to, origin, count):
    def generate(_, builder, __, values):
        addresses = [builder.inttoptr(value, voidptr_t) for value in values[:2]]
        raw_memcpy(builder, *addresses, values[2], 1)

    return types.void(to, origin, count), generate


copy_bytes = intrinsic(_copy_bytes)
"""Copy so many bytes from one address to another: in a third of a loop's time."""


@part
def copy_station(s, what, S, W, WHY, J, M, T, SEG_AT, SEG, S2, W2, WHY2, J2, M2, T2, SEG_AT2, SEG2, begin):
    """Make a station's rows equal in the second state, with its links' and its jobs'; what is not in use is left out."""
    copy_bytes(S2[s].ctypes.data, S[s].ctypes.data, 8 * (HEARING_COLUMNS if what == HEARS else STATION_COLUMNS))
    if S[s, LOCK] >= 0:
        for k in range(S[s, SEGMENTS]):
            SEG_AT2[s, k], SEG2[s, k] = SEG_AT[s, k], SEG[s, k]
    if what == HEARS:
        return
    if what == SENDS and S[s, TX_END] != FAR:
        first, count = begin[s], begin[s + 1] - begin[s]
        copy_bytes(W2.ctypes.data + 8 * first, W.ctypes.data + 8 * first, 8 * count)
        copy_bytes(WHY2.ctypes.data + first, WHY.ctypes.data + first, count)
    if S[s, TX_JOB] >= 0 or S[s, HEAD] >= 0 or S[s, HEAD_LOW] >= 0:
        copy_bytes(M2[s].ctypes.data, M[s].ctypes.data, M.shape[1])
        copy_bytes(T2[s].ctypes.data, T[s].ctypes.data, 4 * T.shape[1])
    for column in (COMING, HEAD, HEAD_LOW):
        x = S[s, column]
        while x >= 0:
            copy_bytes(J2[x].ctypes.data, J[x].ctypes.data, 8 * JOB_COLUMNS)
            x = J[x, FOLLOWING]


@part
def copy(
    S,
    N,
    P,
    W,
    WHY,
    G,
    J,
    M,
    T,
    SEG_AT,
    SEG,
    LS,
    DROPS,
    D,
    S2,
    N2,
    P2,
    W2,
    WHY2,
    G2,
    J2,
    M2,
    T2,
    SEG_AT2,
    SEG2,
    LS2,
    DROPS2,
    begin,
    C,
):
    """Make the second state equal to the first, where they differ: a station that hears nothing costs nothing."""
    for k in range(1, D[0] + 1):  # first of all, for a row may have become another station's
        if D[(D.shape[0] + 1) // 2 + D[k]] == HEARS:
            continue
        for column in (COMING, HEAD, HEAD_LOW):
            x = S2[D[k], column]
            while x >= 0:
                J2[x, IS_LIVE] = 0
                x = J2[x, FOLLOWING]
    for k in range(1, D[0] + 1):
        s = D[k]
        flag = (D.shape[0] + 1) // 2 + s
        copy_station(s, D[flag], S, W, WHY, J, M, T, SEG_AT, SEG, S2, W2, WHY2, J2, M2, T2, SEG_AT2, SEG2, begin)
        D[flag] = 0
    D[0] = 0
    copy_bytes(N2.ctypes.data, N.ctypes.data, 8 * N.size)
    copy_bytes(P2.ctypes.data, P.ctypes.data, 8 * P.size)
    copy_bytes(G2.ctypes.data, G.ctypes.data, 8 * (G_FIRST + G[G_SENDERS]))
    if C[C_LEARNS] == 1:
        for x in range(LS.shape[0]):
            for m in range(LS.shape[1]):
                LS2[x, m, 0], LS2[x, m, 1] = LS[x, m, 0], LS[x, m, 1]
    for x in range(DROPS[0, 0] + 1):
        DROPS2[x, 0], DROPS2[x, 1] = DROPS[x, 0], DROPS[x, 1]


@loop
def relink(S, N, D, P, W, WHY, old_begin, old_receiver, old_why, begin, receiver, gain, fade, keys, C):
    """The list of links is another one: find the frames on the air in it."""
    for j in range(C[C_STATIONS]):
        mark(j, SENDS, D)
        P[j] = 0.0
        N[INCIDENT, j] = 0
        if S[j, LOCK] >= 0:
            S[j, LOCK_LINK] = link_of(S[j, LOCK], j, begin, receiver, C)
            if S[j, LOCK_LINK] < 0:
                S[j, LOCK] = -1
        S[j, CANDIDATE] = -1
    for s in range(C[C_STATIONS]):
        if S[s, TX_END] == FAR:
            continue
        counter = np.uint64(C[C_FRAME] if C[C_BY_FRAME] == 1 else S[s, SENT])
        at = old_begin[s]
        for k in range(begin[s], begin[s + 1]):
            j = receiver[k]
            while at < old_begin[s + 1] and old_receiver[at] < j:
                at += 1
            WHY[k] = old_why[at] if at < old_begin[s + 1] and old_receiver[at] == j else WEAK
            W[k] = gain[k] * fade[mix((mix(keys[s] + counter) ^ keys[j]) + np.uint64(1)) & _LEVEL]
            P[j] += W[k]
            N[INCIDENT, j] += 1


def _pointer(_, address):
    def generate(_, builder, __, values):
        return builder.inttoptr(values[0], voidptr_t)

    return types.voidptr(address), generate


pointer = intrinsic(_pointer)
"""An address as numba's `carray` wants it."""
SIZES = 8
"""Sizes that come before the addresses: stations, links, jobs, window, flows, MCS, drops, extra losses."""


@compiled
def ahead(at, entered, since, until):
    """Bring the first state up to `since`, and run a copy of it ahead; no copy where its drops must be read first.

    First, jobs come that have not yet done so: `entered` is the latest of them (see `enter`), −1 is none.

    Arrays come by address, for numba looks at each array that it is handed, which costs more than most runs:
    `SIZES` sizes, the 13 arrays of the first state, those of its copy, and what they share. An `until` before `since` is no copy.

    Returns: the time that the copy has reached, or the first state where there is none, and as `run`.
    """
    n, links, jobs, window, flows, mcs, drops, extras = at[0], at[1], at[2], at[3], at[4], at[5], at[6], at[7]
    D = carray(pointer(at[34]), (2 * n + 1,), np.int64)
    LI = carray(pointer(at[35]), (flows, FLOW_COLUMNS), np.int64)
    LF = carray(pointer(at[36]), (flows, 3), np.float64)
    OUT = carray(pointer(at[37]), (2 * n + 8, 2), np.int64)
    TOUCH = carray(pointer(at[38]), (3 * n + 3,), np.int64)
    begin = carray(pointer(at[39]), (n + 1,), np.int64)
    receiver = carray(pointer(at[40]), (links,), np.int64)
    gain = carray(pointer(at[41]), (links,), np.float64)
    extra = carray(pointer(at[42]), (extras,), np.float64)
    fade = carray(pointer(at[43]), (1 << 16,), np.float32)
    keys = carray(pointer(at[44]), (n,), np.uint64)
    RATES = carray(pointer(at[45]), (mcs,), np.float64)
    LIMITS = carray(pointer(at[46]), (mcs,), np.int64)
    ORDER = carray(pointer(at[47]), (flows, mcs), np.int64)
    C = carray(pointer(at[48]), (16,), np.int64)
    F = carray(pointer(at[49]), (5,), np.float64)
    curves = carray(pointer(at[50]), (14, 5), np.float64)
    first, goal = SIZES, since
    while True:  # first the first state, then its copy: what is called in one place is compiled into it
        S = carray(pointer(at[first]), (n, STATION_COLUMNS), np.int64)
        N = carray(pointer(at[first + 1]), (2, n), np.int64)
        P = carray(pointer(at[first + 2]), (n,), np.float64)
        W = carray(pointer(at[first + 3]), (links,), np.float64)
        WHY = carray(pointer(at[first + 4]), (links,), np.uint8)
        G = carray(pointer(at[first + 5]), (G_FIRST + n,), np.int64)
        J = carray(pointer(at[first + 6]), (jobs, JOB_COLUMNS), np.int64)
        M = carray(pointer(at[first + 7]), (n, window), np.uint8)
        T = carray(pointer(at[first + 8]), (n, window), np.int32)
        SEG_AT = carray(pointer(at[first + 9]), (n, OVERLAPS), np.int64)
        SEG = carray(pointer(at[first + 10]), (n, OVERLAPS), np.float64)
        LS = carray(pointer(at[first + 11]), (flows, mcs + 1, 2), np.int64)
        DROPS = carray(pointer(at[first + 12]), (drops, 2), np.int64)
        if first == SIZES:
            enter(entered, S, N, D, J)
        reached, told = run(
            goal,
            S,
            N,
            P,
            W,
            WHY,
            G,
            J,
            M,
            T,
            SEG_AT,
            SEG,
            LS,
            DROPS,
            D,
            LI,
            LF,
            OUT,
            TOUCH,
            begin,
            receiver,
            gain,
            extra,
            fade,
            keys,
            RATES,
            LIMITS,
            ORDER,
            C,
            F,
            curves,
        )
        if first > SIZES or until < since or told < 0:
            return reached, told
        S2 = carray(pointer(at[21]), (n, STATION_COLUMNS), np.int64)
        N2 = carray(pointer(at[22]), (2, n), np.int64)
        P2 = carray(pointer(at[23]), (n,), np.float64)
        W2 = carray(pointer(at[24]), (links,), np.float64)
        WHY2 = carray(pointer(at[25]), (links,), np.uint8)
        G2 = carray(pointer(at[26]), (G_FIRST + n,), np.int64)
        J2 = carray(pointer(at[27]), (jobs, JOB_COLUMNS), np.int64)
        M2 = carray(pointer(at[28]), (n, window), np.uint8)
        T2 = carray(pointer(at[29]), (n, window), np.int32)
        SEG_AT2 = carray(pointer(at[30]), (n, OVERLAPS), np.int64)
        SEG2 = carray(pointer(at[31]), (n, OVERLAPS), np.float64)
        LS2 = carray(pointer(at[32]), (flows, mcs + 1, 2), np.int64)
        DROPS2 = carray(pointer(at[33]), (drops, 2), np.int64)
        copy(
            S,
            N,
            P,
            W,
            WHY,
            G,
            J,
            M,
            T,
            SEG_AT,
            SEG,
            LS,
            DROPS,
            D,
            S2,
            N2,
            P2,
            W2,
            WHY2,
            G2,
            J2,
            M2,
            T2,
            SEG_AT2,
            SEG2,
            LS2,
            DROPS2,
            begin,
            C,
        )
        first, goal = SIZES + 13, until
