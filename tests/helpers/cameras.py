"""Small cameras for tests."""

from __future__ import annotations

from objectflow.geometry.camera import Camera


def small_camera(width: int = 8, height: int = 6, focal: float | None = None) -> Camera:
    """A camera with a central principal point and, unless given, a focal length of one image width, in pixels."""
    f = float(width) if focal is None else focal
    return Camera(width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2)
