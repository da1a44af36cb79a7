"""Run the notebooks and keep their outputs: `make outputs`. The site shows them as they were kept.

A notebook also keeps the hash of the code that made its outputs, so that a test can see when the code has changed.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted(path for folder in ("notebooks", "research/pages") for path in (ROOT / folder).glob("*.ipynb"))
"""The tutorials, and the laboratory's."""


def code_hash(cells: list[dict[str, Any]]) -> str:
    """SHA-256 of the code cells, in order."""
    code = "\n\n".join(cell["source"] for cell in cells if cell["cell_type"] == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def run(path: Path) -> None:
    """Run a notebook where it lies, and write it with its outputs."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=1200, record_timing=False, resources={"metadata": {"path": path.parent}}).execute()
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "outputs_of": code_hash(notebook.cells),
    }
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for path in NOTEBOOKS:
        if path.stem in sys.argv[1:] or not sys.argv[1:]:
            run(path)
