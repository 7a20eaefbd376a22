"""Moving objects, rigid motions and dense scene flow from two RGB-D frames."""

import importlib
from typing import TYPE_CHECKING, Any

from objectflow.errors import ObjectflowError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.runtime.forks import use_one_thread_after_fork

if TYPE_CHECKING:
    from objectflow.alignment.frame_pair import FramePair
    from objectflow.methods.base import Estimator, PairEstimator
    from objectflow.methods.baselines.dense_flow import DenseFlow
    from objectflow.methods.baselines.homc.estimator import Homc
    from objectflow.methods.baselines.pd_flow.estimator import PdFlow
    from objectflow.methods.baselines.sr_flow.estimator import SRFlow
    from objectflow.methods.baselines.vo_sf.estimator import VoSf
    from objectflow.methods.baselines.zero import Zero
    from objectflow.methods.consensus.estimator import ConsensusEstimator as Consensus
    from objectflow.methods.registry import DEFAULT_METHOD, METHODS, load
    from objectflow.methods.rigidmatch.estimator import RigidMatchEstimator as RigidMatch
    from objectflow.methods.sceneflownet.estimator import SceneFlowNetC, SceneFlowNetCVL, SceneFlowNetS
    from objectflow.tracking.sequence_estimator import SequenceEstimator

__version__ = "0.1.0"

__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "Camera",
    "Consensus",
    "DenseFlow",
    "Estimator",
    "FramePair",
    "Homc",
    "ObjectMotion",
    "ObjectflowError",
    "PairEstimator",
    "PdFlow",
    "RgbdFrame",
    "RigidMatch",
    "SRFlow",
    "SceneFlowNetC",
    "SceneFlowNetCVL",
    "SceneFlowNetS",
    "SceneMotion",
    "SequenceEstimator",
    "VoSf",
    "Zero",
    "load",
]

use_one_thread_after_fork()

_LAZY = {
    "DEFAULT_METHOD": ("objectflow.methods.registry", "DEFAULT_METHOD"),
    "METHODS": ("objectflow.methods.registry", "METHODS"),
    "load": ("objectflow.methods.registry", "load"),
    "Estimator": ("objectflow.methods.base", "Estimator"),
    "PairEstimator": ("objectflow.methods.base", "PairEstimator"),
    "FramePair": ("objectflow.alignment.frame_pair", "FramePair"),
    "Consensus": ("objectflow.methods.consensus.estimator", "ConsensusEstimator"),
    "DenseFlow": ("objectflow.methods.baselines.dense_flow", "DenseFlow"),
    "Homc": ("objectflow.methods.baselines.homc.estimator", "Homc"),
    "PdFlow": ("objectflow.methods.baselines.pd_flow.estimator", "PdFlow"),
    "RigidMatch": ("objectflow.methods.rigidmatch.estimator", "RigidMatchEstimator"),
    "SRFlow": ("objectflow.methods.baselines.sr_flow.estimator", "SRFlow"),
    "SceneFlowNetC": ("objectflow.methods.sceneflownet.estimator", "SceneFlowNetC"),
    "SceneFlowNetCVL": ("objectflow.methods.sceneflownet.estimator", "SceneFlowNetCVL"),
    "SceneFlowNetS": ("objectflow.methods.sceneflownet.estimator", "SceneFlowNetS"),
    "SequenceEstimator": ("objectflow.tracking.sequence_estimator", "SequenceEstimator"),
    "VoSf": ("objectflow.methods.baselines.vo_sf.estimator", "VoSf"),
    "Zero": ("objectflow.methods.baselines.zero", "Zero"),
}
"""Names that are imported when they are first used, so that `import objectflow` does not import torch."""


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'objectflow' has no attribute {name!r}")
    module, attribute = _LAZY[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
