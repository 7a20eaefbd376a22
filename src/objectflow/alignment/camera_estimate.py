"""What is known of a pair's camera: whether it moved, how, and whether the image supports the answer.

The depth noise and the change of light, which need the camera's motion, are measured here too, so that every later
step compares the frames on equal terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment.camera_motion import DEFAULTS as MOTION
from objectflow.alignment.camera_motion import CameraMotionSettings, background_motion
from objectflow.alignment.frame_pair import MATCH_WIDTH, FramePair
from objectflow.alignment.light_change import LightChange, LightSettings, fit_light_change, in_current_light
from objectflow.alignment.likelihood import motion_cost
from objectflow.alignment.measured_noise import MeasuredNoiseSettings, measure_depth_noise
from objectflow.geometry.depth_noise import DEPTH_NOISE, STRUCTURED_LIGHT, DepthNoiseName
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array

CameraState = Literal["static", "moving", "unknown"]
CameraMode = Literal["auto", "static", "moving"]


@dataclass(frozen=True)
class CameraCheckSettings(Settings):
    """When the image supports a motion of the camera, and what is measured with it."""

    width: int = setting(320, minimum=16)
    """Pixels: width at which motions are judged."""
    min_gain: float = setting(0.1, minimum=0)
    """Nats per pixel by which a motion must explain the image better than standing still."""
    inlier_cost: float = setting(1.0, above=0)
    """Cost up to which a pixel counts as explained."""
    min_inlier_ratio: float = setting(0.6, minimum=0, maximum=1)
    """Share of the visible pixels that the camera's motion must explain, unless matches support it."""
    min_match_ratio: float = setting(0.4, minimum=0, maximum=1)
    """Share of the matches that follow the motion, from which `min_supported_ratio` of the pixels is enough: where
    most of the image moves, as in a falling pile, few pixels show the camera's motion."""
    min_matches: int = setting(100, minimum=3)
    """Number of those matches that this takes."""
    min_match_ratio_static: float = setting(0.15, minimum=0, maximum=1)
    """The same for standing still, which a wrong answer rarely resembles."""
    min_matches_static: int = setting(50, minimum=3)
    """See `min_match_ratio_static`."""
    min_supported_ratio: float = setting(0.25, minimum=0, maximum=1)
    """See `min_match_ratio`."""
    min_rival_ratio: float = setting(0.5, minimum=0)
    """A motion may explain the image no better than standing still, as where only one of the frames is blurred. The
    camera then stood still if at least this many matches follow standing still for each that follows the motion;
    otherwise it is unknown."""
    min_pixels: int = setting(100, minimum=0)
    """Fewest pixels with depth from which the image can contradict a motion."""
    min_visible: float = setting(0.15, minimum=0, maximum=1)
    """Share of the pixels that the previous frame must show; otherwise the camera is unknown."""
    ambiguous_share: float = setting(0.15, minimum=0, maximum=1)
    """Share of the image that follows another motion, from which the camera may be the one that follows it."""
    ambiguous_static_ratio: float = setting(0.7, minimum=0, maximum=1)
    """Share of those pixels that standing still explains, from which the camera is ambiguous."""
    noise: MeasuredNoiseSettings = MeasuredNoiseSettings()
    light: LightSettings = LightSettings()


class CameraEstimate(NamedTuple):
    """The camera of a pair.

    Attributes:
        state: "unknown" where no motion explains most of the image.
        prev_T_curr: (4, 4) motion of the static background; None unless the camera moved.
        pair: the frames, with the noise of their depth, and the previous frame's colours in the current light.
        error: metres by which matches typically deviate from the camera's motion; 0 for a static camera.
        light: how the light of the whole image changed; None where it did not.
        ambiguous: what does not follow the camera's motion stands still before the camera.
    """

    state: CameraState
    prev_T_curr: Float64Array | None
    pair: FramePair
    error: float = 0.0
    light: LightChange | None = None
    ambiguous: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know, a line each."""
        out = []
        if self.state == "unknown":
            out.append("camera: unknown: no motion of the camera explains most of the image, so no object is reported")
        if self.ambiguous:
            out.append(
                "camera: ambiguous: a large part of the image stands still before the camera; pass camera='static' "
                "if the camera stood still"
            )
        if self.light is not None:
            out.append(f"light: exposure or white balance changed ({self.light.words()}); colours were matched")
        return tuple(out)


DEFAULTS = CameraCheckSettings()


def estimate_camera(
    pair: FramePair,
    *,
    camera: CameraMode = "auto",
    depth_noise: DepthNoiseName = "measured",
    seed: int = 0,
    motion: CameraMotionSettings = MOTION,
    settings: CameraCheckSettings = DEFAULTS,
) -> CameraEstimate:
    """Estimate the camera's motion, the depth noise and the change of light of a pair.

    Args:
        pair: the frames.
        camera: "static" is taken as true. "moving" never returns "static". "auto" decides.
        depth_noise: a noise model by name, or "measured".
        seed: of the random minimal sets.
        motion: of the search for the background's motion.
        settings: of the check, of noise and of light.
    """
    pair = pair.with_noise(DEPTH_NOISE.get(depth_noise, STRUCTURED_LIGHT))
    if camera == "static":
        equal, light = _equalised(pair, None, depth_noise, settings)
        return CameraEstimate("static", None, equal, light=light)
    found = _searched(pair, camera, depth_noise, seed, motion, settings)
    if found.state == "unknown" and pair.at_width(motion.width).lacks_features:
        return _searched(pair.with_features(), camera, depth_noise, seed, motion, settings)
    return found


def _searched(
    pair: FramePair,
    camera: CameraMode,
    depth_noise: DepthNoiseName,
    seed: int,
    motion: CameraMotionSettings,
    settings: CameraCheckSettings,
) -> CameraEstimate:
    """The estimate by the matches of the pair."""
    rng = np.random.default_rng(seed)
    moved = background_motion(pair, camera=camera, rng=rng, settings=motion)
    found = _judged(pair, moved, camera, depth_noise, settings)
    if found.state == "unknown" and moved is not None and camera == "auto":
        # A wrong motion also gives a wrong noise and a wrong light, so standing still is judged anew.
        static = _judged_against(moved, pair, camera, depth_noise, settings)
        return static if static.state != "unknown" else found
    return found


def _judged(
    pair: FramePair,
    moved: Float64Array | None,
    camera: CameraMode,
    depth_noise: DepthNoiseName,
    settings: CameraCheckSettings,
) -> CameraEstimate:
    """The estimate for one motion of the background; None stands for no motion."""
    equal, light = _equalised(pair, moved, depth_noise, settings)
    motion = np.eye(4) if moved is None else moved
    error, followed, match_ratio = _match_support(pair, motion)
    cost, visible = _cost(equal, motion, settings)
    explained = cost < settings.inlier_cost
    state: CameraState = "static" if moved is None else "moving"
    ambiguous = False
    if moved is not None and visible.any():
        still, _ = _cost(equal, np.eye(4), settings, out_of_view=None)
        if camera == "auto" and float((still - cost)[visible].mean()) < settings.min_gain:
            return _judged_against(moved, pair, camera, depth_noise, settings)
        other = visible & ~explained
        static_ratio = float((still[other] < settings.inlier_cost).mean()) if other.any() else 0.0
        ambiguous = (
            other.sum() > settings.ambiguous_share * visible.sum() and static_ratio > settings.ambiguous_static_ratio
        )
    valid = int(equal.at_width(settings.width).curr.valid.sum())
    if valid < settings.min_pixels:  # nothing contradicts
        return CameraEstimate(state, moved, equal, light=light)
    least, share = settings.min_matches, settings.min_match_ratio
    if moved is None:
        least, share = settings.min_matches_static, settings.min_match_ratio_static
    by_matches = followed >= least and match_ratio >= share
    needed = settings.min_supported_ratio if by_matches else settings.min_inlier_ratio
    if visible.sum() < settings.min_visible * valid or explained[visible].mean() < needed:
        return CameraEstimate("unknown", None, equal, 0.0, light)
    return CameraEstimate(state, moved, equal, 0.0 if moved is None else error, light, bool(ambiguous))


def _judged_against(
    moved: Float64Array,
    pair: FramePair,
    camera: CameraMode,
    depth_noise: DepthNoiseName,
    settings: CameraCheckSettings,
) -> CameraEstimate:
    """The estimate for standing still instead of a motion that the image does not support."""
    found = _judged(pair, None, camera, depth_noise, settings)
    (_, rivals, _), (_, followed, _) = (_match_support(pair, motion) for motion in (moved, np.eye(4)))
    if rivals >= settings.min_matches and followed < settings.min_rival_ratio * rivals:
        return found._replace(state="unknown", ambiguous=False)
    return found


def _equalised(
    pair: FramePair, moved: Float64Array | None, depth_noise: DepthNoiseName, settings: CameraCheckSettings
) -> tuple[FramePair, LightChange | None]:
    """The pair in one light and with the noise of its depth."""
    light = fit_light_change(pair, moved, settings.light)
    if light is not None:
        pair = in_current_light(pair, light)
    if depth_noise == "measured":
        pair = pair.with_noise(measure_depth_noise(pair, moved, floor=pair.noise, settings=settings.noise))
    return pair, light


def _match_support(pair: FramePair, motion: Float64Array) -> tuple[float, int, float]:
    """Median distance of matches from a motion in metres, and the number and share of those within its noise."""
    pair = pair.at_width(MATCH_WIDTH)
    matches = pair.matches
    if not len(matches.curr):
        return 0.0, 0, 0.0
    distance = np.linalg.norm(geometry.transform(motion, matches.curr) - matches.prev, axis=1)
    followed = distance < 3 * pair.noise.match_sigma(matches.curr[:, 2], pair.curr.frame.camera)
    return float(np.median(distance)), int(followed.sum()), float(followed.mean())


def _cost(
    pair: FramePair, motion: Float64Array, settings: CameraCheckSettings, *, out_of_view: float | None = -1.0
) -> tuple[Float32Array, BoolMask]:
    """(H, W) cost of a motion, and (H, W) bool: the pixels that the previous frame shows under it."""
    pair = pair.at_width(settings.width)
    prev, curr = pair.prev, pair.curr
    appearance = (prev.appearance, curr.appearance)
    cost, hidden = motion_cost(prev.frame, curr.points, motion, appearance, noise=pair.noise, out_of_view=out_of_view)
    return cost, curr.valid & ~hidden & (cost >= 0)
