"""Robust fits and registration, on known motions."""

from __future__ import annotations

import numpy as np
import pytest

import analytic
from objectflow import Camera, geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.matching import PixelMatches

CAMERA = Camera(width=320, height=240, fx=236.46, fy=236.46, cx=159.5, cy=119.5)


def matches_of(points: np.ndarray, prev_T_curr: np.ndarray, noise: np.ndarray) -> PixelMatches:
    prev = geometry.transform(prev_T_curr, points) + noise
    return PixelMatches(
        geometry.project(points, CAMERA).astype(np.float32), points.astype(np.float32), prev.astype(np.float32)
    )


def test_the_fit_ignores_forty_percent_of_wrong_matches() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8], (100, 3))
    prev_T_curr = geometry.se3_exp([0.05, -0.02, 0.03, 0.1, 0.2, -0.3])
    noise = rng.normal(0, 0.0005, (100, 3))
    noise[:40] += rng.uniform(0.05, 0.2, (40, 3))
    fitted, inliers = fitting.fit_matches(matches_of(points, prev_T_curr, noise), CAMERA)
    assert np.linalg.norm(geometry.se3_log(geometry.inverse(fitted) @ prev_T_curr)[:3]) < 0.002
    assert inliers[40:].mean() > 0.95
    assert not inliers[:40].any()


def test_the_fit_is_exact_on_three_exact_matches() -> None:
    points = np.array([[0.0, 0, 0.6], [0.1, 0, 0.65], [0, 0.1, 0.7]])
    prev_T_curr = geometry.se3_exp([0.1, 0, 0, 0, 0, 0.5])
    fitted, inliers = fitting.fit_matches(matches_of(points, prev_T_curr, np.zeros((3, 3))), CAMERA)
    np.testing.assert_allclose(fitted, prev_T_curr, atol=1e-6)
    assert inliers.all()


@pytest.mark.parametrize("seed", [1, 6, 12])
def test_registration_corrects_a_rough_initial_motion(seed: int) -> None:
    scene = analytic.make_scene(seed)
    target = registration.RegistrationTarget(scene.prev)
    rng = np.random.default_rng(seed)
    before, after = [], []
    for label in sorted(scene.moving):
        seen = (scene.labels == label) & scene.visible
        if scene.kinds[label] != "box" or seen.sum() < 800:
            continue
        true, center = scene.prev_T_curr[label], scene.centers[label]
        offset = geometry.se3_exp([*rng.normal(0, 0.004, 3), *rng.normal(0, 0.02, 3)])
        about_center = geometry.make_transform(np.eye(3), geometry.transform(true, center))
        start = about_center @ offset @ geometry.inverse(about_center) @ true
        refined = registration.refine(
            target, registration.RegistrationSources(scene.curr).take(scene.labels == label), start
        )
        for errors, found in ((before, start), (after, refined.prev_T_curr)):
            errors.append(np.linalg.norm(geometry.transform(found, center) - geometry.transform(true, center)))
        assert refined.fitness > 0.8
    assert before
    assert np.median(after) < 0.25 * np.median(before)
    assert np.median(after) < 0.0015


def test_registration_without_points_returns_the_initial_motion() -> None:
    scene = analytic.make_scene(3)
    start = geometry.se3_exp([0.01, 0, 0, 0, 0, 0])
    nothing = registration.RegistrationSources(scene.curr).take(np.zeros(scene.labels.shape, bool))
    refined = registration.refine(registration.RegistrationTarget(scene.prev), nothing, start)
    np.testing.assert_array_equal(refined.prev_T_curr, start)
    assert refined.fitness == 0


def test_the_number_of_iterations_is_a_setting() -> None:
    """One Gauss-Newton step per blur ends farther from the truth than twelve."""
    scene = analytic.make_scene(1, objects=(1, 1))
    target = registration.RegistrationTarget(scene.prev)
    (label,) = scene.moving
    source = registration.RegistrationSources(scene.curr).take(scene.labels == label)
    start = geometry.make_transform(np.eye(3), [0.006, -0.004, 0.005]) @ scene.prev_T_curr[label]
    center = geometry.transform(scene.prev_T_curr[label], scene.centers[label])
    errors = []
    for iterations in (1, 12):
        steps = registration.RegistrationSettings(iterations=iterations)
        found = registration.refine(target, source, start, settings=steps).prev_T_curr
        errors.append(np.linalg.norm(geometry.transform(found, scene.centers[label]) - center))
    assert errors[1] < 0.5 * errors[0]
