"""Cached predictions: how exact they are, and that nothing broken is taken for one."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from objectflow import geometry
from objectflow.errors import DatasetError, ResultError, StorageError
from objectflow.evaluation.cache import (
    STEP,
    MethodCache,
    encode,
    file_name,
    pack_flow,
    read_prediction,
    unpack_flow,
)
from objectflow.motion import ObjectMotion, SceneMotion


def make_motion(labels: int = 3, *, seed: int = 0, size: float = 0.1, moves: bool = True) -> SceneMotion:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, labels + 1, (12, 16)).astype(np.int32)
    flow = rng.normal(0, size, (12, 16, 3)).astype(np.float32)
    flow[2:4, 3:9] = np.nan
    motions = geometry.se3_exp(rng.normal(size=(labels, 6)))
    objects = tuple(
        ObjectMotion(k, int((image == k).sum()), 0.5, k % 2 == 0, rng.normal(size=3), motions[k - 1])
        for k in range(1, labels + 1)
    )
    camera = geometry.se3_exp(rng.normal(size=6)) if moves else None
    return SceneMotion(image, flow, objects, camera, "a", 0.25)


def through_disk(motion: SceneMotion, folder: Path) -> SceneMotion:
    (folder / "a.npz").write_bytes(encode(motion, key="a", cold=True, machine="m, 2 cores"))
    found = read_prediction(folder / "a.npz")
    assert (found.cold, found.machine, found.motion.seconds) == (True, "m, 2 cores", motion.seconds)
    return found.motion


@pytest.mark.parametrize("labels", [0, 3, 300])
def test_round_trip(labels: int, tmp_path: Path) -> None:
    before = make_motion(labels, moves=labels > 0)
    after = through_disk(before, tmp_path)
    assert np.array_equal(after.labels, before.labels)
    assert np.array_equal(np.isnan(after.scene_flow), np.isnan(before.scene_flow))
    assert np.nanmax(np.abs(after.scene_flow - before.scene_flow)) <= STEP / 2 * 1.001
    assert [obj.to_dict() for obj in after.objects] == [obj.to_dict() for obj in before.objects]
    if before.camera_motion is None:
        assert after.camera_motion is None
    else:
        assert after.camera_motion is not None
        assert np.array_equal(after.camera_motion, before.camera_motion)


def test_zero_stays_zero_and_long_flows_stay_exact(tmp_path: Path) -> None:
    zero = SceneMotion(np.zeros((4, 4), np.int32), np.zeros((4, 4, 3), np.float32))
    assert not through_disk(zero, tmp_path).scene_flow.any()
    wild = make_motion(size=40)
    assert np.array_equal(through_disk(wild, tmp_path).scene_flow, wild.scene_flow, equal_nan=True)


def test_a_pixel_without_a_whole_flow_has_none(tmp_path: Path) -> None:
    flow = np.zeros((2, 3, 3), np.float32)
    flow[0, 1, 2], flow[1, 2, 0] = np.inf, np.nan
    after = through_disk(SceneMotion(np.zeros((2, 3), np.int32), flow), tmp_path).scene_flow
    assert np.isnan(after[0, 1]).all()
    assert np.isnan(after[1, 2]).all()
    assert np.isfinite(after).all(axis=-1).sum() == 4


@given(arrays.arrays(np.float32, (3, 5, 3), elements=st.floats(-5, 5, width=32)))
def test_any_flow_is_rounded_by_half_a_step_at_most(flow: np.ndarray[Any, np.dtype[np.float32]]) -> None:
    # Half a step, and the spacing of float32 numbers of this size.
    assert np.abs(unpack_flow(pack_flow(flow)).astype(np.float64) - flow).max() <= STEP / 2 + 5 * 2.0**-23


def test_no_cut_off_file_is_a_prediction(tmp_path: Path) -> None:
    data = encode(make_motion(), key="a", cold=False, machine="m")
    cache = MethodCache(tmp_path)
    for length in [*range(0, len(data), 97), len(data) - 1]:
        (tmp_path / "a.npz").write_bytes(data[:length])
        with pytest.raises(DatasetError, match=r"a\.npz"):
            read_prediction(tmp_path / "a.npz")
        assert not cache.has("a")
    (tmp_path / "a.npz").write_bytes(data)
    assert cache.has("a")


def test_a_flipped_bit_is_found_or_changes_nothing(tmp_path: Path) -> None:
    data = bytearray(encode(make_motion(), key="a", cold=False, machine="m"))
    path = tmp_path / "a.npz"
    path.write_bytes(data)
    whole = read_prediction(path).motion
    found = 0
    for place in range(40, len(data), 53):
        data[place] ^= 16
        path.write_bytes(data)
        data[place] ^= 16
        try:
            after = read_prediction(path).motion
        except DatasetError:
            found += 1
        else:  # a bit of the archive's bookkeeping that nobody reads
            assert np.array_equal(after.scene_flow, whole.scene_flow, equal_nan=True)
            assert np.array_equal(after.labels, whole.labels)
    assert found > 20


@pytest.mark.parametrize(
    "changes",
    [
        {"flow": None},
        {"labels": np.zeros((5, 5), np.uint8)},
        {"flow": np.zeros((3, 12, 16), np.float64)},
        {"ids": np.arange(9)},
        {"seconds": np.array(["x"])},
    ],
)
def test_archives_of_another_form_are_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(encode(make_motion(), key="a", cold=False, machine="m"))
    with np.load(tmp_path / "a.npz") as file:
        values = {**dict(file), **changes}
    np.savez(tmp_path / "a.npz", **{name: value for name, value in values.items() if value is not None})
    with pytest.raises(DatasetError, match="not a cached prediction"):
        read_prediction(tmp_path / "a.npz")


def test_settings_must_stay(tmp_path: Path) -> None:
    cache = MethodCache(tmp_path / "predictions" / "a")
    settings = {"sha256": "1" * 64, "options": {"rounds": 3}}
    with cache.claim(settings):
        pass
    with cache.claim(settings):
        pass
    message = r'made with options = \{"rounds": 3\}, now it is \{"rounds": 1\}'
    with pytest.raises(ResultError, match=message), cache.claim({**settings, "options": {"rounds": 1}}):
        pass
    with pytest.raises(ResultError, match="predictions of another data set"), cache.claim({**settings, "sha256": "2"}):
        pass
    (cache.folder / "settings.json").write_text("{")
    with pytest.raises(ResultError, match="cannot be read"), cache.claim(settings):
        pass
    (cache.folder / "settings.json").unlink()
    (cache.folder / "other").touch()
    with pytest.raises(ResultError, match="holds no predictions"), cache.claim(settings):
        pass


def test_one_run_at_a_time(tmp_path: Path) -> None:
    cache = MethodCache(tmp_path / "a")
    with cache.claim({}), pytest.raises(ResultError, match="another run is writing there"), cache.claim({}):
        pass


def test_a_folder_that_cannot_be_made_is_the_disks_fault(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot write"), MethodCache(tmp_path / "file" / "a").claim({}):
        pass


def test_failures_are_kept_until_there_is_a_prediction(tmp_path: Path) -> None:
    cache = MethodCache(tmp_path)
    key = "test-000001/80"
    assert file_name(key) == "test-000001%2F80"
    assert cache.failure(key) is None
    cache.write_failure(key, "no luck")
    assert (cache.failure(key), cache.has(key)) == ("no luck", False)
    cache.write(key, encode(make_motion(), key=key, cold=False, machine="m"))
    assert (cache.failure(key), cache.has(key)) == (None, True)
    assert math.isclose(make_motion().seconds, cache.read(key).motion.seconds)  # type: ignore[union-attr]
    cache.write_failure(key, "again")
    assert not cache.has(key)


KEYS = ["a/b", "a_b", "a%2Fb", "..", ".", "", "a\0b", "a\nb", "\ud800", "é" * 300, "é" * 301, "x" * 300, "A", "~"]


def test_every_key_has_a_file_of_its_own(tmp_path: Path) -> None:
    names = [file_name(key) for key in KEYS]
    assert len(set(names)) == len(KEYS)
    assert all(len(name.encode()) < 200 and "/" not in name and name.isprintable() for name in names)
    cache = MethodCache(tmp_path)
    for number, key in enumerate(KEYS):
        motion = dataclasses.replace(make_motion(), seconds=float(number))
        cache.write(key, encode(motion, key=key, cold=False, machine="m"))
    assert [cache.read(key).motion.seconds for key in KEYS] == list(range(len(KEYS)))  # type: ignore[union-attr]


def test_a_file_of_another_key_is_not_read(tmp_path: Path) -> None:
    cache = MethodCache(tmp_path)
    cache.write("a", encode(make_motion(), key="b", cold=False, machine="m"))
    assert cache.read("a") is None


@pytest.mark.parametrize(
    "changes",
    [
        {"motions": np.zeros((1, 4, 4))},
        {"motions": np.full((1, 4, 4), np.nan)},
        {"centers": np.full((1, 3), np.inf)},
        {"pixels": np.array([-1])},
        {"moving": np.array(["false"])},
        {"scores": np.array([np.nan])},
        {"camera_motion": np.diag([1.0, 1.0, -1.0, 1.0])},
        {"seconds": np.float64("nan")},
    ],
)
def test_impossible_values_are_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(encode(make_motion(), key="a", cold=False, machine="m"))
    with np.load(path) as file:
        values = dict(file)
    count = len(values["ids"])
    repeated = {name: np.repeat(value, count, 0) if value.ndim and name != "camera_motion" else value
                for name, value in changes.items()}  # fmt: skip
    np.savez(path, **{**values, **repeated})
    with pytest.raises(DatasetError, match=r"a\.npz: not a cached prediction"):
        read_prediction(path)
