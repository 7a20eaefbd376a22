"""A sequence gives the same bits with one and with two threads."""

from __future__ import annotations

import numpy as np
import torch

import objectflow
from live import Recording


def test_one_and_two_threads_give_the_same_sequence() -> None:
    recording = Recording(160, 200)
    estimator = objectflow.load("rigidmatch")
    before = torch.get_num_threads()
    known, tracks = [], []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            sequence = objectflow.SequenceEstimator(estimator)
            for index in range(0, 40, 10):
                sequence.update(recording[index])
            assert sequence.segmentation is not None
            known.append(sequence.segmentation)
            tracks.append([pose for track in sequence.tracks for pose in track.world_T_object])
    finally:
        torch.set_num_threads(before)
    assert len(np.unique(known[0])) > 1
    assert np.array_equal(*known)
    assert np.array_equal(*tracks)
