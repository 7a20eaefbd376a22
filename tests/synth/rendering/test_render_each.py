"""Images with cameras and lamps of their own, rendered in one call."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.cube_scenes import (
    AMBIENT,
    DIFFUSE,
    HEIGHT,
    WIDTH,
    cube_scene,
    look_at,
    poses,
)
from objectflow.errors import DatasetError
from objectflow.geometry import back_project
from objectflow.synth.rendering.camera_rays import camera_of
from objectflow.synth.rendering.renderer import Renderer
from objectflow.synth.scenes.scene_data import Light

mujoco = pytest.importorskip("mujoco", reason="rendering needs the extra [synth]")
pytest.importorskip("mujoco_warp", reason="rendering needs the extra [synth]")


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(WIDTH, HEIGHT)


def test_images_with_their_own_cameras_equal_those_rendered_one_by_one(renderer: Renderer) -> None:
    model = cube_scene(0.1)
    places = np.concatenate([poses((0.0, 0.0, 0.1)), poses((0.1, -0.05, 0.2))])
    cameras = np.stack([look_at((0.5, -0.6, 0.5), (0, 0, 0)), look_at((-0.2, 0.7, 0.6), (0, 0, 0.1))])
    lamp = Light((0.3, -0.4, 1.5), (DIFFUSE / 2,) * 3, (0.0, 0.0, 0.0), (AMBIENT / 2,) * 3)
    together = renderer.render_each(model, places, cameras, [(lamp, lamp)] * 2)
    assert together.color.shape == (2, 1, HEIGHT, WIDTH, 3)
    for k in (0, 1):
        alone = renderer.render(model, places[k : k + 1], cameras[k : k + 1])
        np.testing.assert_array_equal(together.color[k], alone.color[0])
        np.testing.assert_array_equal(together.depth[k], alone.depth[0])
        np.testing.assert_array_equal(together.labels[k], alone.labels[0])


def test_each_image_has_its_own_light(renderer: Renderer) -> None:
    model = cube_scene(0.1)
    places = np.repeat(poses((0.0, 0.0, 0.1)), 3, axis=0)
    cameras = np.stack([look_at((0.5, -0.6, 0.5), (0, 0, 0))] * 3)
    dark = Light((0.3, -0.4, 1.5), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.2, 0.1, 0.05))
    left, right = (Light((side, 0.0, 1.5), (0.3, 0.3, 0.3), (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)) for side in (-1.0, 1.0))
    seen = renderer.render_each(model, places, cameras, [(dark, dark), (left, left), (right, right)])
    # The floor is white: without direct light it has the sum of the two lamps' ambient light.
    floor = seen.color[0, 0][seen.labels[0, 0] == 0]
    np.testing.assert_allclose(floor, np.broadcast_to([0.4 * 255, 0.2 * 255, 0.1 * 255], floor.shape), atol=1)
    np.testing.assert_array_equal(seen.depth[1], seen.depth[2])
    # A shadow falls away from its lamp: the lamp at -x casts it towards +x.
    points = back_project(seen.depth[1, 0], camera_of(model, WIDTH, HEIGHT))
    x = (points @ cameras[0, :3, :3].T + cameras[0, :3, 3])[..., 0]
    shadows = (seen.color[1:, 0].mean(-1) < 80) & (seen.labels[1:, 0] == 0)
    assert shadows.sum(axis=(1, 2)).min() > 30
    assert x[shadows[0]].mean() > 0.1
    assert x[shadows[1]].mean() < -0.1


def test_poses_and_lamps_must_fit_the_images(renderer: Renderer) -> None:
    model, cameras = cube_scene(0.1), np.stack([look_at((0.5, -0.6, 0.5), (0, 0, 0))] * 2)
    lamp = Light((0.3, -0.4, 1.5), (0.2, 0.2, 0.2), (0.0, 0.0, 0.0), (0.2, 0.2, 0.2))
    with pytest.raises(DatasetError, match=r"and \[2, 1\] lamps do not fit the scene: it needs .* and 2 lamps"):
        renderer.render_each(model, np.repeat(poses((0, 0, 0)), 2, axis=0), cameras, [(lamp, lamp), (lamp,)])
    with pytest.raises(DatasetError, match="do not fit the scene"):
        renderer.render_each(model, poses((0, 0, 0)), cameras, [(lamp, lamp)] * 2)
