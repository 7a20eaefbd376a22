"""Files of small networks with random weights, for tests that do not depend on the networks' results."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from objectflow.networks import NetworkSettings, SceneFlowNet
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
from objectflow.networks.weights import save_weights

TINY = dataclasses.replace(NetworkSettings().scaled(0.125), reach=1, trunk_blocks=(1, 1))
TINY_RIGID = RigidMatchSettings(
    stride=4, stem_width=8, fine_channels=8, channels=16, blocks=(1, 1, 1), attention_layers=2, heads=2, key_pool=2,
    window=1, updates=1, queries=4, decoder_layers=1, xfeat="none", detail_channels=0,
)  # fmt: skip
VARIANTS = {"sceneflownet-s": False, "sceneflownet-c": True, "sceneflownet-c-vl": True}
"""The methods of the paper's networks, and whether their network has a correlation."""


def save(path: Path, settings: NetworkSettings = TINY, **metadata: Any) -> Path:
    """Write a network; by default as weights of `sceneflownet-c-vl`, trained at 120x160."""
    network = SceneFlowNet(settings, generator=torch.Generator().manual_seed(0))
    save_weights(path, network, {"variant": "sceneflownet-c-vl", "size": [120, 160], **metadata})
    return path


def save_rigid(path: Path, settings: RigidMatchSettings = TINY_RIGID, **metadata: Any) -> Path:
    """Write a small `RigidMatch`; by default as weights of `rigidmatch`, trained at 48x64."""
    network = RigidMatch(settings, generator=torch.Generator().manual_seed(0))
    save_weights(path, network, {"variant": "rigidmatch", "size": [48, 64], **metadata})
    return path


def save_all(folder: Path) -> Path:
    """Write weights of every learned method, under the names of released weights."""
    for name, correlation in VARIANTS.items():
        save(folder / f"{name}.safetensors", dataclasses.replace(TINY, correlation=correlation), variant=name)
    save_rigid(folder / "rigidmatch.safetensors")
    return folder
