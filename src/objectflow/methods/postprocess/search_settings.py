"""Settings of the search for motions (`motion_search`). Costs are in nats per pixel."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.alignment.matching import MatchSettings
from objectflow.alignment.registration import RegistrationSettings
from objectflow.errors import SettingsError
from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class SearchLikelihoodSettings(Settings):
    """The comparison of frames at the width of the search (`search_likelihood`)."""

    blur_px: float = setting(2.0, above=0)
    """Pixels: standard deviation of the blur, which widens the basin of the colour term."""
    lightness_weight: float = setting(0.25, minimum=0)
    """Weight of lightness relative to the colour channels; it changes when an object rotates relative to the light."""
    max_color: float = setting(2.0, minimum=0)
    """Highest cost of a colour difference."""
    outlier_sigmas: float = setting(3.0, above=0)
    """Depth scales from which a depth difference costs no more; in front of the surface, it violates free space from
    there."""
    hidden_sigmas: float = setting(2.0, above=0)
    """Depth scales behind the measured surface from which a point counts as hidden."""
    changed_lightness: float = setting(3.0, minimum=0)
    """Difference of weighted lightness from which a pixel counts as changed."""
    changed_color: float = setting(12.0, minimum=0)
    """Difference of a colour channel from which a pixel counts as changed."""
    changed_depth: float = setting(0.015, minimum=0)
    """Metres: difference in depth from which a pixel counts as changed."""


@dataclass(frozen=True)
class ColorProposalSettings(Settings):
    """Positions with an object's colours (`color_proposals`)."""

    full_weight_ratio: float = setting(8.0, above=0)
    """Ratio of a colour's frequency in the object to that in the image from which it has full weight."""
    unchanged_weight: float = setting(0.3, minimum=0, maximum=1)
    """Weight of a pixel that did not change: an object that moved was not there."""
    bin_width: float = setting(8.0, above=0)
    """Width of a histogram bin in weighted lightness and in each colour channel of CIELAB."""
    blur_ratio: float = setting(0.7, above=0)
    """Standard deviation of the blur of the weights, relative to the object's radius."""


@dataclass(frozen=True)
class SearchStartSettings(Settings):
    """The first hypotheses of the search, and which of them are kept."""

    angles_deg: tuple[float, ...] = setting((35.0, 70.0), above=0)
    """Degrees: rotations about each of seven axes, in both directions."""
    points: int = setting(60, minimum=1)
    """Number of points on which these hypotheses are evaluated."""
    kept: int = setting(24, minimum=1)
    """Number of hypotheses that are kept."""
    depth_scale: float = setting(0.03, above=0)
    """Metres of depth difference that cost 0.5."""
    color_scale: float = setting(14.0, above=0)
    """Difference in appearance that costs 0.5."""
    min_angle_deg: float = setting(20.0, minimum=0)
    """Degrees: two kept hypotheses differ by more than this or by more than `min_shift`."""
    min_shift: float = setting(0.02, minimum=0)
    """Metres: see `min_angle_deg`."""


@dataclass(frozen=True)
class SearchLevelSettings(Settings):
    """The levels of the search that follow, each value for one level."""

    points: int = setting(120, minimum=1)
    """Number of points on which hypotheses are evaluated at every level."""
    angles_deg: tuple[float, ...] = setting((25.0, 15.0, 10.0, 5.0), minimum=0)
    """Degrees: standard deviation of the random rotation. Two kept hypotheses differ by more than half of it or by
    more than half of `shifts`."""
    shifts: tuple[float, ...] = setting((0.020, 0.015, 0.010, 0.005), minimum=0)
    """Metres: standard deviation of the random shift."""
    perturbed: tuple[int, ...] = setting((480, 360, 240, 160), minimum=1)
    """Number of perturbed hypotheses."""
    kept: tuple[int, ...] = setting((16, 12, 8, 6), minimum=1)
    """Number of hypotheses that are kept."""
    depth_scales: tuple[float, ...] = setting((0.025, 0.020, 0.015, 0.012), above=0)
    """Metres of depth difference that cost 0.5."""
    color_scales: tuple[float, ...] = setting((12.0, 10.0, 9.0, 8.0), above=0)
    """Difference in appearance that costs 0.5."""

    def __post_init__(self) -> None:
        super().__post_init__()
        lengths = {name: len(value) for name, value in vars(self).items() if isinstance(value, tuple)}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{name} {count}" for name, count in lengths.items())
            raise SettingsError(f"the settings of search levels need equally many values each, not {counts}")


@dataclass(frozen=True)
class FeatureMotionSettings(Settings):
    """Motions by features of objects that the search leaves unexplained (`feature_motions`)."""

    min_inliers: int = setting(8, minimum=3)
    """Fewest features of an object that agree on a motion."""
    trials: int = setting(250, minimum=1)
    """Minimal sets of three features that are drawn at a time."""
    max_points: int = setting(400, minimum=6)
    """Maximum number of points that are registered."""
    matching: MatchSettings = MatchSettings()
    registration: RegistrationSettings = RegistrationSettings(iterations=4)


@dataclass(frozen=True)
class MotionSearchSettings(Settings):
    """Which motions are searched again, and which results replace them (`motion_search`)."""

    width: int = setting(160, minimum=16)
    """Pixels: width at which hypotheses are evaluated."""
    max_trusted_cost: float = setting(0.5, minimum=0)
    """Mean cost up to which a motion is not searched again."""
    min_cost_reduction: float = setting(0.2, minimum=0)
    """Minimum mean cost that another motion saves against the present one and against standing still."""
    inlier_cost: float = setting(1.0, above=0)
    """Cost up to which a pixel counts as explained."""
    min_inlier_ratio: float = setting(0.3, minimum=0, maximum=1)
    """Minimum share of pixels that another motion explains."""
    cost_per_metre: float = setting(10.0, minimum=0)
    """Cost per metre between an object's centre under a hypothesis and under the present motion. It is
    not added to motions from features."""
    max_distance_cost: float = setting(3.0, minimum=0)
    """Highest cost of that distance."""
    cost_out_of_view: float = setting(3.0, minimum=0)
    """Cost of a point that the previous frame does not show: as high as a bad fit, since otherwise a motion that hides
    the object or moves it out of the image would win."""
    min_pixels: int = setting(20, minimum=3)
    """Fewest pixels, at the width of the likelihood, of an object that is searched."""
    max_positions: int = setting(30, minimum=0)
    """Maximum number of initial positions by colour."""
    registered: int = setting(2, minimum=1)
    """Number of hypotheses that are registered at the end."""
    max_points: int = setting(400, minimum=6)
    """Maximum number of points that are registered."""
    likelihood: SearchLikelihoodSettings = SearchLikelihoodSettings()
    colors: ColorProposalSettings = ColorProposalSettings()
    start: SearchStartSettings = SearchStartSettings()
    levels: SearchLevelSettings = SearchLevelSettings()
    features: FeatureMotionSettings = FeatureMotionSettings()
    registration: RegistrationSettings = RegistrationSettings(iterations=4)
