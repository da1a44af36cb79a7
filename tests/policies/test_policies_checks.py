"""An answer that repeats most of the one before is checked where it differs, as strictly as a whole one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies_examples import fleet_of

from sortie.policies.checks import check_directives, differing
from sortie.policies.contract import Directive, PolicyError, Representation

VIEW = fleet_of(5)
BEFORE = {p: Directive(VIEW.ego, p, Representation.FEATURES, 0.5, rate_hz=10.0, reason="share") for p in VIEW.peers}
FIRST, SECOND, *REST = ANSWER = tuple(BEFORE.values())


PEERS = st.sets(st.sampled_from(list(BEFORE)))


@given(st.permutations(list(BEFORE)), PEERS, PEERS, st.booleans())
def test_what_is_new_is_found_in_any_order(order: list[int], new: set[int], met: set[int], is_tuple: bool) -> None:
    before = {p: d for p, d in BEFORE.items() if p not in met}  # the others were heard since
    answer = [BEFORE[p]._replace(rate_hz=2.0) if p in new else BEFORE[p] for p in order]
    found = differing(tuple(before.values()), tuple(answer) if is_tuple else answer, VIEW, before)
    assert found == [d for d in answer if d.destination in new | met]


@pytest.mark.parametrize(
    "answer",
    [
        [FIRST, FIRST, *REST],
        [FIRST, FIRST._replace(rate_hz=2.0), *REST],
        [FIRST._replace(rate_hz=2.0), FIRST._replace(rate_hz=5.0), *REST],
        [FIRST, SECOND._replace(destination=VIEW.ego), *REST],
        [FIRST, SECOND._replace(destination=99), *REST],
        [FIRST, SECOND._replace(destination=[1]), *REST],  # type: ignore[arg-type]
        [FIRST, SECOND._replace(source=99), *REST],
        [FIRST, SECOND._replace(rho=1.5), *REST],
        [FIRST, SECOND._replace(rate_hz=float("nan")), *REST],
        [FIRST, tuple(SECOND), *REST],
        [FIRST, None, *REST],
        iter(BEFORE.values()),
        None,
    ],
)  # fmt: skip
def test_what_a_whole_check_refuses_goes_to_a_whole_check(answer: Any) -> None:
    assert differing(ANSWER, answer, VIEW, BEFORE) is None
    with pytest.raises(PolicyError):
        check_directives(answer, VIEW)


@pytest.mark.parametrize(
    "answer", [[FIRST, SECOND], [*BEFORE.values(), FIRST], [FIRST, SECOND._replace(rho=np.float32(0.1)), *REST]]
)  # fmt: skip
def test_what_is_not_plainly_the_same_links_goes_to_a_whole_check(answer: list[Directive]) -> None:
    assert differing(ANSWER, answer, VIEW, BEFORE) is None


@pytest.mark.parametrize("make", [list, tuple])
def test_an_answer_of_the_same_objects_has_nothing_new(make: Callable[..., Any]) -> None:
    assert differing(ANSWER, make(BEFORE.values()), VIEW, BEFORE) == []
    assert differing((), make(), VIEW, {}) == []
