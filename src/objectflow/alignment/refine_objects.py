"""The '+Refine' step: motions of objects registered to the depth and the colour of the previous frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.fitting import FitSettings
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.registration import RegistrationSettings
from objectflow.geometry.moved import STATIC_DISPLACEMENT, displaces
from objectflow.geometry.resample import nearest_indices
from objectflow.motion import ObjectMotion
from objectflow.settings import Settings, setting
from objectflow.typing import Float64Array, LabelImage


@dataclass(frozen=True)
class RefineSettings(Settings):
    """Registration of each object, and which results are accepted."""

    width: int = setting(640, minimum=16)
    """Pixels: width at which the frames are registered."""
    max_points: int = setting(2000, minimum=6)
    """Maximum number of points per object, sampled evenly."""
    min_matches: int = setting(6, minimum=3)
    """Minimum number of matches inside a mask for their fit to be a second initial motion."""
    trusted_fitness: float = setting(0.8, minimum=0, maximum=1)
    """Share of an object's points on the previous surface from which a motion is accepted wherever it started."""
    sufficient_fitness: float = setting(0.9, minimum=0, maximum=1)
    """The same share from which a registered motion fits so well that no further start is tried."""
    max_shift: float = setting(0.01, minimum=0)
    """Metres: a correction of the centre up to this, together with `max_rotation_deg`, is accepted at any fitness."""
    max_rotation_deg: float = setting(5.0, minimum=0)
    """Degrees: see `max_shift`."""
    cost_sigmas: float = setting(3.0, above=0)
    """Standard deviations of depth at which the squared distance of a point to the previous surface is truncated."""
    static_displacement: float = setting(STATIC_DISPLACEMENT, minimum=0)
    """Metres: an object that moves by less counts as static."""
    fit: FitSettings = FitSettings()
    registration: RegistrationSettings = RegistrationSettings(min_step=2e-4)
    """Smaller steps change no result: objects are registered to a fraction of the depth noise."""


DEFAULTS = RefineSettings()


def refine_objects(
    pair: FramePair, labels: LabelImage, objects: tuple[ObjectMotion, ...], settings: RefineSettings = DEFAULTS
) -> tuple[ObjectMotion, ...]:
    """Refine the motion of each object by registration, from its own motion and from a fit to the matches in its mask.

    The best of both results and of the initial motion, by `depth_cost`, is kept, so that no object's depth error
    grows. A result far from the initial motion must also place nearly the whole object on the previous surface: a
    motion that is wrong by centimetres finds some other surface to lie on.

    Args:
        pair: the frames.
        labels: (H, W) int32 on the pixels of the current frame.
        objects: with the initial motions.
        settings: see there.

    Returns:
        The same objects with refined `prev_T_curr`; `moving` follows from it.
    """
    if not objects:
        return ()
    pair = pair.at_width(settings.width)
    matches, camera = pair.matches, pair.curr.frame.camera
    rows, columns = nearest_indices(labels.shape, (camera.height, camera.width))
    labels = labels[rows[:, None], columns]
    column, row = np.rint(matches.pixels).astype(np.intp).T
    owner = labels[np.clip(row, 0, labels.shape[0] - 1), np.clip(column, 0, labels.shape[1] - 1)]
    target, sources = pair.target, pair.sources

    def starts(obj: ObjectMotion) -> Iterator[Float64Array]:
        yield obj.prev_T_curr
        own = matches[owner == obj.id]
        if len(own.curr) >= settings.min_matches:
            yield fitting.fit_matches(own, camera, noise=pair.noise, settings=settings.fit)[0]

    def refined(obj: ObjectMotion) -> ObjectMotion:
        source = sources.take(labels == obj.id, limit=settings.max_points)
        motion = refine_one(target, source, starts(obj), settings)
        moving = displaces(motion, source.points, obj.center, settings.static_displacement)
        return dataclasses.replace(obj, prev_T_curr=motion, moving=moving)

    # Small arrays hold the interpreter's lock, so that threads would take longer than one after the other.
    return tuple(refined(obj) for obj in objects)


def refine_one(
    target: registration.RegistrationTarget,
    source: registration.RegistrationSource,
    initial: Iterable[Float64Array],
    settings: RefineSettings = DEFAULTS,
) -> Float64Array:
    """The motion with the least depth cost among the first initial motion and the registered ones.

    Registration stops at the first motion that fits sufficiently, so later initial motions may never be drawn from the
    iterable.
    """
    starts = iter(initial)
    first = next(starts)
    if not len(source.points):
        return first
    candidates = []
    for start in chain([first], starts):
        found = registration.refine(target, source, start, settings=settings.registration)
        if np.isfinite(found.prev_T_curr).all() and _is_plausible(found, source, first, settings):
            candidates.append(found)
            if found.fitness * found.visible >= settings.sufficient_fitness:
                break
    candidates.append(registration.evaluate_registration(target, source, first, settings.registration))
    return min(candidates, key=lambda one: depth_cost(one, target, source, settings.cost_sigmas)).prev_T_curr


def _is_plausible(
    found: registration.RegistrationResult,
    source: registration.RegistrationSource,
    start: Float64Array,
    settings: RefineSettings,
) -> bool:
    """Whether a registered motion fits well enough for its distance from the initial one."""
    if found.fitness * found.visible >= settings.trusted_fitness:
        return True
    center = source.points.mean(axis=0, dtype=np.float64)
    shift = geometry.transform(found.prev_T_curr, center) - geometry.transform(start, center)
    angle = geometry.rotation_angle(found.prev_T_curr[:3, :3] @ start[:3, :3].T)
    return float(np.linalg.norm(shift)) < settings.max_shift and float(np.degrees(angle)) < settings.max_rotation_deg


def depth_cost(
    found: registration.RegistrationResult,
    target: registration.RegistrationTarget,
    source: registration.RegistrationSource,
    sigmas: float = DEFAULTS.cost_sigmas,
) -> float:
    """Mean squared distance of the points to the previous surface, in square metres, truncated.

    Points that the previous frame does not show cost as much as points that contradict it; otherwise a motion could
    win by hiding what it cannot explain.

    Args:
        found: the motion and how well it fits.
        target: the previous frame.
        source: the object's points.
        sigmas: standard deviations of depth at which the distance is truncated.
    """
    limit = (sigmas * float(target.noise.sigma(float(np.median(source.points[:, 2]))))) ** 2
    share = found.fitness * found.visible
    return limit if share == 0 else share * min(found.inlier_rmse**2, limit) + (1 - share) * limit
