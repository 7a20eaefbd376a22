"""The three forms on images small enough to count by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from objectflow.errors import ResultError
from objectflow.evaluation.metrics.boundary import count_near, outlines, tolerance_pixels
from objectflow.evaluation.metrics.region_matching import assign_regions, compare
from objectflow.evaluation.metrics.segmentation_metrics import PRF, SegmentationScore, score_segmentation
from objectflow.typing import BoolMask, LabelImage

label_images = arrays(np.int32, (6, 7), elements=st.integers(0, 4))


def image(*rows: str) -> LabelImage:
    return np.array([[int(pixel) for pixel in row] for row in rows], dtype=np.int32)


def close(got: PRF, precision: float, recall: float, f: float) -> None:
    assert got == pytest.approx((precision, recall, f), abs=1e-12)


def test_one_object_found_too_large_and_one_missed() -> None:
    true = image("11000", "11000", "00022", "00022")
    guess = image("77700", "77700", "00000", "00000")
    score = score_segmentation(true, guess)
    # Sizes: true background 12, objects 4 and 4; predicted background 14, object 6.
    # Common pixels: background 10 (2 of its 12 lie under the 7), object 1 and 7: 4, object 2 and background: 4.
    # F = 2 common / (sum of sizes): 20/26, 8/10, 8/18. Best sum: background-background, 1-7; object 2 is unmatched.
    # P of the pairs 10/14 and 4/6, R 10/12 and 4/4.
    # FBMS: P = (5/7 + 2/3 + 1) / 3 = 50/63, R = (5/6 + 1 + 0) / 3 = 11/18, F = 2PR / (P + R) = 1100/1593.
    close(score.fbms, 50 / 63, 11 / 18, 1100 / 1593)
    # mean-F: P = (5/7 + 2/3 + 0) / 3 = 29/63, the same R, F = (10/13 + 4/5 + 0) / 3 = 34/65: no harmonic mean.
    close(score.mean_f, 29 / 63, 11 / 18, 34 / 65)
    # UOIS: 4 matched pixels of 6 predicted and of 8 true: P = 2/3, R = 1/2, F = 4/7.
    close(score.overlap, 2 / 3, 1 / 2, 4 / 7)
    # Outlines (pixels that differ from the right, lower or lower right neighbour): object 1 has (0,1) (1,0) (1,1);
    # 7 has (0,2) (1,0) (1,1) (1,2); object 2, in the corner, has (1,2) (1,3) (1,4) (2,2) (3,2). After dilation by 1
    # pixel (a cross), all four of 7 and all three of object 1 are matched: P = 4/4, R = 3 / (3 + 5), F = 6/11.
    close(score.boundary, 1, 3 / 8, 6 / 11)
    assert (score.fbms_extracted, score.extracted, score.overlap_extracted) == (1, 1, 1)  # F = 0.8
    assert (score.true_objects, score.predicted_objects) == (2, 1)
    (match,) = score.matches
    assert match[:2] == (1, 7)
    assert match.f == pytest.approx(0.8)


def test_two_objects_taken_for_one() -> None:
    true = image("1122000000")
    guess = image("3333000000")
    score = score_segmentation(true, guess)
    # F of 3 with 1 and with 2 is 4/6 each: one is matched (P 1/2, R 1), the other is not; background is perfect.
    # FBMS: P = (1 + 1/2 + 1) / 3 = 5/6, R = (1 + 1 + 0) / 3 = 2/3, F = (10/9) / (3/2) = 20/27.
    close(score.fbms, 5 / 6, 2 / 3, 20 / 27)
    # mean-F: P = (1 + 1/2) / 3, R = 2/3, F = (1 + 2/3) / 3.
    close(score.mean_f, 1 / 2, 2 / 3, 5 / 9)
    # UOIS: 2 matched pixels of 4 and of 4.
    close(score.overlap, 1 / 2, 1 / 2, 1 / 2)
    assert score.extracted == 0


def test_surplus_predictions_cost_nothing_in_fbms_and_precision_in_uois() -> None:
    true = image("1111000000")
    guess = image("1111000022")
    score = score_segmentation(true, guess)
    # Background: 4 common of 6 true and 4 predicted, F = 8/10, against 2 common of 6 and 2 with the surplus, F = 4/8.
    close(score.fbms, 1, (1 + 4 / 6) / 2, 2 * (5 / 6) / (1 + 5 / 6))
    close(score.mean_f, 1, 5 / 6, (1 + 0.8) / 2)
    # 4 matched pixels of 6 predicted, of 4 true.
    close(score.overlap, 4 / 6, 1, 0.8)
    assert score.extracted == 1


def test_a_prediction_elsewhere_is_no_match() -> None:
    true = image("1000000000")
    guess = image("0000000005")
    score = score_segmentation(true, guess)
    # Background-background: 8 common of 9 and 9. Object 1 has no common pixel with the other region: P = 1, R = 0.
    close(score.fbms, (8 / 9 + 1) / 2, 4 / 9, 2 * (17 / 18) * (8 / 18) / (25 / 18))
    close(score.mean_f, 4 / 9, 4 / 9, 4 / 9)
    close(score.overlap, 0, 0, 0)
    assert score.matches == ()


def test_background_is_a_region_like_others_in_fbms() -> None:
    # An object that fills most of the image is matched with the predicted background: 8 common of 8 and 10,
    # F = 16/18 > 0.75. The true background is unmatched. In UOIS there is no prediction.
    score = score_segmentation(image("1111111100"), image("0000000000"))
    close(score.fbms, (8 / 10 + 1) / 2, 1 / 2, 2 * 0.9 * 0.5 / 1.4)
    close(score.mean_f, 0.4, 0.5, (16 / 18) / 2)
    close(score.overlap, 1, 0, 0)
    assert (score.extracted, score.overlap_extracted) == (1, 0)


def test_extracted_at_exactly_three_quarters() -> None:
    # 3 common of 3 and 5: F = 6/8 = 0.75, which counts in the headline but not in FBMS.
    score = score_segmentation(image("111000000000"), image("111110000000"))
    assert (score.fbms_extracted, score.extracted, score.overlap_extracted) == (0, 1, 1)


def test_images_without_objects() -> None:
    nothing, something = image("0000", "0000"), image("0110", "0110")
    missed = score_segmentation(something, nothing)
    close(missed.overlap, 1, 0, 0)
    close(missed.boundary, 1, 0, 0)
    # Background and object both have 4 common pixels of 4 and 8. One of them is matched (P 1/2, R 1).
    close(missed.fbms, 3 / 4, 1 / 2, 3 / 5)
    invented = score_segmentation(nothing, something)
    close(invented.overlap, 0, 1, 0)
    close(invented.boundary, 0, 1, 0)
    close(invented.fbms, 1, 1 / 2, 2 / 3)
    empty = score_segmentation(nothing, nothing)
    for form in (empty.fbms, empty.mean_f, empty.overlap, empty.boundary):
        close(form, 1, 1, 1)
    assert (empty.true_objects, empty.extracted) == (0, 0)


def test_an_object_that_fills_the_image_has_no_outline() -> None:
    full = image("1111", "1111")
    close(score_segmentation(full, full).boundary, 1, 1, 1)
    close(score_segmentation(full, full).overlap, 1, 1, 1)
    close(score_segmentation(full, image("1100", "1100")).boundary, 0, 1, 0)


def test_labels_that_cannot_be_scored() -> None:
    with pytest.raises(ResultError, match="do not fit"):
        score_segmentation(image("01"), image("0"))
    with pytest.raises(ResultError, match="above, not -1"):
        score_segmentation(image("01"), np.array([[0, -1]], np.int32))
    with pytest.raises(ResultError, match="integers"):
        score_segmentation(image("01"), np.array([[0.0, 1.0]]))


@pytest.mark.parametrize(("height", "width", "pixels"), [(240, 320, 2), (480, 640, 3), (720, 1280, 5), (10, 10, 1)])
def test_tolerance(height: int, width: int, pixels: int) -> None:
    # 0.003 x 400 = 1.2, x 800 = 2.4, x 1468.6 = 4.4, x 14.1 = 0.04; rounded up.
    assert tolerance_pixels(height, width) == pixels


@given(label_images)
def test_outlines_are_those_of_each_mask_alone(labels: LabelImage) -> None:
    got = outlines(labels)
    height, width = labels.shape
    for label in range(1, 5):
        expected = set()
        for y, x in itertools.product(range(height), range(width)):
            near = [(y + dy, x + dx) for dy, dx in ((0, 1), (1, 0), (1, 1)) if y + dy < height and x + dx < width]
            if any((labels[v, u] == label) != (labels[y, x] == label) for v, u in near):
                expected.add((y, x))
        assert {(int(y), int(x)) for y, x in got.get(label, np.empty((0, 2), np.int64))} == expected


@given(arrays(np.bool_, (5, 8)), arrays(np.bool_, (5, 8)), st.integers(1, 4))
def test_count_near_against_all_distances(a: BoolMask, b: BoolMask, radius: int) -> None:
    p, q = np.argwhere(a), np.argwhere(b)
    distances = np.linalg.norm(p[:, None].astype(float) - q[None], axis=-1)
    assert count_near(p, q, radius, 5, 8) == int((distances <= radius).any(1).sum())


@given(label_images, label_images)
def test_the_assignment_is_the_best_of_all(true: LabelImage, guess: LabelImage) -> None:
    regions = compare(true, guess)
    f = regions.f
    wide = f if f.shape[0] <= f.shape[1] else f.T
    best = max(
        sum(wide[i, j] for i, j in enumerate(columns))
        for columns in itertools.permutations(range(wide.shape[1]), wide.shape[0])
    )
    pairs = assign_regions(regions)
    assert sum(f[i, j] for i, j in pairs) == pytest.approx(best, abs=1e-12)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)


@given(label_images, label_images)
def test_overlaps_are_counts(true: LabelImage, guess: LabelImage) -> None:
    regions = compare(true, guess)
    for (i, t), (j, p) in itertools.product(enumerate(regions.true_ids), enumerate(regions.predicted_ids)):
        assert regions.overlap[i, j] == ((true == t) & (guess == p)).sum()
        assert (regions.true_sizes[i], regions.predicted_sizes[j]) == ((true == t).sum(), (guess == p).sum())


def numbers(score: SegmentationScore) -> tuple[object, ...]:
    forms = (score.fbms, score.mean_f, score.overlap, score.boundary)
    return forms, score.fbms_extracted, score.extracted, score.overlap_extracted, score.true_objects


@settings(max_examples=200)
@given(label_images, label_images, st.permutations(range(1, 5)), st.permutations([1, 3, 50, 100_000]))
def test_renumbering_objects_changes_nothing(
    true: LabelImage, guess: LabelImage, true_names: list[int], guess_names: list[int]
) -> None:
    renamed_true = np.array([0, *true_names], np.int32)[true]
    renamed_guess = np.array([0, *guess_names], np.int32)[guess]
    assert numbers(score_segmentation(true, guess)) == numbers(score_segmentation(renamed_true, renamed_guess))


@given(label_images)
def test_the_truth_scores_one(true: LabelImage) -> None:
    score = score_segmentation(true, true.copy())
    for form in (score.fbms, score.mean_f, score.overlap, score.boundary):
        assert form == (1, 1, 1)
    count = len(set(true.ravel().tolist()) - {0})
    assert score.extracted == score.fbms_extracted == score.overlap_extracted == score.true_objects == count


@given(label_images, label_images)
def test_every_share_is_a_share(true: LabelImage, guess: LabelImage) -> None:
    score = score_segmentation(true, guess)
    for form in (score.fbms, score.mean_f, score.overlap, score.boundary):
        assert all(0 <= value <= 1 + 1e-12 for value in form)
    # mean-F gives an unmatched region less precision than FBMS, and is otherwise the same.
    assert score.mean_f.precision <= score.fbms.precision + 1e-12
    assert score.mean_f.recall == pytest.approx(score.fbms.recall)


@given(label_images)
def test_all_background(true: LabelImage) -> None:
    score = score_segmentation(true, np.zeros_like(true))
    assert score.overlap == ((1, 0, 0) if true.any() else (1, 1, 1))
    # Only a mask of the whole image has no outline to miss.
    assert score.boundary == ((1, 0, 0) if (true != true[0, 0]).any() else (1, 1, 1))
    assert score.matches == ()
