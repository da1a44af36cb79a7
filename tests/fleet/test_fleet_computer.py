"""Headrooms against calculations by hand, and against the figures of the paper that they come from."""

from __future__ import annotations

from dataclasses import astuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.flop_counter import FlopCounterMode

from sortie.fleet.computer import Work, headrooms
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.scenarios.schema import (
    Computer,
)

ORIN, LOOK_S, FRAME_S = Computer(), 0.03, 0.1


def test_headrooms_count_looks_maps_decisions_and_bytes() -> None:
    """By hand: each alone, and together."""
    computer = Computer(cpu_cores=4, decision_s=0.01, payload_mbps=100.0, driving_cores=2.0, fusion_s=0.02)
    cases = [
        (Work(15, 5, 5, 5), 1 - 2 * 10 * 0.03 / 8, 1 - 0.3 / 2),  # ten looks of 30 ms in 2 s, four cores
        (Work(5, 15, 5, 5), 1 - 2 * 10 * 0.02 / 8, 1 - 0.2 / 2),  # ten maps
        (Work(5, 5, 15, 5), 1 - 10 * 0.01 / 8, 1.0),
        (Work(5, 5, 5, 5_000_005), 1 - 40.0 / 100.0 / 8, 1.0),  # 40 Mb
        (Work(15, 15, 15, 5_000_005), 1 - (2 * 0.5 + 0.1 + 0.4) / 8, 1 - 0.5 / 2),
    ]
    for after, cpu, gpu in cases:
        assert headrooms(computer, 0.03, Work(5, 5, 5, 5), after, 2.0) == pytest.approx((cpu, gpu)), after


def test_the_papers_prototype_takes_nine_percent_of_a_core() -> None:
    """Four agents at 10 Hz that send and receive 105 MB/s, without perception: one second of one computer."""
    second = Work(decisions=4 * 10, payload_bytes=2 * 105_000_000)
    cpu, gpu = headrooms(Computer(cpu_cores=1), LOOK_S, Work(), second, 1.0)
    assert cpu == pytest.approx(1 - 0.09, abs=0.0005)
    assert gpu == 1.0


def test_the_time_of_a_fusion_is_its_operations_at_a_tenth_of_the_orins_peak() -> None:
    agents, arrived = torch.zeros(1, 5, 80, 64, 64), torch.ones(1, 4, 64, 64, dtype=torch.bool)
    part = takes_part(arrived, torch.ones_like(arrived), torch.ones(1, 4), "masked")
    with FlopCounterMode(display=False) as counted, torch.inference_mode():
        FUSIONS["disconet"]().eval()(agents, part, torch.ones(1, 5))
    assert counted.get_total_flops() / 4 / (0.1 * 5.3e12) == pytest.approx(ORIN.fusion_s, abs=5e-6)


counts = st.builds(Work, *[st.integers(0, 1000)] * 3, st.integers(0, 10**9))


@given(counts, counts)
def test_headrooms_are_shares_and_more_work_leaves_less(some: Work, more: Work) -> None:
    both = Work(*map(sum, zip(astuple(some), astuple(more), strict=True)))
    less, least = (headrooms(ORIN, LOOK_S, Work(), work, FRAME_S) for work in (some, both))
    assert all(0.0 <= b <= a <= 1.0 for a, b in zip(less, least, strict=True))
