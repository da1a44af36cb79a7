"""Numbers that an SMT solver follows, for policies that combine inputs."""

from __future__ import annotations

from sortie.policies.verification.symbols import Refused


def solver_paths():
    raise Refused("combines inputs, and the extra `verify` (z3) is not installed")
