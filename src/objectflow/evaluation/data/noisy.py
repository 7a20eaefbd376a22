"""Generated pairs as seen by a depth camera: their frames pass through a sensor model; the truth does not change."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence

import numpy as np
import torch

from objectflow.errors import DatasetError
from objectflow.evaluation.data.sources import PairSet, PairWindow
from objectflow.evaluation.results import EvaluationPair
from objectflow.frame import RgbdFrame
from objectflow.geometry.torch_pinhole import intrinsics
from objectflow.sensors.sensor import SENSORS, ColorSensor, observe


class NoisyPairs:
    """A `PairSet` whose frames have the noise of a colour camera and of one kind of depth sensor.

    The noise of a frame depends on the key of its pair only.
    """

    def __init__(self, pairs: PairSet, sensor: str) -> None:
        """Wrap a set.

        Args:
            pairs: of exact frames.
            sensor: a name in `SENSORS`.

        Raises:
            DatasetError: no such sensor, or real pairs, which already have noise.
        """
        if sensor not in SENSORS:
            raise DatasetError(f"unknown depth sensor {sensor!r}: choose one of {', '.join(SENSORS)}")
        if pairs.kind == "real":
            raise DatasetError("real pairs have their own noise: leave --sensor out")
        self.data, self.kind, self.split, self.keys = f"{pairs.data}, {sensor}", pairs.kind, pairs.split, pairs.keys
        self.sha256 = hashlib.sha256(f"{pairs.sha256} {sensor}".encode()).hexdigest()
        self._pairs, self._sensor = pairs, sensor

    def pair(self, key: str) -> EvaluationPair:
        """See `PairSet`."""
        exact = self._pairs.pair(key)
        prev, curr = self._seen([exact.prev, exact.curr], key)
        return dataclasses.replace(exact, prev=prev, curr=curr)

    def window(self, key: str) -> PairWindow | None:
        """See `PairSet`."""
        window = self._pairs.window(key)
        return window and window._replace(frames=tuple(self._seen(window.frames, key)))

    def _seen(self, frames: Sequence[RgbdFrame], key: str) -> list[RgbdFrame]:
        seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:7], "big")
        color, depth = observe(
            torch.from_numpy(np.stack([frame.color for frame in frames])).permute(0, 3, 1, 2).float() / 255,
            torch.from_numpy(np.stack([frame.depth for frame in frames])),
            intrinsics(frames[0].camera).expand(len(frames), -1),
            torch.Generator().manual_seed(seed),
            depth_sensor=SENSORS[self._sensor],
            color_sensor=ColorSensor(),
            images_each=len(frames),
        )
        pictures = (255 * color.clamp(0, 1)).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
        return [
            dataclasses.replace(frame, color=np.ascontiguousarray(picture), depth=one)
            for frame, picture, one in zip(frames, pictures, depth.float().numpy(), strict=True)
        ]
