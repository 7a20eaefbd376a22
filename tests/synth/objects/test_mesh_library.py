"""Mesh folders: layouts, sizes, textures, convex parts, the cache, and broken files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from helpers.paths import SHARED
from objectflow.errors import DatasetError
from objectflow.synth.objects import convex_parts, mesh_library
from objectflow.synth.objects.mesh_files import read_mesh
from objectflow.synth.objects.mesh_library import SHAPENET_SYNSETS, MeshLibrary
from objectflow.synth.objects.mixed_library import MeshFolder, open_library
from objectflow.synth.objects.model import ModelRef

MESHES = SHARED / "data" / "meshes"

CUBE_OBJ = """mtllib model.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
vt 0 0
vt 2 0
vt 2 2
vt 0 2
usemtl print
f 5/1 6/2 7/3 8/4
usemtl paint
f 1/1 4/2 3/3 2/4
f 1/1 2/2 6/3 5/4
f 2/1 3/2 7/3 6/4
f 3/1 4/2 8/3 7/4
f 4/1 1/2 5/3 8/4
"""


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def write_boxes(folder: Path, count: int, size: float = 0.1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        trimesh.creation.box((size, size * (0.6 + 0.01 * i), size * 0.3)).export(folder / f"box{i}.stl")


def write_shapenet(folder: Path) -> None:
    for synset, model in (("03797390", "aaa"), ("02876657", "bbb"), ("00000001", "ccc")):
        place = folder / synset / model / "models"
        place.mkdir(parents=True)
        (place.parent / "images").mkdir()
        (place / "model_normalized.obj").write_text(CUBE_OBJ)
        (place / "model.mtl").write_text("newmtl paint\nKd 1 0 0\nnewmtl print\nKd 1 1 1\nmap_Kd ../images/t.png\n")
        cv2.imwrite(str(place.parent / "images" / "t.png"), np.full((8, 8, 3), (255, 0, 0), np.uint8))  # blue


def test_the_list_has_28_synsets_like_the_paper() -> None:
    assert len(SHAPENET_SYNSETS) == 28
    assert len(set(SHAPENET_SYNSETS.values())) == 28


def test_a_plain_folder_is_split_without_overlap(tmp_path: Path, cache: Path) -> None:
    write_boxes(tmp_path / "boxes", 20)
    library = MeshLibrary(tmp_path / "boxes", cache)
    splits = [list(library.refs(split)) for split in ("train", "val", "test")]
    assert [len(refs) for refs in splits] == [14, 2, 4]  # 69, 10 and 21 per cent
    assert len(set().union(*splits)) == 20
    assert splits == [list(MeshLibrary(tmp_path / "boxes", cache).refs(split)) for split in ("train", "val", "test")]


def test_a_folder_opens_as_a_mesh_library_with_a_cache_in_the_user_s_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    write_boxes(tmp_path / "boxes", 3)
    assert isinstance(open_library(MeshFolder(tmp_path / "boxes")), MeshLibrary)
    assert list((tmp_path / "user" / "objectflow" / "meshes").glob("folder-*.json"))


def test_a_stl_becomes_an_object(tmp_path: Path, cache: Path) -> None:
    write_boxes(tmp_path / "boxes", 3)
    library = MeshLibrary(tmp_path / "boxes", cache)
    model = library.load(ModelRef("boxes", "box1.stl"))
    np.testing.assert_allclose(np.ptp(model.vertices, axis=0), [0.1, 0.061, 0.03], atol=1e-7)
    np.testing.assert_allclose(model.vertices.min(axis=0), -model.vertices.max(axis=0), atol=1e-7)
    assert sorted(axis.order for axis in model.symmetry) == [2, 2, 2]
    assert model.uv.shape == (len(model.vertices), 2)
    assert model.uv.min() >= 0
    assert model.uv.max() <= 1
    assert sum(ConvexHull(part).volume for part in model.parts) == pytest.approx(0.1 * 0.061 * 0.03, rel=0.02)
    again = library.load(ModelRef("boxes", "box1.stl"))
    assert np.array_equal(again.vertices, model.vertices)
    assert all(np.array_equal(a, b) for a, b in zip(again.parts, model.parts, strict=True))


def test_hulls_replace_the_decomposition(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_library, "decompose", lambda *_: pytest.fail("decomposed"))
    write_boxes(tmp_path / "boxes", 2)
    model = MeshLibrary(tmp_path / "boxes", cache, hulls=True).load(ModelRef("boxes", "box1.stl"))
    assert len(model.parts) == 1
    assert ConvexHull(model.parts[0]).volume == pytest.approx(0.1 * 0.061 * 0.03, rel=1e-6)
    monkeypatch.undo()
    solved = MeshLibrary(tmp_path / "boxes", cache).load(ModelRef("boxes", "box1.stl"))
    assert not np.array_equal(solved.parts[0], model.parts[0])  # the two are cached separately


def test_the_second_load_uses_the_cache(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_boxes(tmp_path / "boxes", 1)
    first = MeshLibrary(tmp_path / "boxes", cache).load(ModelRef("boxes", "box0.stl"))
    monkeypatch.setattr(mesh_library, "decompose", lambda *_: pytest.fail("solved again"))
    second = MeshLibrary(tmp_path / "boxes", cache).load(ModelRef("boxes", "box0.stl"))
    assert len(second.parts) == len(first.parts)
    assert second.symmetry == first.symmetry
    write_boxes(tmp_path / "boxes", 1, size=0.2)  # other content under the same name
    with pytest.raises(pytest.fail.Exception):
        MeshLibrary(tmp_path / "boxes", cache).load(ModelRef("boxes", "box0.stl"))


def test_hollow_meshes_have_hollow_parts(tmp_path: Path) -> None:
    tube = trimesh.creation.annulus(0.03, 0.04, 0.08, sections=24)
    parts = convex_parts.decompose(np.asarray(tube.vertices), np.asarray(tube.faces, dtype=np.int32), "tube")
    assert 4 <= len(parts) <= convex_parts.MAX_PARTS
    for part in parts:
        assert (ConvexHull(part).equations[:, 3] > 0).any()  # the tube's centre is outside


def test_if_the_solver_fails_the_hull_is_used_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convex_parts, "run_solver", lambda *_: ())
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    with pytest.warns(UserWarning, match=r"ball\.stl"):
        (hull,) = convex_parts.decompose(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32), "ball.stl")
    assert len(hull) == len(ball.vertices)


@pytest.mark.parametrize(("size", "kept"), [(0.1, True), (0.4, True), (1.0, False), (250.0, False), (0.001, False)])
def test_implausible_sizes_in_metres_are_rescaled(tmp_path: Path, cache: Path, size: float, kept: bool) -> None:
    write_boxes(tmp_path / "boxes", 1, size)
    model = MeshLibrary(tmp_path / "boxes", cache).load(ModelRef("boxes", "box0.stl"))
    longest = np.ptp(model.vertices, axis=0).max()
    if kept:
        assert longest == pytest.approx(size, rel=1e-6)
    else:
        assert 0.07 <= longest <= 0.3


def test_shapenet_layout_with_materials_and_textures(tmp_path: Path, cache: Path) -> None:
    write_shapenet(tmp_path / "shapenet")
    library = MeshLibrary(tmp_path / "shapenet", cache)
    refs = library.refs("train")
    assert {ref.category for ref in refs} == {"mug", "bottle"}  # the third synset is not on the list
    model = library.load(next(ref for ref in refs if ref.category == "mug"))
    assert 0.07 <= np.ptp(model.vertices, axis=0).max() <= 0.3
    assert model.texture is not None
    corners = model.uv[model.faces].mean(axis=1)
    assert corners.min() >= 0
    assert corners.max() <= 1
    height, width = model.texture.shape[:2]
    colour = model.texture[((1 - corners[:, 1]) * height).astype(int), (corners[:, 0] * width).astype(int)]
    z = model.vertices[model.faces][..., 2]
    top = (z > z.max() - 1e-9).all(axis=1)
    assert (colour[top] == [0, 0, 255]).all()  # the printed side, blue in RGB
    assert (colour[~top] == [255, 0, 0]).all()


def test_broken_files_are_named_skipped_and_counted(tmp_path: Path, cache: Path) -> None:
    folder = tmp_path / "things"
    write_boxes(folder, 4)
    (folder / "empty.obj").write_text("")
    (folder / "noise.stl").write_bytes(bytes(range(256)) * 3)
    (folder / "torn.glb").write_bytes(b"glTF\x02\x00\x00\x00\xff")
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    library = MeshLibrary(folder, cache)
    assert set(library.broken) == {"empty.obj", "noise.stl", "torn.glb", "flat.obj"}
    assert all(name in reason and "\n" not in reason for name, reason in library.broken.items())
    assert len(library.refs("train")) + len(library.refs("val")) + len(library.refs("test")) == 4
    with pytest.raises(DatasetError, match=r"noise\.stl"):
        library.load(ModelRef("things", "noise.stl"))
    trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / "noise.stl")  # repaired files are read again
    assert set(MeshLibrary(folder, cache).broken) == {"empty.obj", "torn.glb", "flat.obj"}
    json.loads(next(cache.glob("folder-*.json")).read_text())


def test_folders_without_meshes_are_refused(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(DatasetError, match="not a folder"):
        MeshLibrary(tmp_path / "nowhere", cache)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "readme.txt").write_text("nothing")
    with pytest.raises(DatasetError, match="no meshes"):
        MeshLibrary(tmp_path / "empty", cache)
    (tmp_path / "empty" / "a.obj").write_text("")
    with pytest.raises(DatasetError, match="none of the 1 meshes"):
        MeshLibrary(tmp_path / "empty", cache)
    write_boxes(tmp_path / "one", 1)
    one = MeshLibrary(tmp_path / "one", cache)
    assert len(one.refs("train")) == 1
    with pytest.raises(DatasetError, match="three at least"):
        one.refs("test")
    with pytest.raises(DatasetError, match="unknown split"):
        one.refs("all")


def test_a_closed_mesh_that_is_inside_out_is_inverted(tmp_path: Path, cache: Path) -> None:
    write_boxes(tmp_path / "boxes", 1)
    mesh = trimesh.load_mesh(tmp_path / "boxes" / "box0.stl")
    mesh.invert()
    mesh.export(tmp_path / "boxes" / "box0.ply")
    (tmp_path / "boxes" / "box0.stl").unlink()
    model = MeshLibrary(tmp_path / "boxes", cache).load(ModelRef("boxes", "box0.ply"))
    assert trimesh.Trimesh(model.vertices, model.faces).volume > 0


@pytest.mark.skipif(not MESHES.is_dir(), reason=f"the real meshes are missing: {MESHES}")
def test_real_meshes(cache: Path) -> None:
    library = MeshLibrary(MESHES, cache)
    assert not library.broken
    assert sum(len(library.refs(split)) for split in ("train", "val", "test")) == 14
    flashlight = library.load(ModelRef("meshes", "flashlight.stl"))
    (axis,) = flashlight.symmetry
    assert axis.order == 0
    assert abs(axis.axis[2]) > 0.999
    assert np.ptp(flashlight.vertices, axis=0).max() == pytest.approx(0.139, abs=0.001)
    assert len(read_mesh(MESHES / "bowl.stl").faces) == 5000
