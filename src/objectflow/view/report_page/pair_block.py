"""The page's data of one pair: both frames, the points, and a layer for the truth and for each method."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.results import EvaluationPair
from objectflow.motion import SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage, UInt8Array
from objectflow.view.colors import Rgb, object_color
from objectflow.view.flow import flow_range
from objectflow.view.report_page.packing import millimetres, pack_bytes, pack_photo, pack_words

MAX_POINTS = 20_000
"""Maximum number of points in a pair's 3D view."""

MAX_IMAGE_WIDTH = 400
"""Maximum width of an image in the gallery, pixels."""

TRUTH = -1
"""Index of the truth's layer; methods count from 0."""

_DEPTH_STEP = 0.0005
"""Smallest quantisation step of depth, metres."""
_MAX_LABELS = 255


class _LayerObject(NamedTuple):
    """An object of a layer: its value in the label image, name, colour, centre and motion without the camera's."""

    label: int
    name: str
    color: Rgb
    center: Float64Array
    own_prev_T_curr: Float64Array
    rotation_known: bool


def make_pair_block(
    pair: EvaluationPair, predictions: Mapping[int, SceneMotion], scores: Mapping[int, PairScore]
) -> dict[str, Any]:
    """The JSON data of one pair.

    Args:
        pair: frames and truth.
        predictions: by method index, without failed methods.
        scores: by method index; their matches assign the colours of true objects to predicted ones.
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
    points = geometry.back_project(curr.depth, curr.camera)
    true_flow = _without_camera(truth.scene_flow, points, truth)
    moved = -true_flow[np.isfinite(true_flow).all(axis=-1)].astype(np.float64)
    layers = [_layer(TRUTH, truth.labels, true_flow, _true_objects(truth, points), curr.valid, grid, small, size)]
    for method, motion in predictions.items():
        objects = _predicted_objects(motion, truth, scores.get(method))
        # The true motion of the camera is taken out, so that the differences of flows remain their errors.
        flow = _without_camera(motion.scene_flow, points, truth)
        layers.append(_layer(method, motion.labels, flow, objects, curr.valid, grid, small, size))
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
    objects: Iterable[_LayerObject],
    valid: BoolMask,
    grid: tuple[slice, slice],
    small: int,
    size: tuple[int, int],
) -> dict[str, Any]:
    # Labels are stored as bytes, so only the first 255 objects are shown.
    shown = sorted(objects, key=lambda obj: obj.label)[:_MAX_LABELS]
    byte_of_label = np.zeros(int(max(labels.max(initial=0), 0)) + 1, np.uint8)
    for index, obj in enumerate(shown):
        if obj.label < len(byte_of_label):
            byte_of_label[obj.label] = index + 1
    picture = labels[small // 2 :: small, small // 2 :: small][: size[1], : size[0]]
    return {
        "method": method,
        "labels": pack_bytes(byte_of_label[picture]),
        "flow": pack_words(millimetres(flow[grid], valid[grid])),
        "colors": [None, *(obj.color for obj in shown)],
        "objects": [_object(obj) for obj in shown],
    }


def _object(obj: _LayerObject) -> dict[str, Any]:
    moved = geometry.transform(obj.own_prev_T_curr, obj.center) - obj.center
    angle = math.degrees(float(geometry.rotation_angle(obj.own_prev_T_curr[:3, :3])))
    return {
        "name": obj.name,
        "color": obj.color,
        "center": [round(float(value), 5) for value in obj.center],
        "translation": [round(float(value), 5) for value in moved],
        "degrees": round(angle, 2) if obj.rotation_known else None,
    }


def _without_camera(flow: Float32Array, points: Float32Array, truth: PairTruth) -> Float32Array:
    """Scene flow (H, W, 3) against the world: the true motion of the camera is taken out."""
    camera = truth.background_prev_T_curr
    if camera is None:
        return flow
    return (geometry.transform(geometry.inverse(camera), points + flow) - points).astype(np.float32)


def _true_objects(truth: PairTruth, points: Float32Array) -> list[_LayerObject]:
    camera = truth.background_prev_T_curr
    curr_T_prev = np.eye(4) if camera is None else geometry.inverse(camera)
    centers = geometry.surface_centers(points, truth.labels)
    return [
        _LayerObject(
            label=o.label,
            name=f"object {o.label}",
            color=object_color(o.label),
            center=centers.get(o.label, o.center),
            own_prev_T_curr=curr_T_prev @ o.prev_T_curr,
            rotation_known=o.rotation_known,
        )
        for o in truth.objects
    ]


def _predicted_objects(motion: SceneMotion, truth: PairTruth, score: PairScore | None) -> list[_LayerObject]:
    """Objects with the names and colours of their matched true objects; unmatched ones have unused colours."""
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
        shown.append(_LayerObject(obj.id, name, color, obj.center, obj.own_prev_T_curr, True))
    return shown


def _photo(color: UInt8Array, size: tuple[int, int]) -> str:
    if color.shape[1::-1] != size:
        color = np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return pack_photo(color)
