"""The graph of neighbouring pixels, weighted by how probably they lie on one surface, and its components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from objectflow.alignment.likelihood import EVERYWHERE, Box
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.geometry.normals import surface_normals
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


@dataclass(frozen=True)
class PixelGraphSettings(Settings):
    """Weights of the edges between neighbouring pixels; the weight of a certain pixel's own label is 1."""

    edge_weight: float = setting(30.0, above=0)
    """Weight between two pixels of one smooth surface of even colour."""
    depth_slope: float = setting(0.008, minimum=0)
    """Depth difference that one surface may have between neighbouring pixels, relative to its depth."""
    depth_sigmas: float = setting(3.0, minimum=0)
    """The same in standard deviations of depth, in addition."""
    color_scale: float = setting(25.0, above=0)
    """Grey levels: scale of the colour differences that weaken an edge."""
    min_color_similarity: float = setting(0.12, minimum=0, maximum=1)
    """Factor on an edge across any difference of colour: colour alone may be print, so it weakens an edge only."""
    color_blur: float = setting(0.7, above=0)
    """Pixels: standard deviation of the blur of colours before they are compared."""
    depth_window: Literal[3, 5] = 5
    """Pixels: width of the median filter of depth before normals are computed."""
    holes_factor: float = setting(0.05, minimum=0, maximum=1)
    """Factor on the edges of pixels without depth."""
    holes_color_scale: float = setting(15.0, above=0)
    """Grey levels: `color_scale` of pixels without depth."""
    min_weight: float = setting(0.02, above=0)
    """Weight added to every edge, so that the graph stays connected."""
    step_weight: float = setting(0.01, above=0)
    """Weight of an edge across a depth step."""
    crease_cosine: float = setting(0.97, minimum=-1, maximum=1)
    """Cosine of the angle between two normals below which a concave edge is a crease."""
    crease_factor: float = setting(0.15, minimum=0, maximum=1)
    """Factor on the weight across a crease."""


class PixelGraph:
    """Edges between neighbouring pixels of a box of a frame; weak across depth steps, creases and colour edges.

    Attributes:
        shape: (H, W) of the box.
        head, tail: (E,) flat indices of the two pixels of each edge.
        step: (E,) bool: a depth step lies between them.
        laplacian: (H W, H W) of the weighted graph.
    """

    def __init__(
        self, prepared: PreparedFrame, noise: DepthNoise, settings: PixelGraphSettings, box: Box = EVERYWHERE
    ) -> None:
        frame = prepared.frame
        normals = surface_normals(cv2.medianBlur(frame.depth, settings.depth_window), frame.camera)[box]
        color = cv2.GaussianBlur(frame.color, (0, 0), settings.color_blur)[box].astype(np.float32)
        depth, points = frame.depth[box], prepared.points[box]
        self.shape = depth.shape
        index = np.arange(depth.size).reshape(depth.shape)
        heads, tails, weights, steps = [], [], [], []
        for here, there in (
            ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
            ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
        ):
            weight, step = _edge_weights(depth, points, normals, color, noise, settings, here, there)
            heads.append(index[here].ravel())
            tails.append(index[there].ravel())
            weights.append(weight.ravel())
            steps.append(step.ravel())
        self.head, self.tail = np.concatenate(heads), np.concatenate(tails)
        self.step = np.concatenate(steps)
        n = depth.size
        half = sparse.coo_array((np.concatenate(weights), (self.head, self.tail)), shape=(n, n)).tocsr()
        whole = half + half.T
        self.laplacian: sparse.csr_array = (sparse.diags_array(np.asarray(whole.sum(axis=1)).ravel()) - whole).tocsr()

    def components(self, labels: LabelImage) -> LabelImage:
        """(H, W) numbers of the components of each label, which depth steps divide."""
        flat = labels.ravel()
        joined = (flat[self.head] == flat[self.tail]) & ~self.step
        n = flat.size
        graph = sparse.coo_array(
            (np.ones(joined.sum(), np.int8), (self.head[joined], self.tail[joined])), shape=(n, n)
        )
        _, numbers = csgraph.connected_components(graph, directed=False)
        return np.asarray(numbers.reshape(self.shape), dtype=np.int32)


def _edge_weights(
    depth: Float32Array,
    points: Float32Array,
    normals: Float32Array,
    color: Float32Array,
    noise: DepthNoise,
    settings: PixelGraphSettings,
    here: Any,
    there: Any,
) -> tuple[Float64Array, BoolMask]:
    """Weights of the edges between pixels `here` and `there`, and which of them cross a depth step."""
    z0, z1 = depth[here], depth[there]
    both = (z0 > 0) & (z1 > 0)
    gap = np.abs(z0 - z1)
    # At a width of 320, a surface tilted by 75 degrees changes its depth by about 1.5% per pixel.
    far = np.maximum(z0, z1)
    allowed = settings.depth_slope * far + settings.depth_sigmas * noise.sigma(far)
    step = both & (gap > allowed)
    with np.errstate(invalid="ignore"):
        turn = ((normals[there] - normals[here]) * (points[there] - points[here])).sum(-1)
        crease = (turn < 0) & ((normals[there] * normals[here]).sum(-1) < settings.crease_cosine)
    change = np.abs(color[here] - color[there]).max(-1)
    # A colour edge alone may be print, so it only weakens an edge; depth steps and creases cut it.
    similar = settings.min_color_similarity + (1 - settings.min_color_similarity) * np.exp(
        -((change / settings.color_scale) ** 2)
    )
    weight = settings.edge_weight * similar * np.exp(-((gap / allowed) ** 2)) + settings.min_weight
    weight = np.where(crease, settings.crease_factor * weight, weight)
    holes = settings.holes_factor * settings.edge_weight * np.exp(-((change / settings.holes_color_scale) ** 2))
    weight = np.where(both, weight, holes + settings.min_weight)
    return np.where(step, settings.step_weight, weight), step


_MAX_PIECES = 40
"""Largest pieces of one label that are searched for joins; the others are specks, and time grows with their square."""


def split_regions(
    labels: LabelImage, points: Float32Array, graph: PixelGraph, *, min_pixels: int, gap: float
) -> list[tuple[int, BoolMask]]:
    """Masks of the separate objects of each label; pieces closer than `gap` metres are one object.

    Args:
        labels: (H, W), 0 = background.
        points: (H, W, 3) metres.
        graph: of the same frame.
        min_pixels: smaller objects are dropped, and pieces below a quarter of it are not merged.
        gap: metres: pieces closer than this may be one object behind an obstacle, or a mask with a crack.

    Returns:
        (label, mask) of each, in order of labels.
    """
    labels = np.where(np.isnan(points[..., 2]), 0, labels).astype(np.int32)
    pieces = graph.components(labels)
    sizes = np.bincount(pieces.ravel())
    label_of = np.zeros(len(sizes), np.int32)
    label_of[pieces.ravel()] = labels.ravel()
    found: list[tuple[int, BoolMask]] = []
    for label in np.unique(labels[labels > 0]):
        numbers = np.flatnonzero((label_of == label) & (sizes >= max(4, min_pixels // 4)))
        groups: list[tuple[BoolMask, cKDTree]] = []
        for number in numbers[np.argsort(-sizes[numbers])][:_MAX_PIECES]:
            piece = pieces == number
            tree = cKDTree(points[piece])
            for position, (mask, other) in enumerate(groups):
                small, large = (tree, other) if tree.n < other.n else (other, tree)
                if np.min(large.query(small.data, distance_upper_bound=gap)[0]) < gap:
                    joined = mask | piece
                    groups[position] = (joined, cKDTree(points[joined]))
                    break
            else:
                groups.append((piece, tree))
        found += [(int(label), mask) for mask, _ in groups if mask.sum() >= min_pixels]
    return found
