"""The steps of `homc` on hand-made tracks, and the whole method on images with known motions."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

import analytic
import objectflow
from objectflow import Camera, RgbdFrame
from objectflow.errors import FrameError, MethodError, MissingExtraError
from objectflow.methods.baselines.homc import graph
from objectflow.methods.baselines.homc.costs import CostSettings, pair_costs, triple_costs
from objectflow.methods.baselines.homc.densify import densify
from objectflow.methods.baselines.homc.estimator import Homc
from objectflow.methods.baselines.homc.graph import build_problem
from objectflow.methods.baselines.homc.tracks import Tracks, track_points
from objectflow.typing import LabelImage

pytest.importorskip("bioimage_cpp")

SETTINGS = CostSettings(noise=0.5, distance_unit=32.0)


def make_tracks(*paths: Sequence[complex | None]) -> Tracks:
    """Tracks of points given as u + iv in each frame, or None where not visible, on uniform flow."""
    positions = np.array([[(p.real, p.imag) if p is not None else (np.nan, np.nan) for p in path] for path in paths])
    deviations = np.where(np.isnan(np.diff(positions[..., 0], axis=1)), np.nan, 0.0)
    return Tracks(positions.astype(np.float32), deviations.astype(np.float32))


# --- costs ---


def test_the_cost_of_a_pair_follows_its_formula() -> None:
    tracks = make_tracks([10 + 10j, 12 + 10j, 15 + 10j], [10 + 26j, 12 + 26j, 14 + 26j])
    lab = np.array([[50.0, 0, 0], [50.0, 30, 40]])
    # The motions differ by 1 pixel in the second step, i.e. by 2 deviations; the distances are 16 and 16.03 pixels.
    d_m, d_s, d_c = 2.0, (16 + 16 + np.hypot(1, 16)) / 3 / 32, 50.0
    expected = -max(6 - 2 * d_m - 4 * d_s - 0.02 * d_c, 2 - 2 * d_m)
    np.testing.assert_allclose(pair_costs(tracks, lab, np.array([[0, 1]]), SETTINGS), [expected], rtol=1e-5)


def test_distant_tracks_with_equal_motion_join_and_tracks_without_common_frames_cost_nothing() -> None:
    tracks = make_tracks(
        [1 + 1j, 4 + 1j, None, None], [200 + 90j, 203 + 90j, None, None], [None, None, 30 + 1j, 33 + 1j]
    )
    costs = pair_costs(tracks, np.zeros((3, 3)), np.array([[0, 1], [0, 2]]), SETTINGS)
    np.testing.assert_allclose(costs, [-2, 0])


def test_three_tracks_with_a_common_similarity_join() -> None:
    start = np.array([30 + 40j, 50 + 40j, 42 + 55j])
    moved = (start - 7) * 1.2 * np.exp(0.5j) + 11 - 3j
    again = (moved + 2) * 0.8 * np.exp(-1.1j)
    tracks = make_tracks(*[[complex(a), complex(b), complex(c)] for a, b, c in zip(start, moved, again, strict=True)])
    cost, known = triple_costs(tracks, np.array([[0, 1, 2]]), SETTINGS)
    assert known.tolist() == [True]
    np.testing.assert_allclose(cost, [-1], atol=1e-4)
    pair = pair_costs(tracks, np.zeros((3, 3)), np.array([[0, 1], [1, 2], [0, 2]]), SETTINGS)
    assert (pair > 0).all()


def test_the_cost_of_a_triple_with_a_deviating_track_is_the_minimum_over_the_three_roles() -> None:
    start = np.array([0j, 20 + 0j, 10 + 15j]) + 30 + 30j
    end = start + np.array([0, 0, 4])
    tracks = make_tracks(*[[complex(a), complex(b)] for a, b in zip(start, end, strict=True)])
    distances = []
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        # The similarity of two points, computed as a real matrix and a translation.
        rows = []
        for k in (a, b):
            rows += [[start[k].real, -start[k].imag, 1, 0], [start[k].imag, start[k].real, 0, 1]]
        p, q, x, y = np.linalg.solve(rows, [end[a].real, end[a].imag, end[b].real, end[b].imag])
        expected = complex(p * start[c].real - q * start[c].imag + x, q * start[c].real + p * start[c].imag + y)
        distances.append(abs(expected - end[c]) / 0.5)
    cost, _ = triple_costs(tracks, np.array([[0, 1, 2]]), SETTINGS)
    np.testing.assert_allclose(cost, [-1 + 0.8 * min(distances)], rtol=1e-4)
    assert cost[0] > 0


def test_triples_at_one_point_or_without_common_frames_are_unknown() -> None:
    tracks = make_tracks(
        [5 + 5j, 6 + 5j, None], [5 + 5j, 6 + 5j, None], [9 + 9j, 10 + 9j, None], [None, 1 + 1j, 1 + 1j]
    )
    cost, known = triple_costs(tracks, np.array([[0, 1, 2], [0, 2, 3]]), SETTINGS)
    assert known.tolist() == [False, False]
    assert cost.tolist() == [0, 0]


def test_pairs_with_a_cutting_cost_are_replaced_by_triples() -> None:
    v, u = np.mgrid[0:10, 0:12] * 4.0
    start = (u + 1j * v).ravel()
    rotated = (start - start.mean()) * np.exp(0.6j) + start.mean()
    tracks = make_tracks(*[[complex(a), complex(b)] for a, b in zip(start, rotated, strict=True)])
    problem = build_problem(tracks, np.zeros((len(start), 3)), 0, 4, SETTINGS)
    costs = pair_costs(tracks, np.zeros((len(start), 3)), problem.pairs, SETTINGS)
    np.testing.assert_allclose(problem.pair_costs, costs)
    # For one rotating body the remaining pairs and all triples join.
    assert (problem.pair_costs < 0).all()
    assert len(problem.triples) > 200
    np.testing.assert_allclose(problem.triple_costs, -1, atol=1e-3)


# --- tracks and dense labels ---


def test_points_of_a_translated_image_are_tracked() -> None:
    rng = np.random.default_rng(0)
    big = cv2.resize(rng.integers(0, 256, (40, 50, 3)).astype(np.uint8), (200, 160), interpolation=cv2.INTER_CUBIC)
    big = big.astype(np.uint8)
    images = [np.ascontiguousarray(big[30:126, 30 - 3 * k : 158 - 3 * k]) for k in range(4)]
    tracks = track_points(images, 4)
    complete = tracks.positions[np.isfinite(tracks.positions).all((1, 2))]
    assert len(complete) > 200
    moved = complete[:, 3] - complete[:, 0]
    np.testing.assert_allclose(np.median(moved, axis=0), [9, 0], atol=0.1)
    assert np.mean(np.linalg.norm(moved - [9, 0], axis=1) < 0.5) > 0.95
    # Points that appear on the left are tracked as well, and no cell has two tracks at the start.
    late = np.isnan(tracks.positions[:, 0, 0]) & np.isfinite(tracks.positions[:, 3, 0])
    assert (tracks.positions[late, 3, 0] < 12).any()
    first = tracks.positions[np.isfinite(tracks.positions[:, 0, 0]), 0]
    assert len(np.unique(first // 4, axis=0)) == len(first)
    subset = tracks.visible_in(2)
    assert np.isfinite(subset.positions[:, 2]).all()
    visible = np.isfinite(tracks.positions[..., 0])
    assert len(subset.positions) == (visible[:, 2] & (visible.sum(1) > 1)).sum()


def test_no_track_starts_without_image_structure() -> None:
    flat = np.full((64, 80, 3), 90, np.uint8)
    assert len(track_points([flat, flat], 4).positions) == 0


def test_pixels_take_the_label_of_nearby_tracks_with_their_colour() -> None:
    lab = np.zeros((20, 30, 3), np.float32)
    lab[:, 15:] = 60
    positions = np.array([[13.0, 10], [20.0, 10]])
    out = densify(positions, np.array([1, 2]), np.array([[0.0, 0, 0], [60.0, 60, 60]]), lab)
    # By distance alone the border would lie between columns 16 and 17.
    np.testing.assert_array_equal(out, np.where(np.arange(30) < 15, 1, 2) * np.ones((20, 1)))
    assert (densify(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 3)), lab) == 0).all()


# --- the whole method ---


@cache
def sequence(count: int = 4) -> tuple[list[RgbdFrame], LabelImage]:
    """A static background, a disc that rotates by 5 degrees per frame and a sliding square; labels of the last one."""
    rng = np.random.default_rng(1)
    layers = [cv2.resize(rng.integers(0, 256, (s, s, 3)).astype(np.uint8), (320, 320)) for s in (64, 80, 72)]
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    v, u = np.mgrid[0:120, 0:160]
    frames, labels = [], np.zeros((120, 160), np.int32)
    for k in range(count):
        rotation = cv2.getRotationMatrix2D((45, 60), 5.0 * k, 1.0)
        translation = np.array([[1, 0, 3.0 * k], [0, 1, 1.0 * k]])
        disc, square = (cv2.warpAffine(layers[i], m, (160, 120)) for i, m in ((1, rotation), (2, translation)))
        inside_disc = (u - 45) ** 2 + (v - 60) ** 2 < 30**2
        inside_square = (abs(u - 3 * k - 110) < 20) & (abs(v - k - 55) < 20)
        labels = np.where(inside_disc, 1, np.where(inside_square, 2, 0)).astype(np.int32)
        color = np.where(
            inside_disc[..., None], disc, np.where(inside_square[..., None], square, layers[0][:120, :160])
        )
        frames.append(RgbdFrame(color.astype(np.uint8), np.ones((120, 160), np.float32), camera))
    return frames, labels


def test_triples_make_a_rotating_disc_one_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, labels = sequence()
    motion = Homc().estimate_in_sequence(frames, 0, 3)
    assert len(motion.objects) == 2
    for label in (1, 2):
        mask = labels == label
        found = np.bincount(motion.labels[mask]).argmax()
        assert found != 0
        assert (mask & (motion.labels == found)).sum() / (mask | (motion.labels == found)).sum() > 0.75
    # With pairs only, the disc is split, or its centre is joined to the background.
    monkeypatch.setattr(
        graph, "propose_triples", lambda positions, tree, pairs: np.zeros((2 * len(pairs), 3), np.int64) + pairs[0, 0]
    )
    pieces = Homc().estimate_in_sequence(frames, 0, 3).labels[labels == 1]
    assert (pieces == np.bincount(pieces).argmax()).mean() < 0.75


def test_motions_lead_back_to_the_requested_frame() -> None:
    frames, labels = sequence()
    for prev, steps in ((0, 3), (2, 1)):
        motion = Homc().estimate_in_sequence(frames, prev, 3)
        square = motion.scene_flow[labels == 2]
        # 3 and 1 pixels per frame at 1 m with a focal length of 150 pixels; the tracking error is up to 0.6 pixels.
        np.testing.assert_allclose(np.median(square, axis=0), [-0.02 * steps, -1 / 150 * steps, 0], atol=0.004)
        label = int(np.bincount(motion.labels[labels == 2]).argmax())
        assert [obj.moving for obj in motion.objects if obj.id == label] == [True]
        assert (np.median(np.abs(motion.scene_flow[labels == 0])), motion.camera_motion) == (0, None)


def test_a_pair_is_repeated_to_a_sequence() -> None:
    frames, labels = sequence()
    motion = objectflow.load("homc")(frames[2], frames[3])
    square = motion.labels[labels == 2]
    assert np.bincount(square).argmax() != 0
    assert motion.method == "homc"
    once = Homc(repeats=1)(frames[2], frames[3])
    np.testing.assert_array_equal(np.isnan(motion.scene_flow), np.isnan(once.scene_flow))


def test_sparse_labels_lie_on_tracks_only() -> None:
    frames, _ = sequence()
    sparse = Homc(labels="sparse").estimate_in_sequence(frames, 0, 3)
    dense = Homc().estimate_in_sequence(frames, 0, 3)
    known = np.isfinite(sparse.scene_flow[..., 0])
    assert 0.01 < known.mean() < 0.1
    assert (sparse.labels[~known] == 0).all()
    assert (sparse.labels[known] == dense.labels[known]).mean() > 0.9
    assert np.isfinite(dense.scene_flow).all()


def test_the_camera_motion_is_that_of_the_background() -> None:
    camera_motion = np.eye(4)
    camera_motion[0, 3] = 0.01
    pair = analytic.make_scene(
        0, objects=(1, 2), motion=(0.02, 0.03), max_angle_deg=2, width=160, height=120, camera_motion=camera_motion
    )
    motion = Homc(camera="moving")(pair.prev, pair.curr)
    assert motion.camera_motion is not None
    np.testing.assert_allclose(motion.camera_motion, camera_motion, atol=0.004)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 3), (9, 7), (40, 30), (333, 21)])
def test_images_of_any_size_are_accepted(width: int, height: int) -> None:
    rng = np.random.default_rng(0)
    camera = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    depth = np.full((height, width), 0.8, np.float32)
    depth[0, 1:] = 0
    frame = RgbdFrame(rng.integers(0, 256, (height, width, 3)).astype(np.uint8), depth, camera)
    for labels in ("dense", "sparse"):
        motion = Homc(labels=labels)(frame, frame)
        assert motion.labels.shape == (height, width)
        assert np.isnan(motion.scene_flow[depth == 0]).all()
        assert not motion.labels.any()
    assert np.isfinite(Homc()(frame, frame).scene_flow[depth > 0]).all()


def test_segments_without_depth_are_not_reported() -> None:
    frames, labels = sequence()
    depth = np.where(labels == 2, 0, 1).astype(np.float32)
    with_hole = [dataclasses.replace(frame, depth=np.where(depth > 0, depth, 0)) for frame in frames]
    motion = Homc().estimate_in_sequence(with_hole, 0, 3)
    assert np.isnan(motion.scene_flow[labels == 2]).all()
    assert {obj.id for obj in motion.objects} == set(np.unique(motion.labels).tolist()) - {0}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"labels": "some"}, "labels must be one of dense, sparse, not 'some'"),
        ({"sampling": 0}, "sampling must be at least 1, not 0"),
        ({"repeats": True}, "repeats must be .*, not True"),
        ({"join": float("nan")}, "join must be a finite number, not nan"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        objectflow.load("homc", **options)


def test_invalid_sequences_are_refused() -> None:
    frames, _ = sequence()
    with pytest.raises(FrameError, match="two frames or more, not 1"):
        Homc().estimate_in_sequence(frames[:1], 0, 0)
    with pytest.raises(FrameError, match="two of the 4 frames, not 3 and 4"):
        Homc().estimate_in_sequence(frames, 3, 4)
    with pytest.raises(FrameError, match="both must have one size"):
        Homc().estimate_in_sequence([frames[0].resized(80, 60), *frames[1:]], 1, 2)


def test_the_error_for_a_missing_solver_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bioimage_cpp", None)
    with pytest.raises(MissingExtraError, match=r'homc needs bioimage-cpp: pip install ".+\[baselines\]"'):
        objectflow.load("homc")
