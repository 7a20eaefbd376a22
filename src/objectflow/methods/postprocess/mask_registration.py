"""Registration of the surface of a mask that has no trusted motion yet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objectflow.alignment import fitting, registration
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import RefineSettings
from objectflow.geometry.resample import nearest_indices
from objectflow.typing import BoolMask, Float64Array


def register_mask(
    pair: FramePair, mask: BoolMask, settings: RefineSettings, *, starts: Sequence[Float64Array] = ()
) -> list[Float64Array]:
    """Motions (4, 4) of a mask, registered from standing still, from the fit to its matches, and from others.

    Args:
        pair: the frames, from a static camera.
        mask: (H, W) bool on the pixels of the current frame.
        settings: of the registration and of the fit.
        starts: further initial motions.

    Returns:
        At least one motion; the identity where no registration ends at finite numbers.
    """
    wide = pair.at_width(settings.width)
    camera, matches = wide.curr.frame.camera, wide.matches
    rows, columns = nearest_indices(mask.shape, (camera.height, camera.width))
    mask = mask[rows[:, None], columns]
    column, row = np.rint(matches.pixels).astype(np.intp).T
    own = matches[mask[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]]
    source = wide.sources.take(mask, limit=settings.max_points)
    initial = [np.eye(4)]
    if len(own.curr) >= settings.min_matches:
        initial.append(fitting.fit_matches(own, camera, noise=pair.noise, settings=settings.fit)[0])
    found = [
        registration.refine(wide.target, source, start, settings=settings.registration)
        for start in (*initial, *starts)
    ]
    return [one.prev_T_curr for one in found if np.isfinite(one.prev_T_curr).all()] or [np.eye(4)]
