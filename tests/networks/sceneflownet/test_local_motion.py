"""Rigid motions of neighbourhoods against SciPy's rotations and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from objectflow.networks.sceneflownet.local_motion import local_motion

HEIGHT, WIDTH, FOCAL = 15, 20, 118.0
SETTINGS = {"window": 2, "scale": 0.06, "tolerance": 0.01}


def _surface() -> Tensor:
    """(1, 4, h, w): the cells of a curved surface at half a metre, as a camera of 160x120 sees them at stride 8."""
    row, column = torch.meshgrid(8.0 * torch.arange(HEIGHT), 8.0 * torch.arange(WIDTH), indexing="ij")
    z = 0.5 + 0.02 * torch.sin(column / 30) + 0.03 * torch.cos(row / 20)
    points = torch.stack([(column - 80) / FOCAL * z, (row - 60) / FOCAL * z, z])
    return torch.cat([points, torch.ones(1, HEIGHT, WIDTH)])[None]


def _moved(cells: Tensor, rotation: Rotation, translation: tuple[float, float, float]) -> Tensor:
    """(1, 4, h, w): displacements of a rotation about the point half a metre before the camera, all certain."""
    points, center = cells[0, :3].flatten(1).T.double().numpy(), np.array([0.0, 0.0, 0.5])
    moved = rotation.apply(points - center) + center + translation - points
    offset = torch.from_numpy(moved.T.reshape(3, HEIGHT, WIDTH)).float()
    return torch.cat([offset, torch.ones(1, HEIGHT, WIDTH)])[None]


def _errors(found: Tensor, rotation: Rotation) -> np.ndarray:
    """Degrees between the rotation vectors of cells and a rotation."""
    vectors = found[0, :3].flatten(1).T.double().numpy()
    return np.degrees((Rotation.from_rotvec(vectors) * rotation.inv()).magnitude())


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 2.4, 3.1])
def test_a_rigid_motion_is_found_exactly(angle: float) -> None:
    cells, rotation = _surface(), Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8]))
    displacement = _moved(cells, rotation, (0.03, -0.02, 0.01))
    found = local_motion(displacement, cells, **SETTINGS)
    assert found.shape == (1, 7, HEIGHT, WIDTH)
    # The prior holds the rotations of the corners, whose neighbourhoods are small, back by up to two degrees.
    assert np.median(_errors(found, rotation)) < 1.5
    assert _errors(found, rotation).max() < 12
    torch.testing.assert_close(found[:, 3:6], displacement[:, :3], atol=2e-3, rtol=0)
    torch.testing.assert_close(found[:, 6], torch.ones(1, HEIGHT, WIDTH), atol=0.02, rtol=0)


@pytest.mark.parametrize("angle", [0.3, 1.2])
def test_two_of_five_wrong_matches_do_not_spoil_it(angle: float) -> None:
    generator = torch.Generator().manual_seed(1)
    cells, rotation = _surface(), Rotation.from_rotvec(angle * np.array([0.0, 0.8, -0.6]))
    exact = _moved(cells, rotation, (0.0, 0.05, 0.0))
    displacement = exact.clone()
    wrong = torch.rand(HEIGHT, WIDTH, generator=generator) < 0.4
    displacement[0, :3, wrong] = 0.2 * torch.randn(3, int(wrong.sum()), generator=generator)
    found = local_motion(displacement, cells, **SETTINGS)
    error = (found[:, 3:6] - exact[:, :3]).norm(dim=1)
    assert error.median() < 0.002
    assert np.median(_errors(found, rotation)) < 3
    plain = (displacement[:, :3] - exact[:, :3]).norm(dim=1)
    assert (error > 0.02).float().mean() < 0.25 * (plain > 0.02).float().mean()
    assert found[:, 6].median() < 0.75  # a part of the neighbourhood does not follow


def test_missing_cells_have_no_motion_and_enter_none() -> None:
    cells, rotation = _surface(), Rotation.from_rotvec([0.0, 0.5, 0.0])
    displacement = _moved(cells, rotation, (0.0, 0.0, 0.0))
    cells[:, :, 5:9, 5:9] = 0
    displacement[:, :, 5:9, 5:9] = math.pi
    found = local_motion(displacement, cells, **SETTINGS)
    assert not found[:, :, 5:9, 5:9].any()
    known = cells[0, 3] > 0
    torch.testing.assert_close(found[0, 3:6, known], displacement[0, :3, known], atol=2e-3, rtol=0)


def test_a_single_displacement_gives_a_translation() -> None:
    cells = torch.zeros(1, 4, HEIGHT, WIDTH)
    cells[0, :, 7, 7] = torch.tensor([0.1, 0.0, 0.5, 1.0])
    displacement = torch.zeros(1, 4, HEIGHT, WIDTH)
    displacement[0, :, 7, 7] = torch.tensor([0.02, 0.01, -0.03, 0.8])
    found = local_motion(displacement, cells, **SETTINGS)[0, :, 7, 7]
    torch.testing.assert_close(found[:3], torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(found[3:6], displacement[0, :3, 7, 7])
    torch.testing.assert_close(found[6], torch.tensor(0.8))  # its probability
    displacement[0, 3] = 0  # nothing is certain
    assert not local_motion(displacement, cells, **SETTINGS).any()


def test_lengths_are_in_the_unit_of_the_points() -> None:
    cells, rotation = _surface(), Rotation.from_rotvec([0.4, 0.0, 0.2])
    displacement = _moved(cells, rotation, (0.01, 0.0, 0.02))
    unit = torch.tensor([10.0, 10.0, 10.0, 1.0])[:, None, None]
    metres = local_motion(displacement, cells, **SETTINGS)
    decimetres = local_motion(unit * displacement, unit * cells, window=2, scale=0.6, tolerance=0.1)
    factor = torch.tensor([1.0, 1.0, 1.0, 10.0, 10.0, 10.0, 1.0])[:, None, None]
    torch.testing.assert_close(factor * metres, decimetres, atol=2e-3, rtol=1e-3)
