"""What the README tells people to type must exist, and be what the check script runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import objectflow
from helpers.paths import ROOT
from objectflow.cli import VERBS
from objectflow.readers import open_pair

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_every_command_of_the_readme_exists() -> None:
    verbs = re.findall(r"(?:^|&& |`)objectflow ([a-z]+)", README, flags=re.MULTILINE)
    assert len(verbs) > 5
    assert set(verbs) <= set(VERBS)


def test_the_check_script_runs_the_two_set_up_commands() -> None:
    script = (ROOT / ".ci" / "run").read_text().replace(" --quiet", "")
    for block in blocks("bash")[:2]:
        for command in block.strip().split(" && ")[2:]:  # after making and entering the environment
            assert f"\n{command}" in script, command


def test_the_python_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As printed, with `zero` in place of the slower method and the demo pair as its files."""
    frames = open_pair(Path(objectflow.__file__).parent / "demo" / "pair")
    for index, frame in enumerate(frames.paths):
        (tmp_path / f"color{index}.png").write_bytes(frame.color.read_bytes())
        (tmp_path / f"depth{index}.png").write_bytes(frame.depth.read_bytes())
    monkeypatch.chdir(tmp_path)
    code = blocks("python")[0].replace('"rigidmatch"', '"zero"')
    names = {"color1": frames[1].color, "depth1": frames[1].depth}
    exec(compile(code, "README.md", "exec"), names)
    motion = names["motion"]
    assert isinstance(motion, objectflow.SceneMotion)
    assert motion.scene_flow.dtype == np.float32
    assert (tmp_path / "out" / "objects.json").is_file()
