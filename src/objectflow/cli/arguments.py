"""The arguments that the verbs for frames share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from objectflow.errors import ReaderError
from objectflow.methods.base import Estimator
from objectflow.methods.registry import DEFAULT_METHOD, load
from objectflow.readers import CameraOptions, FrameSequence, open_files, open_pair
from objectflow.view.viewer import Viewer, open_viewer


def option(metavar: str, default: str = "") -> Any:
    """Say in `--help` what an option takes and what happens without it, in words."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "")


@dataclass(frozen=True, kw_only=True)
class CameraArguments:
    """How to read images as frames."""

    camera_file: Annotated[Path | None, option("FILE", "camera.json beside the images")] = None
    """JSON with width, height, fx, fy, cx, cy and perhaps depth_scale; or fr1, fr2, fr3, the TUM cameras."""

    intrinsics: Annotated[tuple[float, float, float, float] | None, option("FX FY CX CY")] = None
    """Intrinsics in pixels, instead of a camera file."""

    depth_scale: Annotated[float | None, option("S", "the camera file's, or 1000; 5000 for a TUM directory")] = None
    """Depth units a metre."""

    def camera_options(self) -> CameraOptions:
        """What the readers need."""
        return CameraOptions(self.camera_file, self.intrinsics, self.depth_scale)


@dataclass(frozen=True, kw_only=True)
class MethodArguments(CameraArguments):
    """Camera, method and output."""

    method: Annotated[str, option("NAME", DEFAULT_METHOD)] = DEFAULT_METHOD
    """How to estimate; `objectflow methods` lists the choices."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """Whether the camera itself moved between the frames; auto decides by the background."""

    out: Annotated[Path | None, option("DIR", "a folder under objectflow_out")] = None
    """Output folder, new or empty; an earlier result of the same kind may be there."""

    weights: Annotated[str | None, option("FILE|DIR|hf://OWNER/NAME", "the released ones")] = None
    """Weights of a learned method."""

    rigid: Annotated[
        Literal["none", "average", "solve", "refine"] | None,
        option("{none,average,solve,refine}", "average; for rigidmatch solve"),
    ] = None
    """Flow of a learned method: each pixel's own, its object's mean motion (rigidmatch: the one that fits its matches
    best), or that aligned with the depth."""

    device: Annotated[str | None, option("NAME", "cuda where there is one")] = None
    """Where a learned method computes: cpu, cuda or cuda:N."""

    def method_options(self) -> dict[str, Any]:
        """What `load` is told beside the name; what was not given is left to the method."""
        given = {"weights": self.weights, "rigid": self.rigid, "device": self.device}
        return {"camera": self.camera, **{name: value for name, value in given.items() if value is not None}}

    def estimator(self) -> Estimator:
        """The method, ready to be called."""
        return load(self.method, **self.method_options())


@dataclass(frozen=True, kw_only=True)
class TopicArguments:
    """Which images of a bag."""

    color_topic: Annotated[str | None, option("TOPIC", "the only one")] = None
    """Of a bag: where the colour images are."""

    depth_topic: Annotated[str | None, option("TOPIC", "the only one")] = None
    """Of a bag: where the depth images are, registered to colour."""


@dataclass(frozen=True, kw_only=True)
class ViewArguments:
    """Whether to show what is found while it is found."""

    view: bool = False
    """Show it in rerun's window (extra `view`)."""

    save_view: Annotated[Path | None, option("FILE.rrd", "not saved")] = None
    """Save what the viewer shows; `rerun FILE.rrd` opens it."""

    def viewer(self, title: str) -> Viewer:
        """The viewer that was asked for; one that does nothing if none was."""
        return open_viewer(title, window=self.view, save=self.save_view)


def open_two(paths: tuple[Path, ...], options: CameraOptions) -> FrameSequence:
    """The two frames of a pair folder, or of four files.

    Raises:
        ReaderError: neither one path nor four, or a path that is not there.
    """
    if len(paths) == 1:
        return open_pair(paths[0], options)
    if len(paths) == 4:
        return open_files(*paths, options=options)
    raise ReaderError(f"expected a pair folder or four files (COLOR0 DEPTH0 COLOR1 DEPTH1), not {len(paths)} paths")
