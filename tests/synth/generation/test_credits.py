"""Credits of meshes: those of the models in the set, and no others."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from helpers.fake_scenes import FakeScenes
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.schema import PairObject, PairRow
from objectflow.errors import DatasetError
from objectflow.runtime.pool import InProcess
from objectflow.synth.generation.credits import write_credits
from objectflow.synth.generation.generate import generate
from objectflow.synth.generation.jobs import GenerationJob
from objectflow.synth.generation.tasks import Maker, SceneRows, Task


@dataclasses.dataclass(frozen=True)
class NamedScenes(FakeScenes):
    """Scenes with one object each, whose model is named by the scene's number."""

    def __call__(self) -> Maker:
        return self.named

    def named(self, task: Task) -> SceneRows:
        row = PairRow.from_dict(self.make(task).rows[0])
        zero = np.zeros(3)
        thing = PairObject(1, "cup", f"cups/{task.scene}.obj", zero, zero, zero, zero, (), np.eye(4), np.eye(4), True)
        return SceneRows([dataclasses.replace(row, objects=(thing,)).to_dict()])


@pytest.fixture
def made(tmp_path: Path) -> Manifest:
    out = tmp_path / "set"
    manifest = generate(out, [GenerationJob("pairs", "train", 3, 1)], InProcess(NamedScenes()), seed=0, settings={})
    assert manifest is not None
    return manifest


def test_the_models_of_the_set_are_credited(tmp_path: Path, made: Manifest) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    known = {f"cups/{number}.obj": {"author": f"Ä{number}", "license": "CC-BY 3.0"} for number in (1, 2, 7)}
    (meshes / "credits.json").write_text(json.dumps(known))
    assert write_credits(tmp_path / "set", meshes, made)
    written = json.loads((tmp_path / "set" / "credits.json").read_text(encoding="utf-8"))
    assert written == {name: known[name] for name in ("cups/1.obj", "cups/2.obj")}


def test_a_folder_without_credits_writes_none_and_a_broken_file_is_named(tmp_path: Path, made: Manifest) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    assert not write_credits(tmp_path / "set", meshes, made)
    assert not (tmp_path / "set" / "credits.json").exists()
    (meshes / "credits.json").write_text("{")
    with pytest.raises(DatasetError, match=r"credits\.json is not a JSON object of meshes"):
        write_credits(tmp_path / "set", meshes, made)
