"""docs/notebook.ipynb runs from top to bottom, and the outputs that it is kept with are still true."""

from __future__ import annotations

import importlib.util
import re
from typing import Any

import pytest

from helpers.paths import ROOT


@pytest.fixture(scope="module")
def notebooks() -> tuple[Any, Any]:
    """As it is kept, and freshly executed."""
    for module in ("nbclient", "nbformat", "ipykernel"):
        pytest.importorskip(module, reason='needs the extra "test"')
    import nbformat

    spec = importlib.util.spec_from_file_location("run_notebook", ROOT / "scripts" / "run_notebook.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
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


def test_it_runs_and_prints_what_it_is_kept_with(notebooks: tuple[Any, Any]) -> None:
    kept, fresh = (printed(notebook) for notebook in notebooks)
    assert len(kept) == 4
    for before, now in zip(kept, fresh, strict=True):
        assert re.sub(r"\d+\.?\d*", "#", now) == re.sub(r"\d+\.?\d*", "#", before)
        # Processors round differently: pixels and scores may change a little, the story may not.
        assert numbers(now) == pytest.approx(numbers(before), rel=0.05, abs=0.3)


def test_every_picture_is_there_and_small(notebooks: tuple[Any, Any]) -> None:
    for notebook in notebooks:
        pictures = [
            output.data["image/jpeg"]
            for cell in notebook.cells
            for output in cell.get("outputs", [])
            if "image/jpeg" in output.get("data", {})
        ]
        assert len(pictures) == 4
        assert all(5_000 < len(picture) < 100_000 for picture in pictures)
