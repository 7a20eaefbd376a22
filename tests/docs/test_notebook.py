"""docs/notebook.ipynb runs, and its committed outputs are up to date."""

from __future__ import annotations

import importlib
import re
from typing import Any

import pytest


@pytest.fixture(scope="module")
def notebooks() -> tuple[Any, Any]:
    """The committed notebook, and the same notebook freshly executed."""
    for module in ("nbclient", "nbformat", "ipykernel"):
        pytest.importorskip(module, reason='needs the extra "test"')
    import nbformat

    script = importlib.import_module("run_notebook")
    return nbformat.read(script.NOTEBOOK, as_version=4), script.execute(script.NOTEBOOK)


def printed(notebook: Any) -> list[str]:
    return [
        output["text"]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if output.output_type == "stream"
    ]


def numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"\d+\.?\d*", text)]


def test_the_outputs_equal_the_committed_ones(notebooks: tuple[Any, Any]) -> None:
    committed, fresh = (printed(notebook) for notebook in notebooks)
    assert len(committed) == 4
    for expected, text in zip(committed, fresh, strict=True):
        assert re.sub(r"\d+\.?\d*", "#", text) == re.sub(r"\d+\.?\d*", "#", expected)
        # Processors round differently, so pixel counts and scores may differ slightly.
        assert numbers(text) == pytest.approx(numbers(expected), rel=0.05, abs=0.3)


def test_every_picture_exists_and_is_small(notebooks: tuple[Any, Any]) -> None:
    for notebook in notebooks:
        pictures = [
            output.data["image/jpeg"]
            for cell in notebook.cells
            for output in cell.get("outputs", [])
            if "image/jpeg" in output.get("data", {})
        ]
        assert len(pictures) == 4
        assert all(5_000 < len(picture) < 100_000 for picture in pictures)
