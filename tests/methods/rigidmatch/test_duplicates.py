"""Several queries on one object, merged."""

import pytest
import torch

from objectflow.methods.rigidmatch.duplicates import MAX_LOGIT, merge_duplicates


def squares(*columns: tuple[int, int], value: float = 4.0) -> torch.Tensor:
    """Mask logits (K, 16, 32): rows 4 to 12 of the given columns."""
    out = torch.full((len(columns), 16, 32), -value)
    for k, (start, stop) in enumerate(columns):
        out[k, 4:12, start:stop] = value
    return out


def test_masks_of_one_object_become_their_weighted_mean() -> None:
    logits = squares((0, 8), (16, 24), (0, 10))
    probability = torch.tensor([0.3, 0.5, 0.6])
    merged = merge_duplicates(logits, probability, 0.5)
    assert merged.best.tolist() == [1, 2]
    assert merged.probability.tolist() == pytest.approx([0.5, 1 - 0.4 * 0.7])
    torch.testing.assert_close(merged.logits[0], logits[1])
    torch.testing.assert_close(merged.logits[1], (0.6 * logits[2] + 0.3 * logits[0]) / 0.9)


def test_only_overlaps_above_the_threshold_are_merged() -> None:
    logits = squares((0, 8), (0, 16))  # an intersection over union of one half
    probability = torch.tensor([0.5, 0.4])
    assert merge_duplicates(logits, probability, 0.51).best.tolist() == [0, 1]
    assert merge_duplicates(logits, probability, 0.49).best.tolist() == [0]
    assert merge_duplicates(logits, probability, 1).best.tolist() == [0, 1]


def test_empty_masks_and_no_masks_are_kept_apart() -> None:
    empty = torch.full((2, 4, 4), -1.0)
    assert len(merge_duplicates(empty, torch.tensor([0.5, 0.4]), 0.5).best) == 2
    nothing = merge_duplicates(empty[:0], torch.zeros(0), 0.5)
    assert len(nothing.logits) == len(nothing.probability) == len(nothing.best) == 0


def test_a_query_of_large_logits_does_not_outweigh_the_others() -> None:
    logits = torch.cat([squares((0, 8), value=100.0), squares((0, 10), value=6.0)])
    merged = merge_duplicates(logits, torch.tensor([0.5, 0.5]), 0.5)
    torch.testing.assert_close(merged.logits[0, 5, 9], torch.tensor((6 - MAX_LOGIT) / 2))
