"""Scenes: drawn from one generator, within the paper's ranges, without overlaps at the start."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from objectflow.errors import DatasetError
from objectflow.geometry.pinhole import project
from objectflow.geometry.se3 import inverse
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.procedural import ProceduralLibrary
from objectflow.synth.scenes.appearance import draw_lights
from objectflow.synth.scenes.initial_layout import CLEARANCE, Box, overlapping_lifts, place_boxes
from objectflow.synth.scenes.paper_scene import SceneSettings, draw_paper_scene
from objectflow.synth.scenes.scene_data import Scene, View
from objectflow.typing import Float64Array

SETTINGS = SceneSettings()


def scene_of(seed: int, settings: SceneSettings = SETTINGS) -> Scene:
    return draw_paper_scene(np.random.default_rng(seed), ProceduralLibrary(), "train", settings)[0]


def test_the_same_seed_gives_the_same_scene() -> None:
    scene = scene_of(3)
    assert scene == scene_of(3)
    assert scene != scene_of(4)


def test_scenes_are_within_the_paper_s_ranges() -> None:
    library = ProceduralLibrary()
    counts, lights = set[int](), set[int]()
    for seed in range(12):
        scene, models = draw_paper_scene(np.random.default_rng(seed), library, "val", SETTINGS)
        counts.add(len(scene.objects))
        lights.add(len(scene.lights))
        assert 1 <= len(scene.objects) <= 30
        for item, model in zip(scene.objects, models, strict=True):
            assert (item.category, item.name) == (model.category, model.name)
            longest = float(np.ptp(model.vertices, axis=0).max()) * item.scale
            assert 0.07 - 1e-9 <= longest <= 0.3 + 1e-9
            placed = model.vertices * item.scale @ item.world_T_object[:3, :3].T + item.position
            assert placed[:, 2].min() >= 0.2
            assert np.linalg.norm(item.quaternion) == pytest.approx(1)
        for view in scene.views:
            assert 0.2 <= view.distance <= 0.8
            assert 20 <= math.degrees(view.elevation) <= 90
            assert abs(math.degrees(view.roll)) <= 1
            assert np.linalg.norm(view.world_T_camera[:3, 3]) == pytest.approx(view.distance, abs=0.07)
        assert (scene.intrinsics.fx, scene.intrinsics.cx, scene.intrinsics.cy) == (236.46, 159.5, 119.5)
    assert len(counts) > 5
    assert lights == {1, 2, 3, 4}


def test_most_light_is_ambient_and_lamps_differ() -> None:
    ambient, direct, tints = [], [], set[tuple[float, ...]]()
    for seed in range(200):
        lights = draw_lights(np.random.default_rng(seed), (1, 4))
        ambient.append(sum(light.ambient[1] for light in lights))
        direct.append(sum(light.diffuse[1] for light in lights))
        tints |= {light.diffuse for light in lights}
        # A white surface that faces all lamps is neither dark nor strongly overexposed.
        assert 0.6 < ambient[-1] + direct[-1] < 1.4
    assert np.mean(np.array(ambient) > np.array(direct)) > 0.9
    assert max(direct) / min(direct) > 2
    assert len(tints) > 200


def test_a_view_looks_at_its_target_with_the_image_level() -> None:
    camera = scene_of(0).intrinsics
    for azimuth, elevation in ((0.3, 0.4), (4.0, 1.2), (1.0, math.pi / 2)):
        view = View((0.02, -0.01, 0.03), 0.5, azimuth, elevation, 0.0)
        camera_T_world = inverse(view.world_T_camera)

        def pixel(point: ArrayLike, camera_T_world: Float64Array = camera_T_world) -> Float64Array:
            return project(camera_T_world[:3, :3] @ np.asarray(point) + camera_T_world[:3, 3], camera)

        assert np.linalg.det(view.world_T_camera[:3, :3]) == pytest.approx(1)
        assert pixel(view.target).tolist() == pytest.approx([camera.cx, camera.cy])
        # A point to the right of the camera is to the right in the image at the same height; a higher point is higher.
        right = np.add(view.target, (-0.1 * math.sin(azimuth), 0.1 * math.cos(azimuth), 0))
        assert pixel(right).tolist() == pytest.approx([camera.cx + 236.46 * 0.1 / 0.5, camera.cy])
        if elevation < 1.5:
            assert pixel(np.add(view.target, (0, 0, 0.1)))[1] < camera.cy
    rolled = View((0, 0, 0), 0.5, 0.0, 0.5, 0.01).world_T_camera
    assert math.asin(rolled[2, 0]) == pytest.approx(-0.01 * math.cos(0.5), abs=1e-6)


def box(rng: np.random.Generator, spread: float) -> Box:
    axes = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return Box(rng.uniform(-spread, spread, 3), axes, rng.uniform(0.01, 0.15, 3))


def overlap(a: Box, b: Box) -> bool:
    """Whether two boxes share a point, by a linear programme: |axes' (x - center)| <= half for both."""
    rows = np.concatenate([s * each.axes.T for each in (a, b) for s in (1, -1)])
    limits = np.concatenate([s * each.axes.T @ each.center + each.half for each in (a, b) for s in (1, -1)])
    return bool(linprog(np.zeros(3), A_ub=rows, b_ub=limits, bounds=(None, None)).status == 0)


@given(st.integers(0, 2**32 - 1))
def test_boxes_overlap_at_the_lifts_that_a_linear_programme_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = box(rng, 0.1), box(rng, 0.1)
    low, high = (float(value[0]) for value in overlapping_lifts(a, b.center[None], b.axes[None], b.half[None]))

    def lifted(lift: float) -> Box:
        return Box(np.add(a.center, (0, 0, lift)), a.axes, a.half)

    if math.isinf(low):
        assert not any(overlap(lifted(lift), b) for lift in np.linspace(-0.6, 0.6, 13))
        return
    assert not overlap(lifted(low - 2e-5), b)
    assert not overlap(lifted(high + 2e-5), b)
    if high - low > 1e-4:
        assert overlap(lifted(low + 2e-5), b)
        assert overlap(lifted(high - 2e-5), b)


def test_boxes_are_placed_close_together_without_overlaps() -> None:
    rng = np.random.default_rng(0)
    axes = Rotation.from_quat(rng.normal(size=(12, 4))).as_matrix()
    half = rng.uniform(0.01, 0.1, (12, 3))
    centers = place_boxes(rng, axes, half, 0.2, 0.15, 4)
    boxes = [Box(*each) for each in zip(centers, axes, half, strict=True)]
    assert not any(overlap(a, b) for i, a in enumerate(boxes) for b in boxes[:i])
    lowest = [float(each.center[2] - each.center_height) for each in boxes]
    assert 0.2 <= min(lowest) <= 0.2 + CLEARANCE
    # Each is as low as possible: lowered slightly, with its clearance, it overlaps another or the minimum height.
    wide = [Box(each.center, each.axes, each.half + CLEARANCE / 2) for each in boxes]
    for i, each in enumerate(wide):
        lowered = Box(np.subtract(each.center, (0, 0, 1e-4)), each.axes, each.half)
        at_the_bottom = each.center[2] - each.center_height < 0.2001
        assert at_the_bottom or any(overlap(lowered, other) for other in wide[:i])


def test_other_cameras() -> None:
    settings = SceneSettings(
        width=640, height=480, focal=(280, 320), principal_shift=5, distance=(1, 1.5), elevation=(30, 40), views=2
    )
    cameras = [scene_of(seed, settings).intrinsics for seed in range(5)]
    assert all(camera.width == 640 and 560 <= camera.fx <= 640 for camera in cameras)
    assert len({camera.fx for camera in cameras}) == 5
    assert max(abs(camera.cx - 319.5) for camera in cameras) > 1
    assert len(scene_of(0, settings).views) == 2


def test_floors_from_images(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "floor.png"), np.full((8, 8, 3), 99, dtype=np.uint8))
    settings = SceneSettings(objects=(1, 1), images=tmp_path, image_share=0.5)
    kinds = [scene_of(seed, settings).floor.texture.kind for seed in range(20)]
    assert 4 <= kinds.count("image") <= 16
    with pytest.raises(DatasetError, match="no images in"):
        scene_of(0, SceneSettings(images=tmp_path / "none"))


class BrokenLibrary:
    """The first half of the models is broken."""

    broken: Mapping[str, str] = {}

    def __init__(self) -> None:
        self.inner = ProceduralLibrary()

    def refs(self, split: str) -> Sequence[ModelRef]:
        return self.inner.refs(split)[:10]

    def load(self, ref: ModelRef) -> ObjectModel:
        if ref in self.refs("train")[:5]:
            raise DatasetError(f"{ref.name} is broken")
        return self.inner.load(ref)


def test_broken_models_are_replaced_and_named() -> None:
    named: list[str] = []
    settings = SceneSettings(objects=(12, 12))
    scene, _ = draw_paper_scene(np.random.default_rng(0), BrokenLibrary(), "train", settings, named.append)
    assert len(scene.objects) == 12
    assert named
    assert all(line.endswith("is broken") for line in named)
    with pytest.raises(DatasetError, match="is broken"):
        draw_paper_scene(np.random.default_rng(0), BrokenLibrary(), "train", settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (replace(SETTINGS, objects=(5, 2)), "objects must be a range"),
        (replace(SETTINGS, distance=(0.0, 1.0)), "distance must be a range"),
        (replace(SETTINGS, elevation=(20.0, 120.0)), "within 0 and 90"),
        (replace(SETTINGS, lights=(1, 5)), "at most 4 lights"),
    ],
)
def test_invalid_settings_are_refused(settings: SceneSettings, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        scene_of(0, settings)


def test_an_unknown_split_is_refused() -> None:
    with pytest.raises(DatasetError, match="unknown split"):
        draw_paper_scene(np.random.default_rng(0), ProceduralLibrary(), "dev", SETTINGS)
