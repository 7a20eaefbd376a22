"""Small steps of an object, found by registration of its model: they are told from rest by what both frames show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.tracking.earlier_settings import EarlierSettings
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.pose_cost import is_better
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import Float64Array


class NeighbourFrame(NamedTuple):
    """A frame beside another one, in which the pose of an object is known.

    Attributes:
        view: the frame.
        neighbour_T_camera: (4, 4) from the camera of the other frame to that of this one.
    """

    view: FrameView
    neighbour_T_camera: Float64Array


class FineStep(NamedTuple):
    """The pose of an object in a frame.

    Attributes:
        camera_T_object: (4, 4).
        present: share of the model's visible points that the frame confirms, 0..1.
        moved: whether the pose differs from that in the neighbouring frame.
    """

    camera_T_object: Float64Array
    present: float
    moved: bool


def fine_step(
    view: FrameView,
    neighbour: NeighbourFrame,
    model: SurfaceModel,
    rest: Float64Array,
    starts: Sequence[Float64Array],
    settings: EarlierSettings,
) -> FineStep | None:
    """The pose of an object in a frame, whose pose in a neighbouring frame is known.

    The object moved if a registered pose explains the frame clearly better than the known one and lies farther from it
    than noise explains, and if the neighbouring frame shows the contrary: otherwise, the known pose is inexact.

    Args:
        view: the frame.
        neighbour: the previous or the next frame.
        model: of the object.
        rest: (4, 4) `camera_T_object`: its pose in the neighbouring frame, in the camera of this one.
        starts: (4, 4) each, further initial poses `camera_T_object`.
        settings: thresholds.

    Returns:
        None where the frame does not show the object.
    """
    # Registration may slide along a surface from a pose that was right.
    poses = [rest, *(view.register(model, start)[0] for start in (rest, *starts)), *starts]
    costs = view.costs(model, poses)
    best = int(np.argmin(costs))
    depth = float(geometry.transform(rest, model.points.mean(axis=0))[2])
    least = max(settings.min_step, settings.min_step_sigmas * float(view.noise.sigma(np.array([depth]))[0]))
    if is_better(costs[[0, best]], view.settings.pose_cost) and displacement(model, rest, poses[best]) >= least:
        before, after = neighbour.view.costs(
            model, [neighbour.neighbour_T_camera @ pose for pose in (rest, poses[best])]
        )
        fit = view.fit(model, poses[best])
        seen = fit.visible >= settings.min_visible and fit.present >= settings.min_present
        if seen and before < after:
            return FineStep(poses[best], fit.present, True)
    fit = view.fit(model, rest)
    seen = fit.visible >= settings.min_visible and fit.present >= settings.min_present
    return FineStep(rest, fit.present, False) if seen else None


def displacement(model: SurfaceModel, a: Float64Array, b: Float64Array) -> float:
    """Metres: mean displacement of a model's points between two poses (4, 4) in the same frame."""
    points = model.points
    return float(np.linalg.norm(geometry.transform(a, points) - geometry.transform(b, points), axis=1).mean())
