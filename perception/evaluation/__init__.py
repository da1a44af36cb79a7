"""Evaluate cooperative perception: limit what drones share, and measure the AP that it costs. Free of torch.

`evaluate_recording` evaluates a recording of another model; `evaluate` any model that is an `harness.Instrument`. Both
return an `Evaluation`.

Example:
    two = Sharing(received_budget=0.02, peers="best-2")
    found = evaluate_recording("mine.npz", [SINGLE, two]).at(0.1)
    found.ap(two, "mission"), found.gain(two, over=SINGLE), found.payload_bytes[two].mean()
"""

from sortie.perception.evaluation.harness import Evaluation, Settings, evaluate
from sortie.perception.evaluation.recorded import evaluate_recording
from sortie.perception.evaluation.sharing import FULL_SHARING, SINGLE, Sharing

__all__ = ["FULL_SHARING", "SINGLE", "Evaluation", "Settings", "Sharing", "evaluate", "evaluate_recording"]
