"""The last frames of a sequence, in which an object that has just been found is followed back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_fit import FrameView
from objectflow.typing import BoolMask, Float64Array, LabelImage


@dataclass(frozen=True, eq=False)
class RecentFrame:
    """A frame of a sequence and what was found in it. It can be pickled.

    Attributes:
        frame: colour and depth.
        time: as in the tracks.
        world_T_camera: (4, 4).
        known: (H, W) int32 masks of the known objects by track id, 0 elsewhere.
    """

    frame: RgbdFrame
    time: float
    world_T_camera: Float64Array
    known: LabelImage


class RecentViews:
    """Recent frames as models are compared with them, each prepared when it is first used.

    Attributes:
        frames: in order of time; the last one is the previous frame of the latest pair.
        revised: masks of the known objects by the time of the frame, of those in which an object was found later.
    """

    def __init__(
        self, frames: tuple[RecentFrame, ...], settings: KnownSettings, noise: DepthNoise, last: FrameView
    ) -> None:
        """Prepare the frames.

        Args:
            frames: of one world, in order of time.
            settings: of the comparison.
            noise: of the frames' depth.
            last: the last of them, which is prepared already.
        """
        self.frames, self.revised = frames, dict[float, LabelImage]()
        self._settings, self._noise = settings, noise
        self._views = {len(frames) - 1: last}

    def view(self, number: int) -> FrameView:
        """The frame of this number, as models are compared with it."""
        if number not in self._views:
            self._views[number] = FrameView(PreparedFrame(self.frames[number].frame), self._settings, self._noise)
        return self._views[number]

    def known(self, number: int) -> LabelImage:
        """(H, W) int32 masks of the known objects in the frame of this number, with those that were found later."""
        frame = self.frames[number]
        return self.revised.get(frame.time, frame.known)

    def add(self, number: int, track: int, mask: BoolMask, whole: int = 0) -> None:
        """Add the mask of an object that was found later.

        Args:
            number: of the frame.
            track: id of the object.
            mask: (H, W) bool.
            whole: id of the object of which it was a part until then, whose pixels it takes.
        """
        known = self.known(number).copy()
        known[mask & ((known == 0) | (known == whole))] = track
        self.revised[self.frames[number].time] = known

    def rename(self, number: int, to: int) -> None:
        """Give the masks of an object another id, since it is a piece of that object."""
        for place, frame in enumerate(self.frames):
            known = self.known(place)
            if (known == number).any():
                self.revised[frame.time] = np.where(known == number, np.int32(to), known)


def revised_frames(frames: tuple[RecentFrame, ...], revised: Mapping[float, LabelImage]) -> tuple[RecentFrame, ...]:
    """The frames with the masks that were found later."""
    return tuple(
        RecentFrame(frame.frame, frame.time, frame.world_T_camera, revised.get(frame.time, frame.known))
        for frame in frames
    )
