"""Which object of a pair is which track: the assignment of largest overlap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from objectflow import geometry
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion
from objectflow.tracking.seen_surface import SeenSurface, footprint_overlap
from objectflow.tracking.tracker_settings import TrackerSettings
from objectflow.typing import Float64Array


@dataclass(eq=False)
class LastState:
    """Last observation of a track: surface points in the world frame, colours, last motion, and its age in pairs."""

    points: Float64Array
    colors: Float64Array
    world_step: Float64Array
    age: int = 0


def associate(
    found: Sequence[tuple[ObjectMotion, SeenSurface]],
    states: Mapping[int, LastState],
    camera: Camera,
    prev_T_world: Float64Array,
    refused: Callable[[int, ObjectMotion], bool] | None,
    settings: TrackerSettings,
) -> list[int | None]:
    """Associate the objects of a pair with tracks (Hungarian method).

    Args:
        found: moving objects, with their surfaces in the current camera frame.
        states: by track id, before the pair.
        camera: of the frames.
        prev_T_world: (4, 4) the previous camera.
        refused: whether an object is not that of a track; None refuses nothing.
        settings: thresholds.

    Returns:
        Track id of each object, None for a new object.
    """
    ids = list(states)
    overlap = np.zeros((len(found), len(ids)))
    prev_surfaces = [geometry.transform(obj.prev_T_curr, surface.points) for obj, surface in found]
    for column, track_id in enumerate(ids):
        state = states[track_id]
        hypotheses = [state.points]
        if 0 < state.age <= settings.coast:
            # The object may have continued its motion while it was hidden.
            step = np.linalg.matrix_power(state.world_step, state.age)
            hypotheses.append(geometry.transform(step, state.points))
        for world_points in hypotheses:
            expected = geometry.transform(prev_T_world, world_points)
            for row, points in enumerate(prev_surfaces):
                similarity = float(np.sqrt(found[row][1].colors * state.colors).sum())
                if similarity < settings.min_color_similarity:
                    continue
                if abs(np.median(points[:, 2]) - np.median(expected[:, 2])) < settings.max_gap:
                    shared = footprint_overlap(points, expected, camera, settings.footprint_cells)
                    overlap[row, column] = max(overlap[row, column], shared)
    if refused is not None:
        for row, column in np.argwhere(overlap >= settings.min_overlap).tolist():
            if refused(ids[column], found[row][0]):
                overlap[row, column] = 0
    # Certain motions come first: a guess does not take a track from them.
    weight = np.array([1.0 if obj.score >= settings.min_score else 0.1 for obj, _ in found]).reshape(-1, 1)
    links: list[int | None] = [None] * len(found)
    for i, j in zip(*linear_sum_assignment(weight * overlap, maximize=True), strict=True):
        if overlap[i, j] >= settings.min_overlap:
            links[i] = ids[j]
    return links
