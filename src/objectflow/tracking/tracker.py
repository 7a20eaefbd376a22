"""Persistent object ids: objects of consecutive pairs are associated and their motions chained into trajectories.

Each pair has its own object ids, with motions from its current frame back to its previous frame. An object's surface
is carried back by its motion and associated with the track whose last surface overlaps it most.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import partial

import numpy as np

from objectflow import geometry
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.association import FoundAgain, LastState, associate, continuation, similar_tracks
from objectflow.tracking.evidence import Evidence
from objectflow.tracking.seen_surface import SeenSurface, color_histogram, seen_surface
from objectflow.tracking.track import Track, next_camera_pose
from objectflow.tracking.tracker_settings import TrackerSettings
from objectflow.typing import Float64Array, UInt8Array


class Tracker:
    """Associates the objects of consecutive pairs.

    Memory grows by one pose per object and pair, unless the settings limit the history.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._tracks: dict[int, Track] = {}
        self._next = 1
        self.camera_times: list[float] = []
        self.world_T_camera: list[Float64Array] = []
        self._states: dict[int, LastState] = {}
        self._first_of_world = 1

    @property
    def world_tracks(self) -> list[Track]:
        """The kept tracks since the last reset, whose poses share a world, in order of id."""
        return [track for track in self._tracks.values() if track.id >= self._first_of_world]

    @property
    def tracks(self) -> list[Track]:
        """All tracks that are kept, in order of id."""
        return list(self._tracks.values())

    def update(
        self,
        prev_time: float,
        curr: RgbdFrame,
        time: float,
        motion: SceneMotion,
        evidence: Evidence | None = None,
    ) -> dict[int, int]:
        """Add the next pair, whose previous frame must be the current frame of the last call.

        Args:
            prev_time: of the pair's previous frame.
            curr: the pair's current frame.
            time: of the current frame, later than `prev_time`.
            motion: the estimate for the pair.
            evidence: what the current frame shows of objects whose shape is known; None without it.

        Returns:
            Track id of each object of `motion` that has a track, by the object's id.

        Raises:
            FrameError: the times are not consecutive, or the frame and the labels differ in size.
        """
        if not prev_time < time or (self.camera_times and prev_time != self.camera_times[-1]):
            raise FrameError(
                f"a tracker needs consecutive pairs in order of time, not {prev_time:g} and then {time:g}"
            )
        if motion.labels.shape != curr.depth.shape:
            raise FrameError(f"labels {motion.labels.shape} do not fit the frame {curr.depth.shape}")
        world_T_prev = self.world_T_camera[-1] if self.world_T_camera else np.eye(4)
        world_T_curr = next_camera_pose(world_T_prev, motion)
        if world_T_curr is None:
            self.reset()
            return {}
        if not self.camera_times:
            self.camera_times.append(prev_time)
            self.world_T_camera.append(world_T_prev)
        self.camera_times.append(time)
        self.world_T_camera.append(world_T_curr)
        for track_id in self._states:
            self._tracks[track_id].world_T_camera = world_T_curr

        objects = [o for o in motion.objects if o.moving]
        surfaces = [seen_surface(curr, motion.labels == o.id, self.settings.max_points) for o in objects]
        known = [(o, s) for o, s in zip(objects, surfaces, strict=True) if len(s.points)]
        refused = None if evidence is None else partial(self._is_refused, world_T_prev, world_T_curr, evidence)
        prev_T_world = geometry.inverse(world_T_prev)
        links = associate(known, self._states, curr.camera, prev_T_world, refused, self.settings)
        found: dict[int, int] = {}
        # Pieces of an object are recognised once the object has its new pose, and sure motions come first.
        order = sorted(zip(known, links, strict=True), key=lambda one: (one[1] is None, not self._is_sure(one[0][0])))
        for (obj, surface), number in order:
            # The object's motion from prev to curr in the world frame, without the camera's motion.
            world_step = world_T_curr @ geometry.inverse(obj.prev_T_curr) @ geometry.inverse(world_T_prev)
            # A motion that is not sure does not tell where the object was, but the frames may show that it moved.
            arrived = number is None and not self._is_sure(obj)
            if arrived and (evidence is None or not evidence.arrives(obj)):
                continue
            if number is not None and not self._is_sure(obj):
                before, after = self._poses(number, obj, world_T_prev, world_T_curr)
                if evidence is None or not evidence.confirms(number, before, after):
                    self._tracks[number].gaps.append(time)
                    continue
            if number is None and evidence is not None and not arrived:
                # Whether an object moved with a known one takes a sure motion.
                whole = evidence.contains(obj, self._steps(found.values(), world_T_prev, world_T_curr))
                if whole is not None:
                    self._add_piece(whole, geometry.transform(world_T_curr, surface.points))
                    found[obj.id] = whole
                    continue
            again = None
            if number is None:
                again = self._found_again(obj, surface, curr, world_T_curr, evidence, {*links, *found.values()})
            if again is not None:
                track, pose = self._tracks[again.number], again.world_T_object
                track.rest_until(prev_time)
            elif arrived:
                track = self._new_track()
                pose = geometry.make_transform(np.eye(3), geometry.transform(world_T_curr, obj.center))
            else:
                track = self._track(number, obj, prev_time, world_T_prev)
                pose = world_step @ track.world_T_object[-1]
            guessed = arrived if again is None else not again.confirmed
            if guessed:
                track.gaps.append(time)
            if arrived or guessed:
                world_step = np.eye(4)  # the unsure motion must not predict the next pose
            track.world_T_object.append(pose)
            track.times.append(time)
            track.labels.append(obj.id)
            track.scores.append(obj.score)
            track.world_T_camera = world_T_curr
            points = geometry.transform(world_T_curr, surface.points)
            self._states[track.id] = LastState(points, surface.colors, world_step)
            found[obj.id] = track.id
        self._age(set(found.values()))
        self._trim()
        return found

    def follow(
        self,
        number: int,
        prev_time: float,
        time: float,
        world_T_object: Float64Array,
        score: float,
        label: int = 0,
    ) -> None:
        """Add a step of a track that the estimate of the latest pair lacks.

        Args:
            number: of the track, which has no pose at this time.
            prev_time, time: of the pair.
            world_T_object: (4, 4) the pose at `time`.
            score: of the step, 0..1.
            label: of the object in the label image of the pair, 0 for none.
        """
        track, state = self._tracks[number], self._states[number]
        track.rest_until(prev_time)
        world_T_object = geometry.nearest_rigid(world_T_object)
        step = world_T_object @ geometry.inverse(track.world_T_object[-1])
        track.times.append(time)
        track.world_T_object.append(world_T_object)
        track.labels.append(label)
        track.scores.append(score)
        track.gaps = [gap for gap in track.gaps if gap != time]
        points = geometry.transform(step, state.points)
        self._states[number] = LastState(points, state.colors, step)
        self._trim()

    def see(self, number: int, surface: SeenSurface) -> None:
        """Replace the last surface of a track by what the current frame shows, in its camera frame.

        The pair's mask may have shown a part only.
        """
        state = self._states[number]
        state.points = geometry.transform(self.world_T_camera[-1], surface.points)
        state.colors = surface.colors

    def split(self, number: int, points: Float64Array, colors: Float64Array) -> Track:
        """A track of a part that rests in the latest pair, while the rest of the object moved.

        Args:
            number: of the object's track, which has moved in the latest pair.
            points: (N, 3) metres in the world: the surface of the part.
            colors: (N, 3) its colours, RGB, 0..255.

        Returns:
            The new track, with the poses of the object up to the previous frame.
        """
        whole = self._tracks[number]
        count = len(whole.times) - 1
        track = self.start(whole.times[:count], whole.world_T_object[:count], whole.scores[:count], points, colors)
        self._states[track.id].world_step, self._states[track.id].age = np.eye(4), 1
        return track

    def start(
        self,
        times: Sequence[float],
        world_T_object: Sequence[Float64Array],
        scores: Sequence[float],
        points: Float64Array,
        colors: Float64Array | UInt8Array,
    ) -> Track:
        """A new track of an object that the estimate of the latest pair lacks.

        Args:
            times: rising, two at least.
            world_T_object: (4, 4) at each time.
            scores: of each pose, 0..1.
            points: (N, 3) metres in the world: its surface at the last time.
            colors: (N, 3) its colours, RGB, 0..255.
        """
        track = self._new_track(times, world_T_object, scores)
        track.world_T_camera = self.world_T_camera[-1]
        pick = np.linspace(0, len(points) - 1, min(len(points), self.settings.max_points)).astype(int)
        histogram = color_histogram(np.clip(np.rint(colors), 0, 255).astype(np.uint8))
        step = world_T_object[-1] @ geometry.inverse(world_T_object[-2]) if len(times) > 1 else np.eye(4)
        self._states[track.id] = LastState(points[pick], histogram, step)
        return track

    def merge(self, number: int, into: int) -> None:
        """End a track whose object is a piece of another one, whose track then continues for both.

        Args:
            number, into: of the track that ends, and of the older one.
        """
        track, state = self._tracks.pop(number), self._states.pop(number)
        older = self._tracks[into]
        older.merged = sorted({*older.merged, number, *track.merged})
        # The labels of one piece are not those of the whole.
        both = {time for time, label in zip(track.times, track.labels, strict=True) if label}
        older.labels = [0 if time in both else label for time, label in zip(older.times, older.labels, strict=True)]
        self._add_piece(into, state.points)

    def keep(self, numbers: Iterable[int]) -> None:
        """Let tracks of objects that are seen at rest not end."""
        for number in numbers:
            if number in self._states:
                self._states[number].age = min(self._states[number].age, self.settings.max_age - 1)

    @property
    def alive(self) -> set[int]:
        """The tracks that have not ended."""
        return set(self._states)

    def predicted_in_camera(self, number: int) -> Float64Array | None:
        """(4, 4) `curr_T_object` of a track if it moves as in its last step; None where it rested, or has no pose.

        It holds after `update`, for a track that the pair did not move.
        """
        state = self._states.get(number)
        if state is None or not 0 < state.age <= self.settings.coast:
            return None
        step = np.linalg.matrix_power(state.world_step, state.age)
        pose = geometry.nearest_rigid(step @ self._tracks[number].world_T_object[-1])
        return geometry.inverse(self.world_T_camera[-1]) @ pose

    def extrapolated(self, number: int, time: float) -> Float64Array | None:
        """(4, 4) `world_T_object` of a track at a later time, at the speed of its last step.

        None where it did not move in the latest pair.
        """
        track, state = self._tracks[number], self._states.get(number)
        if state is None or state.age or len(track.times) < 2:
            return None
        twist = geometry.se3_log(geometry.nearest_rigid(state.world_step))
        steps = (time - track.times[-1]) / (track.times[-1] - track.times[-2])
        return geometry.nearest_rigid(geometry.se3_exp(steps * twist) @ track.world_T_object[-1])

    def reset(self) -> None:
        """Discard the state, as after a cut of the sequence; objects of the next pair get new ids."""
        self.camera_times, self.world_T_camera = [], []
        self._states = {}
        self._first_of_world = self._next
        if self.settings.history is not None:
            self._tracks = {}

    def _found_again(
        self,
        obj: ObjectMotion,
        surface: SeenSurface,
        curr: RgbdFrame,
        world_T_curr: Float64Array,
        evidence: Evidence | None,
        left_out: Collection[int | None],
    ) -> FoundAgain | None:
        """The track that an object without an association is, found again by its model, or else by its place."""
        free = {number: state for number, state in self._states.items() if number not in left_out}
        if evidence is not None:
            known = evidence.recognises(obj, similar_tracks(surface, free, self.settings.min_color_similarity))
            if known is not None:
                return FoundAgain(known[0], world_T_curr @ known[1], confirmed=True)
        curr_T_world = geometry.inverse(world_T_curr)

        def rests(number: int) -> bool:
            last = self._tracks[number].world_T_object[-1]
            return evidence is not None and evidence.rests(number, curr_T_world @ last)

        step = continuation(surface, free, curr.camera, curr_T_world, rests, self.settings)
        if step is None:
            return None
        pose = step[1] @ self._tracks[step[0]].world_T_object[-1]
        return FoundAgain(step[0], geometry.nearest_rigid(pose), confirmed=False)

    def _poses(
        self, number: int, obj: ObjectMotion, world_T_prev: Float64Array, world_T_curr: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Poses `camera_T_object` of a track before and after an object's motion, both in the current camera."""
        world_T_object = self._tracks[number].world_T_object[-1]
        before = geometry.inverse(world_T_curr) @ world_T_object
        return before, geometry.inverse(obj.prev_T_curr) @ geometry.inverse(world_T_prev) @ world_T_object

    def _steps(
        self, numbers: Iterable[int], world_T_prev: Float64Array, world_T_curr: Float64Array
    ) -> dict[int, tuple[Float64Array, Float64Array]]:
        """Poses `camera_T_object` of tracks in both frames of the latest pair."""
        cameras = geometry.inverse(world_T_prev), geometry.inverse(world_T_curr)
        poses = {number: self._tracks[number].world_T_object[-2:] for number in numbers}
        return {number: (cameras[0] @ both[0], cameras[1] @ both[-1]) for number, both in poses.items()}

    def _add_piece(self, number: int, points: Float64Array) -> None:
        """Add surface (N, 3), in the world, of another object of the pair to a track that has moved in the pair."""
        self._tracks[number].labels[-1] = 0  # no label of the pair is that of the whole
        state = self._states[number]
        both = np.concatenate([state.points, points])
        state.points = both[np.linspace(0, len(both) - 1, min(len(both), self.settings.max_points)).astype(int)]

    def _is_sure(self, obj: ObjectMotion) -> bool:
        """Whether the motion of an object is certain enough for a pose."""
        return obj.score >= self.settings.min_score

    def _is_refused(
        self,
        world_T_prev: Float64Array,
        world_T_curr: Float64Array,
        evidence: Evidence,
        number: int,
        obj: ObjectMotion,
    ) -> bool:
        """Whether the current frame shows that an object is not that of a track."""
        if not self._is_sure(obj):
            return False  # such a motion needs to be confirmed anyway
        return evidence.refuses(number, *self._poses(number, obj, world_T_prev, world_T_curr))

    def _track(
        self,
        track_id: int | None,
        obj: ObjectMotion,
        prev_time: float,
        world_T_prev: Float64Array,
    ) -> Track:
        """The track with this id, or a new one that starts at the object's position in the previous frame."""
        if track_id is not None:
            track = self._tracks[track_id]
            track.rest_until(prev_time)
            return track
        start = geometry.make_transform(np.eye(3), geometry.transform(world_T_prev @ obj.prev_T_curr, obj.center))
        return self._new_track([prev_time], [start], [obj.score])

    def _new_track(
        self,
        times: Sequence[float] = (),
        world_T_object: Sequence[Float64Array] = (),
        scores: Sequence[float] = (),
    ) -> Track:
        """A track with these poses, of which no pair has a label."""
        track = Track(self._next, list(times), list(world_T_object), [0] * len(times), list(scores))
        self._tracks[track.id] = track
        self._next += 1
        return track

    def _age(self, associated: set[int]) -> None:
        """Age the tracks without an association, and end those older than `max_age`."""
        for track_id in list(self._states):
            if track_id not in associated:
                self._states[track_id].age += 1
                if self._states[track_id].age > self.settings.max_age:
                    del self._states[track_id]
                    if self.settings.history is not None:
                        del self._tracks[track_id]

    def _trim(self) -> None:
        """Delete poses beyond the history that the settings allow."""
        keep = self.settings.history
        if keep is None:
            return
        del self.camera_times[:-keep], self.world_T_camera[:-keep]
        for track in self._tracks.values():
            track.keep_last(keep)
