"""The language of invariants, one evaluator, and the lines about time."""
