"""The MuJoCo model of a scene: masses, groups, surfaces, lights, camera, and the mesh of a slab."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import trimesh

from helpers.object_models import CORNERS, DENSITY, box_model, place, scene_of
from objectflow.errors import DatasetError
from objectflow.synth.physics.mjcf import box_mesh, build_model
from objectflow.synth.rendering.camera_rays import camera_of
from objectflow.typing import Float64Array

mujoco = pytest.importorskip("mujoco", reason="physics needs the extra [synth]")


def test_box_meshes_are_closed_and_face_outwards() -> None:
    vertices, faces, uv = box_mesh((0.3, 0.2, 0.1))
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    assert mesh.is_watertight
    assert math.isclose(mesh.volume, 8 * 0.3 * 0.2 * 0.1)
    # Textures are not stretched: lengths on the surface are lengths in the texture.
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    ua, ub, uc = (np.c_[uv, np.zeros(len(uv))][faces[:, k]] for k in range(3))
    np.testing.assert_allclose(np.linalg.norm(b - a, axis=1), np.linalg.norm(ub - ua, axis=1))
    np.testing.assert_allclose(np.linalg.norm(c - a, axis=1), np.linalg.norm(uc - ua, axis=1))


def test_the_model_of_a_scene() -> None:
    model = box_model(0.05, 0.03, 0.02)
    scene = scene_of(place(model, (0, 0, 0.2), scale=2), place(model, (0.3, 0, 0.2)))
    whole = build_model(scene, [model, model])
    solid, visible = (build_model(scene, [model, model], **{name: False}) for name in ("visible", "solid"))
    volume = 0.1 * 0.06 * 0.04
    for compiled in (whole, solid):
        assert compiled.body("obj_1").mass[0] == pytest.approx(8 * volume * DENSITY, rel=1e-5)
        assert compiled.body("obj_2").mass[0] == pytest.approx(volume * DENSITY, rel=1e-5)
    assert groups(whole) == {0: 3, 3: 2}
    assert groups(solid) == {0: 1, 3: 2}
    assert groups(visible) == {0: 3}
    # The surface moves with the object frame.
    data = mujoco.MjData(visible)
    mujoco.mj_forward(visible, data)
    corners = visible.mesh_vert[visible.mesh("surface_1").vertadr[0] :][: len(model.vertices)]
    geom = visible.geom_bodyid.tolist().index(visible.body("obj_1").id)
    world = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    np.testing.assert_allclose(sorted(world.tolist()), sorted((2 * model.vertices + (0, 0, 0.2)).tolist()), atol=1e-6)
    assert visible.nlight == 4
    assert visible.light_active.tolist() == [1, 0, 0, 0]
    camera = camera_of(visible, 320, 240)
    assert dataclasses.astuple(camera) == pytest.approx(dataclasses.astuple(scene.intrinsics), abs=1e-4)


@pytest.mark.parametrize("part", [CORNERS * (0.05, 0.03, 0), CORNERS[:2], CORNERS * np.nan])
def test_a_part_that_is_not_a_solid_is_named(part: Float64Array) -> None:
    good = box_model(0.05, 0.03, 0.02)
    bad = dataclasses.replace(good, name="chairs/flat.obj", parts=(*good.parts, part))
    scene = scene_of(place(good, (0, 0, 0.2)), place(bad, (0.3, 0, 0.2)))
    with pytest.raises(DatasetError, match=r"cannot build the model chairs/flat\.obj: ") as raised:
        build_model(scene, [good, bad])
    assert "\n" not in str(raised.value)


def groups(model: Any) -> dict[int, int]:
    values, counts = np.unique(model.geom_group, return_counts=True)
    return dict(zip(values.tolist(), counts.tolist(), strict=True))
