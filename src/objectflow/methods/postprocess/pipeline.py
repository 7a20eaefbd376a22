"""The order of the steps between a network's output and the result, and a record of what each step changed.

A step is a pure function `(pair, labels, objects, settings) -> (labels, objects)`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import refine_objects
from objectflow.errors import SettingsError
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.mask_edges import snap_to_edges
from objectflow.methods.postprocess.changes import StepChange, describe_change
from objectflow.methods.postprocess.drop_uncertain import drop_uncertain
from objectflow.methods.postprocess.merge_fragments import merge_fragments
from objectflow.methods.postprocess.missed_objects import recover_missed_objects
from objectflow.methods.postprocess.motion_search import search_motions
from objectflow.methods.postprocess.outline import drop_without_outline
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.reassign_pixels import reassign_pixels
from objectflow.methods.postprocess.retry_static import retry_static
from objectflow.methods.postprocess.scoring import set_confidence
from objectflow.methods.postprocess.second_look import Look, second_look
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.postprocess.split_objects import split_objects
from objectflow.methods.postprocess.static_test import reject_static, rest_hidden
from objectflow.typing import LabelImage

Step = Callable[[FramePair, LabelImage, Objects, PostprocessSettings], tuple[LabelImage, Objects]]


def _refine(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    return labels, refine_objects(pair, labels, objects, settings.refine)


def _snap(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    if settings.label_size is None:
        return labels, objects
    snapped = snap_to_edges(labels, pair.curr, settings.label_size, pair.noise, settings.snap_to_edges)
    return relabel_present(snapped, objects)


def _no_look(
    _: FramePair, labels: LabelImage, objects: Objects, __: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    return labels, objects


STEPS: dict[str, Step] = {
    "refine": _refine,  # register each object to the previous frame
    "split": split_objects,  # separate surfaces of one mask that move differently are separate objects
    "static_test": reject_static,  # objects without evidence of motion are static
    "retry_static": retry_static,  # motions of objects at rest that standing still does not explain
    "motion_search": search_motions,  # other motions for objects that theirs do not explain
    "merge": merge_fragments,  # fragments that one motion explains are one body
    "reassign": reassign_pixels,  # pixels follow the motion that explains them
    "snap_to_edges": _snap,  # masks that end inside their object give better motions, so borders move only now
    "second_look": _no_look,  # the network on enlarged unexplained regions; only where `postprocess` is given `look`
    "missed_objects": recover_missed_objects,  # what changed outside of all objects
    "rest_hidden": rest_hidden,  # what may have been hidden, where no motion explains it better, is static
    "drop_without_outline": drop_without_outline,  # what looks like all around it is background
    "drop_uncertain": drop_uncertain,  # improbable objects that the frames do not support are background
    "confidence": set_confidence,  # scores of moving objects by their likelihood
}
"""Every step by its name, in the default order."""


def check_steps(settings: PostprocessSettings) -> None:
    """Check the names of the steps.

    Raises:
        SettingsError: an unknown step; the message lists the choices.
    """
    for name, steps in (("steps", settings.steps), ("second_look.then", settings.second_look.then)):
        unknown = [step for step in steps if step not in STEPS]
        if unknown:
            raise SettingsError(
                f"setting postprocess.{name} has no step {unknown[0]!r}: choose among {', '.join(STEPS)}"
            )


def prepare(pair: FramePair, settings: PostprocessSettings) -> None:
    """Compute what the steps need of the frames alone, as while a network is evaluated."""
    likelihood, wide = PairLikelihood.of(pair, settings.likelihood), pair.at_width(settings.refine.width)
    likelihood.static_cost()
    likelihood.static_depth_cost()
    for name in ("target", "sources", "matches"):
        getattr(wide, name)


def postprocess(
    pair: FramePair,
    labels: LabelImage,
    objects: Objects,
    settings: PostprocessSettings,
    changes: list[StepChange] | None = None,
    *,
    look: Look | None = None,
) -> tuple[LabelImage, Objects]:
    """Apply the steps to a network's output.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32 on the pixels of the current frame.
        objects: with the network's motions.
        settings: the steps and their settings.
        changes: where given, a description of what each step changed is appended to it.
        look: evaluates the network on parts of the frames, for `second_look`.

    Returns:
        Labels and objects, numbered from 1.
    """
    steps = STEPS if look is None else STEPS | {"second_look": partial(_look_again, look=look)}
    for name in settings.steps:
        before = labels, objects
        labels, objects = steps[name](pair, labels, objects, settings)
        if changes is not None:
            changes.append(describe_change(name, *before, labels, objects))
    return labels, objects


def _look_again(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings, *, look: Look
) -> tuple[LabelImage, Objects]:
    """`second_look`, and the steps that follow where it added an object."""
    found, more = second_look(pair, labels, objects, settings, look=look)
    if more is objects:
        return labels, objects
    for name in settings.second_look.then:
        found, more = STEPS[name](pair, found, more, settings)
    return found, more
