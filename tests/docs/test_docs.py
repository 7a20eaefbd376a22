"""Documentation pages: commands parse, figures match their script, `check-pair` finds the documented faults."""

from __future__ import annotations

import importlib
import io
import re
import shlex
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any

import pytest
import tyro

import docs_hook
import docs_inputs
import docs_outputs
import draw_conventions
from helpers.paths import ROOT
from objectflow.cli import COMMANDS, split_intrinsics
from objectflow.diagnosis import examine
from objectflow.methods.registry import METHODS
from objectflow.readers import open_pair

PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"]
QUICK_FAULTS = (
    "tenths", "half_size", "unregistered", "ray_length", "holes", "picture", "exposure", "swapped", "same"
)  # fmt: skip
"""Faults that need no ray casting."""


def parse(line: str) -> Any:
    """Parse a command line without running it."""
    words = shlex.split(line, comments=True)
    words = split_intrinsics(words[words.index("objectflow") + 1 :])
    entry = COMMANDS[words[0]]
    module = importlib.import_module(entry.module)
    default = module.default(words[1:]) if hasattr(module, "default") else None
    parser_error = io.StringIO()
    try:
        with redirect_stderr(parser_error):
            return tyro.cli(getattr(module, entry.dataclass), args=words[1:], default=default)
    except SystemExit:
        pytest.fail(f"{line}: {parser_error.getvalue()}")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_example_of_a_command_parses(command: str) -> None:
    examples = importlib.import_module(COMMANDS[command].module).EXAMPLES.splitlines()
    assert examples
    for line in examples:
        assert type(parse(line)).__name__ == COMMANDS[command].dataclass


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_parses(page: Path) -> None:
    blocks = re.findall(r"^```(?:bash|text|)\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        for command in line.removeprefix("$ ").split(" && "):
            if re.match(r"(torchrun .* )?objectflow [a-z]", command):
                parse(command)


def test_the_command_page_is_generated_from_the_program() -> None:
    page = docs_hook.on_page_markdown((ROOT / "docs" / "command-line.md").read_text())
    for command, entry in COMMANDS.items():
        assert f"## `objectflow {command}`" in page
        for line in importlib.import_module(entry.module).EXAMPLES.splitlines():
            assert f"\n{line.strip()}\n" in page
    assert "--depth-scale" in page
    table = docs_hook.on_page_markdown((ROOT / "docs" / "methods.md").read_text())
    assert all(f"| `{name}`" in table for name in METHODS)


def test_figures_equal_those_of_the_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    committed = draw_conventions.OUT
    monkeypatch.setattr(draw_conventions, "OUT", tmp_path)
    for draw in (draw_conventions.camera_frame, draw_conventions.backward_flow, draw_conventions.about_the_centre):
        draw()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(path.name for path in committed.glob("convention_*.svg"))
    assert all((tmp_path / name).read_text() == (committed / name).read_text() for name in names)


@pytest.mark.parametrize("fault", QUICK_FAULTS)
def test_check_pair_finds_what_the_page_prints(fault: str, tmp_path: Path) -> None:
    pair = docs_inputs.Pair.read()
    docs_inputs.faults[fault](pair)
    pair.write(tmp_path / fault)
    found = [finding.check for finding in examine(*open_pair(tmp_path / fault)) if finding.level == "suspicious"]
    page = (ROOT / "docs" / "own-camera.md").read_text()
    (block,) = re.findall(rf"^\$ objectflow check-pair {fault} .*?\n(.*?)```", page, flags=re.DOTALL | re.MULTILINE)
    assert found == re.findall(r"^ (\S.*?) +│ suspicious", block, flags=re.MULTILINE)
    assert found


def test_printed_tables_are_shortened_as_on_the_pages() -> None:
    table = [
        " check ┃ ┃ what",
        "━━━╇━━━╇━━━",
        " a │ fine │ good",
        "   │      │ and more",
        " b │ note │ so",
        "   │      │ and so",
        "1 suspicious",
    ]
    assert docs_outputs.without_fine(table) == [" b │ note │ so", "   │      │ and so", "1 suspicious"]
    block = "$ printf 'x  \\n'\nold\n$ echo y # all but what is fine\n"
    assert docs_outputs.refresh(block, ROOT) == "$ printf 'x  \\n'\nx\n$ echo y # all but what is fine\ny\n"
