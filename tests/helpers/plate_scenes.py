"""Textured plates before a wall, with their true labels and motions, for tests of sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from objectflow import SequenceEstimator
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking import SequenceStep
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.tracker import Tracker
from objectflow.typing import BoolMask, LabelImage

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
ROWS, COLUMNS = np.mgrid[0:120, 0:160]
TEXTURE = np.random.default_rng(5).integers(60, 200, (6, 6, 3), dtype=np.uint8)
"""Colours of a plate, squares of 4 cm."""
Place = tuple[float, float, float]


class PlateScene:
    """Textured square plates of 24 cm before a wall at 2 m; 2 never moves, and 9 hides others.

    Every call renders the frame and the true labels of the plates at their centres (x, y, z), metres.
    """

    def __init__(self) -> None:
        self.labels: dict[int, LabelImage] = {}
        self.places: dict[int, dict[int, Place]] = {}

    def frame(self, number: int, places: dict[int, Place], noise: float = 0.0) -> RgbdFrame:
        depth = np.full((120, 160), 2.0, np.float32)
        color = np.full((120, 160, 3), 120, np.uint8)
        labels = np.zeros((120, 160), np.int32)
        for plate, (x, y, z) in sorted(places.items(), key=lambda item: -item[1][2]):
            u, v = (COLUMNS - 79.5) / 150 * z - x + 0.12, (ROWS - 59.5) / 150 * z - y + 0.12
            inside = (u >= 0) & (u < 0.24) & (v >= 0) & (v < 0.24)
            cells = (v[inside] * 25).astype(int), (u[inside] * 25).astype(int)
            color[inside], depth[inside], labels[inside] = np.roll(TEXTURE, plate, axis=2)[cells], z, plate
        depth += noise * np.random.default_rng(number).standard_normal(depth.shape).astype(np.float32)
        self.labels[number], self.places[number] = labels, places
        return RgbdFrame(color, depth, CAMERA, timestamp=float(number))

    def motion(self, number: int, error: Place = (0, 0, 0), since: int | None = None) -> SceneMotion:
        """The true motion of the plates that moved since a frame, the previous one if None, plus an error, metres."""
        before = self.places[number - 1 if since is None else since]
        after, labels = self.places[number], self.labels[number].copy()
        objects = []
        for plate in np.unique(labels[labels > 0]).tolist():
            if before.get(plate, after[plate]) == after[plate]:
                labels[labels == plate] = 0
                continue
            motion = np.eye(4)
            motion[:3, 3] = np.array(before[plate]) - after[plate] - error
            pixels = int((labels == plate).sum())
            objects.append(ObjectMotion(plate, pixels, 0.9, True, np.array(after[plate]), motion))
        return SceneMotion(labels, np.zeros((120, 160, 3), np.float32), tuple(objects))

    def estimator(self, last: int, usual: int, score: float) -> Callable[[RgbdFrame, RgbdFrame], SceneMotion]:
        """The true motions, but in the pair that ends with frame `last` the first plate's motion of pair `usual`."""

        def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
            number = round(curr.timestamp or 0)
            if number < last:
                return self.motion(number)
            known = self.motion(usual)
            labels = np.where(self.labels[last] == 1, 1, 0).astype(np.int32)
            return SceneMotion(labels, known.scene_flow, (replace(known.objects[0], score=score),))

        return estimate


def play(
    places: list[dict[int, Place]], error: Place = (0, 0, 0), noise: float = 0.0
) -> tuple[PlateScene, SequenceEstimator, list[SequenceStep]]:
    """Feed frames of the plates at these places; `error` of each motion and `noise` of depth in metres."""
    return play_changed(places, lambda number, motion: motion, error=error, noise=noise)


def play_changed(
    places: list[dict[int, Place]],
    change: Callable[[int, SceneMotion], SceneMotion],
    *,
    error: Place = (0, 0, 0),
    noise: float = 0.0,
    tracker: Tracker | None = None,
    settings: KnownSettings | None = None,
) -> tuple[PlateScene, SequenceEstimator, list[SequenceStep]]:
    """Like `play`, with the motion into each frame as `change` makes it of the frame's number and the true motion."""
    scene = PlateScene()
    frames = [scene.frame(number, here, noise) for number, here in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        number = round(curr.timestamp or 0)
        return change(number, scene.motion(number, error))

    sequence = SequenceEstimator(estimate, tracker=tracker, settings=settings)
    steps = [step for frame in frames if (step := sequence.update(frame)) is not None]
    return scene, sequence, steps


def iou(a: BoolMask, b: BoolMask) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))
