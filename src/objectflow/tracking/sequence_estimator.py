"""A sequence, frame after frame: the motion of each pair, persistent ids, and the masks of all known objects."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter as clock
from typing import Any, NamedTuple

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import DEFAULTS as MATCHING
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.methods.base import Estimator, PairEstimator, estimate_pair
from objectflow.methods.labels import unknown_motion
from objectflow.motion import SceneMotion
from objectflow.runtime.side_threads import has_side_threads
from objectflow.runtime.threads import one_blas_thread
from objectflow.tracking.explained_step import explained_step, may_be_explained
from objectflow.tracking.known_objects import KnownObjects
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.longer_gap import LongerEstimate, LongerGaps, add_found
from objectflow.tracking.look_back import add_earlier_masks, add_earlier_poses
from objectflow.tracking.looks import start_features
from objectflow.tracking.merge_objects import MovedTogether, merge_into
from objectflow.tracking.model_motion import PairViews
from objectflow.tracking.recent_frames import RecentFrame, RecentViews, revised_frames
from objectflow.tracking.running_noise import RunningNoise
from objectflow.tracking.scene_cut import CutSettings, is_cut
from objectflow.tracking.track import Track
from objectflow.tracking.tracker import Tracker
from objectflow.typing import LabelImage

CUT = "cut: the frames show different scenes, so no object is reported, and objects get new ids"
"""Note of an estimate that a cut replaces."""


@dataclass(frozen=True, eq=False)
class SequenceStep:
    """The result of one frame of a sequence.

    Attributes:
        prev, curr: the last frame and this one.
        times: of both, seconds, or frame numbers where there are no times.
        motion: between the frames; the camera is unknown at a cut to another scene, where a new world begins.
        tracks: track id of each object of `motion` that has a track, by the object's id.
        known: (H, W) int32 label image of every object that has moved up to now, by track id, also at rest and half
            hidden; 0 elsewhere.
        followed: track ids of the objects that moved although `motion` lacks them, as their models show.
        revised: `known` of earlier frames, by their times, in which objects were found later: an object that moved
            for the first time is followed back, and one that comes apart is two objects in earlier frames too.
        longer: an estimate between this frame and one before `prev`, where something changed that `motion` and the
            known objects do not explain; None in most steps.
        estimated: False where the known objects explained the pair, and `motion` comes from their models.
    """

    prev: RgbdFrame
    curr: RgbdFrame
    times: tuple[float, float]
    motion: SceneMotion
    tracks: Mapping[int, int]
    known: LabelImage
    followed: tuple[int, ...] = ()
    revised: Mapping[float, LabelImage] = field(default_factory=dict)
    longer: LongerEstimate | None = None
    estimated: bool = True


class _Found(NamedTuple):
    """What the recent frames show.

    Attributes:
        revised: their masks of known objects, by time, where these have changed.
        longer: an estimate from one of them to the current frame.
        moved: track ids of all objects that moved in the latest pair.
        pieces: the id of each object that is a piece of an older one, and the id of that one.
    """

    revised: Mapping[float, LabelImage]
    longer: LongerEstimate | None
    moved: frozenset[int]
    pieces: Mapping[int, int]


class SequenceEstimator:
    """Estimates consecutive frames, follows the objects and keeps those that have moved once known.

    With a limited history in the settings of the tracker, memory does not grow with time. `state` and `restore` stop
    and continue a sequence, also in another process.

    Attributes:
        cuts: when two frames show different scenes.
        tracker: the trajectories of the objects and of the camera.
        known_objects: the models of the objects.
        noise: the running estimate of the camera's depth noise, with which models are compared with frames.
        segmentation: the label image `known` of the latest step; None before the first.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        tracker: Tracker | None = None,
        settings: KnownSettings | None = None,
        cuts: CutSettings | None = None,
        skip_explained: bool = False,
    ) -> None:
        """Prepare a sequence.

        Args:
            estimator: of the pairs.
            tracker: a new one, for settings other than the default.
            settings: of the known objects.
            cuts: when two frames show different scenes.
            skip_explained: estimate no pair of a static camera in which standing still and the motions of the known
                objects explain every change; their models give its motion, in a fraction of the time.
        """
        self.estimator = estimator
        self.skip_explained = skip_explained
        self.cuts = cuts or CutSettings()
        self.tracker = tracker or Tracker()
        self.known_objects = KnownObjects(settings)
        settings = self.known_objects.settings
        self.noise = RunningNoise(settings.noise_pairs, settings.noise)
        self.segmentation: LabelImage | None = None
        self._last: PreparedFrame | None = None
        self._time = 0.0
        self._recent: tuple[RecentFrame, ...] = ()
        self._longer_gaps = LongerGaps(settings.longer_gap, settings.change)
        self._together = MovedTogether(self.known_objects.settings.merge)

    @property
    def tracks(self) -> list[Track]:
        """All tracks that are kept, in order of id."""
        return self.tracker.tracks

    @one_blas_thread()
    def update(
        self,
        frame: RgbdFrame,
        time: float | None = None,
        motion: SceneMotion | None = None,
        longer: LongerEstimate | None = None,
    ) -> SequenceStep | None:
        """Add the next frame.

        Args:
            frame: of the same size and camera as the last one.
            time: of the frame, later than that of the last one; the frame's time stamp if None, or the number of the
                frame where it has none.
            motion: between the last frame and this one, where it is known already, as from an earlier run; None
                estimates it.
            longer: `SequenceStep.longer` of this frame, where it is known already.

        Returns:
            The result, or None for the first frame of a sequence.

        Raises:
            FrameError: the frames differ in size or intrinsics, or their times do not rise.
        """
        if time is None:
            time = frame.timestamp
        if time is None:
            time = 0.0 if self._last is None else self._time + 1
        prev, prev_time = self._last, self._time
        if prev is None:
            self._last, self._time = PreparedFrame.of(frame), time
            self._remember(frame, time, np.zeros(frame.depth.shape, np.int32))
            return None
        # What the last estimate computed on its current frame is not computed again, nor are this estimate's matches.
        pair = FramePair(prev, frame, matching=getattr(self.estimator, "matching", MATCHING))
        if self.skip_explained and motion is None and (step := self._explain(pair, time)) is not None:
            return step
        if has_side_threads():
            self._start(pair, motion is None)
        found = estimate_pair(self.estimator, pair) if motion is None else motion
        if is_cut(pair, found, self.cuts):
            unknown = unknown_motion(found.labels.shape)
            found = replace(unknown, method=found.method, seconds=found.seconds, settings=found.settings, notes=(CUT,))
        view = self.known_objects.view(pair.curr, self.noise.add(pair, found))
        static = np.eye(4) if found.camera_motion is None else found.camera_motion
        views = PairViews(pair, self.known_objects.view(pair.prev, view.noise), view, static, self.segmentation)
        evidence = self.known_objects.evidence(views, found.labels, self.tracker)
        tracks = self.tracker.update(
            prev_time,
            frame,
            time,
            found,
            evidence,
        )
        followed = self.known_objects.follow(views, found, tracks, self.tracker, prev_time, time)
        known = self.known_objects.update(view, found, tracks, self.tracker, frame.depth.shape, followed)
        back = self._look_back(views, found, known, time, longer, {*tracks.values(), *followed})
        followed = tuple(sorted(back.moved - set(tracks.values())))
        tracks = {label: back.pieces.get(number, number) for label, number in tracks.items()}
        self._finish(pair.curr, time, known)
        times = prev_time, time
        return SequenceStep(prev.frame, frame, times, found, tracks, known, followed, back.revised, back.longer)

    def cut(self) -> None:
        """Start a new world, as after a cut: the next frame is a first one, and objects get new ids.

        The noise of the camera is kept.
        """
        self.tracker.reset()
        self.known_objects.objects = {}
        self._last = self.segmentation = None
        self._recent = ()

    def state(self) -> dict[str, Any]:
        """Everything that later results depend on but the estimator; it can be pickled."""
        last = None if self._last is None else self._last.frame
        return {
            "tracker": self.tracker,
            "known_objects": self.known_objects,
            "noise": self.noise,
            "last": last,
            "recent": self._recent,
            "longer_gaps": self._longer_gaps,
            "together": self._together,
            "time": self._time,
            "segmentation": self.segmentation,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`; the estimator must be the same."""
        self.tracker, self.known_objects = state["tracker"], state["known_objects"]
        self.noise = state["noise"]
        self._last = None if state["last"] is None else PreparedFrame(state["last"])
        self._recent, self._longer_gaps = state["recent"], state["longer_gaps"]
        self._together = state["together"]
        self._time, self.segmentation = state["time"], state["segmentation"]

    @one_blas_thread()
    def explain(self, frame: RgbdFrame, time: float) -> SequenceStep | None:
        """Add the next frame only if the known objects explain every change in it; see `skip_explained`.

        Args:
            frame, time: as in `update`.

        Returns:
            The result; None where an estimate is needed, and nothing is added.

        Raises:
            FrameError: as in `update`.
        """
        if self._last is None:
            return None
        matching = getattr(self.estimator, "matching", MATCHING)
        return self._explain(FramePair(self._last, frame, matching=matching), time)

    def _explain(self, pair: FramePair, time: float) -> SequenceStep | None:
        """`explain` for a prepared pair."""
        objects, tracker, prev_time, start = self.known_objects, self.tracker, self._time, clock()
        if not tracker.world_T_camera or getattr(self.estimator, "camera", "auto") == "moving":
            return None
        if not may_be_explained(pair, self.segmentation, objects.settings):
            return None
        view, static = objects.view(pair.curr, self.noise.noise), np.eye(4)
        views = PairViews(pair, objects.view(pair.prev, view.noise), view, static, self.segmentation)
        found = explained_step(views, objects.objects, tracker, time, objects.settings)
        if found is None:
            return None
        motion = replace(found.motion, seconds=clock() - start)
        self.noise.add(pair, motion)
        shape = motion.labels.shape
        nothing = SceneMotion(np.zeros(shape, np.int32), motion.scene_flow)
        tracker.update(prev_time, pair.curr.frame, time, nothing)
        labels = {number: label for label, number in found.tracks.items()}
        for number, pose in found.poses.items():
            world_T_object = tracker.world_T_camera[-1] @ pose.curr_T_object
            tracker.follow(number, prev_time, time, world_T_object, pose.present, labels.get(number, 0))
        known = objects.update(view, nothing, {}, tracker, shape, found.poses, found.shown)
        back = self._look_back(views, motion, known, time, None, found.poses)
        tracks = {label: back.pieces.get(number, number) for label, number in found.tracks.items()}
        followed = tuple(sorted(back.moved - set(tracks.values())))
        self._finish(pair.curr, time, known)
        return SequenceStep(
            pair.prev.frame,
            pair.curr.frame,
            (prev_time, time),
            motion,
            tracks,
            known,
            followed,
            back.revised,
            back.longer,
            estimated=False,
        )

    def _finish(self, curr: PreparedFrame, time: float, known: LabelImage) -> None:
        """Make a frame the last one."""
        self._last, self._time, self.segmentation = curr, time, known
        self._remember(curr.frame, time, known)

    def _start(self, pair: FramePair, estimated: bool) -> None:
        """Start in side threads the estimate, if there is one, and after it the features of objects that move."""
        if estimated and isinstance(self.estimator, PairEstimator):
            self.estimator.start(pair)
        settings = self.known_objects.settings
        if any(known.moved for known in self.known_objects.objects.values()):
            start_features(pair.curr.at_width(settings.width), settings.follow.looks, list(pair.beside.values()))

    def _look_back(
        self,
        views: PairViews,
        motion: SceneMotion,
        known: LabelImage,
        time: float,
        given: LongerEstimate | None,
        moved: Collection[int],
    ) -> _Found:
        """Search the recent frames for objects that have just been found, and for others; unite pieces of one.

        Args:
            views: the latest pair.
            motion: its estimate.
            known: (H, W) int32, to which the masks of found objects are added.
            time: of the current frame.
            given: the estimate between frames farther apart of an earlier run.
            moved: track ids of the objects that moved in the pair.
        """
        if not self.tracker.world_T_camera:  # the camera is lost
            self._recent = ()
            return _Found({}, None, frozenset(), {})
        settings, objects = self.known_objects.settings, self.known_objects
        recent = RecentViews(self._recent, settings, views.curr.noise, views.prev)
        tracks = {track.id: track for track in self.tracks}
        for number, whole in objects.found.items():
            if not whole:
                add_earlier_poses(tracks[number], recent, settings.earlier)
            add_earlier_masks(tracks[number], whole, recent, settings.earlier)
        for number in sorted(objects.rested - set(objects.found)):
            # The model has grown since the object was found.
            add_earlier_masks(tracks[number], 0, recent, settings.earlier)
        moving = np.isin(motion.labels, [obj.id for obj in motion.objects if obj.moving])
        world_T_camera = self.tracker.world_T_camera[-1]
        longer = self._longer_gaps.estimate(self.estimator, views, recent, (known > 0) | moving, world_T_camera, given)
        added: tuple[int, ...] = ()
        if longer is not None:
            added = add_found(longer, objects, self.tracker, views, recent, known, time)
            for track in self.tracks:
                if track.id in added:
                    add_earlier_masks(track, 0, recent, settings.earlier)
        moved = {*moved, *(number for number in added if objects.objects[number].moved)}
        pieces = self._together.update(objects.objects, moved)
        for piece, older in pieces.items():
            merge_into(objects.objects[older], objects.objects.pop(piece), settings.follow.looks.max_features)
            self.tracker.merge(piece, older)
            known[known == piece] = older
            recent.rename(piece, older)
        self._recent = revised_frames(self._recent, recent.revised)
        return _Found(recent.revised, longer, frozenset(moved - set(pieces)), pieces)

    def _remember(self, frame: RgbdFrame, time: float, known: LabelImage) -> None:
        """Keep a frame for those in which an object may be found later."""
        world_T_camera = self.tracker.world_T_camera[-1] if self.tracker.world_T_camera else np.eye(4)
        recent = (*self._recent, RecentFrame(frame, time, world_T_camera, known))
        self._recent = recent[-self.known_objects.settings.earlier.frames :]
