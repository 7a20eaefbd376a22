"""Execute docs/notebook.ipynb and store its outputs.

    pip install -e ".[test]"
    python scripts/run_notebook.py                 # writes the notebook with fresh outputs

No Jupyter server is needed. Execution times are removed, since they change from run to run.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import nbclient
import nbformat

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "notebook.ipynb"
TIMEOUT = 300
"""Longest execution time of a cell, seconds."""


def execute(path: Path) -> Any:
    """Execute the notebook of a file and return it.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; the message is its traceback.
    """
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    nbclient.NotebookClient(notebook, timeout=TIMEOUT, kernel_name="python3", resources=resources).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    notebook.metadata["language_info"] = {"name": "python"}
    return notebook


def main() -> None:
    """Execute and write."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    nbformat.write(execute(NOTEBOOK), NOTEBOOK)


if __name__ == "__main__":
    main()
