"""The network evaluated again on enlarged parts of the frames that its first result leaves unexplained.

An object that covers only a few cells of the network's grid often has no query of its own. In a window of half the
frame's width, enlarged by half, it covers more than twice as many cells.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.look_settings import SecondLookSettings
from objectflow.methods.postprocess.look_windows import Remainder, Window, find_remainder, find_windows
from objectflow.methods.postprocess.mask_registration import register_mask
from objectflow.methods.postprocess.new_motion import with_motion
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, LabelImage

Look = Callable[[FramePair, Sequence[Window]], list[tuple[LabelImage, Objects]]]
"""Evaluates a network on windows of a pair: (H, W) int32 labels on each window's pixels, and their objects."""


class Seen(NamedTuple):
    """An object of the second look: its mask (H, W) bool is on the pixels of the frame."""

    obj: ObjectMotion
    mask: BoolMask


def second_look(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings, *, look: Look
) -> tuple[LabelImage, Objects]:
    """Add the objects of a second look whose motions explain pixels that the result leaves unexplained.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: of these labels.
        settings: `second_look`, `refine`, `static_test` and `likelihood` apply.
        look: evaluates the network.

    Returns:
        Labels and objects, numbered anew from 1 if one was added; otherwise the same.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    remainder = find_remainder(likelihood, small, objects)
    windows = find_windows(likelihood, small, objects, remainder, labels.shape, settings.second_look.windows)
    if not windows:
        return labels, objects
    seen = _distinct(_seen(windows, look(pair, windows), labels.shape, settings.second_look), settings.second_look)
    first = max((obj.id for obj in objects), default=0) + 1
    movers = [labels == obj.id for obj in objects if obj.moving]
    out, added = labels.copy(), list[ObjectMotion]()
    for one in seen:
        if any(_iou(one.mask, mask) >= settings.second_look.same_iou for mask in movers):
            continue
        found = _explained(pair, likelihood, remainder, one, settings)
        if found is not None:
            added.append(dataclasses.replace(found, id=first + len(added), pixels=int(one.mask.sum())))
            out[one.mask] = added[-1].id
    return relabel_present(out, objects + tuple(added)) if added else (labels, objects)


def _seen(
    windows: Sequence[Window],
    looks: Sequence[tuple[LabelImage, Objects]],
    size: tuple[int, ...],
    settings: SecondLookSettings,
) -> list[Seen]:
    """The smaller objects that no border of a window cuts."""
    out = []
    for window, (labels, objects) in zip(windows, looks, strict=True):
        cut = _cut_labels(window, labels, size)
        for obj in objects:
            own = labels == obj.id
            if own.sum() <= settings.max_window_share * own.size and obj.id not in cut:
                mask = np.zeros(size, np.bool_)
                mask[window.slices] = own
                out.append(Seen(obj, mask))
    return out


def _cut_labels(window: Window, labels: LabelImage, size: tuple[int, ...]) -> set[int]:
    """Labels at those borders of a window that lie inside the frame."""
    borders = (
        (window.y > 0, labels[:2]),
        (window.x > 0, labels[:, :2]),
        (window.y + window.height < size[0], labels[-2:]),
        (window.x + window.width < size[1], labels[:, -2:]),
    )
    return {int(number) for inside, border in borders if inside for number in np.unique(border)}


def _distinct(seen: list[Seen], settings: SecondLookSettings) -> list[Seen]:
    """The objects, the most probable first, without those that overlap a more probable one."""
    kept: list[Seen] = []
    for one in sorted(seen, key=lambda one: -one.obj.score):
        area = int(one.mask.sum())
        if all((one.mask & other.mask).sum() <= settings.max_overlap * min(area, other.mask.sum()) for other in kept):
            kept.append(one)
    return kept


def _iou(a: BoolMask, b: BoolMask) -> float:
    return float((a & b).sum()) / max(1, int((a | b).sum()))


def _explained(
    pair: FramePair, likelihood: PairLikelihood, remainder: Remainder, one: Seen, settings: PostprocessSettings
) -> ObjectMotion | None:
    """The object with its best motion; None where what its pixels follow so far may be right.

    If no registered motion explains an object that cannot have followed it, the network's own motion is kept: the
    registered ones lie on surfaces that are not the object's.
    """
    look = settings.second_look
    mask = likelihood.mask(likelihood.downscale(one.mask.astype(np.int32)), 1)
    if mask.sum() < look.min_pixels:
        return None
    before = float(remainder.cost[mask].mean())
    if before < look.min_gain:
        return None
    motions = register_mask(pair, one.mask, settings.refine, starts=[one.obj.prev_T_curr])
    costs = [float(likelihood.cost(motion, mask, out_of_view=look.cost_out_of_view).mean()) for motion in motions]
    best = int(np.argmin(costs))
    least = max(look.min_gain, look.min_total_gain / mask.sum())
    if before - costs[best] >= least and costs[best] <= look.max_cost:
        motion = motions[best]
    elif before >= look.contradicted_cost and remainder.hidden[mask].mean() <= look.max_hidden:
        motion = one.obj.prev_T_curr
    else:
        return None
    points = likelihood.points[mask]
    noise = float(pair.noise.sigma(float(np.median(points[:, 2]))))
    smallest = max(settings.static_test.static_displacement, look.min_noise_ratio * noise)
    found = with_motion(one.obj, motion, points, smallest)
    return found if found.moving else None
