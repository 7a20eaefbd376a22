"""Mixtures of meshes and procedural objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from helpers.object_models import plate_model
from objectflow.synth.objects.mixed_library import MixedLibrary, open_library
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.procedural import ProceduralLibrary


class FakeLibrary:
    """Three meshes, one per split."""

    broken: Mapping[str, str] = {}

    def refs(self, split: str) -> Sequence[ModelRef]:
        return [ModelRef("mesh", split)]

    def load(self, ref: ModelRef) -> ObjectModel:
        return plate_model(name=ref.name)


def test_meshes_are_mixed_in_by_their_share() -> None:
    mixed = MixedLibrary(FakeLibrary(), ProceduralLibrary(), 0.3, every=False)
    refs = mixed.refs("val")
    picked = [refs[int(k)] for k in np.random.default_rng(0).integers(len(refs), size=2000)]
    meshes = [ref for ref in picked if ref.category == "mesh"]
    assert 0.26 < len(meshes) / len(picked) < 0.34
    assert set(meshes) == {ModelRef("mesh", "val")}
    assert mixed.load(meshes[0]).name == "val"
    assert mixed.load(refs[99]).category != "mesh"
    everything = MixedLibrary(FakeLibrary(), ProceduralLibrary(), 1.0, every=True).refs("test")
    assert [ref.name for ref in everything] == ["train", "val", "test"]


def test_without_a_mesh_folder_the_library_is_procedural() -> None:
    assert isinstance(open_library(None), ProceduralLibrary)
