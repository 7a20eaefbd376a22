"""Reconstruction of analytic solids from poses that drift, and what gets no model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from helpers.turning_solids import View, distance_to_surface, solid, turning
from objectflow import geometry
from objectflow.tracking.background import BackgroundCloud
from objectflow.tracking.model_files import write_models
from objectflow.tracking.reconstruction import ReconstructionSettings, SequenceView, fuse_background, fuse_objects
from objectflow.tracking.track import Track
from objectflow.typing import Float64Array

BOX = solid("box", (0.05, 0.07, 0.04))
COUNT = 12


@pytest.fixture(scope="module")
def views() -> list[View]:
    return turning(BOX, COUNT, degrees=6)


def sequence(views: list[View]) -> list[SequenceView]:
    return [
        SequenceView(k, 0, float(k), view.frame, view.mask.astype(np.int32), np.eye(4)) for k, view in enumerate(views)
    ]


def track(poses: list[Float64Array]) -> Track:
    count = len(poses)
    return Track(1, [float(k) for k in range(count)], poses, [1] * count, [1.0] * count)


def drifting(views: list[View]) -> list[Float64Array]:
    """The true poses with an error that grows by 1.5 mm and 0.7 degrees a frame."""
    step = geometry.se3_exp([0.0008, -0.0006, 0.0011, 0.007, -0.006, 0.008])
    center = views[0].camera_T_object[:3, 3]
    about = geometry.make_transform(np.eye(3), center)
    error = about @ step @ geometry.inverse(about)
    return [np.linalg.matrix_power(error, k) @ view.camera_T_object for k, view in enumerate(views)]


def test_registration_to_the_model_bounds_the_drift(views: list[View]) -> None:
    poses = drifting(views)
    (model,) = fuse_objects(sequence(views), [track(poses)])
    assert model.frames == list(range(COUNT))
    center = np.zeros(3)

    def error(estimated: Float64Array) -> tuple[float, float]:
        true = views[-1].camera_T_object
        shift = np.linalg.norm(geometry.transform(estimated, center) - geometry.transform(true, center))
        return float(shift), float(np.degrees(geometry.rotation_angle(estimated[:3, :3].T @ true[:3, :3])))

    chained, registered = error(poses[-1]), error(model.world_T_object[-1])
    assert chained[0] > 0.012
    assert registered[0] < 0.004
    assert chained[1] > 6
    assert registered[1] < 2
    distance = distance_to_surface(BOX, model.volume.surface().points.astype(np.float64))
    assert np.median(distance) < 0.0015
    assert np.quantile(distance, 0.9) < 0.004


def test_a_view_that_does_not_fit_is_left_out(views: list[View]) -> None:
    poses = [view.camera_T_object.copy() for view in views]
    poses[6] = poses[6] @ geometry.make_transform(np.eye(3), [0.0, 0.05, 0.0])
    poses[7:] = [pose.copy() for pose in poses[7:]]
    (model,) = fuse_objects(sequence(views), [track(poses)])
    assert model.rejected == 1
    assert model.frames == [k for k in range(COUNT) if k != 6]


def test_the_background_lacks_the_object_also_where_no_mask_shows_it(views: list[View]) -> None:
    masked = sequence(views)
    models = fuse_objects(masked, [track([view.camera_T_object for view in views])])
    # The mask of every other frame is lost, as at rest; the model tells where the object is.
    lost = [
        view._replace(labels=np.zeros_like(view.labels)) if view.number % 2 == 0 and view.number > 4 else view
        for view in masked
    ]
    points = fuse_background(lost, models).points().points
    tilt = np.radians(35)
    height = (points - [0, 0, 1.0]) @ [0, -np.cos(tilt), -np.sin(tilt)]
    # The plane lies half a metre below the box, which slides and turns slowly.
    assert len(points) > 5000
    assert np.median(np.abs(height + 0.5)) < 0.01
    assert (height > -0.2).sum() == 0


def test_objects_that_are_too_small_get_no_model(views: list[View], tmp_path: Path) -> None:
    settings = ReconstructionSettings()
    small = [view._replace(mask=shrunk(view)) for view in views[:3]]
    once = Track(2, [0.0], [views[0].camera_T_object], [1], [1.0])
    never = track([view.camera_T_object for view in small])
    models = fuse_objects(sequence(small), [never], settings) + fuse_objects(sequence(views[:1]), [once], settings)
    written, reasons = write_models(tmp_path, models, BackgroundCloud(0.01), settings)
    assert written == []
    assert "never seen in 40 pixels" in reasons[1]
    assert reasons[2] == "seen in 1 frame, a model needs 2"
    assert {path.name for path in (tmp_path / "models").iterdir()} == {"index.json", "background.ply"}
    index = json.loads((tmp_path / "models" / "index.json").read_text())
    assert [one["id"] for one in index["without_model"]] == [1, 2]


def shrunk(view: View) -> np.ndarray:
    mask = np.zeros_like(view.mask)
    rows, columns = np.nonzero(view.mask)
    mask[int(rows.mean()) :, int(columns.mean()) :][:5, :5] = True
    return mask
