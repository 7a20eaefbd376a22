"""The renderer against Embree, against analytic images, and with invalid input."""

from __future__ import annotations

import gc
import importlib.metadata
import sys
import weakref

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.cube_scenes import (
    AMBIENT,
    CUBE,
    CUBE_FACES,
    DIFFUSE,
    GREY,
    HEIGHT,
    WIDTH,
    add_object,
    cube_scene,
    empty_scene,
    look_at,
    poses,
)
from objectflow.errors import DatasetError, MissingExtraError, ObjectflowError
from objectflow.synth.objects.procedural import ProceduralLibrary
from objectflow.synth.rendering.camera_rays import camera_of, pixel_rays
from objectflow.synth.rendering.renderer import Renderer

mujoco = pytest.importorskip("mujoco", reason="rendering needs the extra [synth]")
pytest.importorskip("mujoco_warp", reason="rendering needs the extra [synth]")


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(WIDTH, HEIGHT)


def test_labels_and_depth_equal_embree(renderer: Renderer) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex", reason="the comparison needs embreex")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    library = ProceduralLibrary()
    refs = library.refs("test")
    models = [library.load(refs[index]) for index in range(0, len(refs), len(refs) // 9)]
    spec = empty_scene()
    for number, model in enumerate(models, 1):
        add_object(spec, number, model.vertices, model.faces, model.uv, GREY)
    compiled = spec.compile()
    rng = np.random.default_rng(4)
    world_T_objects = np.tile(np.eye(4), (2, len(models), 1, 1))
    turns = Rotation.random(2 * len(models), random_state=rng).as_matrix()
    world_T_objects[..., :3, :3] = turns.reshape(2, -1, 3, 3)
    world_T_objects[..., :3, 3] = rng.uniform((-0.2, -0.2, 0.05), (0.2, 0.2, 0.2), (2, len(models), 3))
    cameras = np.stack([look_at((0, -0.5, 0.5), (0, 0, 0.05)), look_at((0.4, 0.3, 0.7), (0, 0, 0))])
    frames = renderer.render(compiled, world_T_objects, cameras)

    # The intrinsics of the camera of `empty_scene`.
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    cx, cy = (WIDTH - 1) / 2 - 3, (HEIGHT - 1) / 2 + 2
    rays = np.stack([(column - cx) / 71, (row - cy) / 70, np.ones(column.shape)], axis=-1).reshape(-1, 3)
    seen = set[int]()
    for frame, camera in np.ndindex(2, 2):
        corners = [m.vertices @ p[:3, :3].T + p[:3, 3] for m, p in zip(models, world_T_objects[frame], strict=True)]
        starts = np.cumsum([0, *(len(c) for c in corners)])
        faces = np.concatenate([m.faces + start for m, start in zip(models, starts, strict=False)])
        owner = np.repeat(np.arange(1, len(models) + 1), [len(m.faces) for m in models])
        embree = RayMeshIntersector(trimesh.Trimesh(np.concatenate(corners), faces, process=False))
        pose = cameras[camera]
        directions = rays @ pose[:3, :3].T
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        hit, ray, place = embree.intersects_id(origins, directions, multiple_hits=False, return_locations=True)
        with np.errstate(divide="ignore"):
            depth = np.where(directions[:, 2] < 0, -pose[2, 3] / directions[:, 2], np.inf)
        labels = np.zeros(len(rays), dtype=np.int64)
        z = (place - pose[:3, 3]) @ pose[:3, 2]
        nearer = z < depth[ray]
        depth[ray[nearer]], labels[ray[nearer]] = z[nearer], owner[hit[nearer]]
        depth[np.isinf(depth)] = 0
        found = frames.labels[frame, camera].ravel()
        np.testing.assert_allclose(frames.depth[frame, camera].ravel(), depth, atol=1e-5)
        # Where objects intersect, a ray may hit two surfaces at the same depth.
        assert (found != labels).sum() <= 1
        seen |= set(found.tolist())
    assert seen == set(range(len(models) + 1))


def test_rays_are_those_of_the_model_s_camera() -> None:
    """Compared with the rays of mujoco-warp for the same camera."""
    import mujoco_warp
    import warp

    model = cube_scene(0.05)
    with warp.ScopedDevice("cpu"):
        theirs = mujoco_warp.create_render_context(model, cam_res=(2 * WIDTH, 2 * HEIGHT)).ray.numpy()
    np.testing.assert_allclose(pixel_rays(model, 2 * WIDTH, 2 * HEIGHT, 1), theirs, atol=1e-6)


def test_a_camera_given_by_its_field_of_view_alone() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='camera' fovy='90'/></worldbody></mujoco>")
    camera = camera_of(model, 320, 240)
    assert (camera.fx, camera.fy) == pytest.approx((120, 120))
    assert (camera.cx, camera.cy) == (159.5, 119.5)


def test_light_shadow_and_depth_of_a_cube_from_above(renderer: Renderer) -> None:
    """With a distant light above, the floor has ambient and diffuse light, and only ambient light below a cube."""
    model = cube_scene(0.05, light=(0, 0, 1000))
    side = look_at((0, -0.9, 0.25), (0, 0, 0.05))
    frames = renderer.render(model, poses((0, 0, 0.2)), np.stack([look_at((0, 0, 1), (0, 0, 0)), side]))
    color, depth, labels = frames.color[0, 0], frames.depth[0, 0], frames.labels[0, 0]
    assert frames.color.shape == (1, 2, HEIGHT, WIDTH, 3)
    # From above: the top of the cube is at z = 0.25, the floor at 0.
    np.testing.assert_allclose(depth[labels == 1], 0.75, atol=1e-6)
    np.testing.assert_allclose(depth[labels == 0], 1.0, atol=1e-6)
    width = (labels == 1).any(axis=0).sum()
    assert abs(width - 0.1 / 0.75 * 71) <= 1
    assert abs(color[labels == 0].astype(float) - 255 * (AMBIENT + DIFFUSE)).max() < 2
    assert abs(color[labels == 1].astype(float) - 128 * (AMBIENT + DIFFUSE)).max() < 2
    # From the side: the floor below the cube is in shadow.
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    camera = camera_of(model, WIDTH, HEIGHT)
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(row.shape)], axis=-1)
    points = (rays * frames.depth[0, 1][..., None]) @ side[:3, :3].T + side[:3, 3]
    floor = (frames.labels[0, 1] == 0) & (frames.depth[0, 1] > 0)
    below = floor & (np.abs(points[..., :2]).max(axis=-1) < 0.049)
    beside = floor & (np.abs(points[..., :2]).max(axis=-1) > 0.051) & (points[..., 1] < 1)
    assert below.sum() > 10
    assert abs(frames.color[0, 1][below].astype(float) - 255 * AMBIENT).max() < 2
    assert frames.color[0, 1][beside].min() > 255 * AMBIENT + 20


def test_textures_have_mujoco_s_orientation(renderer: Renderer) -> None:
    """On a square that faces the camera, v runs downwards from the first row of the texture."""
    texture = np.zeros((64, 64, 3), dtype=np.uint8)
    texture[:32, :32], texture[:32, 32:] = (255, 0, 0), (0, 255, 0)
    texture[32:, :32], texture[32:, 32:] = (0, 0, 255), (255, 255, 255)
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, 0, -1)]) * 0.1
    uv = np.array([(0, 1), (1, 1), (1, 0), (0, 0), (0, 0)])
    faces = np.array([(0, 1, 2), (0, 2, 3), (1, 0, 4), (2, 1, 4), (3, 2, 4), (0, 3, 4)])
    spec = empty_scene(light=(0, 0, 1000))
    add_object(spec, 1, corners, faces, uv, texture)
    camera = look_at((0, 0, 0.6), (0, 0, 0))
    color = renderer.render(spec.compile(), poses((0, 0, 0.2)), camera[None]).color[0, 0] > 100
    # The camera looks down with y up in the image: a point (x, y) projects to (cx + 71 x / 0.4, cy - 70 y / 0.4).
    cx, cy = (WIDTH - 1) / 2 - 3, (HEIGHT - 1) / 2 + 2
    found = {
        (x, y): tuple(color[round(cy - 70 * y * 0.05 / 0.4), round(cx + 71 * x * 0.05 / 0.4)].tolist())
        for x in (-1, 1)
        for y in (-1, 1)
    }
    assert found == {
        (-1, 1): (True, False, False),
        (1, 1): (False, True, False),
        (-1, -1): (False, False, True),
        (1, -1): (True, True, True),
    }


def test_four_samples_smooth_colour_and_change_nothing_else(renderer: Renderer) -> None:
    model = cube_scene(0.06)
    arguments = (model, poses((0.02, 0.01, 0.06)), look_at((0.3, -0.5, 0.4), (0, 0, 0))[None])
    one, four = renderer.render(*arguments), Renderer(WIDTH, HEIGHT, samples=4).render(*arguments)
    np.testing.assert_array_equal(one.depth, four.depth)
    np.testing.assert_array_equal(one.labels, four.labels)
    # Four samples must be closer than one to an image that is rendered at 8 times the size and averaged.
    fine = Renderer(8 * WIDTH, 8 * HEIGHT).render(*arguments).color[0, 0].astype(float)
    mean = fine.reshape(HEIGHT, 8, WIDTH, 8, 3).mean(axis=(1, 3))
    error = [float(np.square(frames.color[0, 0] - mean).mean()) for frames in (one, four)]
    assert error[1] < 0.35 * error[0]


def test_a_batch_of_frames_and_cameras_equals_single_images(renderer: Renderer) -> None:
    model = cube_scene(0.05)
    world_T_objects = np.concatenate([poses((0, 0, 0.05)), poses((0.1, 0.05, 0.1)), poses((-0.1, 0, 0.05))])
    cameras = np.stack([look_at((0, -0.5, 0.5), (0, 0, 0)), look_at((0.6, 0, 0.3), (0, 0, 0))])
    together = renderer.render(model, world_T_objects, cameras)
    for frame, camera in np.ndindex(3, 2):
        alone = renderer.render(model, world_T_objects[frame : frame + 1], cameras[camera : camera + 1])
        np.testing.assert_array_equal(together.color[frame, camera], alone.color[0, 0])
        np.testing.assert_array_equal(together.depth[frame, camera], alone.depth[0, 0])
        np.testing.assert_array_equal(together.labels[frame, camera], alone.labels[0, 0])


def test_nothing_is_compiled_from_the_second_scene_on(renderer: Renderer, capfd: pytest.CaptureFixture[str]) -> None:
    """At log level DEBUG, Warp prints when it loads a module. The scenes differ in size, objects and lights."""
    import warp

    camera = look_at((0, -0.5, 0.5), (0, 0, 0))[None]
    renderer.render(cube_scene(0.05), poses((0, 0, 0.05)), camera)
    kernels = dict(renderer.kernels)
    renderer.render(cube_scene(0.07), poses((0, 0, 0.07)), camera)
    assert renderer.kernels == kernels
    level, warp.config.log_level = warp.config.log_level, warp.LOG_DEBUG
    try:
        capfd.readouterr()
        for number, size in enumerate((0.02, 0.4, 0.08), 1):
            spec = empty_scene(light=(0.2 * number, 0.1, 2 + number))
            for k in range(1, number + 1):
                add_object(spec, k, CUBE * size, CUBE_FACES, np.zeros((8, 2)), GREY)
            spec.lights[2].active = number == 2
            spec.lights[0].type = mujoco.mjtLightType.mjLIGHT_SPOT
            spec.lights[1].attenuation = [1, 0.1 * number, 0]
            spec.visual.headlight.active = number == 3
            # A renderer without a kernel, so that all values that are compiled in are checked again.
            fresh = Renderer(WIDTH, HEIGHT)
            fresh.render(spec.compile(), poses(*[(0.1 * k, 0, size) for k in range(number)]), camera)
            assert len(fresh.kernels) == 1
        assert "Module" not in capfd.readouterr().out
        # A new module is reported.
        other = mujoco.MjModel.from_xml_string(
            "<mujoco><worldbody><camera name='camera'/><light pos='0 0 2'/>"
            "<geom type='sphere' size='.1'/></worldbody></mujoco>"
        )
        renderer.render(other, np.empty((1, 0, 4, 4)), camera)
        assert "Module" in capfd.readouterr().out
    finally:
        warp.config.log_level = level


def test_a_model_is_freed_once_it_is_rendered(renderer: Renderer) -> None:
    """Without a full garbage collection, which runs too late: Python does not count the memory of a model."""
    model = cube_scene(0.05)
    watch = weakref.ref(model)
    gc.disable()
    try:
        renderer.render(model, poses((0, 0, 0.05)), look_at((0, -0.5, 0.5), (0, 0, 0))[None])
        del model
        assert watch() is None
    finally:
        gc.enable()


def test_no_versions_are_looked_up_from_the_second_scene_on(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """mujoco-warp looks up MuJoCo's version repeatedly, and each lookup reads a file."""
    looked_up: list[str] = []
    version = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: (looked_up.append(name), version(name))[1])
    camera = look_at((0, -0.5, 0.5), (0, 0, 0))[None]
    renderer.render(cube_scene(0.05), poses((0, 0, 0.05)), camera)
    looked_up.clear()
    renderer.render(cube_scene(0.07), poses((0, 0, 0.07)), camera)
    assert looked_up == []


def test_invalid_input_is_refused(renderer: Renderer) -> None:
    model = cube_scene(0.05)
    camera = look_at((0, -0.5, 0.5), (0, 0, 0))[None]
    with pytest.raises(DatasetError, match=r"it needs \(1, 1, 4, 4\)"):
        renderer.render(model, poses((0, 0, 0), (1, 0, 0)), camera)
    with pytest.raises(ObjectflowError, match="1 or 4"):
        Renderer(8, 8, samples=2)
    with pytest.raises(ObjectflowError, match="choose cpu or cuda"):
        Renderer(8, 8, device="tpu")  # type: ignore[arg-type]


def test_cuda_is_refused_on_a_machine_without_it() -> None:
    import warp

    if warp.is_cuda_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(ObjectflowError, match="no CUDA device") as raised:
        Renderer(8, 8, device="cuda")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("missing", ["warp", "mujoco_warp"])
def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r'pip install ".+\[synth\]"'):
        Renderer(8, 8)
