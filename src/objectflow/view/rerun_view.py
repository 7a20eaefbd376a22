"""The rerun viewer: frames in its window, in a browser or as an .rrd file. Needs the extra `view`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from urllib.parse import quote

import numpy as np

from objectflow import geometry
from objectflow.errors import StorageError
from objectflow.typing import Float64Array
from objectflow.view import colors
from objectflow.view.motion_arrows import place_arrow
from objectflow.view.point_colors import color_by_flow, color_by_object, pale_gray
from objectflow.view.rerun_layout import CAMERA, FRAME, MODELS, POINTS, make_layout
from objectflow.view.rerun_sdk import rr
from objectflow.view.viewer_frames import NO_TRACK, NO_TRACK_NAME, ViewerFrame
from objectflow.view.viewer_outputs import check_display, free_port, temporary_beside

APPLICATION = "objectflow"
SECONDS = "seconds"
"""The timeline of times."""

MAX_POINTS = 100_000
"""Maximum number of points per frame; larger frames are subsampled so that recordings stay small."""
MAX_TRAIL = 300
"""Largest number of positions of a trail."""
MIN_STEP = 0.001
"""Metres: smallest step that a trail shows, so that it does not grow at rest."""
JPEG_QUALITY = 92
PORTS = (9090, 9876)
"""rerun's default ports of the web page and of the data; others are used where these are taken."""
SERVER_MEMORY = "2GiB"
"""Memory limit of the web viewer's server, beyond which the earliest frames are dropped."""

NO_TRACK_COLOR = (173, 181, 189, 255)
TRANSPARENT = (0, 0, 0, 0)
"""Colour of the background in the labels, so that the image below stays visible."""


class RerunViewer:
    """See `viewer.open_viewer` for arguments and errors."""

    def __init__(
        self, title: str, *, window: bool = False, save: Path | None = None, web: bool = False, models: bool = False
    ) -> None:
        if window:
            check_display()
        self._shown: set[int] = set()
        self._drawn: set[int] = set()
        self._names: dict[int, str] = {}
        self._named = False
        self._trails: dict[int, list[Float64Array]] = {}
        self._modelled: set[int] = set()
        self._save, self._temporary = save, None if save is None else temporary_beside(save)
        self._stream = rr.RecordingStream(APPLICATION, recording_id=f"{title}-{time.time_ns()}")
        sinks: list[rr.GrpcSink | rr.GrpcServerSink | rr.FileSink] = []
        self.address: str | None = None
        if window:
            rr.spawn(connect=False)
            sinks.append(rr.GrpcSink())
        if web:
            page, data = (free_port(port) for port in PORTS)
            sinks.append(rr.GrpcServerSink("127.0.0.1", data, server_memory_limit=SERVER_MEMORY))
            rr.serve_web_viewer(web_port=page, open_browser=False)
            url = f"rerun+http://127.0.0.1:{data}/proxy"
            self.address = f"http://127.0.0.1:{page}/?url={quote(url, safe='')}"
        if self._temporary is not None:
            sinks.append(rr.FileSink(self._temporary.path))
        self._stream.set_sinks(*sinks)
        self._stream.send_blueprint(make_layout(models=models))
        self._stream.send_recording_name(title)
        self._log("world", rr.ViewCoordinates.RDF, static=True)

    def __enter__(self) -> RerunViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.flush()
        self._stream.disconnect()
        if self._save is None or self._temporary is None:
            return
        try:
            if kind is None:
                os.replace(self._temporary.path, self._save)
        except OSError as problem:
            raise StorageError(f"cannot write {self._save}: {problem.strerror}") from problem
        finally:
            with suppress(OSError):
                self._temporary.remove()

    def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
        """Log every frame whose number has not been logged yet."""
        for shown in make():
            if shown.number not in self._shown:
                self._shown.add(shown.number)
                self._log_frame(shown)

    def _log_frame(self, shown: ViewerFrame) -> None:
        self._stream.set_time(FRAME, sequence=shown.number)
        if shown.seconds is not None:
            self._stream.set_time(SECONDS, duration=shown.seconds)
        self._log_names(shown)
        self._log_camera(shown)
        self._log_points(shown)
        self._log_motions(shown)
        self._log_poses(shown)
        self._log_trails(shown)
        self._log_models(shown)

    def _log_names(self, shown: ViewerFrame) -> None:
        """Register names and colours of new ids."""
        names = {obj.id: obj.name for obj in shown.objects if obj.id not in self._names}
        if not names and self._named:
            return
        self._named = True
        self._names |= names
        classes = [(0, "static", TRANSPARENT), (NO_TRACK, NO_TRACK_NAME, NO_TRACK_COLOR)]
        classes += [
            (object_id, name, (*colors.object_color(object_id), 255)) for object_id, name in self._names.items()
        ]
        self._log("world", rr.AnnotationContext(classes), static=True)

    def _log_camera(self, shown: ViewerFrame) -> None:
        camera = shown.frame.camera
        pose = shown.world_T_camera
        self._log(CAMERA, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        self._log(
            CAMERA,
            rr.Pinhole(
                resolution=[camera.width, camera.height],
                focal_length=[camera.fx, camera.fy],
                # rerun's pixel coordinates start at the corner of the first pixel, ours at its centre.
                principal_point=[camera.cx + 0.5, camera.cy + 0.5],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.1,
            ),
        )
        self._log(f"{CAMERA}/color", rr.Image(shown.frame.color).compress(jpeg_quality=JPEG_QUALITY))
        self._log(f"{CAMERA}/depth", rr.DepthImage(shown.frame.depth, meter=1.0))
        ids = np.zeros(shown.frame.depth.shape, np.uint16) if shown.ids is None else shown.ids
        self._log(f"{CAMERA}/labels", rr.SegmentationImage(ids, opacity=0.6))

    def _log_points(self, shown: ViewerFrame) -> None:
        frame = shown.frame
        step = max(1, int(np.ceil(np.sqrt(frame.depth.size / MAX_POINTS))))
        grid = (slice(step // 2, None, step), slice(step // 2, None, step))
        valid = frame.valid[grid]
        points = geometry.back_project(frame.depth, frame.camera)[grid][valid]
        world = geometry.transform(shown.world_T_camera, points)
        gray = pale_gray(frame.color)[grid][valid]
        # Points as wide as their spacing make surfaces look closed.
        radii = 0.75 * step * points[:, 2] / frame.camera.fx
        by_object = gray if shown.ids is None else color_by_object(gray, shown.ids[grid][valid])
        by_flow = gray if shown.own_flow is None else color_by_flow(gray, shown.own_flow[grid][valid])
        self._log(f"{POINTS}/by_object", rr.Points3D(world, colors=by_object, radii=radii))
        self._log(f"{POINTS}/by_flow", rr.Points3D(world, colors=by_flow, radii=radii))
        # The points of objects with models are apart, so that a view can show the models instead.
        color = frame.color[grid][valid]
        modelled = [obj.id for obj in shown.objects if obj.model is not None]
        on_model = np.zeros(len(world), np.bool_) if shown.ids is None else np.isin(shown.ids[grid][valid], modelled)
        for name, part in (("modelled", on_model), ("rest", ~on_model)):
            self._log(f"{POINTS}/by_color/{name}", rr.Points3D(world[part], colors=color[part], radii=radii[part]))

    def _log_motions(self, shown: ViewerFrame) -> None:
        """Log the arrow and the caption of each moving object."""
        moving = [
            (obj, obj.path, *place_arrow(shown, obj.id, obj.path[1])) for obj in shown.objects if obj.path is not None
        ]
        # Darker than the points in front of which they lie.
        shades = [tuple(channel // 2 for channel in colors.object_color(obj.id)) for obj, *_ in moving]
        self._log(
            "world/motion",
            rr.Arrows3D(
                origins=np.array([path[0] + shift for _, path, shift, _ in moving]).reshape(-1, 3),
                vectors=np.array([path[1] - path[0] for _, path, _, _ in moving]).reshape(-1, 3),
                colors=shades,
                radii=0.003,
            ),
        )
        self._log(
            "world/captions",
            rr.Points3D(
                np.array([position for *_, position in moving]).reshape(-1, 3),
                colors=shades,
                labels=[f"{obj.name}: {obj.caption}" for obj, *_ in moving],
                show_labels=True,
                radii=0.0,
            ),
        )

    def _log_poses(self, shown: ViewerFrame) -> None:
        """Log the object poses and clear the objects that are not visible any more.

        A `Clear` also hides a pose logged at the same time, so objects that are present are never cleared.
        """
        present = {obj.id for obj in shown.objects}
        for object_id in sorted(self._drawn - present):
            self._log(f"world/objects/{object_id:03d}", rr.Clear(recursive=False))
        self._drawn = present
        for obj in shown.objects:
            entity, pose = f"world/objects/{obj.id:03d}", obj.world_T_object
            self._log(entity, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            self._log(entity, rr.TransformAxes3D(axis_length=0.08))

    def _log_trails(self, shown: ViewerFrame) -> None:
        """Extend the trails of the objects and log those of the objects in this frame."""
        present = {obj.id for obj in shown.objects}
        self._trails = {number: trail for number, trail in self._trails.items() if number in present}
        for obj in shown.objects:
            trail = self._trails.setdefault(obj.id, [])
            position = obj.world_T_object[:3, 3]
            if not trail or np.linalg.norm(position - trail[-1]) >= MIN_STEP:
                trail.append(position)
            del trail[:-MAX_TRAIL]
        drawn = [(number, trail) for number, trail in sorted(self._trails.items()) if len(trail) > 1]
        self._log(
            "world/trails",
            rr.LineStrips3D(
                [np.array(trail) for _, trail in drawn],
                colors=[colors.object_color(number) for number, _ in drawn],
                radii=0.002,
            ),
        )

    def _log_models(self, shown: ViewerFrame) -> None:
        """Log each model when its object first appears, and its pose."""
        present = {obj.id for obj in shown.objects if obj.model is not None}
        for number in sorted(self._modelled - present):
            self._log(f"{MODELS}/{number:03d}", rr.Clear(recursive=False))
        for obj in shown.objects:
            if obj.model is None:
                continue
            entity, pose = f"{MODELS}/{obj.id:03d}", obj.world_T_object
            self._log(entity, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            if obj.id not in self._modelled:
                self._log(entity, rr.Asset3D(path=obj.model))
        self._modelled = present

    def _log(self, entity: str, components: rr.AsComponents, *, static: bool = False) -> None:
        self._stream.log(entity, components, static=static)
