"""Several pairs at once give what each gives alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import objectflow
from helpers.network_scenes import moving_pairs, scene
from helpers.small_networks import save
from objectflow.alignment.frame_pair import FramePair
from objectflow.networks import SceneFlowNet, SceneFlowNetOutput

NAME = "sceneflownet-c-vl"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


class Foreground(torch.nn.Module):
    """A network with random weights, of which 40% of the pixels are foreground; by itself it may have none."""

    def __init__(self, inner: SceneFlowNet) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, *images: torch.Tensor) -> SceneFlowNetOutput:
        maps: SceneFlowNetOutput = self.inner(*images)
        difference = maps.mask[:, 1:] - maps.mask[:, :1]
        level = difference.flatten(1).quantile(0.6, dim=1)[:, None, None, None]
        mask = torch.cat([torch.zeros_like(difference), 20 * (difference - level)], dim=1)
        return maps._replace(mask=mask, radius=torch.full_like(maps.radius, 0.05))


@pytest.mark.parametrize("rigid", ["none", "average", "refine"])
def test_a_batch_equals_its_pairs_one_by_one(weights: Path, rigid: str) -> None:
    """Frames of two sizes from a static camera, and one pair from a moving one."""
    estimator: Any = objectflow.load(NAME, weights=weights, rigid=rigid, device="cpu")
    object.__setattr__(estimator, "network", Foreground(estimator.network))
    calls: list[int] = []
    predict = estimator.predict
    object.__setattr__(estimator, "predict", lambda prev, curr: calls.append(len(prev)) or predict(prev, curr))
    scenes = [scene(), scene(160, 90), *moving_pairs()]
    found = estimator.estimate_batch([FramePair(pair.prev, pair.curr) for pair in scenes])
    assert sorted(calls) == [1, 3]  # one evaluation per size
    assert [motion.camera_motion is not None for motion in found] == [False, False, False, True]
    assert sum(len(motion.objects) for motion in found) >= 4
    for pair, motion in zip(scenes, found, strict=True):
        alone = estimator(pair.prev, pair.curr)
        np.testing.assert_array_equal(motion.labels, alone.labels)
        np.testing.assert_allclose(motion.scene_flow, alone.scene_flow, atol=1e-4)
        assert len(motion.objects) == len(alone.objects)
        for one, other in zip(motion.objects, alone.objects, strict=True):
            assert (one.id, one.pixels, one.moving) == (other.id, other.pixels, other.moving)
            # Registration ends when a step is small, and starts from maps that differ in their last bits.
            np.testing.assert_allclose(one.prev_T_curr, other.prev_T_curr, atol=1e-4)
            np.testing.assert_allclose(one.center, other.center, atol=1e-5)
            assert one.score == pytest.approx(other.score, abs=1e-5)
        assert motion.settings == alone.settings
    assert estimator.estimate_batch([]) == []
