"""Thresholds of known objects."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.alignment.measured_noise import MeasuredNoiseSettings
from objectflow.alignment.registration import RegistrationSettings
from objectflow.settings import Settings, setting
from objectflow.tracking.arrivals import ArrivalSettings
from objectflow.tracking.earlier_settings import EarlierSettings
from objectflow.tracking.follow_settings import FollowSettings
from objectflow.tracking.longer_gap_settings import LongerGapSettings
from objectflow.tracking.merge_settings import MergeSettings
from objectflow.tracking.pose_cost import PoseCostSettings
from objectflow.tracking.unexplained_change import UnexplainedChangeSettings


@dataclass(frozen=True)
class KnownSettings(Settings):
    """Thresholds by which models are compared with frames."""

    width: int = setting(640, minimum=16)
    """Pixels: wider frames are downscaled to it before models are compared with them."""
    max_points: int = setting(20_000, minimum=100)
    """Maximum number of voxels per model; voxels grow where a model would exceed it."""
    min_pixels: int = setting(40, minimum=1)
    """Pixels at `width`: smallest mask from which a model is made, and smallest known mask."""
    noise: MeasuredNoiseSettings = MeasuredNoiseSettings()
    """Measurement of the depth noise in each pair."""
    noise_pairs: int = setting(30, minimum=1)
    """Number of recent pairs of which the median noise is taken, for each bin of depth."""
    depth_sigmas: float = setting(3.0, above=0)
    """Standard deviations of depth: largest difference between model and frame."""
    depth_margin: float = setting(0.006, minimum=0)
    """Metres, added to `depth_sigmas`, for the extent of voxels and errors of the pose."""
    max_chroma: float = setting(22.0, above=0)
    """CIELAB units: largest difference in the two colour-opponent channels between model and frame."""
    color_blur: float = setting(1.0, above=0)
    """Pixels at `width`: standard deviation of the blur of the frame's colours before they are compared with those of
    the model, which are means over a voxel."""
    min_present: float = setting(0.6, minimum=0, maximum=1)
    """Minimum share of the model's visible points that a frame must confirm for the object to be there."""
    min_visible: float = setting(0.08, minimum=0, maximum=1)
    """Share of the facing points below which an object counts as hidden."""
    max_loss: float = setting(0.05, minimum=0, maximum=1)
    """Largest loss of the share of confirmed points at which a registered pose is still accepted."""
    gap_depth: float = setting(0.02, minimum=0)
    """Metres: a gap in a mask is filled if the frame is at most this much nearer there than the model."""
    gap_radius: int = setting(2, minimum=0)
    """Pixels at `width`: radius of the morphological closing of a mask, which fills gaps of up to twice this width."""
    registration: RegistrationSettings = RegistrationSettings(iterations=6, color_weight=0.3, first_gate=0.02)
    """Registration of a model to the frame; the pose is known to a few centimetres."""
    registration_points: int = setting(1500, minimum=10)
    """Maximum number of model points that registration uses."""
    pose_cost: PoseCostSettings = PoseCostSettings()
    """When a registered pose replaces a chained one."""
    follow: FollowSettings = FollowSettings()
    """When an object is followed by its model alone, and when an estimate is refused."""
    earlier: EarlierSettings = EarlierSettings()
    """How an object that has just been found is followed back in time."""
    longer_gap: LongerGapSettings = LongerGapSettings()
    """When a frame is also compared with an older one than the previous one."""
    change: UnexplainedChangeSettings = UnexplainedChangeSettings()
    """Which changes since an older frame standing still and the known objects do not explain."""
    explained: UnexplainedChangeSettings = UnexplainedChangeSettings(min_share=0.0002, rim=1)
    """The same since the previous frame, where pairs that they explain are not estimated."""
    arrival: ArrivalSettings = ArrivalSettings()
    """When an object whose motion is unsure becomes known."""
    merge: MergeSettings = MergeSettings()
    """When two known objects are pieces of one."""
    max_correction: float = setting(0.02, minimum=0)
    """Metres: largest displacement by which registration to the model corrects a chained pose."""
    max_correction_deg: float = setting(16.0, minimum=0)
    """Degrees: largest rotation by which registration to the model corrects a chained pose."""
