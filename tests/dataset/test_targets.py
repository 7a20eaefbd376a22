"""Dense targets against a loop over pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.object_tables import object_table
from objectflow import geometry
from objectflow.dataset.schema import PairObject
from objectflow.dataset.targets import make_targets, with_camera
from objectflow.errors import DatasetError


def an_object(label: int, rng: np.random.Generator, *, in_both: bool = True) -> PairObject:
    rotation = rng.normal(0, 0.5, 3)
    return PairObject(
        label=label,
        category="box",
        model=f"box-{label}",
        center=rng.uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 0.9]),
        translation=rng.normal(0, 0.05, 3),
        rotation_vector=rotation,
        raw_rotation_vector=rotation,
        symmetry=(),
        prev_pose=np.eye(4),
        curr_pose=np.eye(4),
        in_both=in_both,
    )


def a_batch() -> tuple[list[list[PairObject]], torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(0)
    rows = [
        [an_object(1, rng), an_object(2, rng, in_both=False), an_object(5, rng)],
        [an_object(3, rng)],
        [],
    ]
    labels = np.zeros((3, 24, 32), np.int64)
    labels[0, :10, :10], labels[0, 12:20, 5:25], labels[0, 2:8, 15:30] = 1, 2, 5
    labels[1, 5:22, 3:29] = 3
    points = rng.uniform([-0.3, -0.3, 0.4], [0.3, 0.3, 1.0], (3, 24, 32, 3)).astype(np.float32)
    points[rng.random((3, 24, 32)) < 0.1] = np.nan
    return rows, torch.from_numpy(labels), torch.from_numpy(points).permute(0, 3, 1, 2)


def test_maps_equal_a_loop_over_pixels() -> None:
    rows, labels, points = a_batch()
    targets = make_targets(object_table(rows), labels, points, nearest=40)
    for b, objects in enumerate(rows):
        by_label = {entry.label: entry for entry in objects}
        for v in range(24):
            for u in range(32):
                entry = by_label.get(int(labels[b, v, u]))
                assert bool(targets.mask[b, v, u]) == (entry is not None)
                if entry is None:
                    for dense in (targets.rotation, targets.translation, targets.center, targets.flow, targets.radius):
                        assert not dense[b, :, v, u].any()
                    continue
                assert objects[int(targets.index[b, v, u])].label == entry.label
                assert bool(targets.seen[b, v, u]) == entry.in_both
                np.testing.assert_allclose(targets.rotation[b, :, v, u], entry.rotation_vector, rtol=1e-6)
                np.testing.assert_allclose(targets.translation[b, :, v, u], entry.translation, rtol=1e-6)
                np.testing.assert_allclose(targets.center[b, :, v, u], entry.center, rtol=1e-6)
                p = points[b, :, v, u].numpy().astype(np.float64)
                if np.isfinite(p[2]):
                    R = Rotation.from_rotvec(entry.rotation_vector).as_matrix()
                    expected = R @ (p - entry.center) + entry.center + entry.translation - p
                    np.testing.assert_allclose(targets.flow[b, :, v, u], expected, atol=1e-6)
                else:
                    assert not targets.flow[b, :, v, u].any()


def test_the_background_of_a_moving_camera_moves_with_it() -> None:
    rows, labels, points = a_batch()
    targets = make_targets(object_table(rows), labels, points)
    camera = np.tile(np.eye(4), (3, 1, 1))
    camera[0, :3, :3] = Rotation.from_rotvec([0.02, -0.05, 0.01]).as_matrix()
    camera[0, :3, 3] = [0.01, 0.0, -0.03]
    moved = with_camera(targets, points, torch.from_numpy(camera).float())
    flow = geometry.flow_from_motions(points[0].permute(1, 2, 0).numpy(), labels[0].int().numpy(), {}, camera[0])
    rest = (~targets.mask[0] & torch.isfinite(points[0, 2])).numpy()
    np.testing.assert_allclose(moved.flow[0].permute(1, 2, 0).numpy()[rest], flow[rest], atol=1e-6)
    assert np.linalg.norm(flow[rest], axis=1).min() > 0.005
    np.testing.assert_array_equal(moved.flow[0][:, ~rest], targets.flow[0][:, ~rest])
    np.testing.assert_array_equal(moved.flow[1:], targets.flow[1:])  # the other cameras are static
    assert with_camera(targets, points, None) is targets


def test_radius_is_half_the_distance_to_the_nearest_trajectory() -> None:
    rows, labels, points = a_batch()
    targets = make_targets(object_table(rows), labels, points)
    trajectories = {entry.label: np.r_[entry.center, entry.center + entry.translation] for entry in rows[0]}
    for label, own in trajectories.items():
        nearest = min(np.linalg.norm(own - other) for k, other in trajectories.items() if k != label)
        found = targets.radius[0, 0][labels[0] == label]
        np.testing.assert_allclose(found, 0.5 * nearest, rtol=1e-5)
    np.testing.assert_array_equal(targets.radius[1, 0][labels[1] == 3], 0.5)


def test_rotations_enter_the_radius_on_request() -> None:
    rows, labels, points = a_batch()
    targets = make_targets(object_table(rows), labels, points, rotation_weight=0.2)
    features = {
        entry.label: np.r_[entry.center, entry.center + entry.translation, 0.2 * entry.rotation_vector]
        for entry in rows[0]
    }
    for label, own in features.items():
        nearest = min(np.linalg.norm(own - other) for k, other in features.items() if k != label)
        np.testing.assert_allclose(targets.radius[0, 0][labels[0] == label], nearest / 2, rtol=1e-5)


def test_seeds_are_the_nearest_pixels_to_the_center() -> None:
    rows, labels, points = a_batch()
    targets = make_targets(object_table(rows), labels, points, nearest=40)
    for b, objects in enumerate(rows):
        for entry in objects:
            inside = (labels[b] == entry.label) & torch.isfinite(points[b, 2])
            distance = (points[b] - torch.tensor(entry.center, dtype=torch.float32)[:, None, None]).norm(dim=0)
            wanted = torch.zeros_like(inside)
            flat = torch.where(inside, distance, torch.inf).flatten().argsort()[: min(40, int(inside.sum()))]
            wanted.view(-1)[flat] = True
            assert torch.equal(targets.eta[b] & (labels[b] == entry.label), wanted)
    assert not targets.eta[2].any()


def test_an_unknown_label_and_wrong_shapes_are_refused() -> None:
    rows, labels, points = a_batch()
    table = object_table(rows)
    with pytest.raises(DatasetError, match="lacks"):
        make_targets(table, torch.full_like(labels, 9), points)
    with pytest.raises(DatasetError, match="points"):
        make_targets(table, labels, points[:, :2])
    with pytest.raises(DatasetError, match="rows"):
        make_targets(table, labels[:2], points[:2])
