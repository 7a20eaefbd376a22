"""Execute docs/notebook.ipynb from top to bottom and keep its outputs.

    pip install -e ".[test]"
    python scripts/run_notebook.py                 # writes the notebook with fresh outputs

No Jupyter server is needed. What changes from run to run (times of execution) is left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import nbclient
import nbformat

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "notebook.ipynb"
SECONDS = 300


def execute(path: Path) -> Any:
    """The notebook of a file, executed.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails; the message is its traceback.
    """
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    nbclient.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=resources).execute()
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
