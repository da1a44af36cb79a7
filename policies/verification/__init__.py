"""Whether a policy keeps its promises: conformance, invariants, proofs and a shield in flight."""
