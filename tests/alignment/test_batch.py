"""Registration and likelihood of many motions at once, against those of one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from objectflow import geometry
from objectflow.alignment import registration
from objectflow.alignment.batch_likelihood import batch_cost
from objectflow.alignment.batch_registration import refine_batch
from objectflow.alignment.batch_target import BatchSource, BatchTarget
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings, motion_cost
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import Float64Array

CAMERA = Camera(width=80, height=60, fx=80.0, fy=80.0, cx=39.5, cy=29.5)


def noisy_wall(seed: int) -> RgbdFrame:
    """A coloured wall at 1 m without depth in a corner."""
    rng = np.random.default_rng(seed)
    depth = (1 + rng.normal(0, 0.004, (60, 80))).astype(np.float32)
    depth[:10, :20] = 0
    return RgbdFrame(rng.integers(60, 190, (60, 80, 3), dtype=np.uint8), depth, CAMERA)


def hypotheses(motions: list[Float64Array], center: Float64Array) -> tuple[Float64Array, Float64Array]:
    return np.stack([T[:3, :3] for T in motions]), np.stack([geometry.transform(T, center) for T in motions])


@pytest.mark.parametrize("out_of_view", [1.0, 3.0])
def test_the_cost_of_many_motions_is_that_of_each(out_of_view: float) -> None:
    """Shifts by whole pixels of a wall, and away from it: there, the nearest pixel is what interpolation gives."""
    pair = FramePair(noisy_wall(0), noisy_wall(1))
    motions = [
        geometry.make_transform(np.eye(3), shift)
        for shift in ([0, 0, 0], [0.05, -0.025, 0], [0, 0, 0.02], [0, 0, -0.02], [0, 0, 0.3], [0, 0, -0.3], [2, 0, 0])
    ]
    rays = geometry.back_project(np.ones((60, 80), np.float32), CAMERA)
    frame = dataclasses.replace(pair.curr.frame, depth=np.ones((60, 80), np.float32))
    pair = FramePair(pair.prev, frame)
    rows, columns = (index.ravel() for index in np.mgrid[5:55, 5:75])
    center = rays[rows, columns].mean(axis=0, dtype=np.float64)
    settings = LikelihoodSettings()
    many = batch_cost(
        BatchTarget.of(pair),
        BatchSource.take(pair, rows, columns, center),
        *hypotheses(motions, center),
        out_of_view=out_of_view,
        settings=settings,
    )
    assert many.shape == (len(motions), len(rows))
    assert many.dtype == np.float32
    appearance = pair.prev.appearance, pair.curr.appearance
    for T, found in zip(motions, many, strict=True):
        one, _ = motion_cost(
            pair.prev.frame, pair.curr.points, T, appearance, out_of_view=out_of_view, settings=settings
        )
        same = np.isclose(found, one[rows, columns], atol=0.02)
        # Which of the four neighbours lies nearest in depth depends on how a pixel is rounded.
        assert same.mean() > 0.9
        assert abs(float(found.mean()) - float(one[rows, columns].mean())) < 0.1


def disturbed(true: Float64Array, center: Float64Array, random: np.random.Generator) -> Float64Array:
    """A motion that is off by about 2 degrees and 5 mm."""
    position = geometry.transform(true, center)
    turn = Rotation.from_rotvec(random.normal(0, 0.02, 3)).as_matrix()
    return geometry.make_transform(turn, position - turn @ position + random.normal(0, 0.003, 3)) @ true


def distance(a: Float64Array, b: Float64Array, points: Float64Array) -> float:
    """Mean distance in metres between points under two motions."""
    return float(np.linalg.norm(geometry.transform(a, points) - geometry.transform(b, points), axis=1).mean())


@pytest.mark.parametrize("seed", [1, 6, 12])
def test_many_registrations_end_where_one_does(seed: int) -> None:
    scene = analytic.make_scene(seed)
    pair = FramePair(scene.prev, scene.curr)
    random = np.random.default_rng(seed)
    checked = 0
    for label in sorted(scene.moving):
        seen = (scene.labels == label) & scene.visible
        if scene.kinds[label] != "box" or seen.sum() < 800:
            continue
        rows, columns = np.nonzero(seen)
        pick = random.permutation(len(rows))[:400]
        center = np.asarray(scene.centers[label], dtype=np.float64)
        starts = [disturbed(scene.prev_T_curr[label], center, random) for _ in range(8)]
        rotations, positions = refine_batch(
            BatchTarget.of(pair),
            BatchSource.take(pair, rows[pick], columns[pick], center),
            *hypotheses(starts, center),
            (8, 8),
        )
        points = pair.curr.points[seen].astype(np.float64)
        single = registration.refine(pair.target, pair.sources.take(seen), starts[0]).prev_T_curr
        ends = [geometry.make_transform(R, t - R @ center) for R, t in zip(rotations, positions, strict=True)]
        assert np.median([distance(start, single, points) for start in starts]) > 0.003
        assert np.median([distance(end, single, points) for end in ends]) < 0.001
        checked += 1
    assert checked


def test_a_hypothesis_without_overlap_stays() -> None:
    pair = FramePair(noisy_wall(0), noisy_wall(1))
    rows, columns = (index.ravel() for index in np.mgrid[20:40, 30:50])
    center = np.array([0.0, 0.0, 1.0])
    away = [geometry.make_transform(np.eye(3), shift) for shift in ([5.0, 0, 0], [0, 0, 3.0])]
    R, t = hypotheses(away, center)
    rotations, positions = refine_batch(
        BatchTarget.of(pair), BatchSource.take(pair, rows, columns, center), R, t, (3, 2)
    )
    np.testing.assert_allclose(rotations, R, atol=1e-6)
    np.testing.assert_allclose(positions, t, atol=1e-6)
