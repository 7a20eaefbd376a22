"""Arguments shared by the commands that read frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from objectflow.cli.output import Export
from objectflow.errors import ReaderError
from objectflow.methods.registry import DEFAULT_METHOD, check_name, find_class, load
from objectflow.readers import CameraOptions, FrameSequence, FrameSource, open_files, open_pair, open_source
from objectflow.settings import flat, parse_assignments, read_toml

if TYPE_CHECKING:
    from objectflow.methods.base import Estimator
    from objectflow.view.viewer import Viewer


def option(metavar: str, default: str = "") -> Any:
    """Show an option's value and its default in `--help` as text."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


@dataclass(frozen=True, kw_only=True)
class CameraArguments:
    """Camera and depth of image files."""

    camera_file: Annotated[Path | None, option("FILE", "camera.json beside the images")] = None
    """Camera file: JSON with width, height, fx, fy, cx, cy and optionally depth_scale, a ROS camera_info YAML, a file
    of Open3D, RealSense, COLMAP or BOP, or a 3x3 matrix as text or .npy; or a TUM camera: fr1, fr2, fr3."""

    intrinsics: Annotated[tuple[float, float, float, float] | None, option("FX FY CX CY")] = None
    """Intrinsics in pixels, instead of a camera file; commas may separate them."""

    depth_scale: Annotated[float | None, option("S", "the camera file's, or 1000; 5000 for a TUM directory")] = None
    """Depth units per metre; floating-point depth is in metres unless this is given."""

    max_depth: Annotated[float | None, option("METRES", "no limit")] = None
    """Depth beyond this is missing."""

    def camera_options(self) -> CameraOptions:
        """The options of the readers."""
        return CameraOptions(self.camera_file, self.intrinsics, self.depth_scale, self.max_depth)


@dataclass(frozen=True, kw_only=True)
class MethodArguments(CameraArguments):
    """Camera, method and output."""

    method: Annotated[str, option("NAME", DEFAULT_METHOD)] = DEFAULT_METHOD
    """The method; `objectflow methods` lists the choices."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """Whether the camera moved between the frames; auto decides from the background."""

    out: Annotated[Path | None, option("DIR", "a folder under objectflow_out")] = None
    """Output folder: new, empty, or with an earlier result of the same kind."""

    weights: Annotated[str | None, option("FILE|DIR|hf://OWNER/NAME", "the released ones")] = None
    """Weights of a learned method."""

    rigid: Annotated[
        Literal["none", "average", "solve", "refine"] | None,
        option("{none,average,solve,refine}", "refine for rigidmatch, average for sceneflownet"),
    ] = None
    """How a learned method computes motions. none: flow per pixel. average (sceneflownet) and solve (rigidmatch): one
    rigid motion per object from the network's output. refine: that motion, registered to the depth."""

    device: Annotated[str | None, option("NAME", "cuda if available")] = None
    """Device of a learned method: cpu, cuda or cuda:N."""

    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], option("PATH=VALUE", "none")] = ()
    """A setting of the method, such as postprocess.merge.max_loss=0.1; may be repeated. `objectflow methods NAME`
    lists all settings."""

    config: Annotated[Path | None, option("FILE.toml", "none")] = None
    """Settings of the method as a TOML file; --set and the options above override it."""

    def method_options(self) -> dict[str, Any]:
        """Keyword arguments for `load`: the file, then `--set`, then the options; the rest is left to the method."""
        options: dict[str, Any] = {} if self.config is None else flat(read_toml(self.config))
        options |= parse_assignments(self.set)
        given = {"weights": self.weights, "rigid": self.rigid, "device": self.device}
        # Methods whose result does not depend on the camera motion have no such setting.
        fields = dataclasses.fields(cast(Any, find_class(self.method)))
        if self.camera != "auto" and any(field.name == "camera" for field in fields):
            given["camera"] = self.camera
        return options | {name: value for name, value in given.items() if value is not None}

    def check_method(self) -> None:
        """Check the name of the method, before anything is read or loaded.

        Raises:
            MethodError: an unknown name.
        """
        check_name(self.method)

    def estimator(self) -> Estimator:
        """Load the method."""
        return load(self.method, **self.method_options())


@dataclass(frozen=True, kw_only=True)
class SourceArguments(CameraArguments):
    """How a recording is read."""

    color_topic: Annotated[str | None, option("TOPIC", "the only one")] = None
    """Topic of the colour images in a bag."""

    depth_topic: Annotated[str | None, option("TOPIC", "the only one")] = None
    """Topic of the depth images in a bag, registered to colour."""

    max_lag: Annotated[float | None, option("SECONDS", "0.02")] = None
    """Longest time between a colour image and its depth image, where they have times of their own."""

    def camera_options(self) -> CameraOptions:
        """The options of the readers."""
        return dataclasses.replace(super().camera_options(), max_lag=self.max_lag)

    def open_path(self, path: Path) -> FrameSource:
        """Open a source."""
        return open_source(path, self.camera_options(), color_topic=self.color_topic, depth_topic=self.depth_topic)


@dataclass(frozen=True, kw_only=True)
class ViewArguments:
    """Display of results while they are computed."""

    view: bool = False
    """Show results in rerun's window (extra `view`)."""

    save_view: Annotated[Path | None, option("FILE.rrd", "not saved")] = None
    """Save the viewer's recording; `rerun FILE.rrd` opens it."""

    def viewer(self, title: str) -> Viewer:
        """Open the requested viewer, or a null viewer."""
        # The viewer imports much that commands need only after their arguments have been checked.
        from objectflow.view.viewer import open_viewer

        return open_viewer(title, window=self.view, save=self.save_view)


@dataclass(frozen=True, kw_only=True)
class ResultArguments:
    """Files of a result."""

    pictures: bool = True
    """Write overlay.png and flow.png."""

    export: Annotated[tyro.conf.UseAppendAction[tuple[Export, ...]], option("{coco,ply}", "none")] = ()
    """Also write coco.json, the masks as COCO annotations with run-length encoding, or points_001.ply etc., a point
    cloud per object; may be repeated."""


def location(frames: FrameSequence) -> dict[str, Any]:
    """Where two frames lie and how they are read, as `SceneMotion.frames` keeps it."""
    camera = frames.camera
    return {
        "paths": [str(path.resolve()) for one in frames.paths for path in (one.color, one.depth)],
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "depth_scale": frames.depth_scale,
    }


def open_location(where: Mapping[str, Any]) -> FrameSequence:
    """Open the two frames at a `location`.

    Raises:
        ReaderError: a file does not exist any more, or the location is damaged.
    """
    try:
        paths = [Path(path) for path in where["paths"]]
        fx, fy, cx, cy = (float(number) for number in where["intrinsics"])
        options = CameraOptions(intrinsics=(fx, fy, cx, cy), depth_scale=float(where["depth_scale"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ReaderError(f"the place of the frames is damaged: {error!r}: give them by --frames") from error
    return open_two(tuple(paths), options)


def open_two(paths: tuple[Path, ...], options: CameraOptions) -> FrameSequence:
    """Open the two frames of a pair folder or of four files.

    Raises:
        ReaderError: there are neither one nor four paths, or a path does not exist.
    """
    if len(paths) == 1:
        return open_pair(paths[0], options)
    if len(paths) == 4:
        return open_files(*paths, options=options)
    raise ReaderError(f"expected a pair folder or four files (COLOR0 DEPTH0 COLOR1 DEPTH1), not {len(paths)} paths")
