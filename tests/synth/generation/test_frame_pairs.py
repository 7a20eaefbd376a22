"""Selection of frames in which every object either clearly moves or stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from helpers.object_models import plate_model
from objectflow import geometry
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.synth.generation.frame_pairs import SelectedFrames, select_frames
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.recording import Recording


def recording(shifts: Sequence[float], angles: Sequence[float] = (), frames: int = 61) -> Recording:
    """Objects that move along x, or rotate about z, uniformly; the numbers are those of the last frame."""
    poses = np.tile(np.eye(4), (frames, max(len(shifts), len(angles)), 1, 1))
    share = np.linspace(0, 1, frames)
    for k, shift in enumerate(shifts):
        poses[:, k, 0, 3] = share * shift
    for k, angle in enumerate(angles):
        poses[:, k, :3, :3] = geometry.so3_exp(np.outer(share, [0, 0, angle]))
    return Recording(poses, np.zeros(frames), np.zeros(frames))


def select(made: Recording, models: Sequence[ObjectModel], movers: tuple[int, int] = (1, 8)) -> SelectedFrames | None:
    rng = np.random.default_rng(0)
    return select_frames(rng, made, models, [1.0] * len(models), gap=(60, 60), movers=movers)


def test_objects_that_hardly_move_are_made_static_and_moving_ones_keep_their_poses() -> None:
    made = recording([0.0024, 0.0051])
    selected = select(made, [plate_model(), plate_model()])
    assert selected is not None
    assert selected.moving.tolist() == [False, True]
    np.testing.assert_array_equal(selected.world_T_object[0, 0], selected.world_T_object[1, 0])
    np.testing.assert_array_equal(selected.world_T_object[1, 1], made.world_T_object[60, 1])


def test_no_pair_has_objects_that_neither_move_nor_stand_still() -> None:
    models = [plate_model(), plate_model()]
    assert select(recording([0.004, 0.05]), models) is None
    assert select(recording([0.05, 0.05]), models, (1, 1)) is None  # too many move
    assert select(recording([0.0, 0.0]), models) is None  # none moves
    deep = replace(recording([0.0, 0.05]), penetration=np.full(61, 0.01))
    assert select(deep, models) is None


def test_a_rotation_of_the_symmetry_group_is_no_motion() -> None:
    """A quarter turn of a square plate about its axis."""
    made = recording([], [np.pi / 2])
    assert select(made, [plate_model((SymmetryAxis((0.0, 0.0, 1.0), 4),))]) is None
    selected = select(made, [plate_model()])
    assert selected is not None
    assert selected.moving.tolist() == [True]


def test_without_movers_the_first_frame_is_selected_twice() -> None:
    selected = select(recording([0.5]), [plate_model()], (0, 0))
    assert selected is not None
    assert not selected.moving.any()
    np.testing.assert_array_equal(*selected.world_T_object)
