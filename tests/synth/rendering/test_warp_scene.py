"""The renderer reads the same arrays as mujoco-warp, and the bounding boxes fit the meshes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow.synth.rendering.placement import Placement, object_numbers
from objectflow.synth.rendering.warp_scene import MARGIN, WarpModel, tighten_bounds
from objectflow.synth.rendering.warp_setup import import_tracer
from objectflow.typing import Float32Array

mujoco = pytest.importorskip("mujoco", reason="this needs the extra [synth]")
pytest.importorskip("mujoco_warp", reason="this needs the extra [synth]")

HALF = (0.03, 0.02, 0.01)


def make_model() -> Any:
    """A floor, a flat box whose corner is its origin (object 1), and a ball (object 2)."""
    corners = " ".join(
        f"{2 * HALF[0] * x} {2 * HALF[1] * y} {2 * HALF[2] * z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)
    )
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <asset><mesh name="slab" vertex="{corners}"/><material name="dull" specular="0.1" rgba="0.2 0.4 0.6 1"/></asset>
      <worldbody>
        <light pos="1 0 2" diffuse="0.3 0.2 0.1"/>
        <light pos="0 1 2" active="false" castshadow="false"/>
        <camera name="camera" fovy="50"/>
        <geom type="plane" size="2 2 0.1"/>
        <body name="obj_1"><freejoint/><geom type="mesh" mesh="slab" material="dull"/></body>
        <body name="obj_2"><freejoint/><geom type="sphere" size="0.05"/></body>
      </worldbody>
    </mujoco>""")


READ = [
    "geom_type", "geom_size", "geom_matid", "geom_rgba", "light_active",
    "light_diffuse", "mat_specular", "mat_texid", "mesh_normal", "mesh_faceadr",
    "cam_intrinsic", "flex_edge", "nlight",
]  # fmt: skip
NOT_READ_YET = "dof_tri_row"
"""An attribute that `mujoco.MjModel` does not have."""


@pytest.mark.parametrize("name", [*READ, NOT_READ_YET])
def test_a_model_has_the_values_of_put_model(name: str) -> None:
    warp, tracer = import_tracer()
    model = make_model()
    expected, found = getattr(tracer.put_model(model), name), getattr(WarpModel(tracer, warp, model), name)
    if isinstance(expected, int):
        assert found == expected
        return
    assert found.dtype == expected.dtype
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found.numpy(), expected.numpy())


def test_bounding_boxes_fit_the_meshes_in_every_world_and_others_stay() -> None:
    warp, _ = import_tracer()
    model = make_model()
    # Frame 0 has the initial poses; in frame 1 object 1 is raised by a metre and rotated by 45 degrees about z.
    raised = np.eye(4)
    raised[:3, :3], raised[2, 3] = Rotation.from_euler("z", 45, degrees=True).as_matrix(), 1.0
    poses = np.stack([np.stack([pose, np.eye(4)]) for pose in (np.eye(4), raised)])
    placement = Placement.of(model, object_numbers(model), poses, np.eye(4)[None])
    before = np.arange(18, dtype=np.float32).reshape(6, 3)
    refitted: list[bool] = []
    context = SimpleNamespace(
        enabled_geom_ids=warp.array([0, 1, 2], dtype=int),
        lower=warp.array(before, dtype=warp.vec3),
        upper=warp.array(before, dtype=warp.vec3),
        bvh=SimpleNamespace(refit=lambda: refitted.append(True)),
    )
    tighten_bounds(model, placement, context)
    lower, upper = context.lower.numpy().reshape(2, 3, 3), context.upper.numpy().reshape(2, 3, 3)
    assert_box(lower[0, 1], upper[0, 1], (0, 0, 0), (2 * HALF[0], 2 * HALF[1], 2 * HALF[2]))
    a, b = 2 * HALF[0] / math.sqrt(2), 2 * HALF[1] / math.sqrt(2)
    assert_box(lower[1, 1], upper[1, 1], (-b, 0, 1), (a, a + b, 1 + 2 * HALF[2]))
    for bounds in (lower, upper):
        np.testing.assert_array_equal(bounds[:, [0, 2]], before.reshape(2, 3, 3)[:, [0, 2]])
    assert refitted


def assert_box(lower: Float32Array, upper: Float32Array, low: Any, high: Any) -> None:
    np.testing.assert_allclose(lower, np.array(low) - MARGIN, atol=1e-6)
    np.testing.assert_allclose(upper, np.array(high) + MARGIN, atol=1e-6)
