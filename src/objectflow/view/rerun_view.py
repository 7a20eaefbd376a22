"""The rerun viewer: moments in its window, in a browser, or as an .rrd file. Nothing else imports rerun."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.errors import MissingExtraError, StorageError, ViewerError
from objectflow.frame import RgbdFrame
from objectflow.typing import Float32Array, Float64Array, UInt8Array
from objectflow.view import colors
from objectflow.view.flow import flow_range
from objectflow.view.viewer_frames import NO_TRACK, NO_TRACK_NAME, ViewerFrame

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise MissingExtraError("the viewer needs rerun: pip install 'objectflow[view]'") from error

APPLICATION = "objectflow"
FRAME, SECONDS = "frame", "seconds"
"""The timelines."""

MOST_POINTS = 100_000
"""Of a frame: beyond, rows and columns are left out, so that a sequence stays light."""
JPEG_QUALITY = 92
PORTS = (9090, 9876)
"""rerun's own, of the web page and of the data; others where they are taken."""
SERVER_MEMORY = "2GiB"
"""Of the web viewer's server: the earliest frames go first."""

NO_TRACK_COLOR = (173, 181, 189, 255)
CLEAR = (0, 0, 0, 0)
"""Of the static rest in the labels, so that the picture below keeps its colours."""
CAMERA = "world/camera"


class RerunViewer:
    """See `viewer.open_viewer` for arguments and errors."""

    def __init__(self, title: str, *, window: bool = False, save: Path | None = None, web: bool = False) -> None:
        if window:
            _check_display()
        self._shown: set[int] = set()
        self._drawn: set[int] = set()
        self._names: dict[int, str] = {}
        self._save, self._temporary = save, None if save is None else _temporary_beside(save)
        self._stream = rr.RecordingStream(APPLICATION, recording_id=f"{title}-{time.time_ns()}")
        sinks: list[rr.GrpcSink | rr.GrpcServerSink | rr.FileSink] = []
        self.address: str | None = None
        if window:
            rr.spawn(connect=False)
            sinks.append(rr.GrpcSink())
        if web:
            page, data = (_free_port(port) for port in PORTS)
            sinks.append(rr.GrpcServerSink("127.0.0.1", data, server_memory_limit=SERVER_MEMORY))
            rr.serve_web_viewer(web_port=page, open_browser=False)
            url = f"rerun+http://127.0.0.1:{data}/proxy"
            self.address = f"http://127.0.0.1:{page}/?url={quote(url, safe='')}"
        if self._temporary is not None:
            sinks.append(rr.FileSink(self._temporary))
        self._stream.set_sinks(*sinks)
        self._stream.send_blueprint(_layout())
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
                os.replace(self._temporary, self._save)
        except OSError as problem:
            raise StorageError(f"cannot write {self._save}: {problem.strerror}") from problem
        finally:
            with suppress(OSError):
                self._temporary.unlink()

    def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
        """Log every moment whose number was not logged before."""
        for moment in make():
            if moment.number not in self._shown:
                self._shown.add(moment.number)
                self._show(moment)

    def _show(self, moment: ViewerFrame) -> None:
        self._stream.set_time(FRAME, sequence=moment.number)
        if moment.seconds is not None:
            self._stream.set_time(SECONDS, duration=moment.seconds)
        self._name(moment)
        self._show_camera(moment)
        self._show_points(moment)
        self._show_objects(moment)

    def _name(self, moment: ViewerFrame) -> None:
        """Tell rerun the names and colours of the ids, when there are new ones."""
        names = {obj.id: obj.name for obj in moment.objects if obj.id not in self._names}
        if not names and self._names:
            return
        self._names |= names
        classes = [(0, "static", CLEAR), (NO_TRACK, NO_TRACK_NAME, NO_TRACK_COLOR)]
        classes += [(number, name, (*colors.object_color(number), 255)) for number, name in self._names.items()]
        self._log("world", rr.AnnotationContext(classes), static=True)
        self._names.setdefault(NO_TRACK, NO_TRACK_NAME)

    def _show_camera(self, moment: ViewerFrame) -> None:
        camera = moment.frame.camera
        pose = moment.world_T_camera
        self._log(CAMERA, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        self._log(
            CAMERA,
            rr.Pinhole(
                resolution=[camera.width, camera.height],
                focal_length=[camera.fx, camera.fy],
                # Pixel centres are whole here; rerun counts from the corner of the first pixel.
                principal_point=[camera.cx + 0.5, camera.cy + 0.5],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.1,
            ),
        )
        self._log(f"{CAMERA}/color", rr.Image(moment.frame.color).compress(jpeg_quality=JPEG_QUALITY))
        self._log(f"{CAMERA}/depth", rr.DepthImage(moment.frame.depth, meter=1.0))
        ids = np.zeros(moment.frame.depth.shape, np.uint16) if moment.ids is None else moment.ids
        self._log(f"{CAMERA}/labels", rr.SegmentationImage(ids, opacity=0.6))

    def _show_points(self, moment: ViewerFrame) -> None:
        frame = moment.frame
        step = max(1, int(np.ceil(np.sqrt(frame.depth.size / MOST_POINTS))))
        thin = (slice(step // 2, None, step), slice(step // 2, None, step))
        kept = frame.valid[thin]
        points = geometry.back_project(frame.depth, frame.camera)[thin][kept]
        world = geometry.transform(moment.world_T_camera, points)
        grey = _greyed(frame)[thin][kept]
        # A point as wide as the gap to the next one makes surfaces look whole.
        radii = 0.75 * step * points[:, 2] / frame.camera.fx
        by_object = grey if moment.ids is None else _color_ids(grey, moment.ids[thin][kept])
        by_flow = grey if moment.scene_flow is None else _color_flow(grey, moment.scene_flow[thin][kept])
        self._log("world/points/by_object", rr.Points3D(world, colors=by_object, radii=radii))
        self._log("world/points/by_flow", rr.Points3D(world, colors=by_flow, radii=radii))

    def _show_objects(self, moment: ViewerFrame) -> None:
        moved = [(obj, obj.way, *_beside(moment, obj.id, obj.way[1])) for obj in moment.objects if obj.way is not None]
        # Darker than the points, which they lie before.
        shades = [tuple(channel // 2 for channel in colors.object_color(obj.id)) for obj, *_ in moved]
        self._log(
            "world/motion",
            rr.Arrows3D(
                origins=np.array([way[0] + before for _, way, before, _ in moved]).reshape(-1, 3),
                vectors=np.array([way[1] - way[0] for _, way, _, _ in moved]).reshape(-1, 3),
                colors=shades,
                radii=0.003,
            ),
        )
        self._log(
            "world/captions",
            rr.Points3D(
                np.array([above for *_, above in moved]).reshape(-1, 3),
                colors=shades,
                labels=[f"{obj.name}: {obj.caption}" for obj, *_ in moved],
                show_labels=True,
                radii=0.0,
            ),
        )
        # What is not seen any more is not drawn. Rerun places nothing at a time that holds a clear of it, too.
        present = {obj.id for obj in moment.objects}
        for number in sorted(self._drawn - present):
            self._log(f"world/objects/{number:03d}", rr.Clear(recursive=False))
        self._drawn = present
        for obj in moment.objects:
            path, pose = f"world/objects/{obj.id:03d}", obj.world_T_object
            self._log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            self._log(path, rr.TransformAxes3D(axis_length=0.08))

    def _log(self, path: str, what: rr.AsComponents, *, static: bool = False) -> None:
        self._stream.log(path, what, static=static)


def _layout() -> rrb.Blueprint:
    """The world large, with objects or flow as its tabs; colour with masks, depth and labels beside it."""

    def world(name: str, points: str) -> rrb.Spatial3DView:
        # rerun would draw the depth image as points once more.
        hidden = [f"- /{CAMERA}/depth", f"- /{CAMERA}/labels", f"- /world/points/{points}"]
        return rrb.Spatial3DView(
            origin="world",
            contents=["+ $origin/**", *hidden],
            name=name,
            background=[255, 255, 255],
            line_grid=False,
            # Above the first camera's right shoulder, looking where it looks.
            eye_controls=rrb.EyeControls3D(position=(0.35, -0.35, -0.25), look_target=(0, 0, 0.8), eye_up=(0, -1, 0)),
        )

    def image(name: str, *parts: str) -> rrb.Spatial2DView:
        return rrb.Spatial2DView(origin=CAMERA, contents=[f"+ /{CAMERA}/{part}" for part in parts], name=name)

    # Alone they need not let a picture shine through.
    labels = rrb.Spatial2DView(
        origin=CAMERA,
        contents=[f"+ /{CAMERA}/labels"],
        name="Labels",
        overrides={f"{CAMERA}/labels": rr.SegmentationImage.from_fields(opacity=1.0)},
    )

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(world("Objects", "by_flow"), world("Flow", "by_object"), active_tab=0),
            rrb.Vertical(image("Colour with masks", "color", "labels"), image("Depth", "depth"), labels),
            column_shares=[2.4, 1],
        ),
        rrb.BlueprintPanel(expanded=False),
        rrb.SelectionPanel(expanded=False),
        rrb.TimePanel(expanded=False, timeline=FRAME, fps=2.0),
    )


def _greyed(frame: RgbdFrame) -> UInt8Array:
    """(H, W, 3) the frame in pale grey."""
    brightness = frame.color.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.repeat((70 + 0.62 * brightness)[..., None], 3, axis=2).astype(np.uint8)


def _color_ids(grey: UInt8Array, ids: NDArray[np.uint16]) -> UInt8Array:
    """(N, 3) each object's points in its colour, shaded by the picture; the rest grey."""
    painted = grey.copy()
    for number in np.unique(ids[(ids > 0) & (ids != NO_TRACK)]).tolist():
        mine = ids == number
        shade = 0.35 + 0.65 * (grey[mine, :1].astype(np.float32) / 228)
        painted[mine] = np.rint(np.array(colors.object_color(number), np.float32) * shade).astype(np.uint8)
    return painted


def _color_flow(grey: UInt8Array, scene_flow: Float32Array) -> UInt8Array:
    """(N, 3) in the colours of `flow.png`, forward in time: hue = direction in the image; what rests is grey."""
    moved = -scene_flow.astype(np.float64)
    known = np.isfinite(moved).all(axis=-1)
    painted = grey.copy()
    full = flow_range(moved[known])
    wheel = colors.wheel(moved[known, 0] / full, moved[known, 1] / full).astype(np.float32)
    strength = np.clip(np.linalg.norm(moved[known], axis=-1) / full, 0, 1)[:, None] ** 0.5
    painted[known] = np.rint(grey[known] + (wheel - grey[known]) * strength).astype(np.uint8)
    return painted


def _beside(moment: ViewerFrame, number: int, center: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Where an object hides nothing, and nothing hides it: a shift (3,) and a place (3,), both in the world.

    The shift carries its centre to just before its surface, towards the camera, for arrows; the place lies beyond its
    end towards the image's top edge, for a caption.
    """
    frame = moment.frame
    mask = np.zeros_like(frame.valid) if moment.ids is None else (moment.ids == number) & frame.valid
    if not mask.any():
        return np.zeros(3), center
    eye = moment.world_T_camera[:3, 3]
    surface = geometry.transform(moment.world_T_camera, geometry.back_project(frame.depth, frame.camera)[mask])
    ranges, far = np.linalg.norm(surface - eye, axis=1), float(np.linalg.norm(center - eye))
    before = min(0.0, float(np.percentile(ranges, 2)) - 0.01 - far) * (center - eye) / max(far, 1e-9)
    rows, columns = np.nonzero(mask)
    camera, row, depth = frame.camera, rows[0] - 0.04 * frame.camera.height, frame.depth[rows[0], columns[0]]
    above = np.array([(columns.mean() - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0]) * depth
    return before, geometry.transform(moment.world_T_camera, above)


def _temporary_beside(path: Path) -> Path:
    """An empty file beside `path`, so that a disk that refuses is noticed before the work."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    if path.is_dir():
        raise StorageError(f"cannot write {path}: it is a folder: name a file, such as view.rrd")
    try:
        temporary.touch()
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}") from error
    return temporary


def _check_display() -> None:
    """Rerun's window would fail in a process of its own, where nobody sees it."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(
            "no display for the viewer's window: save a file (view --save, elsewhere --save-view), or view --web"
        )


def _free_port(wanted: int) -> int:
    """A port that nobody listens on, `wanted` if possible."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            # As servers do: a port that was just left is free.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with suppress(OSError):
                probe.bind(("0.0.0.0", port))
                return int(probe.getsockname()[1])
    raise ViewerError("no free port for the web viewer")
