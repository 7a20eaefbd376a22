"""Settings of the search for motions (`motion_search`). Costs are in nats per pixel."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.alignment.matching import MatchSettings
from objectflow.alignment.prepared_frame import GRAY_BLURS
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
    kept: int = setting(48, minimum=1)
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
    """The levels of the coarse search that follow, each value for one level."""

    points: int = setting(120, minimum=1)
    """Number of points on which hypotheses are evaluated at every level."""
    angles_deg: tuple[float, ...] = setting((25.0,), minimum=0)
    """Degrees: standard deviation of the random rotation. Two kept hypotheses differ by more than half of it or by
    more than half of `shifts`."""
    shifts: tuple[float, ...] = setting((0.020,), minimum=0)
    """Metres: standard deviation of the random shift."""
    perturbed: tuple[int, ...] = setting((480,), minimum=1)
    """Number of perturbed hypotheses."""
    kept: tuple[int, ...] = setting((96,), minimum=1)
    """Number of hypotheses that are kept."""
    depth_scales: tuple[float, ...] = setting((0.025,), above=0)
    """Metres of depth difference that cost 0.5."""
    color_scales: tuple[float, ...] = setting((12.0,), above=0)
    """Difference in appearance that costs 0.5."""

    def __post_init__(self) -> None:
        super().__post_init__()
        lengths = {name: len(value) for name, value in vars(self).items() if isinstance(value, tuple)}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{name} {count}" for name, count in lengths.items())
            raise SettingsError(f"the settings of search levels need equally many values each, not {counts}")


def _check_iterations(name: str, iterations: tuple[int, ...]) -> None:
    if len(iterations) > len(GRAY_BLURS):
        raise SettingsError(f"motion_search.{name} takes at most {len(GRAY_BLURS)} values, not {len(iterations)}")


@dataclass(frozen=True)
class JudgedSearchSettings(Settings):
    """The search by registration and by the likelihood proper, which ends the search."""

    points: int = setting(200, minimum=1)
    """Number of points on which hypotheses are judged."""
    registered_points: int = setting(80, minimum=6)
    """Number of points by which hypotheses are registered."""
    iterations: tuple[int, ...] = setting((4, 1), minimum=0)
    """Steps of the registration for each blur of the grey images, coarse to fine."""
    kept: int = setting(8, minimum=1)
    """Number of hypotheses that are kept and perturbed."""
    perturbed: int = setting(96, minimum=1)
    """Number of perturbed hypotheses, which are registered as well."""
    angle_deg: float = setting(8.0, minimum=0)
    """Degrees: standard deviation of the random rotation. Two kept hypotheses differ by more than half of it or by
    more than half of `shift`."""
    shift: float = setting(0.008, minimum=0)
    """Metres: standard deviation of the random shift."""
    distinct_angle_deg: float = setting(3.0, minimum=0)
    """Degrees: two of the last hypotheses differ by more than this or by more than `distinct_shift`."""
    distinct_shift: float = setting(0.003, minimum=0)
    """Metres: see `distinct_angle_deg`."""
    registration: RegistrationSettings = RegistrationSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_iterations("judged.iterations", self.iterations)


@dataclass(frozen=True)
class FeatureMotionSettings(Settings):
    """Motions by features of objects that the search leaves unexplained (`feature_motions`)."""

    min_pixels: int = setting(500, minimum=3)
    """Fewest pixels of such an object, at the width of the likelihood; smaller ones have hardly any features."""
    min_cost: float = setting(1.5, minimum=0)
    """Mean cost of the motion from the search, from which features are tried. Detecting them takes nearly as long as
    the rest of the search, and they hardly ever improve a motion that explains part of the object."""
    min_inliers: int = setting(8, minimum=3)
    """Fewest features of an object that agree on a motion."""
    trials: int = setting(250, minimum=1)
    """Minimal sets of three features that are drawn at a time."""
    max_points: int = setting(400, minimum=6)
    """Maximum number of points that are registered."""
    min_cost_reduction: float = setting(0.2, minimum=0)
    """Minimum mean cost that a motion by features saves against the present one and against standing still."""
    min_inlier_ratio: float = setting(0.3, minimum=0, maximum=1)
    """Minimum share of pixels that a motion by features explains."""
    matching: MatchSettings = MatchSettings()
    registration: RegistrationSettings = RegistrationSettings(iterations=4)


@dataclass(frozen=True)
class MotionSearchSettings(Settings):
    """Which motions are searched again, and which results replace them (`motion_search`)."""

    width: int = setting(160, minimum=16)
    """Pixels: width at which hypotheses are evaluated."""
    max_trusted_cost: float = setting(0.5, minimum=0)
    """Mean cost up to which a motion is not searched again."""
    min_cost_reduction: float = setting(0.1, minimum=0)
    """Minimum mean cost that another motion saves against the present one and against standing still."""
    inlier_cost: float = setting(1.0, above=0)
    """Cost up to which a pixel counts as explained."""
    min_inlier_ratio: float = setting(0.15, minimum=0, maximum=1)
    """Minimum share of pixels that another motion explains."""
    cost_per_metre: float = setting(8.0, minimum=0)
    """Cost per metre between an object's centre under a hypothesis and under the present motion. It is
    not added to motions from features."""
    cost_per_radian: float = setting(0.35, minimum=0)
    """Cost per radian between the rotations of a hypothesis and of the present motion."""
    usual_pixels: int = setting(1000, minimum=1)
    """Number of pixels, at the width of the likelihood, for which these two costs hold. They fall with the root of an
    object's number of pixels, since more pixels are more evidence."""
    max_distance_cost: float = setting(3.0, minimum=0)
    """Highest cost of the distance in the coarse search."""
    cost_out_of_view: float = setting(3.0, minimum=0)
    """Cost of a point that the previous frame does not show: as high as a bad fit, since otherwise a motion that hides
    the object or moves it out of the image would win."""
    min_pixels: int = setting(20, minimum=3)
    """Fewest pixels, at the width of the likelihood, of an object that is searched."""
    max_positions: int = setting(30, minimum=0)
    """Maximum number of initial positions by colour."""
    registered: int = setting(3, minimum=1)
    """Number of hypotheses that are registered with more points at the end."""
    max_points: int = setting(400, minimum=6)
    """Maximum number of points that are registered."""
    last_iterations: tuple[int, ...] = setting((4, 4), minimum=0)
    """Steps of the last registration for each blur of the grey images, coarse to fine."""
    likelihood: SearchLikelihoodSettings = SearchLikelihoodSettings()
    colors: ColorProposalSettings = ColorProposalSettings()
    start: SearchStartSettings = SearchStartSettings()
    levels: SearchLevelSettings = SearchLevelSettings()
    judged: JudgedSearchSettings = JudgedSearchSettings()
    features: FeatureMotionSettings = FeatureMotionSettings()
    registration: RegistrationSettings = RegistrationSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_iterations("last_iterations", self.last_iterations)
