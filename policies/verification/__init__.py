"""Verification of policies: the conformance kit, invariants, proofs, and a shield at run time."""
