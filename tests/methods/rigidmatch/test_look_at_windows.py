"""`rigidmatch` on windows of a pair: sizes, windows without depth, threads, and the setting that switches it off."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

import analytic
import objectflow
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.methods.postprocess.look_windows import Window

SCENE = analytic.make_scene(7, objects=(3, 3))
WINDOWS = (Window(0, 0, 160, 120), Window(100, 60, 160, 120))


@pytest.fixture(autouse=True)
def restore_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def load(**settings: Any) -> Any:
    return objectflow.load("rigidmatch", camera="static", **settings)


def test_labels_and_objects_are_those_of_each_window() -> None:
    for labels, objects in load()._look(FramePair(SCENE.prev, SCENE.curr), WINDOWS):
        assert labels.shape == (120, 160)
        assert labels.dtype == np.int32
        assert {obj.id for obj in objects} == set(np.unique(labels[labels > 0]).tolist())
        for obj in objects:
            assert obj.pixels > 0


def test_a_window_shows_the_objects_of_the_scene() -> None:
    """The masks of the enlarged window are those of the true objects that lie within it."""
    ((labels, objects),) = load()._look(FramePair(SCENE.prev, SCENE.curr), (Window(80, 60, 160, 120),))
    true = SCENE.labels[60:180, 80:240]
    best = [
        max(((labels == obj.id) & (true == k)).sum() / ((labels == obj.id) | (true == k)).sum() for obj in objects)
        for k in np.unique(true[true > 0])
        if (true == k).sum() > 500
    ]
    assert best
    assert min(best) > 0.6


def test_a_window_without_depth_shows_nothing() -> None:
    depth = SCENE.prev.depth.copy()
    depth[:120, :160] = 0
    pair = FramePair(RgbdFrame(SCENE.prev.color, depth, SCENE.prev.camera), SCENE.curr)
    (labels, objects), _ = load()._look(pair, WINDOWS)
    assert not labels.any()
    assert objects == ()


def test_the_number_of_threads_does_not_change_what_is_seen() -> None:
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(load()._look(FramePair(SCENE.prev, SCENE.curr), WINDOWS))
    for (labels, objects), (same, others) in zip(*found, strict=True):
        np.testing.assert_array_equal(labels, same)
        assert [obj.to_dict() for obj in objects] == [obj.to_dict() for obj in others]


def test_the_frame_alone_is_seen_where_the_setting_says_so() -> None:
    """With objects of no probability, everything is left unexplained, and windows are looked at."""
    for detail, looks in (("frame", False), ("crops", True)):
        estimator = load(detail=detail, threshold=0.999)
        asked: list[Window] = []
        look = estimator._look

        def record(pair: FramePair, windows: tuple[Window, ...]) -> Any:
            asked.extend(windows)  # noqa: B023
            return look(pair, windows)  # noqa: B023

        object.__setattr__(estimator, "_look", record)
        steps = dataclasses.replace(estimator.postprocess, steps=("second_look",))
        object.__setattr__(estimator, "postprocess", steps)
        estimator(SCENE.prev, SCENE.curr)
        assert bool(asked) is looks


def test_the_closer_method_has_the_same_network_and_looks_at_windows() -> None:
    estimator = load()
    closer = estimator.closer()
    assert closer.network is estimator.network
    assert (estimator.detail, closer.detail) == ("frame", "crops")
    assert closer.to_dict() == {**estimator.to_dict(), "detail": "crops"}
