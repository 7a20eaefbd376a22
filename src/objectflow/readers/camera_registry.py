"""The kinds of live cameras by their names."""

from __future__ import annotations

import difflib
import importlib
from typing import NamedTuple, cast

from objectflow.errors import ReaderError
from objectflow.readers.camera_driver import CameraDriver


class CameraEntry(NamedTuple):
    """A kind of camera: one line about it, its module, and its driver there."""

    summary: str
    module: str
    driver: str


CAMERAS: dict[str, CameraEntry] = {
    "realsense": CameraEntry("Intel RealSense", "objectflow.readers.realsense", "RealSense"),
    "orbbec": CameraEntry("Orbbec Gemini, Femto and Astra", "objectflow.readers.orbbec", "Orbbec"),
    "oak": CameraEntry("Luxonis OAK-D", "objectflow.readers.oak", "Oak"),
}


def make_driver(name: str) -> CameraDriver:
    """Make the driver of a kind of camera; the camera is not opened.

    Args:
        name: one of `CAMERAS`.

    Raises:
        ReaderError: an unknown name; the message lists the choices.
        MissingExtraError: the library of the camera is not installed.
    """
    if name not in CAMERAS:
        raise ReaderError(f"unknown camera {name!r}: {suggestion(name)}choose one of {', '.join(CAMERAS)}")
    entry = CAMERAS[name]
    driver = cast("type[CameraDriver]", getattr(importlib.import_module(entry.module), entry.driver))
    return driver()


def suggestion(name: str) -> str:
    """The beginning of a sentence that suggests the camera with a similar name; empty if there is none."""
    near = difflib.get_close_matches(name, CAMERAS, n=1)
    return f"did you mean {near[0]!r}? " if near else ""
