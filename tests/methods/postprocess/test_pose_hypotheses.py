"""Hypotheses about motions: which are kept, and how they are perturbed."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.methods.postprocess.motion_prior import MotionPrior
from objectflow.methods.postprocess.pose_hypotheses import PoseHypotheses, perturb, suppress_duplicates
from objectflow.methods.postprocess.search_settings import MotionSearchSettings


def random_hypotheses(count: int) -> PoseHypotheses:
    rng = np.random.default_rng(0)
    return PoseHypotheses(Rotation.random(count, random_state=1).as_matrix(), rng.uniform(-0.05, 0.05, (count, 3)))


def apart(a: PoseHypotheses, b: PoseHypotheses) -> tuple[float, float]:
    """Degrees and metres between the only hypotheses of two sets."""
    angle = Rotation.from_matrix(a.rotations[0] @ b.rotations[0].T).magnitude()
    return float(np.degrees(angle)), float(np.linalg.norm(a.positions[0] - b.positions[0]))


def test_the_kept_hypotheses_are_distinct() -> None:
    hypotheses, cost = random_hypotheses(400), np.random.default_rng(1).uniform(size=400)
    kept = suppress_duplicates(hypotheses, cost, 10, np.radians(20), 0.02)
    assert kept[0] == cost.argmin()
    assert list(cost[kept]) == sorted(cost[kept])
    some = [hypotheses.take(kept[i : i + 1]) for i in range(len(kept))]
    for i in range(len(kept)):
        for j in range(i):
            degrees, metres = apart(some[i], some[j])
            assert degrees > 20 or metres > 0.02


def test_every_hypothesis_left_out_is_near_a_cheaper_one() -> None:
    hypotheses, cost = random_hypotheses(60), np.random.default_rng(2).uniform(size=60)
    kept = suppress_duplicates(hypotheses, cost, 60, np.radians(70), 0.05)
    assert 1 < len(kept) < 60
    for i in set(range(60)) - set(kept.tolist()):
        near = [
            apart(hypotheses.take(np.array([i])), hypotheses.take(np.array([k]))) for k in kept if cost[k] < cost[i]
        ]
        assert any(degrees <= 70 and metres <= 0.05 for degrees, metres in near)


def test_duplicates_far_from_the_camera_are_told_apart() -> None:
    """The shift between positions is exact at 10 m."""
    positions = np.array([[0.0, 0, 10], [0.0005, 0, 10], [0.0015, 0, 10]])
    hypotheses = PoseHypotheses(np.tile(np.eye(3), (3, 1, 1)), positions)
    assert suppress_duplicates(hypotheses, np.arange(3.0), 3, 0.1, 0.001).tolist() == [0, 2]


def test_the_spread_of_perturbed_hypotheses() -> None:
    start = PoseHypotheses(np.eye(3)[None], np.array([[0.1, 0.2, 0.9]]))
    many = perturb(start, 4000, 0.1, 0.02, np.random.default_rng(3))
    angles = Rotation.from_matrix(many.rotations).magnitude()
    np.testing.assert_allclose(np.sqrt(np.square(angles).mean()), 0.1, rtol=0.03)
    np.testing.assert_allclose((many.positions - start.positions).std(axis=0), 0.02, rtol=0.05)


def test_the_prior_of_a_motion() -> None:
    """8 per metre and 0.35 per radian for an object of 1,000 pixels; half of it for four times the pixels."""
    settings = MotionSearchSettings(cost_per_metre=8.0, cost_per_radian=0.35, usual_pixels=1000)
    center = np.array([0.1, 0.0, 1.0])
    first = np.eye(4)
    turned = Rotation.from_rotvec([0, 0.5, 0]).as_matrix()
    hypotheses = PoseHypotheses(np.stack([np.eye(3), turned]), np.add(center, [[0.03, 0, 0.04], [0, 0, 0]]))
    for pixels, factor in ((1000, 1.0), (4000, 0.5)):
        prior = MotionPrior(first, center, pixels, settings)
        np.testing.assert_allclose(prior(hypotheses), factor * np.array([8 * 0.05, 0.35 * 0.5]), rtol=1e-6)
        assert prior(prior.hypothesis(first)).item() == 0
