"""The conformance kit over every registered policy, with no exemptions."""

from __future__ import annotations

import pytest

from sortie.policies.registry import POLICIES
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.kit.views import to_json


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_keeps_the_contract(name: str) -> None:
    shown = {
        c.name: (c.what, c.counterexample and to_json(c.counterexample))
        for c in failing(conform(POLICIES[name], count=100))
    }
    assert shown == {}
