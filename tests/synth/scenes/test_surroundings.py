"""Tables, bins and walls around the objects, and the views that they block."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from objectflow.synth.scenes.scene_data import Floor, Slab
from objectflow.synth.scenes.surroundings import draw_surroundings, is_unobstructed
from objectflow.synth.scenes.textures import TextureSpec


def test_slabs_block_the_view() -> None:
    wall = Slab((1.0, 0.0, 0.5), 0.0, (0.02, 1.0, 0.5), Floor(TextureSpec("plain"), 1.0, 0.0, 0.1))
    target = np.zeros(3)
    assert is_unobstructed((wall,), np.array([0.5, 0, 0.5]), target)
    assert not is_unobstructed((wall,), np.array([1.5, 0, 0.5]), target)
    assert not is_unobstructed((wall,), np.array([0.96, 0, 0.5]), target)  # too close
    assert is_unobstructed((wall,), np.array([1.5, 0, 3.0]), target)  # above it
    rotated = replace(wall, yaw=math.pi / 2)
    assert is_unobstructed((rotated,), np.array([1.5, 0.5, 0.5]), np.array([0.0, 0.5, 0.0]))


def test_surroundings_support_the_objects_at_height_zero() -> None:
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(60):
        surroundings = draw_surroundings(rng, 0.2)
        groups = [group for group, _ in surroundings.slabs]
        kinds.update(groups)
        assert ("table" in groups) == (surroundings.floor < 0)
        assert ("wall" in groups) == surroundings.walls
        for group, slab in surroundings.slabs:
            if group == "table":
                assert math.isclose(slab.center[2] + slab.half[2], 0, abs_tol=1e-12)
                assert min(slab.half[:2]) > 0.2
    assert kinds == {"table", "wall", "bin"}
