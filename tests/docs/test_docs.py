"""What the pages show: commands that parse, figures that their script draws, faults that `check-pair` still names."""

from __future__ import annotations

import importlib
import importlib.util
import io
import re
import shlex
import sys
from contextlib import redirect_stderr
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import tyro

from helpers.paths import ROOT
from objectflow.cli import VERBS
from objectflow.diagnosis import examine
from objectflow.methods.registry import METHODS
from objectflow.readers import open_pair

PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"]
QUICK_FAULTS = (
    "tenths", "half_size", "unregistered", "ray_length", "holes", "picture", "exposure", "swapped", "same"
)  # fmt: skip
"""Those that need no ray casting."""


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def parse(line: str) -> Any:
    """The arguments of a command line, understood but not run."""
    words = shlex.split(line, comments=True)
    words = words[words.index("objectflow") + 1 :]
    entry = VERBS[words[0]]
    module = importlib.import_module(entry.module)
    default = module.default(words[1:]) if hasattr(module, "default") else None
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(getattr(module, entry.dataclass), args=words[1:], default=default)
    except SystemExit:
        pytest.fail(f"{line}: {complaint.getvalue()}")


@pytest.mark.parametrize("verb", VERBS)
def test_every_example_of_a_command_can_be_pasted(verb: str) -> None:
    examples = importlib.import_module(VERBS[verb].module).EXAMPLES.splitlines()
    assert examples
    for line in examples:
        assert type(parse(line)).__name__ == VERBS[verb].dataclass


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_can_be_pasted(page: Path) -> None:
    blocks = re.findall(r"^```(?:bash|text|)\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        for command in line.removeprefix("$ ").split(" && "):
            if re.match(r"(torchrun .* )?objectflow [a-z]", command):
                parse(command)


def test_the_command_page_is_made_of_what_the_program_says(monkeypatch: pytest.MonkeyPatch) -> None:
    page = script("docs_hook", monkeypatch).on_page_markdown((ROOT / "docs" / "command-line.md").read_text())
    for verb, entry in VERBS.items():
        assert f"## `objectflow {verb}`" in page
        for line in importlib.import_module(entry.module).EXAMPLES.splitlines():
            assert f"\n{line.strip()}\n" in page
    assert "--depth-scale" in page
    table = script("docs_hook", monkeypatch).on_page_markdown((ROOT / "docs" / "methods.md").read_text())
    assert all(f"| `{name}`" in table for name in METHODS)


def test_figures_are_those_that_the_script_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawing = script("draw_conventions", monkeypatch)
    kept = drawing.OUT
    monkeypatch.setattr(drawing, "OUT", tmp_path)
    for draw in (drawing.camera_frame, drawing.backward_flow, drawing.about_the_centre):
        draw()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(path.name for path in kept.glob("convention_*.svg"))
    assert all((tmp_path / name).read_text() == (kept / name).read_text() for name in names)


@pytest.mark.parametrize("fault", QUICK_FAULTS)
def test_check_pair_still_says_what_the_page_prints(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = script("docs_inputs", monkeypatch)
    pair = inputs.Pair.read()
    inputs.faults[fault](pair)
    pair.write(tmp_path / fault)
    found = [finding.check for finding in examine(*open_pair(tmp_path / fault)) if finding.level == "suspicious"]
    page = (ROOT / "docs" / "own-camera.md").read_text()
    (block,) = re.findall(rf"^\$ objectflow check-pair {fault} .*?\n(.*?)```", page, flags=re.DOTALL | re.MULTILINE)
    assert found == re.findall(r"^ (\S.*?) +│ suspicious", block, flags=re.MULTILINE)
    assert found


def test_printed_tables_are_cut_as_the_pages_show_them(monkeypatch: pytest.MonkeyPatch) -> None:
    outputs = script("docs_outputs", monkeypatch)
    table = [
        " check ┃ ┃ what",
        "━━━╇━━━╇━━━",
        " a │ fine │ good",
        "   │      │ and more",
        " b │ note │ so",
        "   │      │ and so",
        "1 suspicious",
    ]
    assert outputs.without_fine(table) == [" b │ note │ so", "   │      │ and so", "1 suspicious"]
    block = "$ printf 'x  \\n'\nold\n$ echo y # all but what is fine\n"
    assert outputs.refresh(block, ROOT) == "$ printf 'x  \\n'\nx\n$ echo y # all but what is fine\ny\n"
