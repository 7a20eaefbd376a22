"""What a frame shows of known objects, as the association of a pair's objects needs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from objectflow import geometry
from objectflow.geometry.resample import resize_nearest
from objectflow.motion import ObjectMotion
from objectflow.tracking.arrivals import Arrivals
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_motion import PairViews, best_pose
from objectflow.tracking.search_starts import starts_in_mask
from objectflow.typing import Float64Array, LabelImage


class ModelEvidence:
    """The models of known objects as evidence for and against associations; see `Evidence`."""

    def __init__(
        self,
        objects: Mapping[int, KnownObject],
        views: PairViews,
        labels: LabelImage,
        prev_T_world: Float64Array | None,
        settings: KnownSettings,
    ) -> None:
        """Prepare the evidence of a pair.

        Args:
            objects: by the id of the track, before this pair.
            views: the pair.
            labels: (H, W) int32 of the estimate.
            prev_T_world: (4, 4) the previous camera; None for the first frame of a world.
            settings: thresholds.
        """
        self._objects, self._view, self._settings = objects, views.curr, settings
        self._labels = labels
        self._arrivals = Arrivals(views.pair, views.prev_T_curr, views.curr.noise, settings.arrival)
        self._curr_T_world = None if prev_T_world is None else geometry.inverse(views.prev_T_curr) @ prev_T_world

    def confirms(self, number: int, before: Float64Array, after: Float64Array) -> bool:
        """See `Evidence.confirms`."""
        known, view, settings = self._objects.get(number), self._view, self._settings
        if known is None:
            return False
        pose, better = view.register(known.model, after)
        fit = view.fit(known.model, pose if better else after)
        seen = fit.visible >= settings.min_visible and fit.present >= settings.min_present
        return seen and view.is_better(known.model, before, pose if better else after)

    def refuses(self, number: int, before: Float64Array, after: Float64Array) -> bool:
        """See `Evidence.refuses`."""
        known, settings = self._objects.get(number), self._settings.follow
        if known is None:
            return False
        fit = self._view.fit(known.model, before)
        if fit.fits.sum() < settings.min_points or fit.visible < settings.min_visible:
            return False
        return fit.present >= settings.refused_rest and self._view.is_better(known.model, after, before)

    def rests(self, number: int, camera_T_object: Float64Array) -> bool:
        """See `Evidence.rests`."""
        known = self._objects.get(number)
        if known is None:
            return False
        fit = self._view.fit(known.model, camera_T_object)
        return fit.visible >= self._settings.min_visible and fit.present >= self._settings.follow.max_rest

    def arrives(self, obj: ObjectMotion) -> bool:
        """See `Evidence.arrives`."""
        return self._arrivals.contains(self._labels, obj.id)

    def recognises(self, obj: ObjectMotion, candidates: Sequence[int]) -> tuple[int, Float64Array] | None:
        """See `Evidence.recognises`."""
        view, settings = self._view, self._settings.follow
        if self._curr_T_world is None or not candidates:
            return None
        mask = np.asarray(resize_nearest((self._labels == obj.id).astype(np.uint8), view.frame.frame.depth.shape) > 0)
        best: tuple[float, int, Float64Array] | None = None
        for number in [n for n in candidates if n in self._objects][: settings.max_candidates]:
            known = self._objects[number]
            rest = self._curr_T_world @ known.world_T_object
            if self.rests(number, rest):
                continue
            found = best_pose(view, known.model, starts_in_mask(view, known, mask, rest, self._settings), settings)
            if found is None:
                continue
            shown, _ = view.mask(known.model, found.curr_T_object)
            overlap = float((shown & mask).sum() / max(1, (shown | mask).sum()))
            if overlap >= settings.min_overlap and (best is None or found.present > best[0]):
                best = found.present, number, found.curr_T_object
        return None if best is None else best[1:]

    def contains(self, obj: ObjectMotion, steps: Mapping[int, tuple[Float64Array, Float64Array]]) -> int | None:
        """See `Evidence.contains`."""
        view, settings = self._view, self._settings.follow
        mask = np.asarray(resize_nearest((self._labels == obj.id).astype(np.uint8), view.frame.frame.depth.shape) > 0)
        own = geometry.transform(obj.prev_T_curr, obj.center)
        for number, (before, after) in steps.items():
            if number not in self._objects:
                continue
            apart = np.linalg.norm(own - geometry.transform(before @ geometry.inverse(after), obj.center))
            limit = max(settings.piece_shift, settings.piece_share * float(np.linalg.norm(own - obj.center)))
            if apart > limit:
                continue
            shown, _ = view.mask(self._objects[number].model, after)
            if (shown & mask).sum() >= settings.min_piece * max(1, mask.sum()):
                return number
        return None
