"""The network of the paper (figure 2): encoders, correlation, weighted max-pool, hourglass, heads."""

from __future__ import annotations

import math
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from objectflow.errors import MethodError
from objectflow.networks.sceneflownet.backbone import Bottleneck, ColorEncoder, load_backbone, shape_encoder
from objectflow.networks.sceneflownet.correlation import correlate, weighted_max_pool
from objectflow.networks.sceneflownet.decoder import Heads, Hourglass
from objectflow.networks.sceneflownet.local_motion import CHANNELS as _LOCAL_MOTION_CHANNELS
from objectflow.networks.sceneflownet.local_motion import local_motion
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput
from objectflow.networks.sceneflownet.settings import NetworkSettings
from objectflow.networks.xfeat import XFeat, sample_cells

_STRIDE = 8
"""Stride of the encoders in pixels; images are padded to a multiple of it, and the maps are cropped."""
_DISPLACEMENT_CHANNELS = 4
"""Channels of `expected_displacement`: a vector, and its probability."""
_INITIAL_SHARPNESS = 2.0
"""Initial value of `sharpness`; the first runs converged to within 0.1 of it."""
_INITIAL_XFEAT_SHARPNESS, _LARGEST_XFEAT_SHARPNESS = math.log(10.0), math.log(30.0)
"""Initial and maximum value of `xfeat_sharpness`."""


class SceneFlowNet(nn.Module):
    """Two RGB-D frames -> dense maps of rigid motions: OurC, or OurS without `settings.correlation`.

    Missing points are 0 in the XYZ encoder's input, and a fourth channel is 1 where there is a point.
    """

    def __init__(self, settings: NetworkSettings | None = None, *, generator: torch.Generator | None = None) -> None:
        """Build the network with random weights.

        Args:
            settings: widths and depths; the paper's when None.
            generator: of the random numbers; torch's global one when None.
        """
        super().__init__()
        self.settings = settings or NetworkSettings()
        cosine = self.settings.correlation and self.settings.correlation_cosine
        self.sharpness = nn.Parameter(torch.tensor(_INITIAL_SHARPNESS)) if cosine else None
        """Logarithm of the factor of the cosines."""
        self.xfeat = XFeat(generator) if cosine and self.settings.xfeat else None
        self.xfeat_sharpness = None if self.xfeat is None else nn.Parameter(torch.tensor(_INITIAL_XFEAT_SHARPNESS))
        """Logarithm of the factor of XFeat's cosines."""
        shape_channels = self.settings.shape_stages[-1][-1]
        if self.settings.correlation:
            self.color_encoder: ColorEncoder | None = ColorEncoder(self.settings)
            self.shape_encoder = shape_encoder(4, self.settings.shape_stages)
            extra = _DISPLACEMENT_CHANNELS if self.settings.displacement else 0
            extra += _LOCAL_MOTION_CHANNELS if self.settings.local_motion_window else 0
            self.hourglass = Hourglass(3 * shape_channels + extra, self.settings)
        else:
            self.color_encoder = None
            self.shape_encoder = shape_encoder(2 * (3 + 4), self.settings.shape_stages)
            self.hourglass = Hourglass(shape_channels, self.settings)
        self.heads = Heads(self.hourglass.channels)
        _initialise(self, generator)

    def load_backbone(self, path: str | Path) -> None:
        """Take pretrained weights: XFeat's filters with `settings.xfeat`, else torchvision's `resnet50` for the trunk.

        Raises:
            MethodError: a file that does not fit, or a network without a colour encoder (OurS).
        """
        if self.color_encoder is None:
            raise MethodError(f"{path}: the simple network has no colour trunk: leave backbone weights out")
        if self.xfeat is None:
            load_backbone(self.color_encoder.trunk, path)
        else:
            self.xfeat.load(Path(path))

    def forward(
        self, prev_color: Tensor, prev_points: Tensor, curr_color: Tensor, curr_points: Tensor
    ) -> SceneFlowNetOutput:
        """Predict the motion from the current back to the previous frame.

        Args:
            prev_color, curr_color: (B, 3, H, W) RGB in 0..1.
            prev_points, curr_points: (B, 3, H, W) metres in the camera frame, NaN where depth is missing.

        Returns:
            Maps of size (H, W), for any H and W.
        """
        return self.predict(prev_color, prev_points, curr_color, curr_points)[0]

    def predict(
        self, prev_color: Tensor, prev_points: Tensor, curr_color: Tensor, curr_points: Tensor
    ) -> tuple[SceneFlowNetOutput, Tensor | None]:
        """`forward`, and the correlation (B, (2 L + 1)^2, H / 8, W / 8) as `correlate` orders it; None for OurS."""
        height, width = curr_color.shape[-2:]
        unit = self.settings.length_unit
        origin = curr_points.new_tensor((0.0, 0.0, self.settings.origin_depth))[:, None, None]
        prev_shape, curr_shape = (_with_validity((points - origin) / unit) for points in (prev_points, curr_points))
        images = [_pad(image) for image in (prev_color, prev_shape, curr_color, curr_shape)]
        features, correlation = self._encode(
            *images, descriptors=self._describe(prev_color, curr_color, images[0].shape[-2:])
        )
        details = _pyramid(images[2], images[3]) if self.settings.details else ()
        maps = SceneFlowNetOutput(
            *(channels[..., :height, :width] for channels in self.heads(self.hourglass(features, details)))
        )
        # X is predicted as an offset from the pixel's own point; without depth, from the mean of the nearest points.
        center = maps.center + fill_holes(curr_shape[:, :3], curr_shape[:, 3:])
        maps = maps._replace(
            center=unit * center + origin, translation=unit * maps.translation, radius=unit * maps.radius
        )
        return maps, correlation

    def _describe(self, prev_color: Tensor, curr_color: Tensor, padded: torch.Size) -> tuple[Tensor, Tensor] | None:
        """XFeat descriptors (B, 64, h, w) of unit length at the cells of the current and of the previous frame."""
        if self.xfeat is None:
            return None
        size = (curr_color.shape[-2], curr_color.shape[-1])
        cells = (padded[0] // _STRIDE, padded[1] // _STRIDE)
        sampled = sample_cells(self.xfeat(torch.cat([curr_color, prev_color])), size, _STRIDE, cells)
        curr, prev = F.normalize(sampled, dim=1).chunk(2)
        return curr, prev

    def _encode(
        self,
        prev_color: Tensor,
        prev_shape: Tensor,
        curr_color: Tensor,
        curr_shape: Tensor,
        *,
        descriptors: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, Tensor | None]:
        """Features at stride 8 for the hourglass, and the correlation."""
        if self.color_encoder is None:
            return self.shape_encoder(torch.cat([curr_color, prev_color, curr_shape, prev_shape], dim=1)), None
        # The encoders are Siamese: both frames form one batch.
        curr_features, prev_features = self.color_encoder(torch.cat([curr_color, prev_color])).chunk(2)
        curr_geometry, prev_geometry = self.shape_encoder(torch.cat([curr_shape, prev_shape])).chunk(2)
        reach = self.settings.reach
        if self.sharpness is not None:
            curr_features, prev_features = F.normalize(curr_features, dim=1), F.normalize(prev_features, dim=1)
            correlation = correlate(curr_features, prev_features, reach) * self.sharpness.exp()
            if descriptors is not None and self.xfeat_sharpness is not None:
                factor = self.xfeat_sharpness.clamp(max=_LARGEST_XFEAT_SHARPNESS).exp()
                correlation = correlation + correlate(*descriptors, reach) * factor
            weights = (correlation - correlation.amax(1, keepdim=True)).exp()
        else:
            correlation = correlate(curr_features, prev_features, reach)
            weights = torch.relu(correlation)
        parts = [curr_geometry, prev_geometry, weighted_max_pool(weights, prev_geometry, reach)]
        if self.settings.displacement:
            prev_cells, curr_cells = (shape[..., ::_STRIDE, ::_STRIDE] for shape in (prev_shape, curr_shape))
            window = self.settings.displacement_window
            displacement = expected_displacement(correlation, prev_cells, curr_cells, reach, window=window)
            parts.append(displacement)
            if self.settings.local_motion_window:
                parts.append(self._local_motion(displacement, curr_cells))
        return torch.cat(parts, dim=1), correlation

    def _local_motion(self, displacement: Tensor, curr_cells: Tensor) -> Tensor:
        settings = self.settings
        return local_motion(
            displacement,
            curr_cells,
            window=settings.local_motion_window,
            scale=settings.local_motion_scale / settings.length_unit,
            tolerance=settings.local_motion_tolerance / settings.length_unit,
        )


def expected_displacement(
    correlation: Tensor, prev_cells: Tensor, curr_cells: Tensor, reach: int, *, window: int = 0
) -> Tensor:
    """Mean displacement of each cell's point over its patch, weighted by the softmax of its correlations.

    Args:
        correlation: (B, (2 L + 1)^2, h, w), as `correlate` orders it.
        prev_cells, curr_cells: (B, 4, h, w) points, and 1 where there is a point.
        reach: L, in cells.
        window: cells around the most probable one, in each direction, over which the mean is taken; 0 for the whole
            patch.

    Returns:
        (B, 4, h, w): the displacement, 0 where the point or all its candidates are missing; and among cells with
        points the probability of the window, or the highest probability without one.
    """
    height, width = correlation.shape[-2:]
    side = 2 * reach + 1
    patches = F.unfold(prev_cells, side, padding=reach)
    patches = patches.reshape(len(prev_cells), 4, -1, height, width).to(correlation.dtype)
    points, valid = patches[:, :3], patches[:, 3]
    best = correlation.amax(1, keepdim=True).detach()
    likely = (correlation - best).exp() * valid
    share = likely / likely.sum(1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
    known = (share.sum(1, keepdim=True) > 0) & (curr_cells[:, 3:] > 0)
    if window > 0:
        share = share * _around_maximum(share, side, window)
        probability = share.sum(1, keepdim=True)
        share = share / probability.clamp_min(torch.finfo(torch.float32).tiny)
    else:
        probability = share.amax(1, keepdim=True)
    mean = (points * share[:, None]).sum(2)
    displacement = torch.where(known, mean - curr_cells[:, :3], 0.0)
    return torch.cat([displacement, probability], dim=1)


def _around_maximum(share: Tensor, side: int, window: int) -> Tensor:
    """(B, side^2, h, w) bool: entries at most `window` rows and columns from the largest of their cell."""
    largest = share.argmax(1, keepdim=True)
    entry = torch.arange(side * side, device=share.device)[:, None, None]
    rows, columns = (entry // side - largest // side).abs(), (entry % side - largest % side).abs()
    return torch.maximum(rows, columns) <= window


def _pyramid(color: Tensor, shape: Tensor) -> list[Tensor]:
    """The frame at strides 4, 2 and 1: mean colours, but sampled points, since mean points would lie off surfaces."""
    return [
        torch.cat([F.avg_pool2d(color, step) if step > 1 else color, shape[..., ::step, ::step]], dim=1)
        for step in (4, 2, 1)
    ]


def _with_validity(points: Tensor) -> Tensor:
    """(B, 3, H, W) with NaN -> (B, 4, H, W): points with 0 for NaN, and a channel that is 1 where there is a point."""
    valid = torch.isfinite(points).all(dim=1, keepdim=True)
    return torch.cat([torch.where(valid, points, torch.zeros_like(points)), valid.to(points.dtype)], dim=1)


def _pad(image: Tensor) -> Tensor:
    """Pad with zeros at the right and the bottom, to multiples of the stride."""
    height, width = image.shape[-2:]
    return F.pad(image, (0, -width % _STRIDE, 0, -height % _STRIDE))


def fill_holes(points: Tensor, valid: Tensor) -> Tensor:
    """Replace missing points by the mean of the points around them, from the smallest block that has any.

    Args:
        points: (B, 3, H, W) metres, 0 where not valid.
        valid: (B, 1, H, W), 1 or 0.

    Returns:
        (B, 3, H, W): valid points unchanged; 0 if the whole image has none.
    """
    height, width = valid.shape[-2:]
    filled, known = points, valid
    block = 2
    while block < 2 * max(height, width):
        pad = (0, -width % block, 0, -height % block)
        count = F.avg_pool2d(F.pad(valid, pad), block)
        mean = F.avg_pool2d(F.pad(points, pad), block) / count.clamp_min(torch.finfo(count.dtype).tiny)
        some = (count > 0).to(count.dtype)
        mean, some = (F.interpolate(x, scale_factor=block)[..., :height, :width] for x in (mean, some))
        filled = filled + (1 - known) * mean
        known = torch.maximum(known, some)
        block *= 2
    return filled


def _initialise(network: nn.Module, generator: torch.Generator | None) -> None:
    """He et al. 2015 for layers with ReLU; heads near 0, so that training starts from zero motion."""
    if next(network.parameters()).is_meta:
        return  # there are no values, and drawing them on this device imports torch's compiler, which takes a second
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            fan_in = module.weight[0].numel() if isinstance(module, nn.Conv2d) else module.weight[:, 0].numel() // 4
            with torch.no_grad():
                module.weight.normal_(0, math.sqrt(2 / fan_in), generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, Heads):
                for parameter in module.parameters():
                    parameter.mul_(0.01)
            elif isinstance(module, Bottleneck):
                module.bn3.weight.zero_()  # every block starts as its shortcut (Goyal et al. 2017)
            elif isinstance(module, ColorEncoder):
                # The correlation is a sum over channels: unscaled, matched features would start hundreds of times
                # larger than the others.
                module.project.weight.div_(math.sqrt(2 * module.project.out_channels))
