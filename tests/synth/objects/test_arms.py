"""Arms, packages and shadow casters: closed surfaces of real sizes, reproducible, different for different numbers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from objectflow.synth.objects.arms import build_arm
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.objects.packages import build_package
from objectflow.synth.objects.shadow_casters import build_shadow_caster
from objectflow.synth.objects.symmetry_detection import detect_symmetry


def arm_model(number: int) -> ObjectModel:
    return build_arm(number).model


@pytest.mark.parametrize("build", [arm_model, build_package, build_shadow_caster])
def test_surfaces_are_closed_point_outwards_and_are_reproducible(build: Callable[[int], ObjectModel]) -> None:
    for number in range(12):
        model = build(number)
        mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        assert mesh.is_watertight
        assert all(piece.volume > 0 for piece in mesh.split(only_watertight=False))
        assert model.uv.min() > -1e-12
        assert model.uv.max() < 1 + 1e-12
        again = build(number)
        np.testing.assert_array_equal(model.vertices, again.vertices)
        assert not np.array_equal(model.vertices[:20], build(number + 12).vertices[:20])


def test_arms_have_the_size_of_an_adult_s_and_reach_forward() -> None:
    arms = [build_arm(number) for number in range(40)]
    assert {arm.model.category for arm in arms} == {"arm", "robot-arm"}
    assert {bool(arm.grip[1] > 0) for arm in arms} == {False, True}  # left and right hands
    for arm in arms:
        low, high = arm.model.vertices.min(axis=0), arm.model.vertices.max(axis=0)
        assert 0.05 < high[0] < 0.16  # from the palm's centre to the fingertips
        assert 0.4 < np.linalg.norm(arm.shoulder) < 1.1
        assert low[0] < -0.3
        assert arm.grip[0] > 0.02
        # The shoulder is the far end of the arm's surface.
        nearest = np.linalg.norm(arm.model.vertices - arm.shoulder, axis=1).min()
        assert nearest < 0.01


def test_skin_is_on_the_left_half_of_the_texture_and_the_sleeve_on_the_right() -> None:
    textures = [arm.texture for number in range(30) if (arm := arm_model(number)).category == "arm"]
    for texture in textures:
        assert texture is not None
        skin = texture[:, :64].astype(float).mean(axis=(0, 1))
        assert skin[0] > skin[1] > skin[2]
    sleeves = np.stack([texture[:, 64:].mean(axis=(0, 1)) for texture in textures if texture is not None])
    assert sleeves.std(axis=0).min() > 30


def test_packages_are_oblong_and_have_the_symmetry_of_a_box() -> None:
    lengths = []
    for number in range(30):
        model = build_package(number)
        size = np.ptp(model.vertices, axis=0)
        assert size.argmax() == 2
        assert size[2] > 1.25 * size[0] > 1.25 * size[1]
        lengths.append(size[2])
    assert 0.15 <= min(lengths) < 0.2
    assert 0.27 < max(lengths) <= 0.32
    found = detect_symmetry(model.vertices, model.faces)
    assert sorted(axis.order for axis in found) == sorted(axis.order for axis in model.symmetry) == [2, 2, 2]
