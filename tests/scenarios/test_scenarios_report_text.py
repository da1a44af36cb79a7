"""Text between two markers of a page."""

from __future__ import annotations

import pytest

from sortie.scenarios.report_text import replace_section

BEGIN, END = "<!-- part:begin -->", "<!-- part:end -->"


def test_a_section_replaces_what_was_between_the_markers() -> None:
    section = f"{BEGIN}\nnew\n{END}"
    before = f"# Title\n\n{BEGIN}\nold\n{END}\n\nmore\n"
    after = replace_section(before, section, BEGIN, END)
    assert after == f"# Title\n\n{section}\n\nmore\n"
    assert replace_section(after, section, BEGIN, END) == after
    for broken in ("no markers", f"{END}{BEGIN}", before + before):
        with pytest.raises(ValueError, match="once each, in this order"):
            replace_section(broken, section, BEGIN, END)
