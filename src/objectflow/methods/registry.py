"""The methods by their names, and `load`."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from objectflow.errors import MethodError, SettingsError
from objectflow.settings import build, flat

if TYPE_CHECKING:
    from objectflow.methods.base import PairEstimator

DEFAULT_METHOD = "rigidmatch"


class MethodEntry(NamedTuple):
    """A method: one line about it, its module, and its class there, a dataclass whose fields are the settings."""

    summary: str
    module: str
    factory: str


METHODS: dict[str, MethodEntry] = {
    "rigidmatch": MethodEntry(
        "global matching, objects as a set, motions by solving, checked against the frames; weights come with it",
        "objectflow.methods.rigidmatch.estimator",
        "RigidMatchEstimator",
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
    ),
    "sceneflownet-c": MethodEntry(
        "the same without the variance and violation losses; needs weights",
        "objectflow.methods.sceneflownet.estimator",
        "SceneFlowNetC",
    ),
    "sceneflownet-s": MethodEntry(
        "the paper's simple network, without correlation; needs weights",
        "objectflow.methods.sceneflownet.estimator",
        "SceneFlowNetS",
    ),
    "zero": MethodEntry(
        "nothing moves: the row that every method must beat", "objectflow.methods.baselines.zero", "Zero"
    ),
}


def load(name: str = DEFAULT_METHOD, **settings: Any) -> PairEstimator:
    """Make an estimator by its name.

    Args:
        name: one of `METHODS`.
        **settings: of the method, by field; nested ones as mappings, as settings objects, or by dotted paths, such as
            `**{"postprocess.merge.max_loss": 0.1}`. Every method whose result depends on it has `camera`: "auto",
            "static" or "moving".

    Raises:
        MethodError: an unknown name; the message lists the choices.
        SettingsError: a setting that the method does not have, or a value that it cannot have.
    """
    cls = find_class(name)
    if settings and not _has_settings(cls):
        others = ", ".join(other for other in METHODS if _has_settings(find_class(other)))
        path = next(iter(flat(settings)))
        raise SettingsError(
            f"unknown setting {path}: the method {name} has no settings; methods with settings: {others}"
        )
    return build(cls, settings)


def _has_settings(cls: type[PairEstimator]) -> bool:
    return any(field.init for field in dataclasses.fields(cast(Any, cls)))


def find_class(name: str) -> type[PairEstimator]:
    """The class of a method; its fields are the method's settings.

    Raises:
        MethodError: an unknown name; the message lists the choices.
    """
    check_name(name)
    entry = METHODS[name]
    return cast("type[PairEstimator]", getattr(importlib.import_module(entry.module), entry.factory))


def has_network(name: str) -> bool:
    """Whether a method is learned: its settings then name a file of weights.

    Raises:
        MethodError: an unknown name; the message lists the choices.
    """
    return any(field.name == "weights" for field in dataclasses.fields(cast(Any, find_class(name))))


def check_name(name: str) -> None:
    """Check the name of a method.

    Raises:
        MethodError: an unknown name; the message lists the choices.
    """
    if name not in METHODS:
        near = difflib.get_close_matches(name, METHODS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise MethodError(f"unknown method {name!r}: {hint}choose one of {', '.join(sorted(METHODS))}")
