"""Verdicts as JUnit XML, the form of test reports that build servers read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple
from xml.etree import ElementTree

from sortie.sim.check.checking import Checked

_NOT_IN_XML = re.compile(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Suite(NamedTuple):
    """One scenario that was to be checked."""

    name: str
    """As the command names it: a file, or a library scenario."""
    checked: Checked | None
    """None where its flight failed."""
    error: str = ""
    """Why it failed."""


def junit(suites: Sequence[Suite]) -> str:
    """JUnit XML: a test suite for each scenario, and a test case for each of its expectations.

    A failed expectation has the value, the reason, facts from the record and the command that shows it. A flight that
    failed is a test case with an error.
    """
    root = ElementTree.Element("testsuites", name="sortie check")
    for suite in suites:
        verdicts = () if suite.checked is None else suite.checked.verdicts
        failed, errors = sum(not v.holds for v in verdicts), int(suite.checked is None)
        counts = {"tests": len(verdicts) + errors, "failures": failed, "errors": errors}
        inside = ElementTree.SubElement(
            root, "testsuite", {"name": _text(suite.name), **{key: str(n) for key, n in counts.items()}}
        )
        for v in verdicts:
            case = ElementTree.SubElement(inside, "testcase", classname=_text(suite.name), name=_text(v.expected))
            if not v.holds and suite.checked is not None:
                what = ElementTree.SubElement(case, "failure", message=_text(f"{v.expected}, got {v.got}"))
                lines = [f"because: {v.because}", f"the record: {v.explanation}", f"see it: {suite.checked.replay(v)}"]
                what.text = _text("\n".join(line for line in lines if not line.endswith(": ")))
        if suite.checked is None:
            case = ElementTree.SubElement(inside, "testcase", classname=_text(suite.name), name="flight")
            ElementTree.SubElement(case, "error", message=_text(suite.error))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _text(text: str) -> str:
    """Without the characters that XML cannot hold."""
    return _NOT_IN_XML.sub("�", text)
