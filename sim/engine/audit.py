"""The audit of decisions in flight: who decided, where a shield stepped in, and which invariants were broken how long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import simpy

from sortie.policies.contract import Directive
from sortie.policies.verification.enforced import CAUSES, POLICY, Violation
from sortie.policies.verification.shield import MARK
from sortie.sim.results.record import DECISIONS_OF, VIOLATIONS_OF, Recorder

_Key = tuple[int, str, str]  # peer, line, cause


@dataclass(slots=True)
class _Standing:
    """A violation that lasts."""

    since_s: float
    until_s: float
    policy: str
    what: str


class Audit:
    """Records each change of policy with its reason, each intervention of a shield, and each violation with its cause."""

    def __init__(self, env: simpy.Environment, recorder: Recorder) -> None:
        self._env, self._rows = env, recorder.rows
        self.counts = {"policy_changes": 0, "shield_interventions": 0, "invariant_violations": 0, "violated_ticks": 0}
        self.counts |= {f"{VIOLATIONS_OF}{cause}": 0 for cause in CAUSES}
        self.decisions: dict[str, int] = {}
        """By policy."""
        self._lasting: dict[int, dict[_Key, _Standing]] = {}  # by drone

    def totals(self) -> dict[str, float]:
        """Counts, and decisions by policy as `decisions_of NAME`."""
        return {**self.counts, **{f"{DECISIONS_OF}{name}": n for name, n in self.decisions.items()}}

    @property
    def now_s(self) -> float:
        """The flight's clock."""
        return self._env.now

    def took_over(self, drone: int, before: str, after: str, reason: str) -> None:
        """A drone's policy changed."""
        self.counts["policy_changes"] += 1
        self._rows["events"].append((self._env.now, drone, "policy", f"{before} → {after}: {reason}"))

    def stepped_in(self, policy: str, directive: Directive, where: str) -> None:
        """The shield replaced a directive, or could not keep an invariant. `where`: on the `policy`'s output or at the `gate`."""
        self.counts["shield_interventions"] += 1
        text = directive.reason.removeprefix(MARK)
        self._rows["interventions"].append(
            (self._env.now, directive.source, directive.destination, policy, where, text)
        )

    def judged(self, drone: int, policy: str, violations: Sequence[Violation]) -> None:
        """What a drone's gates break at this moment. A violation lasts while this call names it; then it is written down."""
        lasting = self._lasting.get(drone)
        if not violations and not lasting:
            return
        if lasting is None:
            lasting = self._lasting[drone] = {}
        now_s = self._env.now
        self.counts["violated_ticks"] += bool(violations)
        broken = {(v.peer, v.line, v.cause): v for v in violations}
        for key in [key for key in lasting if key not in broken]:
            self._write(drone, key, lasting.pop(key))
        for key, v in broken.items():
            if key in lasting:
                lasting[key].until_s = now_s
            else:
                lasting[key] = self._begin(drone, policy, v)

    def failed(self, drone: int, peer: int, policy: str, line: str, what: str) -> None:
        """A policy broke a rule on a view that the scenario showed to it; peer −1: all its directives together."""
        violation = Violation(line, peer, POLICY, what)
        self._write(drone, (peer, line, POLICY), self._begin(drone, policy, violation))

    def finish(self) -> None:
        """Write down what still lasts; call once, at the end of the sortie."""
        for drone, lasting in sorted(self._lasting.items()):
            for key, standing in lasting.items():
                self._write(drone, key, standing)
        self._lasting.clear()

    def _begin(self, drone: int, policy: str, v: Violation) -> _Standing:
        self.counts["invariant_violations"] += 1
        self.counts[f"{VIOLATIONS_OF}{v.cause}"] += 1
        now_s = self._env.now
        link = "" if v.peer < 0 else f" on link {drone}→{v.peer}"
        self._rows["events"].append((now_s, drone, "violation", f"{v.line}{link}: broken by {v.cause}"))
        return _Standing(now_s, now_s, policy, v.what)

    def _write(self, drone: int, key: _Key, s: _Standing) -> None:
        self._rows["violations"].append((s.since_s, s.until_s, drone, key[0], s.policy, key[2], key[1], s.what))
