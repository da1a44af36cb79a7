"""Conditions: what they refuse, and their labels."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.perception.evaluation import FULL_SHARING, SINGLE, Sharing

conditions = st.one_of(
    st.just(SINGLE),
    st.builds(
        Sharing,
        st.floats(0, 1),
        st.sampled_from(["all-4", "best-1", "best-2", "best-4", "worst-2", "worst-3", "random-2", "random-4"]),
        st.sampled_from(["uniform", "overlap"]),
        st.sampled_from(["zero", "masked"]),
        st.booleans(),
    ),
)


@given(conditions)
def test_a_label_names_its_condition(condition: Sharing) -> None:
    assert Sharing.parse(condition.label) == condition


def test_labels_are_short() -> None:
    assert SINGLE.label == "single"
    assert FULL_SHARING.label == "all-4@1"
    assert Sharing(0.02, "best-2").label == "best-2@0.02"
    assert Sharing(0.1, "all-4", "overlap", "masked", True).label == "all-4@0.1,overlap,masked,roi"


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"received_budget": 1.5}, "received_budget is 1.5, must be 0 to 1"),
        ({"received_budget": float("nan")}, "received_budget is nan, must be 0 to 1"),
        ({"received_budget": 0.1, "peers": "nearest-2"}, "peers is 'nearest-2', must be none, or all-k, best-k"),
        ({"received_budget": 0.1, "peers": "best-0"}, "peers is 'best-0', must be"),
        ({"received_budget": 0.1, "peers": "none"}, "received_budget is 0.1 with no peers, must be 0"),
        ({"received_budget": 0.1, "allocation": "equal"}, "allocation is 'equal', must be uniform or overlap"),
        ({"received_budget": 0.1, "unsent": "gone"}, "unsent is 'gone', must be zero or masked"),
    ],
)
def test_what_a_condition_refuses(knobs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Sharing(**knobs)


@pytest.mark.parametrize("label", ["", "best-2", "best-2@x", "best-2@0.1,loud", "best-2@7"])
def test_what_is_no_label(label: str) -> None:
    with pytest.raises(ValueError, match="must be like best-2@0\\.02,masked"):
        Sharing.parse(label)
