"""A sequence from the files of its frames: all files are checked before the first frame is read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from objectflow.errors import ObjectflowError, ReaderError
from objectflow.readers.camera_values import CameraValues
from objectflow.readers.frame_steps import ColorAtDepth, DepthAtColor, PlanarDepth
from objectflow.readers.options import DEFAULT_DEPTH_SCALE, CameraOptions, CameraSetup
from objectflow.readers.rectify import Rectification
from objectflow.readers.sequence import FramePaths, FrameSequence, FrameStep
from objectflow.storage.image_files import read_size

MAX_NAMED = 3
"""Largest number of files that a note names."""
ASPECT_TOLERANCE = 0.02
"""Largest relative difference of the aspect ratios of colour and depth that show the same field of view."""


@dataclass(frozen=True)
class Layout:
    """What a layout of folders defines where neither the caller nor a camera file does.

    Attributes:
        depth_scale: units per metre of integer depth.
        camera: the camera of the images; None where a camera file is required.
        depth_camera: the camera of depth where colour has another one with the same centre and orientation; colour is
            resampled to its pixels.
        ray_length: whether depth is the distance along each ray.
        notes: what the reader says of the layout.
    """

    depth_scale: float = DEFAULT_DEPTH_SCALE
    camera: CameraValues | None = None
    depth_camera: CameraValues | None = None
    ray_length: bool = False
    notes: tuple[str, ...] = ()


def assemble(
    folder: Path,
    frames: Sequence[FramePaths],
    options: CameraOptions | None,
    layout: Layout | None = None,
    *,
    cuts: tuple[int, ...] = (),
    notes: tuple[str, ...] = (),
    strict: bool = False,
) -> FrameSequence:
    """Check the files of all frames and make a sequence.

    A frame with a missing, empty or unreadable file, or of another size than most frames, stays in the sequence, so
    that the numbers of the others do not depend on it. Reading it raises an error, and a note names it.

    Args:
        folder: may hold a camera file.
        frames: at least one.
        options: the caller's.
        layout: of the folder.
        cuts: see `FrameSequence`.
        notes: of the reader.
        strict: check the first frame alone, and leave errors of the others to their reading.

    Raises:
        ReaderError: no frame can be read, or the sizes of colour, depth and camera do not fit.
        CameraError, FrameError: an invalid camera file or depth scale.
    """
    options, layout = options or CameraOptions(), layout or Layout()
    sizes, problems = _read_sizes(frames[:1] if strict else frames)
    if not sizes:
        raise problems[0]
    color_size, depth_size = Counter(sizes.values()).most_common(1)[0][0]
    for index, found in sizes.items():
        if found != (color_size, depth_size):
            problems.append(ReaderError(f"{frames[index].color}: its size or that of its depth is not the others'"))
    image = str(frames[next(index for index, found in sizes.items() if found == (color_size, depth_size))].color)
    steps: list[FrameStep] = []
    said = [*notes, *layout.notes]
    if layout.camera is not None and layout.depth_camera is not None and not options.has_camera:
        color_camera = layout.camera.camera(color_size, str(folder)).scaled(*color_size)
        camera = layout.depth_camera.camera(depth_size, str(folder)).scaled(*depth_size)
        steps.append(ColorAtDepth(color_camera, camera))
        setup = CameraSetup(camera, options.depth_scale or layout.depth_scale, options.depth_scale or 1.0)
    else:
        setup = options.fit(color_size, folder, image, layout.depth_scale, layout.camera)
        camera = setup.camera
        if depth_size != color_size:
            steps.append(DepthAtColor(depth_size))
            said.append(_resized_note(color_size, depth_size, image))
        if setup.lens is not None:
            steps.append(Rectification(setup.lens, camera))
            said.append(f"colour and depth are undistorted ({setup.lens.model} lens)")
    if layout.ray_length:
        steps.append(PlanarDepth(camera))
    if setup.note:
        said.append(setup.note)
    if problems:
        said.append(_problem_note(problems, len(frames)))
    return FrameSequence(
        tuple(frames),
        camera,
        setup.depth_scale,
        setup.float_depth_scale,
        options.max_depth,
        tuple(steps),
        cuts,
        tuple(said),
    )


def _read_sizes(
    frames: Sequence[FramePaths],
) -> tuple[dict[int, tuple[tuple[int, int], tuple[int, int]]], list[ObjectflowError]]:
    """The (width, height) of colour and depth of each frame whose files can be read, and the errors of the others."""

    def read(files: FramePaths) -> tuple[tuple[int, int], tuple[int, int]] | ObjectflowError:
        try:
            return read_size(files.color), read_size(files.depth)
        except ObjectflowError as error:
            return error

    # Opening many files on a network drive waits; it does not compute.
    with ThreadPoolExecutor(max_workers=8) as pool:
        found = list(pool.map(read, frames))
    sizes = {index: entry for index, entry in enumerate(found) if not isinstance(entry, ObjectflowError)}
    return sizes, [entry for entry in found if isinstance(entry, ObjectflowError)]


def _resized_note(color_size: tuple[int, int], depth_size: tuple[int, int], image: str) -> str:
    (width, height), (w, h) = color_size, depth_size
    if abs(width * h / (height * w) - 1) > ASPECT_TOLERANCE:
        raise ReaderError(
            f"{image}: colour is {width}x{height}, depth {w}x{h}: register the depth to the colour image"
        )
    return (
        f"depth is {w}x{h}, colour {width}x{height}: depth is resampled to the pixels of colour; both "
        "are taken to have the same field of view"
    )


def _problem_note(problems: Sequence[ObjectflowError], count: int) -> str:
    named = "; ".join(str(problem) for problem in problems[:MAX_NAMED])
    more = f"; and {len(problems) - MAX_NAMED} more" if len(problems) > MAX_NAMED else ""
    return f"{len(problems)} of {count} frames cannot be read and are left out ({named}{more})"
