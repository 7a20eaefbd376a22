"""Commands and code of the README exist, run, and agree with the check script."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import objectflow
from helpers.paths import ROOT
from objectflow.cli import COMMANDS
from objectflow.readers import open_pair

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_every_command_of_the_readme_exists() -> None:
    commands = re.findall(r"(?:^|&& |`)objectflow ([a-z]+)", README, flags=re.MULTILINE)
    assert len(commands) > 5
    assert set(commands) <= set(COMMANDS)


def test_the_check_script_runs_the_two_set_up_commands() -> None:
    script = (ROOT / ".ci" / "run").read_text().replace(" --quiet", "")
    for block in blocks("bash")[:2]:
        for command in block.strip().split(" && ")[2:]:  # Without the lines that create and activate the environment.
            assert f"\n{command}" in script, command


def test_the_python_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The block runs as printed, except for `vo-sf` instead of the slower method, on the demo pair."""
    frames = open_pair(Path(objectflow.__file__).parent / "demo" / "pair")
    for index, frame in enumerate(frames.paths):
        (tmp_path / f"color{index}.png").write_bytes(frame.color.read_bytes())
        (tmp_path / f"depth{index}.png").write_bytes(frame.depth.read_bytes())
    monkeypatch.chdir(tmp_path)
    code = blocks("python")[0].replace('"rigidmatch"', '"vo-sf"')
    names = {"color1": frames[1].color, "depth1": frames[1].depth}
    exec(compile(code, "README.md", "exec"), names)
    motion = names["motion"]
    assert isinstance(motion, objectflow.SceneMotion)
    assert motion.scene_flow.dtype == np.float32
    assert (tmp_path / "out" / "objects.json").is_file()
