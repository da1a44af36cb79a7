"""The plain Python that a proof follows: what is in it, and what is refused with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.policies.registry import POLICIES, resolve
from sortie.policies.verification.proof.allowed import why_not_provable

HEAD = "import math, random, time, helper\nfrom helper import LEAST, rate\nfrom sortie import Directive, LinkState\nRATES = {0: 2.0}; BEGIN = time.time()\nSEEN = []\n"
HELPER = "LEAST = 0.3\nNOW = [0]\ndef rate(soc, least=LEAST):\n    return 2.0 if soc < least else 8.0\ndef counts():\n    NOW[0] += 1\n"
ALLOWED = (
    "x = rate(me.battery_soc)\ndef unused(): pass",
    "x = RATES[0] + RATES.get(1, 2.0) if 0 in RATES else math.floor(me.battery_soc * 10)",
    "why = f'charge {me.battery_soc:.0%}'\nwhy += ', low'\nx = Directive(0, 1, reason=why + f'{LEAST}')",
    "x = [d._replace(reason=f'capped: {d.reason}') for d in []]",
    "def reason(p):\n    return f'{p}' if p else 'none'\nx = Directive(0, 1, reason=reason(1))",
    "x = me.link_state(1) is LinkState.MEASURED and me.region is None",
    "best = max(view.peers, key=me.goodput_to, default=None)\nx = sum(me.goodput_to(p) for p in view.peers)",
)
REFUSED = {
    "SEEN.append(1)": "hands on SEEN in line 8",
    "x = SEEN": "hands on SEEN in line 8",
    "x = helper.NOW": "uses helper in line 8",
    "x = f'{me.battery_soc}' == '0.5'": "uses an f-string with values for more than `reason` or `why` in line 8",
    "why = f'{me.battery_soc}'\nx = len(why)": "uses why for more than a reason in line 9",
    "x = Directive(0, 1, reason='a').reason == 'a'": "uses .reason in line 8",
    "x = {1, 2}": "has a set in line 8",
    "try:\n    x = 1\nexcept ValueError:\n    pass": "has a try statement in line 8",
    "x = BEGIN": "uses BEGIN in line 8",
    "def f(kept=SEEN):\n    return kept\nx = f()": "hands on SEEN in line 8",
    "rate = 1.0": "gives rate another meaning in line 6",
    "x = view._replace(age_s={})": "hands age_s to a function in line 8",
    "x = random.random()": "uses random in line 8",
    "x = type(me)": "uses type in line 8",
    "x = me.battery_soc is 0.5": "compares by `is` with more than None, a truth value or an enum in line 8",
    "me.battery_soc = 1": "sets me.battery_soc in line 8",
    "x = me.__class__": "uses .__class__ in line 8",
    "x = sum([me.battery_soc, 1e16])": "adds with sum(…) in place of sortie.scenarios.plain_sum.plain_sum in line 8",
}


def why(folder: Path, body: str) -> str:
    path = folder / "policy.py"
    (folder / "helper.py").write_text(HELPER)
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    path.write_text(f"{HEAD}def decide(view):\n    me = view.me\n{lines}    return []\n")
    return why_not_provable(resolve(f"{path}:decide"))


@pytest.mark.parametrize("body", ALLOWED)
def test_plain_python_is_allowed(body: str, tmp_path: Path) -> None:
    assert why(tmp_path, body) == ""


@pytest.mark.filterwarnings("ignore::SyntaxWarning")
@pytest.mark.parametrize("body", REFUSED)
def test_what_is_refused_is_named_with_its_line(body: str, tmp_path: Path) -> None:
    assert why(tmp_path, body) == REFUSED[body]


@pytest.mark.parametrize("name", POLICIES)
def test_registered_policies_are_not_walked(name: str) -> None:
    assert why_not_provable(resolve(name)) == ""


def test_a_file_that_was_edited_is_read_anew(tmp_path: Path) -> None:
    file = tmp_path / "policy.py"
    file.write_text("def decide(view):\n    return []\n")
    assert why_not_provable(resolve(f"{file}:decide")) == ""
    file.write_text("def decide(view):\n    return [*{1}]\n")
    assert "line 2" in why_not_provable(resolve(f"{file}:decide"))
