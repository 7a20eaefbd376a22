"""The cost of the background's motion on a pair of frames, which several steps share."""

from __future__ import annotations

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings, motion_cost
from objectflow.typing import BoolMask, Float32Array, Float64Array


def background_cost(
    pair: FramePair, prev_T_curr: Float64Array, settings: LikelihoodSettings
) -> tuple[Float32Array, BoolMask]:
    """The cost of each pixel under the motion of the background, whatever the light; it is computed once per pair.

    Args:
        pair: the frames, at the width of the likelihood.
        prev_T_curr: (4, 4) motion of the static background.
        settings: of the likelihood.

    Returns:
        See `motion_cost`; the arrays are shared and must not be changed.
    """
    key = background_cost, prev_T_curr.tobytes(), settings
    if key not in pair.memo:
        pair.memo[key] = motion_cost(
            pair.prev.frame,
            pair.curr.points,
            prev_T_curr,
            (pair.prev.appearance, pair.curr.appearance),
            light=True,
            noise=pair.noise,
            settings=settings,
        )
    found: tuple[Float32Array, BoolMask] = pair.memo[key]
    return found
