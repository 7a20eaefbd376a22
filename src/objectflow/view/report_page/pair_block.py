"""What the page holds of one pair: both frames, the points, and a layer for the truth and for each method."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np

from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.results import EvaluationPair
from objectflow.geometry.se3 import so3_log, transform
from objectflow.motion import SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage, UInt8Array
from objectflow.view.colors import Rgb, object_color
from objectflow.view.flow import flow_range
from objectflow.view.report_page.packing import millimetres, pack_bytes, pack_photo, pack_words

MAX_POINTS = 20_000
"""Of a pair's 3D view."""

MAX_IMAGE_WIDTH = 400
"""Pixels of a picture in the gallery."""

TRUTH = -1
"""The number of the truth's layer; methods count from 0."""

_DEPTH_STEP = 0.0005
_MOST_LABELS = 255


class _Shown(NamedTuple):
    """An object as the page shows it: its value in a label image, its name and colour there, its motion if known."""

    label: int
    name: str
    color: Rgb
    center: Float64Array
    prev_T_curr: Float64Array
    turn_known: bool


def make_pair_block(
    pair: EvaluationPair, predictions: Mapping[int, SceneMotion], scores: Mapping[int, PairScore]
) -> dict[str, Any]:
    """The JSON of one pair.

    Args:
        pair: frames and truth.
        predictions: by the method's number; a method that failed is left out.
        scores: likewise; they tell which predicted object stands for which true one, and so has its colour.
    """
    curr, truth = pair.curr, pair.truth
    height, width = truth.labels.shape
    stride = max(1, math.ceil(math.sqrt(height * width / MAX_POINTS)))
    while len(range(stride // 2, width, stride)) * len(range(stride // 2, height, stride)) > MAX_POINTS:
        stride += 1
    grid = (slice(stride // 2, None, stride),) * 2
    depth = curr.depth[grid]
    step = max(_DEPTH_STEP, float(depth.max(initial=0)) / 65535)
    small = math.ceil(width / MAX_IMAGE_WIDTH)
    size = (width // small, height // small)
    camera = curr.camera
    moved = -truth.scene_flow[np.isfinite(truth.scene_flow).all(axis=-1)].astype(np.float64)
    layers = [_layer(TRUTH, truth.labels, truth.scene_flow, _true_objects(truth), curr.valid, grid, small, size)]
    for method, motion in predictions.items():
        shown = _predicted_objects(motion, truth, scores.get(method))
        layers.append(_layer(method, motion.labels, motion.scene_flow, shown, curr.valid, grid, small, size))
    return {
        "prev": _photo(pair.prev.color, size),
        "curr": _photo(curr.color, size),
        "image": size,
        "image_stride": small,
        "grid": (depth.shape[1], depth.shape[0]),
        "stride": stride,
        "offset": stride // 2,
        "camera": (camera.fx, camera.fy, camera.cx, camera.cy),
        "depth": pack_words(np.rint(depth / step).astype(np.uint16).view(np.int16)),
        "depth_step": step,
        "full": flow_range(moved),
        "layers": layers,
    }


def _layer(
    method: int,
    labels: LabelImage,
    flow: Float32Array,
    objects: Iterable[_Shown],
    valid: BoolMask,
    grid: tuple[slice, slice],
    small: int,
    size: tuple[int, int],
) -> dict[str, Any]:
    # Should there be more objects than a byte can count, the first ones are shown.
    shown = sorted(objects, key=lambda obj: obj.label)[:_MOST_LABELS]
    place = np.zeros(int(max(labels.max(initial=0), 0)) + 1, np.uint8)
    for index, obj in enumerate(shown):
        if obj.label < len(place):
            place[obj.label] = index + 1
    picture = labels[small // 2 :: small, small // 2 :: small][: size[1], : size[0]]
    return {
        "method": method,
        "labels": pack_bytes(place[picture]),
        "flow": pack_words(millimetres(flow[grid], valid[grid])),
        "colors": [None, *(obj.color for obj in shown)],
        "objects": [_object(obj) for obj in shown],
    }


def _object(obj: _Shown) -> dict[str, Any]:
    moved = transform(obj.prev_T_curr, obj.center) - obj.center
    angle = math.degrees(float(np.linalg.norm(so3_log(obj.prev_T_curr[:3, :3]))))
    return {
        "name": obj.name,
        "color": obj.color,
        "center": [round(float(value), 5) for value in obj.center],
        "translation": [round(float(value), 5) for value in moved],
        "degrees": round(angle, 2) if obj.turn_known else None,
    }


def _true_objects(truth: PairTruth) -> list[_Shown]:
    return [
        _Shown(o.label, f"object {o.label}", object_color(o.label), o.center, o.prev_T_curr, o.rotation_known)
        for o in truth.objects
    ]


def _predicted_objects(motion: SceneMotion, truth: PairTruth, score: PairScore | None) -> list[_Shown]:
    """Named and coloured as the true objects that they stand for; others have colours that no true object has."""
    matches = {} if score is None else {match.predicted: match for match in score.segmentation.matches}
    spare = max((obj.label for obj in truth.objects), default=0)
    shown = []
    for obj in motion.objects:
        match = matches.get(obj.id)
        if match is None:
            spare += 1
            name, color = f"extra {obj.id}", object_color(spare)
        else:
            name, color = f"object {match.true}, F {match.f:.2f}", object_color(match.true)
        shown.append(_Shown(obj.id, name, color, obj.center, obj.prev_T_curr, True))
    return shown


def _photo(color: UInt8Array, size: tuple[int, int]) -> str:
    if color.shape[1::-1] != size:
        color = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return pack_photo(color)
