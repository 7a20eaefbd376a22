"""Changing light, and places for shadow casters: between lamp and table, and never in sight."""

from __future__ import annotations

import numpy as np

from objectflow.geometry.camera import Camera
from objectflow.synth.scenes.light_changes import change_lights, draw_hard_lights, place_shadow_caster
from objectflow.synth.scenes.scene_data import Light, View

CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
LAMP = Light((0.8, 0.3, 1.6), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


def test_lamps_change_in_strength_and_rarely_in_place() -> None:
    rng = np.random.default_rng(0)
    factors, moved = [], 0
    for _ in range(300):
        before = draw_hard_lights(rng, (1, 3))
        after = change_lights(rng, before)
        assert len(before) == len(after) <= 3
        factors += [b.diffuse[1] / a.diffuse[1] for a, b in zip(before, after, strict=True)]
        moved += any(a.position != b.position for a, b in zip(before, after, strict=True))
        assert all(light.position[2] > 0.2 for light in after)
    assert 0.2 < np.log(factors).std() < 0.3
    assert 0.2 < moved / 300 < 0.4


def test_one_lamp_dominates_in_most_scenes() -> None:
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(300):
        energies = [light.diffuse[1] for light in draw_hard_lights(rng, (3, 3))]
        shares.append(max(energies) / sum(energies))
    assert np.median(shares) > 0.5


def test_shadow_casters_are_out_of_sight_and_between_lamp_and_table() -> None:
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(60):
        view = View((0.0, 0.0, 0.0), 1.0, float(rng.uniform(0, 6.28)), float(rng.uniform(0.4, 1.4)), 0.0)
        cameras = np.stack([view.world_T_camera] * 2)
        places = place_shadow_caster(rng, LAMP, 0.3, 0.2, cameras, CAMERA)
        if places is None:
            continue
        found += 1
        # Independent of the frustum's planes: no point of the sphere is projected into the image.
        directions = rng.normal(size=(4000, 3))
        for place in places:
            points = place + 0.2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
            x, y, z = ((points - view.world_T_camera[:3, 3]) @ view.world_T_camera[:3, :3]).T
            column, row = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
            seen = (z > 0) & (column > -0.5) & (column < 159.5) & (row > -0.5) & (row < 119.5)
            assert not seen.any()
        # The straight line from the lamp through the first place meets the table within the disc.
        lamp = np.asarray(LAMP.position)
        spot = lamp + (places[0] - lamp) * lamp[2] / (lamp[2] - places[0, 2])
        assert np.hypot(*spot[:2]) < 0.3 + 1e-9
    assert found > 20


def test_a_shadow_caster_that_is_always_in_sight_is_left_out() -> None:
    above = View((0.0, 0.0, 0.0), 4.0, 0.0, 1.5, 0.0)
    cameras = np.stack([above.world_T_camera] * 2)
    assert place_shadow_caster(np.random.default_rng(0), LAMP, 0.1, 0.5, cameras, CAMERA) is None
