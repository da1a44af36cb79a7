"""Sphinx settings of the documentation site. `make docs` builds the site into build/site.

The repository's own pages are the site's pages: Sphinx reads them where they lie, so each link in them works on a code
host and on the site. Only `docs/site/*.md` is written for the site. It needs no network.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [
    str(ROOT),
    str(Path(__file__).parent),
]  # document this checkout, and find the extension beside this file

project = "Sortie"
copyright = "the Sortie developers"
html_title = "Sortie"
language = "en"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "site_extension"]
root_doc = "README"
folders = ("docs", "fleet", "perception", "policies", "radio", "research", "ros2", "scenarios", "sim")
notebooks = ("notebooks/*.ipynb", "research/pages/*.ipynb")
include_patterns = ["*.md", *(f"{folder}/**.md" for folder in folders), *notebooks]

nb_execution_mode = "off"  # notebooks are shown with the outputs that they were committed with
myst_heading_anchors = 4  # `page.md#heading`, as code hosts have it
default_role = "literal"  # docstrings write `names` between single backticks

nitpicky = True  # a reference that leads nowhere is an error
nitpick_ignore_regex = [("py:.*", r".*")]
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"exclude-members": "__new__, __init__, model_config"}
autodoc_type_aliases = {name: name for name in ("ScenarioLike", "PolicyLike", "Overrides", "Policy", "Observer")}

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_theme_options = {"navigation_with_keys": True, "footer_icons": []}
