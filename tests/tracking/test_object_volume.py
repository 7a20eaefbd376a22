"""Volumes of analytic solids with the noise of a depth camera, compared with their closed forms."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree

from helpers.turning_solids import CAMERA, View, distance_to_surface, solid, turning
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame
from objectflow.geometry import project
from objectflow.tracking.object_volume import ObjectVolume, VolumeSettings
from objectflow.tracking.volume_meshing import mesh_area

SPHERE = solid("sphere", (0.06, 0.06, 0.06))
BOX = solid("box", (0.05, 0.07, 0.04))
BOOK = solid("box", (0.012, 0.05, 0.08))
SOLIDS = {"sphere": SPHERE, "box": BOX, "book": BOOK}


@pytest.fixture(scope="module", params=SOLIDS)
def fused(request: pytest.FixtureRequest) -> tuple[str, list[View], ObjectVolume]:
    views = turning(SOLIDS[request.param], 16)
    return request.param, views, fuse(views)


def fuse(views: list[View], settings: VolumeSettings | None = None) -> ObjectVolume:
    volume = ObjectVolume(settings)
    for view in views:
        assert volume.integrate(view.frame, view.mask, view.camera_T_object) > 0
    return volume


def test_surface_lies_on_the_solid_and_covers_what_was_seen(fused: tuple[str, list[View], ObjectVolume]) -> None:
    name, views, volume = fused
    surface = volume.surface()
    distance = distance_to_surface(SOLIDS[name], surface.points.astype(np.float64))
    assert np.median(distance) < 0.0006
    assert np.quantile(distance, 0.9) < 0.0015
    seen = np.concatenate([view.points for view in views])
    assert (cKDTree(surface.points).query(seen[::11])[0] < 0.003).mean() > 0.88


def test_normals_point_out_of_the_solid() -> None:
    surface = fuse(turning(SPHERE, 8)).surface()
    radial = surface.points / np.linalg.norm(surface.points, axis=1, keepdims=True)
    assert np.quantile((surface.normals * radial).sum(axis=1), 0.1) > 0.93


def test_rendering_shows_the_exact_mask_and_depth(fused: tuple[str, list[View], ObjectVolume]) -> None:
    _, views, volume = fused
    view = views[5]
    shown = volume.render(CAMERA, view.camera_T_object)
    assert (shown.valid & view.mask).sum() / (shown.valid | view.mask).sum() > 0.9
    both = shown.valid & view.mask
    exact = view.points @ view.camera_T_object[:3, :3].T + view.camera_T_object[:3, 3]
    depth = np.zeros(view.mask.shape)
    depth[view.mask] = exact[:, 2]
    # Depth has a noise of 1.9 mm; fusion reduces it.
    assert np.median(np.abs(shown.depth - depth)[both]) < 0.0008
    error = np.abs(shown.color.astype(int) - view.frame.color)[both]
    assert np.median(error) < 25


def test_rendering_from_behind_shows_nothing_that_was_not_seen() -> None:
    view = turning(BOX, 1)[0]
    volume = fuse([view])
    turned = view.camera_T_object.copy()
    turned[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ turned[:3, :3]
    front, back = (volume.render(CAMERA, pose).valid.sum() for pose in (view.camera_T_object, turned))
    assert back < 0.02 * front


def test_views_through_a_voxel_remove_what_was_fused_wrongly() -> None:
    views = turning(SPHERE, 12)
    volume = fuse(views[:6])
    # A piece of another object that does not move along, 15 cm beside the sphere.
    wrong = views[5]
    mask = np.zeros_like(wrong.mask)
    mask[100:130, 225:255] = True
    depth = np.where(mask, np.float32(1.0), wrong.frame.depth)
    frame = RgbdFrame(wrong.frame.color, depth, CAMERA)
    volume.integrate(frame, mask, wrong.camera_T_object, free=np.zeros_like(mask))
    settings = volume.settings
    floating = np.linalg.norm(volume.surface().points, axis=1) > 0.1
    assert floating.sum() > 100
    for view in views[6:]:
        volume.integrate(view.frame, view.mask, view.camera_T_object)
    left = np.linalg.norm(volume.surface().points, axis=1) > 0.1
    assert left.sum() < 0.1 * floating.sum()
    assert settings == VolumeSettings()


def test_size_is_bounded_by_coarser_voxels() -> None:
    views = turning(BOX, 6)
    fine, coarse = fuse(views), fuse(views, VolumeSettings(max_voxels=60_000))
    assert fine.grid is not None
    assert coarse.grid is not None
    assert coarse.grid.voxel == pytest.approx(2 * fine.grid.voxel)
    assert coarse.grid.distance.size <= 60_000
    distance = distance_to_surface(BOX, coarse.surface().points.astype(np.float64))
    assert np.median(distance) < 0.001


def test_pickled_volume_goes_on_with_the_same_bytes() -> None:
    views = turning(BOX, 6)
    whole = fuse(views)
    half = pickle.loads(pickle.dumps(fuse(views[:3])))
    for view in views[3:]:
        half.integrate(view.frame, view.mask, view.camera_T_object)
    for a, b in zip(whole.surface(), half.surface(), strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_mask_of_few_pixels_changes_nothing() -> None:
    view = turning(BOX, 1)[0]
    mask = np.zeros_like(view.mask)
    rows, columns = np.nonzero(view.mask)
    mask[rows.mean().astype(int) :, columns.mean().astype(int) :][:4, :4] = True
    volume = ObjectVolume()
    assert volume.integrate(view.frame, mask, view.camera_T_object) == 0
    assert volume.grid is None
    assert not len(volume.surface().points)
    assert not volume.render(CAMERA, view.camera_T_object).valid.any()


def test_a_mask_of_another_size_is_refused() -> None:
    view = turning(BOX, 1)[0]
    with pytest.raises(FrameError, match="does not fit"):
        ObjectVolume().integrate(view.frame, view.mask[:-1], view.camera_T_object)


def test_mesh_lies_on_the_solid_and_is_oriented(fused: tuple[str, list[View], ObjectVolume]) -> None:
    name, views, volume = fused
    mesh = volume.mesh()
    distance = distance_to_surface(SOLIDS[name], mesh.vertices.astype(np.float64))
    assert np.median(distance) < 0.0006
    assert np.quantile(distance, 0.9) < 0.0015
    seen = np.concatenate([view.points for view in views])
    assert (cKDTree(mesh.vertices).query(seen[::11])[0] < 0.003).mean() > 0.85
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    outward = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1)
    assert (outward > 0).mean() > 0.98
    radial = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (((mesh.normals * radial).sum(axis=1)) > 0).mean() > 0.98


def test_mesh_is_open_where_nothing_was_seen() -> None:
    view = turning(SPHERE, 1)[0]
    mesh = fuse([view]).mesh()
    eye = -view.camera_T_object[:3, :3].T @ view.camera_T_object[:3, 3]
    # A camera at distance d sees the cap of a sphere above r^2 / d.
    height = mesh.vertices @ (eye / np.linalg.norm(eye))
    assert height.min() > 0.06**2 / np.linalg.norm(eye) - 0.003
    area, missing = mesh_area(mesh)
    cap = 1 - height.min() / 0.06
    assert area == pytest.approx(2 * np.pi * 0.06**2 * cap, rel=0.15)
    rim = 0.06**2 - height.min() ** 2
    assert missing == pytest.approx(np.pi * rim, rel=0.15)


def test_colors_of_the_mesh_are_those_of_the_texture() -> None:
    views = turning(SPHERE, 8, noise=0.0)
    mesh = fuse(views).mesh()
    view = views[4]
    points = mesh.vertices @ view.camera_T_object[:3, :3].T + view.camera_T_object[:3, 3]
    pixels = np.rint(project(points, CAMERA)).astype(int)
    front = (mesh.normals @ view.camera_T_object[:3, :3].T * points).sum(axis=1) < -0.5
    shown = view.frame.color[pixels[front, 1], pixels[front, 0]].astype(int)
    assert np.median(np.abs(shown - mesh.colors[front])) < 25


def test_detached_pieces_are_dropped() -> None:
    views = turning(SPHERE, 6)
    volume = fuse(views)
    wrong = views[5]
    mask = np.zeros_like(wrong.mask)
    mask[100:112, 225:237] = True
    frame = RgbdFrame(wrong.frame.color, np.where(mask, np.float32(1.0), wrong.frame.depth), CAMERA)
    volume.integrate(frame, mask, wrong.camera_T_object, free=np.zeros_like(mask))
    assert (np.linalg.norm(volume.surface().points, axis=1) > 0.1).sum() > 10
    assert np.linalg.norm(volume.mesh().vertices, axis=1).max() < 0.07


def test_empty_volume_has_an_empty_mesh() -> None:
    mesh = ObjectVolume().mesh()
    assert mesh.vertices.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)
