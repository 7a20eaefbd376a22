"""Prepared pairs: each part is computed once, at each width, and shared by the pairs of a sequence."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment import frame_pair, prepared_frame, registration
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import MatchSettings, feature_matches
from objectflow.alignment.prepared_frame import GRAY_BLURS, PreparedFrame
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import DEPTH_NOISE, STRUCTURED_LIGHT, DepthNoise
from objectflow.methods.base import PairEstimator, estimate_pair
from objectflow.motion import SceneMotion

SCENE = analytic.make_scene(4, objects=(2, 2))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each of the costly functions is called."""
    counted: Counter[str] = Counter()
    for module, name in (
        (frame_pair, "match_frames"),
        (frame_pair, "RegistrationTarget"),
        (frame_pair, "RegistrationSources"),
        (prepared_frame, "to_gray"),
        (prepared_frame, "surface_normals"),
        (prepared_frame, "AppearanceFeatures"),
        (prepared_frame.geometry, "back_project"),
        (prepared_frame.cv2, "GaussianBlur"),
        (prepared_frame.cv2.SIFT, "create"),
        (RgbdFrame, "resized"),
    ):
        original = getattr(module, name)

        def wrapper(*arguments, name=name, original=original, **options):  # type: ignore[no-untyped-def]
            counted[name] += 1
            return original(*arguments, **options)

        monkeypatch.setattr(module, name, wrapper)
    return counted


def use_everything(pair: FramePair) -> None:
    _ = pair.matches, pair.target, pair.sources
    for frame in (pair.prev, pair.curr):
        _ = frame.points, frame.normals, frame.gray, frame.blurred, frame.appearance, frame.keypoints(1500, 0.02)


def test_nothing_is_computed_before_it_is_used(calls: Counter[str]) -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    _ = pair.prev.valid, pair.noise
    assert not calls


def test_each_part_is_computed_once(calls: Counter[str]) -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    use_everything(pair)
    first = Counter(calls)
    # AppearanceFeatures blurs once per frame, besides the blurred grey images.
    assert first == {
        "match_frames": 1, "RegistrationTarget": 1, "RegistrationSources": 1, "to_gray": 2, "surface_normals": 2,
        "AppearanceFeatures": 2, "back_project": 2, "create": 2, "GaussianBlur": 2 * (len(GRAY_BLURS) + 1),
    }  # fmt: skip
    use_everything(pair)
    assert calls == first


def test_each_width_is_prepared_once(calls: Counter[str]) -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    small = pair.at_width(160)
    assert pair.at_width(160) is small
    assert calls["resized"] == 2
    assert small.curr.frame.camera.width == 160
    assert small.curr.frame.depth.shape == (120, 160)
    assert small is not pair.at_width(80)
    assert pair.at_width(320) is pair.at_width(10_000) is pair
    assert small.at_width(200) is small
    assert small.curr is pair.curr.at_width(160) is pair.curr.resized(160, 120)
    use_everything(small)
    use_everything(pair.at_width(160))
    assert calls["match_frames"] == 1
    assert calls["to_gray"] == 2


def test_parts_are_those_of_the_frames_themselves() -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    for prepared, frame in ((pair.prev, SCENE.prev), (pair.curr, SCENE.curr)):
        assert prepared.frame is frame
        np.testing.assert_array_equal(prepared.points, geometry.back_project(frame.depth, frame.camera))
        np.testing.assert_array_equal(prepared.valid, frame.valid)
        assert len(prepared.blurred) == len(GRAY_BLURS)
        norms = np.linalg.norm(prepared.normals, axis=-1)
        np.testing.assert_allclose(norms[np.isfinite(norms)], 1, atol=1e-5)
        assert np.mean(np.isfinite(norms)) > 0.8
        words = prepared.keypoints(1500, 0.02).descriptors
        np.testing.assert_allclose(np.linalg.norm(words, axis=1), 1, atol=1e-4)
        assert (prepared.keypoints(1500, 0.02).pixels >= 0).all()
    small = pair.at_width(160).curr.frame
    expected = SCENE.curr.resized(160, 120)
    np.testing.assert_array_equal(small.color, expected.color)
    np.testing.assert_array_equal(small.depth, expected.depth)


def test_the_next_pair_of_a_sequence_reuses_the_current_frame(calls: Counter[str]) -> None:
    noise = DEPTH_NOISE["stereo"]
    first = FramePair(SCENE.prev, SCENE.curr, noise=noise)
    use_everything(first)
    use_everything(first.at_width(160))
    before = Counter(calls)
    second = first.followed_by(SCENE.prev)
    assert second.prev is first.curr
    assert second.prev.at_width(160) is first.curr.at_width(160)
    assert second.curr.frame is SCENE.prev
    assert second.noise is noise
    use_everything(second)
    use_everything(second.at_width(160))
    # Of each part of a frame, only the new one is computed.
    assert calls["to_gray"] - before["to_gray"] == 2
    assert calls["surface_normals"] - before["surface_normals"] == 2
    assert calls["create"] - before["create"] == 2
    assert calls["resized"] - before["resized"] == 1
    assert calls["match_frames"] - before["match_frames"] == 2


def test_another_noise_keeps_the_prepared_frames() -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    assert pair.noise is STRUCTURED_LIGHT
    assert pair.with_noise(DepthNoise()) is pair
    stereo = pair.with_noise(DEPTH_NOISE["stereo"])
    assert (stereo.prev, stereo.curr) == (pair.prev, pair.curr)
    assert stereo.noise is stereo.at_width(160).noise is stereo.target.noise is DEPTH_NOISE["stereo"]
    assert pair.noise is pair.at_width(160).noise is pair.target.noise is STRUCTURED_LIGHT
    assert stereo.at_width(160).curr is pair.at_width(160).curr


def test_other_match_settings_keep_the_prepared_frames() -> None:
    pair = FramePair(SCENE.prev, SCENE.curr, noise=DEPTH_NOISE["stereo"])
    assert pair.with_matching(MatchSettings()) is pair
    sparse = pair.with_matching(MatchSettings(narrow_stride=16))
    assert (sparse.prev, sparse.curr, sparse.noise) == (pair.prev, pair.curr, pair.noise)
    assert sparse.at_width(160).matching == sparse.followed_by(SCENE.prev).matching == MatchSettings(narrow_stride=16)
    on_grid, on_sparse_grid = (np.sum((one.matches.pixels % 1 == 0).all(axis=1)) for one in (pair, sparse))
    assert 14 < on_grid / on_sparse_grid < 18  # one in sixteen


def test_features_are_left_out_where_flow_suffices(calls: Counter[str]) -> None:
    pair = FramePair(SCENE.prev, SCENE.curr, matching=MatchSettings(sufficient_flow_share=0.5))
    assert pair.flow.share > 0.5
    np.testing.assert_array_equal(pair.matches.pixels, pair.flow.matches.pixels)
    assert pair.lacks_features
    assert calls["create"] == 0
    whole = pair.with_features()
    assert not whole.lacks_features
    assert whole is pair.with_features() is whole.with_features()
    assert len(whole.matches.curr) > len(pair.matches.curr)
    np.testing.assert_array_equal(whole.matches.pixels, FramePair(SCENE.prev, SCENE.curr).matches.pixels)
    assert whole.flow is pair.flow
    assert calls["create"] == 4  # two of them for the other pair
    strict = FramePair(SCENE.prev, SCENE.curr, matching=MatchSettings(sufficient_flow_share=0.999))
    assert not strict.lacks_features
    matches = strict.matches
    assert strict.with_features().matches is matches


def test_prepared_frames_are_taken_as_they_are() -> None:
    prepared = PreparedFrame(SCENE.prev)
    assert PreparedFrame.of(prepared) is prepared
    assert FramePair(prepared, SCENE.curr).prev is prepared
    target = registration.RegistrationTarget(prepared)
    assert target.points is prepared.points
    assert target.normals is prepared.normals


def test_frames_that_cannot_be_compared_are_rejected() -> None:
    with pytest.raises(FrameError, match="both must have one size"):
        FramePair(SCENE.prev, SCENE.curr.resized(160, 120))
    camera = dataclasses.replace(SCENE.curr.camera, fx=200.0)
    with pytest.raises(FrameError, match="different intrinsics"):
        FramePair(SCENE.prev, dataclasses.replace(SCENE.curr, camera=camera))


def test_extreme_proportions_keep_a_row() -> None:
    frame = SCENE.prev.resized(300, 1)
    assert FramePair(frame, frame).at_width(100).curr.frame.depth.shape == (1, 100)


# --- estimators on pairs ---


class Recorder(PairEstimator):
    """Records the pairs that it is given."""

    def __init__(self) -> None:
        self.pairs: list[FramePair] = []

    def estimate(self, pair: FramePair) -> SceneMotion:
        self.pairs.append(pair)
        shape = pair.curr.frame.depth.shape
        return SceneMotion(np.zeros(shape, np.int32), np.zeros((*shape, 3), np.float32), method="recorder")


def test_estimators_take_prepared_pairs_and_frames() -> None:
    recorder, pair = Recorder(), FramePair(SCENE.prev, SCENE.curr)
    assert estimate_pair(recorder, pair).method == "recorder"
    assert recorder.pairs == [pair]
    recorder(SCENE.prev, SCENE.curr)
    assert recorder.pairs[1].prev.frame is SCENE.prev
    assert len(recorder.estimate_batch(iter([pair, pair]))) == 2
    assert recorder.pairs[2:] == [pair, pair]
    assert recorder.estimate_batch([]) == []
    with pytest.raises(FrameError):
        recorder(SCENE.prev, SCENE.curr.resized(160, 120))


def test_an_estimator_of_frames_is_given_frames() -> None:
    def estimator(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        assert (prev, curr) == (SCENE.prev, SCENE.curr)
        return SceneMotion(np.zeros((1, 1), np.int32), np.zeros((1, 1, 3), np.float32), method="plain")

    assert estimate_pair(estimator, FramePair(SCENE.prev, SCENE.curr)).method == "plain"


def test_matches_are_kept_under_another_noise_model(calls: Counter[str]) -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    small, matches = pair.at_width(64), pair.matches
    other = pair.with_noise(DepthNoise(base=0.01))
    assert other.matches is matches
    assert calls["match_frames"] == 1
    assert other.at_width(64).curr is small.curr
    assert other.target is not pair.target
    assert other.target.noise == DepthNoise(base=0.01)


def test_matches_are_carried_to_another_view_of_the_previous_frame(calls: Counter[str]) -> None:
    pair = FramePair(SCENE.prev, SCENE.curr)
    turn, shift = geometry.so3_exp(np.array([0.02, -0.01, 0.03])), np.array([0.01, 0.0, -0.02])
    seen_T_prev = geometry.make_transform(turn, shift)
    seen = pair.with_previous(SCENE.prev, seen_T_prev).with_noise(DEPTH_NOISE["stereo"])
    assert calls["match_frames"] == 0
    for width in (320, 160):
        found, given = seen.at_width(width).matches, pair.at_width(width).matches
        assert len(given.curr) > 100
        np.testing.assert_array_equal(found.pixels, given.pixels)
        np.testing.assert_array_equal(found.curr, given.curr)
        np.testing.assert_allclose(found.prev, given.prev @ turn.T + shift, atol=1e-6)
    assert calls["match_frames"] == 2  # once for each width


def test_features_of_a_downscaled_frame_lie_on_the_pixels_of_the_frame() -> None:
    scene = analytic.make_scene(4, objects=(2, 2), width=640, height=480)
    medians = {}
    for width in (640, 320):
        found = feature_matches(scene.prev, scene.curr, MatchSettings(feature_width=width))
        column, row = np.rint(found.pixels).astype(int).T
        truth = found.curr + scene.scene_flow[row, column]
        medians[width] = float(np.median(np.linalg.norm(found.prev - truth, axis=1)))
        assert len(found.curr) > 50
    # A systematic shift by half a pixel would be 1.6 mm at a metre.
    assert medians[320] < 2 * medians[640] + 2e-4
    assert medians[320] < 1e-3
