"""Two plates that touch and are two objects to the method: one object if they always move as one."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.plate_scenes import Place, iou, play

STILL: Place = (0.3, 0.25, 1.2)
STEP = 0.02
"""Metres per frame."""


def pair_of_plates(count: int, gap: float = 0.0) -> list[dict[int, Place]]:
    """Plates 1 and 3 slide by `STEP` from frame to frame; `gap` metres lie between their edges."""
    return [{1: (-0.32 + STEP * k, 0.0, 1.0), 3: (-0.08 + gap + STEP * k, 0.0, 1.0), 2: STILL} for k in range(count)]


def test_two_pieces_that_always_move_as_one_become_one_with_the_older_id() -> None:
    scene, sequence, steps = play([*pair_of_plates(8), *[pair_of_plates(8)[-1]] * 2])
    (track,) = sequence.tracks
    assert (track.id, track.merged) == (1, [2])
    merged = next(number for number, step in enumerate(steps, start=1) if set(step.tracks.values()) == {1})
    # The first step makes both known; three more are needed.
    assert merged == 4
    assert set(steps[merged - 1].revised) == set(range(merged))
    for number, step in enumerate(steps, start=1):
        both = (scene.labels[number] == 1) | (scene.labels[number] == 3)
        assert set(np.unique(step.known)) == ({0, 1, 2} if number < merged else {0, 1})
        if number >= merged:
            assert iou(step.known == 1, both) > 0.9
    for number in range(1, merged):
        both = (scene.labels[number] == 1) | (scene.labels[number] == 3)
        assert iou(steps[merged - 1].revised[number] == 1, both) > 0.9
    moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
    np.testing.assert_allclose(moved, [7 * STEP, 0, 0], atol=0.003)
    assert track.model is not None
    assert np.ptp(track.model.points, axis=0)[0] == pytest.approx(0.48, abs=0.03)


def test_two_that_do_not_touch_or_have_moved_apart_stay_two() -> None:
    _, sequence, _ = play(pair_of_plates(9, gap=0.06))
    assert len(sequence.tracks) == 2
    apart = [{**here, 3: (here[3][0] + 0.01 * min(k, 2), *here[3][1:])} for k, here in enumerate(pair_of_plates(9))]
    _, sequence, _ = play(apart)
    assert [track.merged for track in sequence.tracks] == [[], []]


def test_one_that_moved_alone_before_is_not_a_piece_of_what_it_carries() -> None:
    """Plate 1 slides to plate 3, which then moves with it."""
    alone = [{1: (-0.4 + STEP * k, 0.0, 1.0), 3: (-0.08, 0.0, 1.0), 2: STILL} for k in range(4)]
    _, sequence, _ = play([*alone, *pair_of_plates(9)[1:]])
    assert len(sequence.tracks) == 2
