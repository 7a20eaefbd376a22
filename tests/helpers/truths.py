"""True objects, true motions and the truth of analytic scenes, for tests of metrics, oracles and methods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from analytic import AnalyticPair
from objectflow.evaluation.data.truth import PairTruth, TrueObject, make_pair_truth
from objectflow.motion import ObjectMotion


def true_object(
    label: int,
    center: ArrayLike = (0.0, 0.0, 0.0),
    prev_T_curr: ArrayLike | None = None,
    *,
    axes: ArrayLike = (),
    orders: Sequence[int] = (),
    in_both: bool = True,
    rotation_known: bool = True,
) -> TrueObject:
    """A static object without symmetry, unless specified otherwise."""
    return TrueObject(
        label=label,
        center=np.asarray(center, np.float64),
        prev_T_curr=np.eye(4) if prev_T_curr is None else np.asarray(prev_T_curr, np.float64),
        axes=np.asarray(axes, np.float64).reshape(-1, 3),
        orders=tuple(orders),
        in_both=in_both,
        rotation_known=rotation_known,
    )


def truth_of_scene(scene: AnalyticPair, key: str = "pair", scene_name: str | None = None) -> PairTruth:
    """The exact truth of an analytic scene, static objects included."""
    objects = [
        true_object(label, scene.centers[label], T, in_both=bool((scene.prev_labels == label).any()))
        for label, T in scene.prev_T_curr.items()
    ]
    return make_pair_truth(key, scene.curr, scene.labels, objects, scene=scene_name)


def true_objects(scene: AnalyticPair, *, score: float = 0.5, all_moving: bool = False) -> tuple[ObjectMotion, ...]:
    """The visible objects of an analytic scene with their exact motions, by label.

    Args:
        scene: the pair.
        score: of every object.
        all_moving: mark static objects as moving too.
    """
    return tuple(
        ObjectMotion(
            id=label,
            pixels=int((scene.labels == label).sum()),
            score=score,
            moving=all_moving or label in scene.moving,
            center=scene.centers[label],
            prev_T_curr=scene.prev_T_curr[label],
        )
        for label in sorted(scene.prev_T_curr)
        if (scene.labels == label).any()
    )
