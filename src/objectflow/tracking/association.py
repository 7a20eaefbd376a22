"""Which object of a pair is which track: the assignment of largest overlap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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


class FoundAgain(NamedTuple):
    """The track that an object is, its pose (4, 4) in the world, and whether its model confirms it."""

    number: int
    world_T_object: Float64Array
    confirmed: bool


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


def continuation(
    surface: SeenSurface,
    states: Mapping[int, LastState],
    camera: Camera,
    curr_T_world: Float64Array,
    rests: Callable[[int], bool],
    settings: TrackerSettings,
) -> tuple[int, Float64Array] | None:
    """The track that went on to a surface although the motion of the pair leads elsewhere.

    The track moved in one of the last pairs and has similar colours, and the surface covers the place of its last
    surface, or that to which its last motion leads.

    Args:
        surface: in the current camera frame.
        states: of tracks without an association, by track id.
        camera: of the frame.
        curr_T_world: (4, 4) of the frame.
        rests: whether the frame shows a track's object where it was.
        settings: thresholds.

    Returns:
        The track and its step (4, 4) in the world: no motion or the last one, shifted to the surface. None for a new
        object.
    """
    best, most = None, settings.min_continued_overlap
    for number in similar_tracks(surface, states, settings.min_continued_similarity):
        state = states[number]
        if state.age > settings.coast:
            continue
        for step in (np.eye(4), np.linalg.matrix_power(state.world_step, state.age + 1)):
            expected = geometry.transform(curr_T_world @ step, state.points)
            overlap = footprint_overlap(surface.points, expected, camera, settings.footprint_cells)
            if overlap >= most and not rests(number):
                shift = np.median(surface.points, axis=0) - np.median(expected, axis=0)
                world_step = geometry.make_transform(np.eye(3), curr_T_world[:3, :3].T @ shift) @ step
                best, most = (number, world_step), overlap
    return best


def similar_tracks(surface: SeenSurface, states: Mapping[int, LastState], least: float) -> list[int]:
    """The tracks whose colours are similar to those of a surface, the most similar first.

    Args:
        surface: of an object.
        states: by track id.
        least: Bhattacharyya coefficient of the colours.
    """
    similarity = {number: float(np.sqrt(surface.colors * state.colors).sum()) for number, state in states.items()}
    similar = [number for number, value in similarity.items() if value >= least]
    return sorted(similar, key=lambda number: (-similarity[number], number))
