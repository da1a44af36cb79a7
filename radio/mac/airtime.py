"""How many bytes a sample puts on the air, and how long they take: pure functions.

A sample is cut into fragments of at most `fragment_bytes`, each one RTPS datagram over UDP/IPv4 and one
802.11 frame (MPDU). Unicast frames travel in A-MPDUs, each answered by a block ack; group-addressed
frames travel alone at a basic rate and are never answered.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

from sortie.radio.mac.contention import DIFS_S, SIFS_S, SLOT_S, Contention
from sortie.radio.rates import STANDARDS, Standard

# Bytes (OMG DDSI-RTPS 2.5; RFC 791, 768; IEEE 802.11)
RTPS_HEADER, INFO_TS, INFO_DST = 20, 12, 16
DATA, DATA_FRAG = 24 + 4, 36
"""DATA includes a CDR header of 4 B. A descriptor in the paper's form has its own, so its frame counts 4 B too many."""
HEARTBEAT, ACKNACK = 32, 28
UDP_IP = 28
MAC_UNICAST, MAC_GROUP = 38, 36
MPDU_DELIMITER = 4

# Seconds
LEGACY_PREAMBLE_S, LEGACY_SYMBOL_S = 20e-6, 4e-6
MAX_PPDU_S = 5.484e-3
SERVICE_TAIL_BITS = 22
CONTROL_MBPS = 24.0


def fragments(payload_bytes: int, fragment_bytes: int) -> int:
    """Number of DDS fragments of a sample."""
    return -(-payload_bytes // fragment_bytes)


def datagram_bytes(payload_bytes: int, *, fragmented: bool, unicast: bool) -> int:
    """IP packet of one fragment that carries `payload_bytes`."""
    rtps = RTPS_HEADER + INFO_TS + (INFO_DST if unicast else 0) + (DATA_FRAG if fragmented else DATA)
    return payload_bytes + rtps + UDP_IP


def frame_bytes(payload_bytes: int, *, fragmented: bool = False, unicast: bool = True) -> int:
    """802.11 frame (MPDU) of one fragment, FCS included."""
    mac = MAC_UNICAST if unicast else MAC_GROUP
    return datagram_bytes(payload_bytes, fragmented=fragmented, unicast=unicast) + mac


@lru_cache(maxsize=4096)
def sample_wire(payload_bytes: int, fragment_bytes: int, alone: bool = False) -> tuple[int, int]:
    """A unicast sample's fragments, and every byte of its frames, each counted once.

    Args: `alone`: each fragment is a sample of its own to DDS, usable without the others.
    """
    k = fragments(payload_bytes, fragment_bytes)
    return k, payload_bytes + k * frame_bytes(0, fragmented=k > 1 and not alone)


@lru_cache(maxsize=4096)
def repair_wire_bytes(lost: int) -> int:
    """A heartbeat and the ACKNACK that answers it with a bitmap of `lost` fragments (up to 256 bits), as frames."""
    around = 2 * (RTPS_HEADER + INFO_DST + UDP_IP + MAC_UNICAST)
    return around + HEARTBEAT + ACKNACK + 4 * max(1, ceil(min(lost, 256) / 32))


AX = STANDARDS["ax"]


def ppdu_s(psdu_bytes: int, rate_mbps: float, standard: Standard = AX) -> float:
    """Time of an HT, VHT or HE frame: its preamble (44 µs with 802.11ax), then whole symbols (13.6 µs)."""
    symbol_s = standard.symbol_s
    bits_per_symbol = rate_mbps * 1e6 * symbol_s
    return standard.preamble_s + symbol_s * ceil((SERVICE_TAIL_BITS + 8 * psdu_bytes) / bits_per_symbol - 1e-9)


def legacy_ppdu_s(psdu_bytes: int, rate_mbps: float) -> float:
    """Time of an 802.11a frame: 20 µs preamble, then 4 µs symbols."""
    bits_per_symbol = rate_mbps * 1e6 * LEGACY_SYMBOL_S
    return LEGACY_PREAMBLE_S + LEGACY_SYMBOL_S * ceil((SERVICE_TAIL_BITS + 8 * psdu_bytes) / bits_per_symbol - 1e-9)


@lru_cache(maxsize=4096)
def group_frame_s(payload_bytes: int, rate_mbps: float) -> float:
    """Time of one group-addressed sample of a single fragment; 180 B at 6 Mb/s is 432 µs."""
    return legacy_ppdu_s(frame_bytes(payload_bytes, unicast=False), rate_mbps)


ACK_S = legacy_ppdu_s(14, CONTROL_MBPS)
BLOCK_ACK_S = legacy_ppdu_s(32, CONTROL_MBPS)
BLOCK_ACK_LONG_S = legacy_ppdu_s(56, CONTROL_MBPS)
"""Of more than 64 frames."""
RTS_S = legacy_ppdu_s(20, CONTROL_MBPS)
CTS_S = legacy_ppdu_s(14, CONTROL_MBPS)


def ampdu_frames(frame: int, rate_mbps: float, max_frames: int, standard: Standard = AX) -> int:
    """How many frames of `frame` bytes one A-MPDU takes: by number, length and the 5.484 ms limit; at least 1."""
    fit = int((MAX_PPDU_S - standard.preamble_s) * rate_mbps * 1e6 / (8 * (frame + MPDU_DELIMITER)))
    by_length = standard.max_ampdu_bytes // (frame + MPDU_DELIMITER)
    return max(1, min(max_frames, standard.max_ampdu_frames, fit, by_length))


@dataclass(frozen=True, slots=True)
class Exchanges:
    """Load that a sample puts on the medium when no frame fails."""

    count: float
    """Number of exchanges (frame or A-MPDU, SIFS, ack)."""
    ppdu_s: float
    """Time that the sender transmits."""
    clean_s: float
    """Time on the channel without backoff and collisions: frames, SIFS, acks, DIFS and one slot each."""

    def scaled(self, factor: float) -> Exchanges:
        """`factor` times as much, for the retries."""
        return Exchanges(self.count * factor, self.ppdu_s * factor, self.clean_s * factor)

    def __add__(self, other: Exchanges) -> Exchanges:
        return Exchanges(self.count + other.count, self.ppdu_s + other.ppdu_s, self.clean_s + other.clean_s)

    def channel_s(self, among: Contention) -> float:
        """Channel time that it uses up among n backlogged senders: itself, idle slots and its part of the collisions.

        With all n alike, payload bits over this time are Bianchi's throughput.
        """
        return self.clean_s + self.count * among.idle_s + among.collisions * (self.ppdu_s + self.count * DIFS_S)


def _exchange(ppdu_s: float, ack_s: float) -> Exchanges:
    return Exchanges(1.0, ppdu_s, ppdu_s + SIFS_S + ack_s + DIFS_S + SLOT_S)


def frames_exchanges(
    count: int,
    frame: int,
    last_frame: int,
    rate_mbps: float,
    max_frames: int,
    ack_s: float = BLOCK_ACK_S,
    standard: Standard = AX,
) -> Exchanges:
    """Exchanges for `count` frames of `frame` bytes, the last of them of `last_frame` bytes, in full A-MPDUs."""
    m = ampdu_frames(frame, rate_mbps, max_frames, standard)
    if m == 1:
        full = _exchange(ppdu_s(frame, rate_mbps, standard), ack_s).scaled(count - 1)
        return full + _exchange(ppdu_s(last_frame, rate_mbps, standard), ack_s)
    whole, rest = divmod(count - 1, m)  # the last frame rides in the last, perhaps partial, A-MPDU
    full = _exchange(ppdu_s(m * (frame + MPDU_DELIMITER), rate_mbps, standard), ack_s).scaled(whole)
    tail_bytes = rest * (frame + MPDU_DELIMITER) + last_frame + MPDU_DELIMITER
    return full + _exchange(ppdu_s(tail_bytes, rate_mbps, standard), ack_s)


def sample_exchanges(
    payload_bytes: int,
    fragment_bytes: int,
    rate_mbps: float,
    max_frames: int,
    standard: Standard = AX,
    alone: bool = False,
) -> Exchanges:
    """Exchanges of a whole unicast sample; `alone` as for `sample_wire`."""
    k = fragments(payload_bytes, fragment_bytes)
    last = frame_bytes(payload_bytes - (k - 1) * fragment_bytes, fragmented=k > 1 and not alone)
    full = frame_bytes(fragment_bytes, fragmented=not alone)
    return frames_exchanges(k, full, last, rate_mbps, max_frames, standard=standard)


def tries(per: float, retry_limit: int) -> float:
    """Mean transmissions of a frame: 1 / (1 − PER), cut off after retry_limit + 1."""
    return retry_limit + 1.0 if per >= 1.0 else (1.0 - per ** (retry_limit + 1)) / (1.0 - per)


def residual_loss(per: float, retry_limit: int) -> float:
    """Probability that a frame fails every try, PER^(retry_limit + 1), its tries being independent."""
    return float(per ** (retry_limit + 1))
