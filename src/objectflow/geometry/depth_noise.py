"""Noise of depth cameras: the standard deviation of a measured depth, to which thresholds in metres relate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from objectflow.geometry.camera import Camera
from objectflow.settings import Settings, setting
from objectflow.typing import Float32Array

DepthNoiseName = Literal["structured-light", "time-of-flight", "stereo", "measured"]
"""Noise models that a method can be given by name; "measured" is fitted to the pair itself."""


@dataclass(frozen=True)
class DepthNoise(Settings):
    """Axial standard deviation `base + growth (max(z, near) - near)^2` in metres at depth z.

    The defaults are those of a structured-light camera (Nguyen, Izadi and Lovell, 3DIMPVT 2012, equation 2): 1.2 mm at
    0.4 m, 8.1 mm at 2.3 m.
    """

    base: float = setting(0.0012, above=0)
    """Metres: standard deviation at `near` and nearer."""
    growth: float = setting(0.0019, minimum=0)
    """Metres per square metre."""
    near: float = setting(0.4, minimum=0)
    """Metres: depth from which noise grows."""

    def sigma(self, z: NDArray[Any] | float) -> Float32Array:
        """Standard deviation in metres at depths z, of any shape."""
        z = np.asarray(z, dtype=np.float32)
        with np.errstate(over="ignore"):  # absurd depth has an infinite error
            return np.asarray(self.base + self.growth * (np.maximum(z, self.near) - self.near) ** 2, dtype=np.float32)

    def match_sigma(self, z: NDArray[Any], camera: Camera, pixels: float = 0.7) -> Float32Array:
        """Standard deviation in metres of the displacement of a match: two depths and `pixels` of matching error."""
        z = np.asarray(z, dtype=np.float32)
        with np.errstate(over="ignore"):
            sideways = pixels * z / np.float32(camera.fx)
            return np.asarray(np.sqrt(2 * self.sigma(z) ** 2 + sideways**2), dtype=np.float32)


@dataclass(frozen=True)
class MeasuredDepthNoise(DepthNoise):
    """A formula as a lower bound, and standard deviations that were measured at some depths.

    Between the depths they are interpolated; beyond them the nearest one holds, and the formula where it is larger.
    """

    depths: tuple[float, ...] = ()
    """Metres, rising."""
    sigmas: tuple[float, ...] = ()
    """Metres: the standard deviation measured at each depth."""

    def sigma(self, z: NDArray[Any] | float) -> Float32Array:
        """See `DepthNoise.sigma`."""
        formula = super().sigma(z)
        if not self.depths:
            return formula
        return np.fmax(formula, np.interp(z, self.depths, self.sigmas).astype(np.float32))


STRUCTURED_LIGHT = DepthNoise()
DEPTH_NOISE: dict[str, DepthNoise] = {
    "structured-light": STRUCTURED_LIGHT,
    # Random error of Azure Kinect's narrow field of view: about 2 mm at 0.5 m and 9 mm at 3.5 m (Tolgyessy et al.,
    # Sensors 2021).
    "time-of-flight": DepthNoise(base=0.002, growth=0.0008, near=0.5),
    # A stereo camera's error is z^2 times the disparity error over focal length times baseline; at 0.2 pixels, 640
    # pixels and 50 mm that is 6 mm at 1 m.
    "stereo": DepthNoise(base=0.002, growth=0.006, near=0.2),
}
"""Noise models by name."""
