"""The '+Refine' step: objects' motions aligned with the depth and the colour of the previous frame."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.moved import is_moving
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.geometry.resample import nearest_indices
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage

MAX_POINTS = 2000
"""Of each object at most, spread evenly."""
MIN_MATCHES = 6
"""Fewer say nothing about a rigid motion that chance could not."""
TRUSTED_FITNESS = 0.8
"""Share of an object's points on the previous surface from which a motion is believed wherever it started."""
MAX_SHIFT, MAX_ROTATION = 0.01, np.radians(5)
"""Metres of the points' middle, and radians: corrections up to these are believed with any share."""


def refine_objects(pair: FramePair, labels: LabelImage, objects: tuple[ObjectMotion, ...]) -> tuple[ObjectMotion, ...]:
    """Refine each object's motion by `rigid.refine`, from where it stands and from what image matches in its mask say.

    The best of the two and of the motion as it was, by `depth_cost`, is kept: no object's depth error grows. A motion
    that goes far from where it started also has to put nearly all of the object onto the previous surface: among many
    surfaces, one that is wrong by centimetres finds some other one to lie on.

    Args:
        pair: the frames.
        labels: (H, W) int32 on the current one's pixels, before it was narrowed.
        objects: with the motions to start from.

    Returns:
        The same objects with refined `prev_T_curr`, and `moving` decided anew; centres and scores stay.
    """
    if not objects:
        return ()
    matches, camera = pair.matches, pair.curr_small.camera
    rows, columns = nearest_indices(labels.shape, (camera.height, camera.width))
    labels = labels[rows[:, None], columns]
    column, row = np.rint(matches.pixels).astype(np.intp).T
    owner = labels[np.clip(row, 0, labels.shape[0] - 1), np.clip(column, 0, labels.shape[1] - 1)]
    out = []
    for obj in objects:
        source = pair.sources.take(labels == obj.id, limit=MAX_POINTS)
        starts = [obj.prev_T_curr]
        own = matches[owner == obj.id]
        if len(own.curr) >= MIN_MATCHES:
            starts.append(fitting.fit_matches(own, camera)[0])
        motion = refine_one(pair.target, source, starts)
        refined = dataclasses.replace(obj, prev_T_curr=motion)
        out.append(dataclasses.replace(refined, moving=bool(is_moving(motion[:3, :3], refined.translation))))
    return tuple(out)


def refine_one(
    target: registration.RegistrationTarget, source: registration.RegistrationSource, starts: list[Float64Array]
) -> Float64Array:
    """The motion that explains the depth best among the first start and what refining each start gives."""
    if not len(source.points):
        return starts[0]
    found = [registration.refine(target, source, start) for start in starts]
    found = [one for one in found if np.isfinite(one.prev_T_curr).all() and _is_plausible(one, source, starts[0])]
    return min(
        [*found, registration.evaluate_registration(target, source, starts[0])],
        key=lambda one: depth_cost(one, source),
    ).prev_T_curr


def _is_plausible(
    found: registration.RegistrationResult, source: registration.RegistrationSource, start: Float64Array
) -> bool:
    """Whether a refined motion explains enough for how far it went."""
    if found.fitness * found.visible >= TRUSTED_FITNESS:
        return True
    middle = source.points.mean(axis=0, dtype=np.float64)
    shift = geometry.transform(found.prev_T_curr, middle) - geometry.transform(start, middle)
    turn = geometry.rotation_angle(found.prev_T_curr[:3, :3] @ start[:3, :3].T)
    return float(np.linalg.norm(shift)) < MAX_SHIFT and float(turn) < MAX_ROTATION


def depth_cost(found: registration.RegistrationResult, source: registration.RegistrationSource) -> float:
    """Mean over the points of the squared distance to the previous surface, in metres squared, truncated at 3 sigma.

    Points that the previous frame does not see count as much as those that it contradicts: else a motion would win by
    hiding what it cannot explain.
    """
    limit = 9 * float(depth_sigma(np.array(np.median(source.points[:, 2])))) ** 2
    share = found.fitness * found.visible
    return limit if share == 0 else share * min(found.inlier_rmse**2, limit) + (1 - share) * limit
