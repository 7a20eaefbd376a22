"""Object ids that last: the objects of consecutive pairs linked, and their motions chained into trajectories.

Every pair gives motions from its current frame back to its previous one, under ids of its own. An object of this pair
is the one that was where its mask came from.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from objectflow import geometry
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float64Array

CELLS = 64
"""Footprints are compared on so many cells across the image: fine enough for a cup, and thinned points fill them."""
MAX_POINTS = 600
"""Points that a track remembers of its surface."""


@dataclass(frozen=True)
class TrackerSettings:
    """When two masks are one object.

    Attributes:
        min_overlap: intersection over union of footprints from which on two may be one.
        max_gap: metres between their median distances from the camera.
        min_score: objects below it, such as regions that no motion explains, get no track.
        coast: pairs for which an unseen track is also looked for where its last motion would have carried it.
        forget: pairs after which a track that was not seen again ends. Things that stop are not seen: they rest.
        history: poses that are kept of each track, and of the camera; None keeps all, and tracks that ended too.
    """

    min_overlap: float = 0.1
    max_gap: float = 0.1
    min_score: float = 0.3
    coast: int = 3
    forget: int = 300
    history: int | None = None


@dataclass(eq=False)
class Track:
    """One object through time. World: the first frame's camera.

    Attributes:
        id: from 1, never used again.
        times: of each pose, in seconds, or frame numbers where there are no times.
        world_T_object: (4, 4) of each time. The object's frame lies at its first centre, turned like the world.
        labels: of each pose, its id in that frame's labels; 0 = seen by the other end of a pair.
        scores: of each pose.
    """

    id: int
    times: list[float] = field(default_factory=list)
    world_T_object: list[Float64Array] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)


@dataclass(eq=False)
class _Memory:
    """Where a track was last seen: its surface in the world, its last step, and how many pairs ago."""

    points: Float64Array
    world_step: Float64Array
    unseen: int = 0


class Tracker:
    """Links the objects of pair after pair.

    Its memory grows by a pose an object and pair, or not at all where the settings limit the history.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._tracks: dict[int, Track] = {}
        self._next = 1
        self.camera_times: list[float] = []
        self.world_T_camera: list[Float64Array] = []
        self._memories: dict[int, _Memory] = {}

    @property
    def tracks(self) -> list[Track]:
        """Every track that is kept, by its id."""
        return list(self._tracks.values())

    def update(self, prev_time: float, curr: RgbdFrame, time: float, motion: SceneMotion) -> dict[int, int]:
        """Take in the next pair; its previous frame is the current one of the last call.

        Args:
            prev_time: of the pair's previous frame.
            curr: the pair's current frame.
            time: of the current frame, later than `prev_time`.
            motion: what a method found in the pair.

        Returns:
            The track of each object of `motion` that has one, by the object's id.

        Raises:
            FrameError: times that do not rise, or a frame of another size than the labels.
        """
        if not prev_time < time or (self.camera_times and prev_time != self.camera_times[-1]):
            raise FrameError(
                f"a tracker needs consecutive pairs in order of time, not {prev_time:g} and then {time:g}"
            )
        if motion.labels.shape != curr.depth.shape:
            raise FrameError(f"labels {motion.labels.shape} do not fit the frame {curr.depth.shape}")
        if not self.camera_times:
            self.camera_times.append(prev_time)
            self.world_T_camera.append(np.eye(4))
        world_T_prev = self.world_T_camera[-1]
        camera_step = np.eye(4) if motion.camera_motion is None else motion.camera_motion
        world_T_curr = world_T_prev @ camera_step
        self.camera_times.append(time)
        self.world_T_camera.append(world_T_curr)

        objects = [o for o in motion.objects if o.moving and o.score >= self.settings.min_score]
        surfaces = [_surface(curr, motion.labels == o.id) for o in objects]
        known = [(o, s) for o, s in zip(objects, surfaces, strict=True) if len(s)]
        links = self._link([o for o, _ in known], [s for _, s in known], curr.camera, world_T_prev)
        found: dict[int, int] = {}
        for (obj, surface), number in zip(known, links, strict=True):
            # Where a point of the world was before, and is now: the object's own motion, the camera's taken out.
            world_step = world_T_curr @ geometry.inverse(obj.prev_T_curr) @ geometry.inverse(world_T_prev)
            track = self._track(number, obj, surface, prev_time, world_T_prev)
            track.times.append(time)
            track.world_T_object.append(world_step @ track.world_T_object[-1])
            track.labels.append(obj.id)
            track.scores.append(obj.score)
            self._memories[track.id] = _Memory(geometry.transform(world_T_curr, surface), world_step)
            found[obj.id] = track.id
        self._age(set(found.values()))
        self._trim()
        return found

    def reset(self) -> None:
        """Forget where things are, as after a cut: the next pair starts anew, under new ids."""
        self.camera_times, self.world_T_camera = [], []
        self._memories = {}
        if self.settings.history is not None:
            self._tracks = {}

    def _link(
        self, objects: list[ObjectMotion], surfaces: list[Float64Array], camera: Camera, world_T_prev: Float64Array
    ) -> list[int | None]:
        """The track of each object, None for a new one: the assignment of greatest overlap (Hungarian method)."""
        numbers = list(self._memories)
        overlap = np.zeros((len(objects), len(numbers)))
        before = [geometry.transform(o.prev_T_curr, s) for o, s in zip(objects, surfaces, strict=True)]
        prev_T_world = geometry.inverse(world_T_prev)
        for column, number in enumerate(numbers):
            memory = self._memories[number]
            places = [memory.points]
            if 0 < memory.unseen <= self.settings.coast:
                # It may have moved on while nobody saw it.
                step = np.linalg.matrix_power(memory.world_step, memory.unseen)
                places.append(geometry.transform(step, memory.points))
            for place in places:
                seen = geometry.transform(prev_T_world, place)
                for row, points in enumerate(before):
                    if abs(np.median(points[:, 2]) - np.median(seen[:, 2])) < self.settings.max_gap:
                        overlap[row, column] = max(overlap[row, column], footprint_overlap(points, seen, camera))
        links: list[int | None] = [None] * len(objects)
        for i, j in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
            if overlap[i, j] >= self.settings.min_overlap:
                links[i] = numbers[j]
        return links

    def _track(
        self,
        number: int | None,
        obj: ObjectMotion,
        surface: Float64Array,
        prev_time: float,
        world_T_prev: Float64Array,
    ) -> Track:
        """The track of that number, or a new one that starts where the object was in the previous frame."""
        if number is not None:
            track = self._tracks[number]
            if track.times[-1] < prev_time:
                # It rested until the previous frame, as far as anybody saw.
                track.times.append(prev_time)
                track.world_T_object.append(track.world_T_object[-1])
                track.labels.append(0)
                track.scores.append(track.scores[-1])
            return track
        start = np.eye(4)
        start[:3, 3] = geometry.transform(world_T_prev @ obj.prev_T_curr, surface.mean(axis=0))
        track = Track(self._next, [prev_time], [start], [0], [obj.score])
        self._tracks[self._next] = track
        self._next += 1
        return track

    def _age(self, seen: set[int]) -> None:
        for number in list(self._memories):
            if number not in seen:
                self._memories[number].unseen += 1
                if self._memories[number].unseen > self.settings.forget:
                    del self._memories[number]
                    if self.settings.history is not None:
                        del self._tracks[number]

    def _trim(self) -> None:
        """Keep no more history than the settings allow."""
        keep = self.settings.history
        if keep is None:
            return
        del self.camera_times[:-keep], self.world_T_camera[:-keep]
        for track in self._tracks.values():
            del track.times[:-keep], track.world_T_object[:-keep], track.labels[:-keep], track.scores[:-keep]


def footprint_overlap(a: Float64Array, b: Float64Array, camera: Camera) -> float:
    """Intersection over union of the image cells that two sets of points (N, 3), camera frame, fall into."""
    cell = camera.width / CELLS
    footprints = []
    for points in (a, b):
        pixels = geometry.project(points[points[:, 2] > 0], camera)
        footprints.append({tuple(one) for one in np.floor((pixels + 0.5) / cell).astype(int).tolist()})
    union = len(footprints[0] | footprints[1])
    return len(footprints[0] & footprints[1]) / union if union else 0.0


def _surface(frame: RgbdFrame, mask: BoolMask) -> Float64Array:
    """(N, 3) points of a mask, camera frame, thinned evenly."""
    rows, columns = np.nonzero(mask & frame.valid)
    if len(rows) > MAX_POINTS:
        pick = np.linspace(0, len(rows) - 1, MAX_POINTS).astype(int)
        rows, columns = rows[pick], columns[pick]
    camera, z = frame.camera, frame.depth[rows, columns].astype(np.float64)
    return np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
