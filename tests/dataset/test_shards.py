"""Rows, shards and the manifest: round trips, reproducible bytes, and clear errors for damaged files."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from objectflow import geometry
from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Manifest, Part, Shard
from objectflow.dataset.schema import DEPTH_SCALE, FrameObject, PairObject, PairRow, SequenceRow
from objectflow.dataset.shards import open_pairs, open_sequences, read_metadata, write_shard
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.storage import files

CAMERA = Camera(width=16, height=12, fx=11.8, fy=11.8, cx=7.5, cy=5.5)


def make_frame(rng: np.random.Generator) -> tuple[RgbdFrame, np.ndarray]:
    color = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    depth = rng.uniform(0.3, 1.5, (12, 16)).astype(np.float32)
    depth[0, 0] = 0
    labels = rng.integers(0, 3, (12, 16)).astype(np.int32)
    return RgbdFrame(color=color, depth=depth, camera=CAMERA), labels


def make_pair(number: int) -> PairRow:
    rng = np.random.default_rng(number)
    (prev, prev_labels), (curr, curr_labels) = make_frame(rng), make_frame(rng)
    objects = []
    for label in (1, 2):
        prev_pose, curr_pose = geometry.se3_exp(rng.normal(size=(2, 6)))
        motion = prev_pose @ geometry.inverse(curr_pose)
        vector = geometry.so3_log(motion[:3, :3])
        objects.append(
            PairObject(
                label=label,
                category="mug",
                model=f"mug-{number:05d}",
                center=curr_pose[:3, 3],
                translation=prev_pose[:3, 3] - curr_pose[:3, 3],
                rotation_vector=vector,
                raw_rotation_vector=vector,
                symmetry=(SymmetryAxis((0.0, 0.0, 1.0), 0),) if label == 1 else (),
                prev_pose=prev_pose,
                curr_pose=curr_pose,
                in_both=label == 1,
            )
        )
    key = f"train-{number:06d}"
    return PairRow(key, key, prev, prev_labels, curr, curr_labels, tuple(objects))


def write_set(folder: Path, counts: tuple[int, ...] = (10, 7)) -> Manifest:
    folder.mkdir(exist_ok=True)
    shards, number = [], 0
    for i, count in enumerate(counts):
        path = folder / manifests.shard_name("train", i, len(counts))
        write_shard(path, [make_pair(number + j).to_dict() for j in range(count)], "pairs", {"shard": i})
        shards.append(Shard(path.name, count, path.stat().st_size, files.hash_file(path)))
        number += count
    part = Part("pairs", "train", number, number, 1, {}, tuple(shards))
    manifest = Manifest(seed=3, settings={"preset": "test"}, parts={"train": part}, objectflow="0")
    manifest.write(folder)
    return manifest


def test_pairs_survive_a_round_trip(tmp_path: Path) -> None:
    write_set(tmp_path)
    rows = open_pairs(tmp_path, "train")
    assert len(rows) == 17
    for index in (0, 9, 10, 16, 3, -1):
        row, expected = rows[index], make_pair(index % 17)
        assert row.key == expected.key
        assert row.curr.camera == CAMERA
        np.testing.assert_array_equal(row.prev.color, expected.prev.color)
        np.testing.assert_array_equal(row.curr_labels, expected.curr_labels)
        np.testing.assert_allclose(row.curr.depth, expected.curr.depth, atol=0.51 / DEPTH_SCALE)
        assert row.curr.depth[0, 0] == 0
        for got, want in zip(row.objects, expected.objects, strict=True):
            assert (got.label, got.model, got.symmetry, got.in_both) == (
                want.label,
                want.model,
                want.symmetry,
                want.in_both,
            )
            np.testing.assert_array_equal(got.prev_pose, want.prev_pose)
            np.testing.assert_array_equal(got.translation, want.translation)


def test_object_motion_is_equation_1() -> None:
    obj = make_pair(0).objects[0]
    point_in_object = np.array([0.1, -0.2, 0.3])
    curr, prev = (geometry.transform(pose, point_in_object) for pose in (obj.curr_pose, obj.prev_pose))
    R = geometry.so3_exp(obj.rotation_vector)
    np.testing.assert_allclose(R @ (curr - obj.center) + obj.center + obj.translation, prev, atol=1e-12)
    np.testing.assert_allclose(geometry.transform(obj.prev_T_curr(), curr), prev, atol=1e-12)


@pytest.mark.parametrize("name", ["center", "translation", "rotation_vector"])
def test_motions_beyond_any_scene_are_refused(name: str) -> None:
    obj = make_pair(0).objects[0]
    with pytest.raises(DatasetError, match=f"{name} of object {obj.label} is beyond"):
        dataclasses.replace(obj, **{name: np.array([0.0, -1e39, 0.0])})  # finite, but not in float32


def test_rows_are_found_by_their_keys(tmp_path: Path) -> None:
    write_set(tmp_path)
    rows = open_pairs(tmp_path)
    assert rows.keys() == [f"train-{i:06d}" for i in range(17)]
    assert rows.count_objects() == 2 * 17
    assert rows.find("train-000012") == 12
    with pytest.raises(DatasetError, match="no row 'x'; there are 17: train-000000, "):
        rows.find("x")


def test_rows_can_be_pickled_after_use(tmp_path: Path) -> None:
    write_set(tmp_path)
    rows = open_pairs(tmp_path)
    first = rows[0]
    again = pickle.loads(pickle.dumps(rows))
    np.testing.assert_array_equal(again[0].curr.color, first.curr.color)


def test_an_index_out_of_range_ends_iteration(tmp_path: Path) -> None:
    write_set(tmp_path, counts=(3,))
    rows = open_pairs(tmp_path)
    assert [row.key for row in rows] == rows.keys()
    with pytest.raises(IndexError):
        rows[3]


def test_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_set(tmp_path / name)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["manifest.json", "train-00000-of-00002.parquet", "train-00001-of-00002.parquet"]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_metadata_survives_a_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    write_shard(path, [make_pair(0).to_dict()], "pairs", {"seed": 5})
    assert read_metadata(path) == ({"seed": 5}, 1)


def test_sequences_survive_a_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frame, labels = make_frame(rng)
    pose = geometry.se3_exp(rng.normal(size=6))
    obj = FrameObject(label=1, category="cube", model="c", symmetry=(SymmetryAxis((1.0, 0.0, 0.0), 4),), pose=pose)
    rows = [SequenceRow("test-000000", number, frame, labels, (obj,)) for number in (20, 30)]
    path = tmp_path / manifests.shard_name("test-sequences", 0, 1)
    write_shard(path, [row.to_dict() for row in rows], "sequences", {})
    shard = Shard(path.name, 2, path.stat().st_size, files.hash_file(path))
    Manifest(0, {}, {"test-sequences": Part("sequences", "test", 2, 1, 1, {}, (shard,))}, "0").write(tmp_path)
    read = open_sequences(tmp_path, "test")
    assert read.keys() == ["test-000000/20", "test-000000/30"]
    assert read[1].frame == 30
    np.testing.assert_array_equal(read[1].objects[0].pose, pose)
    assert read[0].objects[0].symmetry == obj.symmetry


def test_manifest_round_trip_and_hash_of_the_set(tmp_path: Path) -> None:
    manifest = write_set(tmp_path)
    read = Manifest.read(tmp_path)
    assert read == manifest
    other = dataclasses.replace(manifest.parts["train"], rows=10, shards=manifest.parts["train"].shards[:1])
    assert dataclasses.replace(manifest, parts={"train": other}).sha256 != read.sha256


def test_verify_finds_one_changed_byte(tmp_path: Path) -> None:
    manifest = write_set(tmp_path)
    assert manifests.verify(tmp_path, manifest) == 2
    path = tmp_path / "train-00001-of-00002.parquet"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"train-00001-of-00002\.parquet: its hash differs from that in"):
        manifests.verify(tmp_path, manifest)


def test_a_folder_that_is_no_data_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        open_pairs(tmp_path / "none")
    with pytest.raises(DatasetError, match=r"no manifest\.json: not a data set"):
        open_pairs(tmp_path)
    write_set(tmp_path)
    with pytest.raises(DatasetError, match="no pairs of split 'val'; there is: train"):
        open_pairs(tmp_path, "val")
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(DatasetError, match="not finished"):
        open_pairs(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values.update(version=99), "version 99, this program reads 1"),
        (lambda values: values.pop("seed"), "not a manifest"),
        (lambda values: values["parts"]["train"].pop("rows"), "not a manifest"),
    ],
)
def test_a_wrong_manifest_is_refused(tmp_path: Path, change: object, message: str) -> None:
    write_set(tmp_path)
    values = json.loads((tmp_path / "manifest.json").read_text())
    change(values)  # type: ignore[operator]
    (tmp_path / "manifest.json").write_text(json.dumps(values))
    with pytest.raises(DatasetError, match=message):
        open_pairs(tmp_path)


def test_missing_short_and_broken_shards_are_named(tmp_path: Path) -> None:
    write_set(tmp_path)
    path = tmp_path / "train-00000-of-00002.parquet"
    data = path.read_bytes()
    path.write_bytes(data[:-10])
    with pytest.raises(DatasetError, match=r"train-00000-of-00002\.parquet: .* bytes, \d+ in manifest\.json"):
        open_pairs(tmp_path)
    path.write_bytes(b"x" * len(data))
    with pytest.raises(DatasetError, match="not a Parquet file that can be read"):
        open_pairs(tmp_path)[0]
    path.unlink()
    with pytest.raises(DatasetError, match=r"missing, though manifest\.json lists it"):
        open_pairs(tmp_path)


def test_a_foreign_parquet_file_is_refused(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"x": [1]}), tmp_path / "x.parquet")
    with pytest.raises(DatasetError, match="objectflow did not write"):
        read_metadata(tmp_path / "x.parquet")


def test_a_set_loads_with_hugging_face_datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = pytest.importorskip("datasets", reason="`datasets` is not installed (pip install objectflow[test])")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    write_set(tmp_path / "set")
    loaded = datasets.load_dataset(
        "parquet",
        data_files={"train": str(tmp_path / "set" / "train-*.parquet")},
        split="train",
        cache_dir=str(tmp_path / "cache"),
    )
    assert loaded.num_rows == 17
    row = loaded[12]
    back, expected = PairRow.from_dict(row), make_pair(12)
    np.testing.assert_array_equal(back.curr.color, expected.curr.color)
    np.testing.assert_array_equal(back.objects[1].curr_pose, expected.objects[1].curr_pose)
