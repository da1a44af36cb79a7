"""The shipped weights earn their place: cooperation beats a single drone in towns that nobody has seen before."""

from sortie.perception.network.detector import SHIPPED_WEIGHTS


def test_the_weights_are_small_and_have_a_card() -> None:
    assert SHIPPED_WEIGHTS.stat().st_size < 5_000_000
    card = SHIPPED_WEIGHTS.with_suffix(".md").read_text()
    assert "python -m research train" in card
    assert "95 % interval" in card
