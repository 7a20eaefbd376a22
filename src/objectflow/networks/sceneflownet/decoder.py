"""The hourglass with skip links, and the six linear heads."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput
from objectflow.networks.sceneflownet.settings import NetworkSettings, Widths

FRAME_CHANNELS = 7
"""Channels of a frame that is linked to a fine stage: colour, point, and validity of the point."""


class Upsampling(nn.ConvTranspose2d):
    """5x5 transposed convolution with stride 2 to a given size, 2 n or 2 n - 1 (15 cells are halved to 8)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 5, stride=2, padding=2)

    def to_size(self, x: Tensor, height: int, width: int) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, height, width)."""
        extra = (height - (2 * x.shape[-2] - 1), width - (2 * x.shape[-1] - 1))
        return F.conv_transpose2d(x, self.weight, self.bias, stride=2, padding=2, output_padding=extra)


class UpStage(nn.Module):
    """One stage upward: double the size, add the skip link, apply ReLU, then 3x3 layers."""

    def __init__(self, inputs: int, widths: Widths, skip: int | None) -> None:
        super().__init__()
        self.enlarge = Upsampling(inputs, widths[0])
        self.link = None if skip is None else nn.Conv2d(skip, widths[0], 3, padding=1)
        self.layers = _layers(widths)

    def forward(self, x: Tensor, skip: Tensor | None = None) -> Tensor:
        """(B, inputs, H, W), and the skip link at twice the size -> (B, last width, 2 H, 2 W)."""
        height, width = (2 * x.shape[-2], 2 * x.shape[-1]) if skip is None else skip.shape[-2:]
        x = self.enlarge.to_size(x, height, width)
        if self.link is not None and skip is not None:
            x = x + self.link(skip)
        out: Tensor = self.layers(torch.relu(x))
        return out


class Hourglass(nn.Module):
    """Down to an eighth of the cells' resolution and up again, then on to the resolution of the pixels.

    (B, inputs, H / 8, W / 8) -> (B, last of `fine`, H, W).
    """

    def __init__(self, inputs: int, settings: NetworkSettings) -> None:
        super().__init__()
        self.down = nn.ModuleList()
        for depth, widths in enumerate(settings.down):
            first = nn.Conv2d(inputs, widths[0], 5 if depth else 3, 2 if depth else 1, 2 if depth else 1)
            self.down.append(nn.Sequential(first, nn.ReLU(inplace=True), _layers(widths)))
            inputs = widths[-1]
        self.up = nn.ModuleList()
        for widths, skip in zip(settings.up, reversed(settings.down[:-1]), strict=True):
            self.up.append(UpStage(inputs, widths, skip[-1]))
            inputs = widths[-1]
        self.fine = nn.ModuleList()
        for widths in settings.fine:
            self.fine.append(UpStage(inputs, widths, FRAME_CHANNELS if settings.details else None))
            inputs = widths[-1]
        self.channels = inputs

    def forward(self, x: Tensor, details: Sequence[Tensor] = ()) -> Tensor:
        """Features at the input's resolution.

        Args:
            x: (B, inputs, H / 8, W / 8).
            details: with `settings.details`, the (B, 7, H / s, W / s) frames at strides s = 4, 2, 1.
        """
        skips = []
        for stage in self.down:
            x = stage(x)
            skips.append(x)
        for stage, skip in zip(self.up, reversed(skips[:-1]), strict=True):
            x = stage(x, skip)
        for stage, detail in zip(self.fine, details or (None,) * len(self.fine), strict=True):
            x = stage(x, detail)
        return x


def _layers(widths: Sequence[int]) -> nn.Sequential:
    """3x3 layers with ReLU from each width to the next; the first width is that of the input."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class Heads(nn.Module):
    """A 3x3 linear layer per map: (B, inputs, H, W) -> `SceneFlowNetOutput`, with the centre still an offset."""

    CHANNELS = SceneFlowNetOutput(rotation=3, translation=3, center=3, mask=2, centrality=2, radius=1)  # type: ignore[arg-type]

    def __init__(self, inputs: int) -> None:
        super().__init__()
        names = SceneFlowNetOutput._fields
        self.maps = nn.ModuleDict(
            {name: nn.Conv2d(inputs, cast(int, getattr(self.CHANNELS, name)), 3, padding=1) for name in names}
        )

    def forward(self, x: Tensor) -> SceneFlowNetOutput:
        """All maps, in float32 even under autocast: bfloat16 would round to millimetres."""
        if torch.is_autocast_enabled(x.device.type):
            with torch.autocast(x.device.type, enabled=False):
                return self._apply_all(x.float())
        return self._apply_all(x)

    def _apply_all(self, x: Tensor) -> SceneFlowNetOutput:
        # As one layer, the features, which are the largest tensor of all, are read once instead of six times.
        heads = [cast(nn.Conv2d, self.maps[name]) for name in SceneFlowNetOutput._fields]
        weight = torch.cat([head.weight for head in heads])
        bias = torch.cat([cast(Tensor, head.bias) for head in heads])
        maps = F.conv2d(x, weight, bias, padding=1)
        return SceneFlowNetOutput(*torch.split(maps, [head.out_channels for head in heads], dim=1))
