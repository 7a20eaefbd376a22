"""The one interface of every method, and `load("name")`."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
from typing import Any, NamedTuple, cast

from objectflow.errors import MethodError
from objectflow.methods.base import Estimator, check_camera_option

DEFAULT_METHOD = "rigidmatch"


class MethodEntry(NamedTuple):
    """Where a method lives; its class is a dataclass whose fields are the options of `load`.

    `assumes_static_camera`: the method assumes a static camera; for a moving one, `load` wraps it in `MovingCamera`.
    """

    summary: str
    module: str
    factory: str
    assumes_static_camera: bool = False


METHODS: dict[str, MethodEntry] = {
    "rigidmatch": MethodEntry(
        "global matching, objects as a set, motions by solving, checked against the frames; weights come with it",
        "objectflow.methods.rigidmatch.estimator",
        "RigidMatchEstimator",
        assumes_static_camera=True,
    ),
    "consensus": MethodEntry(
        "training-free: rigid motions by consensus of matched points, refined against the depth",
        "objectflow.methods.consensus.estimator",
        "ConsensusEstimator",
    ),
    "dense-flow": MethodEntry(
        "DIS optical flow lifted by depth, occlusion-checked; flow only, no objects",
        "objectflow.methods.baselines.dense_flow",
        "DenseFlow",
    ),
    "pd-flow": MethodEntry(
        "Jaimez et al. 2015: dense variational flow of brightness and depth; flow only, no objects",
        "objectflow.methods.baselines.pd_flow.estimator",
        "PdFlow",
        assumes_static_camera=True,
    ),
    "vo-sf": MethodEntry(
        "Jaimez et al. 2017: geometric clusters, static or moving, with a rigid motion each",
        "objectflow.methods.baselines.vo_sf.estimator",
        "VoSf",
    ),
    "sr-flow": MethodEntry(
        "Quiroga et al. 2014: a twist a pixel, piecewise constant; rigid camera motion on request; flow only",
        "objectflow.methods.baselines.sr_flow.estimator",
        "SRFlow",
    ),
    "homc": MethodEntry(
        "Keuper 2017: motion segments of point tracks by higher-order lifted multicuts; colour only, labels only",
        "objectflow.methods.baselines.homc.estimator",
        "Homc",
    ),
    "sceneflownet-c-vl": MethodEntry(
        "the paper's network with correlation and all losses; needs weights",
        "objectflow.methods.sceneflownet.estimator",
        "SceneFlowNetCVL",
        assumes_static_camera=True,
    ),
    "sceneflownet-c": MethodEntry(
        "the same without the variance and violation losses; needs weights",
        "objectflow.methods.sceneflownet.estimator",
        "SceneFlowNetC",
        assumes_static_camera=True,
    ),
    "sceneflownet-s": MethodEntry(
        "the paper's simple network, without correlation; needs weights",
        "objectflow.methods.sceneflownet.estimator",
        "SceneFlowNetS",
        assumes_static_camera=True,
    ),
    "zero": MethodEntry(
        "nothing moves: the row that every method must beat", "objectflow.methods.baselines.zero", "Zero"
    ),
}


def load(name: str = DEFAULT_METHOD, **options: Any) -> Estimator:
    """Make an estimator by its name.

    Args:
        name: one of `METHODS`.
        **options: the method's own settings; `camera` ("auto", "static" or "moving") is known to every method. For
            methods made for a still camera, another one's motion is found and taken out first: see `MovingCamera`.

    Raises:
        MethodError: an unknown name (the message lists the choices), or an option or a value that it does not have.
    """
    if name not in METHODS:
        near = difflib.get_close_matches(name, METHODS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise MethodError(f"unknown method {name!r}: {hint}choose one of {', '.join(sorted(METHODS))}")
    entry = METHODS[name]
    factory = getattr(importlib.import_module(entry.module), entry.factory)
    known = [field.name for field in dataclasses.fields(factory) if field.init]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise MethodError(f"method {name!r} has no option {unknown[0]!r}: it has {', '.join(known)}")
    camera = options.get("camera", "auto")
    if not entry.assumes_static_camera or camera == "static":
        return cast(Estimator, factory(**options))
    check_camera_option(camera)
    # Imported here: it is made of estimators.
    from objectflow.methods.moving_camera import MovingCamera

    return MovingCamera(factory(**{**options, "camera": "static"}), camera=camera)
