"""The solve of rigid motions from weighted matches: exact, against SciPy, and where points fix no rotation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from objectflow.networks.rigidmatch.rigid_solver import agreement, solve_motions


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def matches(seed: int, count: int = 30) -> tuple[Tensor, Tensor, Tensor, Rotation, np.ndarray]:
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.from_rotvec(rng.normal(size=3)), rng.normal(size=3)
    curr = rng.normal(size=(count, 3)) * 0.05 + [0.1, -0.2, 0.9]
    prev = turn.apply(curr) + shift
    weights = rng.uniform(0, 1, count)
    return torch.from_numpy(weights), torch.from_numpy(curr), torch.from_numpy(prev), turn, shift


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exact_matches_give_the_exact_motion(seed: int) -> None:
    w, p, q, turn, shift = matches(seed)
    R, t = solve_motions(w[None, None], p[None], q[None], torch.zeros(1, 1, 6))
    np.testing.assert_allclose(R[0, 0].numpy(), turn.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(t[0, 0].numpy(), shift, atol=1e-9)


def test_noisy_matches_give_the_weighted_least_squares_of_scipy() -> None:
    w, p, q, _, _ = matches(4)
    q = q + 0.01 * torch.randn(q.shape, dtype=q.dtype, generator=generator(1))
    R, t = solve_motions(w[None, None], p[None], q[None], torch.zeros(1, 1, 6))
    p_mean, q_mean = ((w[:, None] * one).sum(0) / w.sum() for one in (p, q))
    expected, _ = Rotation.align_vectors((q - q_mean).numpy(), (p - p_mean).numpy(), w.numpy())
    np.testing.assert_allclose(R[0, 0].numpy(), expected.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(t[0, 0].numpy(), (q_mean - R[0, 0] @ p_mean).numpy(), atol=1e-9)


def test_the_solve_has_the_true_gradient() -> None:
    w, p, q, _, _ = matches(5, count=6)
    q = q + 0.01 * torch.randn(q.shape, dtype=q.dtype, generator=generator(2))
    votes = torch.randn(1, 2, 6, dtype=torch.float64, generator=generator(3))
    both = torch.stack([w, w.flip(0)])[None].requires_grad_()
    inputs = (both, p[None].clone().requires_grad_(), q[None].clone().requires_grad_(), votes.requires_grad_())
    assert torch.autograd.gradcheck(lambda *x: solve_motions(*x, prior=0.3), inputs)


@pytest.mark.parametrize("kind", ["nothing", "one point", "a line", "mirrored"])
@pytest.mark.parametrize("prior", [0.0, 1.0])
def test_where_points_fix_no_rotation_everything_stays_finite(kind: str, prior: float) -> None:
    w, p, q, _, _ = (one.clone() if isinstance(one, Tensor) else one for one in matches(6))
    if kind == "nothing":
        w = torch.zeros_like(w)
    elif kind == "one point":
        p, q = p[:1].expand_as(p).clone(), q[:1].expand_as(q).clone()
    elif kind == "a line":
        p = p[:1] + torch.arange(30.0)[:, None] * 0.01 * torch.tensor([1.0, 0, 0])
        q = p + 0.1
    else:
        q = p * torch.tensor([1.0, 1, -1])
    w, p, q = (one.float().requires_grad_() for one in (w, p, q))
    R, t = solve_motions(w[None, None], p[None], q[None], torch.zeros(1, 1, 6), prior=prior)
    (R.square().sum() + R[..., 0, 1].sum() + t.sum()).backward()  # type: ignore[no-untyped-call]
    assert float(torch.linalg.det(R[0, 0].detach().double())) == pytest.approx(1, abs=1e-5)
    for one in (R, t, w.grad, p.grad, q.grad):
        assert one is not None
        assert bool(one.isfinite().all())


def test_without_matches_the_votes_say_how_the_object_moved() -> None:
    votes = torch.tensor([[[0.1, 0.2, 0.9, 0.15, 0.2, 0.8]]])
    R, t = solve_motions(torch.zeros(1, 1, 5), torch.rand(1, 5, 3), torch.rand(1, 5, 3), votes, prior=1.0)
    torch.testing.assert_close(R[0, 0], torch.eye(3))
    torch.testing.assert_close(t[0, 0], torch.tensor([0.05, 0.0, -0.1]))


def test_matches_that_do_not_fit_weigh_less() -> None:
    p = torch.rand(1, 4, 3, generator=generator(4))
    q = p + torch.tensor([0.0, 0.0, 0.1])
    q[0, 3, 0] += 0.02
    found = agreement(torch.eye(3)[None, None], torch.tensor([[[0.0, 0.0, 0.1]]]), p, q, 0.02)
    torch.testing.assert_close(found[0, 0], torch.tensor([1.0, 1.0, 1.0, 0.5]))
