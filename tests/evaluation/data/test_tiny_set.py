"""The packaged set is complete, small, and consistent with its manifest."""

from __future__ import annotations

import numpy as np

from objectflow.dataset.manifest import Manifest, verify
from objectflow.evaluation.data.sources import TINY_FOLDER, open_set


def test_it_is_whole_and_small() -> None:
    assert verify(TINY_FOLDER, Manifest.read(TINY_FOLDER)) == 1
    assert sum(file.stat().st_size for file in TINY_FOLDER.iterdir()) < 3_000_000


def test_every_pair_has_objects_that_move_and_depth_that_agrees_with_labels() -> None:
    pairs = open_set("tiny")
    assert len(pairs.keys) == 16
    moving = 0
    for key in pairs.keys:
        pair = pairs.pair(key)
        assert (pair.curr.camera.width, pair.curr.camera.height) == (320, 240)
        assert np.array_equal(np.isfinite(pair.truth.scene_flow).all(axis=-1), pair.curr.valid)
        assert not pair.truth.scene_flow[(pair.truth.labels == 0) & pair.curr.valid].any()
        assert set(np.unique(pair.truth.labels)) - {0} == {obj.label for obj in pair.truth.objects}
        moving += len(pair.truth.moving)
    assert moving > 16
