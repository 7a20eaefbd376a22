"""Settings of the steps that follow a network, one dataclass per step. Costs and gains are in nats per pixel."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.alignment.refine_objects import RefineSettings
from objectflow.geometry.moved import STATIC_DISPLACEMENT
from objectflow.methods.consensus.assignment import AssignmentSettings
from objectflow.methods.consensus.pixel_graph import PixelGraphSettings
from objectflow.methods.mask_edges import MaskEdgeSettings
from objectflow.methods.postprocess.look_settings import SecondLookSettings
from objectflow.methods.postprocess.search_settings import MotionSearchSettings
from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class StaticTestSettings(Settings):
    """When an object counts as static (`static_test`)."""

    min_gain: float = setting(0.2, minimum=0)
    """Minimum mean gain of an object's motion over standing still."""
    inlier_cost: float = setting(1.0, above=0)
    """Cost up to which a pixel counts as explained."""
    static_inlier_ratio: float = setting(0.2, minimum=0, maximum=1)
    """Share of pixels that standing still explains, from which it cannot be excluded."""
    free_space_violation_ratio: float = setting(0.02, minimum=0, maximum=1)
    """Share of pixels that would violate free space if they stood still, above which the object must have moved. Depth
    edges produce a few such pixels anywhere."""
    network_confidence: float = setting(0.3, minimum=0, maximum=1)
    """Probability of an object from which the network decides where the frames give no evidence."""
    hidden_cost: float = setting(1.9, minimum=0)
    """Mean cost of standing still up to which an object may have been hidden in part, where no motion explains it
    better; that of a pixel that was hidden is 2, and 6 if it would violate free space (`rest_hidden`)."""
    static_displacement: float = setting(STATIC_DISPLACEMENT, minimum=0)
    """Metres: an object that moves by less counts as static."""
    uncovered_cost: float = setting(1.5, minimum=0)
    """Cost of standing still for background without texture that another mover uncovered."""
    full_texture: float = setting(15.0, above=0)
    """Grey levels: mean local contrast from which a surface counts as textured."""
    shadow_depth_ratio: float = setting(0.85, minimum=0, maximum=1)
    """Share of an object whose depth did not change, from which it may be the shadow of a mover beside it."""
    shadow_area_ratio: float = setting(0.7, minimum=0)
    """Largest size of such a shadow relative to the mover."""
    shadow_cost: float = setting(0.7, minimum=0)
    """Largest mean cost of standing still of a shadow that light explains: a surface keeps its texture and its
    chromaticity."""
    shadow_motion_ratio: float = setting(0.4, minimum=0)
    """Relative distance between the ends of the motions of a reflection and of a mover up to which it follows it."""
    shadow_reach_px: int = setting(5, minimum=0)
    """Pixels, at the width of the likelihood, between a mover and its shadow."""
    min_visible: float = setting(1 / 3, minimum=0, maximum=1)
    """Share of an object that the previous frame must show under its motion; other motions are guesses."""
    unseen_score: float = setting(0.3, minimum=0, maximum=1)
    """Highest score of an object of which the previous frame shows less."""
    explained_cost: float = setting(2.0, above=0)
    """Largest cost of a pixel that a motion explains."""
    two_way_exponent: float = setting(0.65, above=0)
    """Exponent of the shares of pixels that a motion explains, forwards and backwards, in the score; chosen on
    validation pairs, before rivals and colours count."""
    max_unexplained: float = setting(0.25, minimum=0, maximum=1)
    """Largest share of an object's visible pixels that its motion leaves unexplained; beyond it, the object is not
    rigid."""


@dataclass(frozen=True)
class OutlineSettings(Settings):
    """When an object differs too little from what is around it to be one (`drop_without_outline`)."""

    min_unchanged: float = setting(0.5, minimum=0, maximum=1)
    """Share of an object whose depth did not change, from which it needs an outline."""
    min_contrast: float = setting(3.0, minimum=0)
    """Smallest difference, in levels of 8-bit CIELAB, between the colours inside and outside of an outline."""
    min_sigmas: float = setting(3.0, minimum=0)
    """Smallest step of depth at an outline, in standard deviations of depth."""
    reach_px: int = setting(5, minimum=1)
    """Pixels, at the width of the likelihood, on both sides of the border that are compared."""
    min_border: int = setting(8, minimum=1)
    """Fewest pixels of a border that can be compared."""


@dataclass(frozen=True)
class RetryStaticSettings(Settings):
    """When an object at rest is registered once more, and when it moved after all (`retry_static`)."""

    min_pixels: int = setting(20, minimum=3)
    """Fewest pixels, at the width of the likelihood."""
    min_static_cost: float = setting(0.4, minimum=0)
    """Mean cost of standing still from which an object is registered again."""
    min_gain: float = setting(0.2, minimum=0)
    """Minimum mean gain of the motion over standing still."""
    min_gain_ratio: float = setting(0.5, minimum=0, maximum=1)
    """The same relative to the mean cost of standing still."""
    max_cost: float = setting(1.0, minimum=0)
    """Largest mean cost of the motion; one that explains little is no evidence."""


@dataclass(frozen=True)
class SplitSettings(Settings):
    """When the separate surfaces of one mask are separate objects (`split_objects`)."""

    min_pixels: int = setting(60, minimum=3)
    """Fewest pixels of a part, at the width of the likelihood."""
    min_share: float = setting(0.1, minimum=0, maximum=1)
    """Share of the mask: smaller parts stay with the rest."""
    max_points: int = setting(600, minimum=6)
    """Maximum number of points per part that are registered."""
    min_core_share: float = setting(0.15, minimum=0, maximum=1)
    """Share of a mask that cannot have stood still, from which these pixels alone may give the object's motion."""
    max_core_cost: float = setting(0.7, minimum=0)
    """Largest mean cost of those pixels under that motion."""
    depth_slope: float = setting(0.012, minimum=0)
    """Depth difference between neighbouring pixels of one surface, relative to depth."""
    depth_sigmas: float = setting(3.0, minimum=0)
    """The same in standard deviations of depth, in addition."""
    max_cost: float = setting(1.0, minimum=0)
    """Largest mean cost of each part under its motion; motions that explain nothing are no evidence of two things."""
    max_loss: float = setting(0.4, minimum=0)
    """Largest mean cost that a part may lose by sharing another part's motion."""
    max_trusted_cost: float = setting(0.4, minimum=0)
    """Mean cost of a part under the whole's motion, or at rest, up to which it is not registered by itself; also under
    a registered motion, up to which it is registered from no further start."""


@dataclass(frozen=True)
class RivalSettings(Settings):
    """Which other motions an object's motion must surpass (`rival_motions`), and what they cost the score."""

    unconfirmed_score: float = setting(0.4, minimum=0, maximum=1)
    """Score that a motion keeps without confirmation; only what exceeds it depends on rivals and colours."""
    rate: float = setting(4.0, above=0)
    """Per nat: how fast the confirmation grows with the mean cost per pixel that the best rival adds."""
    min_distance: float = setting(0.01, above=0)
    """Metres: mean distance between an object's points under its motion and under a rival, from which they differ."""
    min_relative_distance: float = setting(0.2, minimum=0)
    """The same relative to the object's mean displacement; the larger distance applies."""
    min_pixels: int = setting(6, minimum=6)
    """Fewest pixels, at the width of the likelihood, of an object whose motion may surpass its rivals."""
    angles_deg: tuple[float, ...] = setting((20.0, 45.0, 90.0, 180.0), above=0)
    """Degrees: rotations about each principal axis of the visible surface, in both directions."""
    shift_ratios: tuple[float, ...] = setting((1.5, 3.0), above=0)
    """Shifts along each axis of the camera, in both directions, relative to the distance from which motions differ."""
    points: int = setting(120, minimum=6)
    """Number of points on which rivals are evaluated."""
    depth_scale: float = setting(0.015, above=0)
    """Metres of depth difference that cost 0.5."""
    color_scale: float = setting(9.0, above=0)
    """Difference in appearance that costs 0.5."""
    kept: int = setting(12, minimum=1)
    """Number of first rivals that are perturbed."""
    perturbed: int = setting(144, minimum=1)
    """Number of perturbed rivals."""
    perturbed_angle_deg: float = setting(12.0, minimum=0)
    """Degrees: standard deviation of their random rotation."""
    perturbed_shift: float = setting(0.01, minimum=0)
    """Metres: standard deviation of their random shift."""
    min_angle_deg: float = setting(8.0, minimum=0)
    """Degrees: two kept rivals differ by more than this or by more than `min_shift`."""
    min_shift: float = setting(0.006, minimum=0)
    """Metres: see `min_angle_deg`."""
    registered: int = setting(6, minimum=1)
    """Number of rivals that are registered at the end."""


@dataclass(frozen=True)
class ColorSimilaritySettings(Settings):
    """How the colours of an object confirm its motion (`color_similarity`)."""

    explained_cost: float = setting(2.0, above=0)
    """Cost of depth alone up to which a motion explains a pixel; 2 is two standard deviations."""
    min_pixels: int = setting(6, minimum=1)
    """Fewest such pixels, at the width of the likelihood."""
    lightness_noise: float = setting(4.0, above=0)
    """Levels of lightness, 0 to 255, of which a difference is noise or a change of light."""
    hue_noise: float = setting(2.0, above=0)
    """The same of the two colour channels of CIELAB."""


@dataclass(frozen=True)
class JointMotionSettings(Settings):
    """When a motion that is registered to two fragments makes them one body (`merge_fragments`)."""

    min_pixels: int = setting(60, minimum=3)
    """Fewest pixels of a fragment, at the width of the likelihood: many motions explain a few."""
    max_gap_ratio: float = setting(0.3, minimum=0)
    """Largest distance between the fragments, relative to the extent of the larger one."""
    max_sigmas: float = setting(10.0, minimum=0)
    """Standard deviations of a match: largest mean distance between the ends of the points of both fragments under
    their two motions. Beyond it, nothing is registered."""
    min_turn_sigmas: float = setting(0.7, minimum=0)
    """Standard deviations of a match: smallest mean distance of the displacements of the points from their mean, by
    which the motion is more than a shift."""
    max_loss: float = setting(0.02, minimum=0)
    """Largest mean loss of both."""
    max_piece_loss: float = setting(0.2, minimum=0)
    """Largest mean loss of either."""
    max_piece_cost: float = setting(1.3, minimum=0)
    """Largest mean cost of either, before and after."""


@dataclass(frozen=True)
class MergeSettings(Settings):
    """When fragments are one body (`merge_fragments`)."""

    min_contact: float = setting(0.8, minimum=0, maximum=1)
    """Minimum share of the common border across which the surface is continuous."""
    max_loss: float = setting(0.2, minimum=0)
    """Largest mean log-likelihood per pixel that two fragments may lose by sharing one motion."""
    max_cost: float = setting(1.0, minimum=0)
    """Largest mean cost per pixel under that motion; two motions that explain nothing are no evidence of one body."""
    agreement_sigmas: float = setting(1.5, minimum=0)
    """Standard deviations of a match: mean distance between the ends of the points of both fragments under their two
    motions, up to which the motions agree."""
    agreement_factor: float = setting(2.0, minimum=1)
    """Factor on `max_cost` where the motions agree, which is evidence of one body by itself."""
    max_depth_step: float = setting(0.01, above=0)
    """Metres between neighbouring pixels at which a surface ends."""
    max_gap_ratio: float = setting(0.05, minimum=0)
    """Largest distance between fragments that do not touch along a continuous surface, relative to the extent of the
    larger one. Farther pieces with one motion may be things that were moved together."""
    max_apart_loss: float = setting(0.05, minimum=0)
    """Largest loss of such fragments, unless their motions agree."""
    max_piece_cost: float = setting(2.0, minimum=0)
    """Largest mean cost per pixel of each fragment under the common motion. A small fragment hardly counts in the mean
    over both, and one that no motion explains loses nothing by following a large one."""
    max_apart_piece_cost: float = setting(0.95, minimum=0)
    """The same of fragments that do not touch along a continuous surface; a pixel that was hidden costs 1 or more."""
    max_points: int = setting(300, minimum=3)
    """Maximum number of points of each fragment between which this distance is measured."""
    joint: JointMotionSettings = JointMotionSettings()
    """Fragments that neither motion explains, or that lie farther apart."""


@dataclass(frozen=True)
class ReassignSettings(Settings):
    """How pixels are assigned between the movers and standing still (`reassign_pixels`)."""

    min_pixels: int = setting(20, minimum=3)
    """Fewest pixels, at the width of the likelihood, of an object that takes part."""
    inlier_cost: float = setting(1.0, above=0)
    """Cost up to which a pixel counts as explained."""
    min_inlier_ratio: float = setting(0.5, minimum=0, maximum=1)
    """Share of its mask that an object's motion must explain to take part; other masks stay as they are."""
    neighbour_px: int = setting(2, minimum=0)
    """Pixels, at the width of the likelihood, within which another mover keeps an object's mask as it is."""
    own_mask: float = setting(2.0, minimum=0)
    """Cost that an object's motion is spared within its mask."""
    growth: float = setting(3.0, minimum=0)
    """Cost of an object's motion outside its mask, where the surface has no texture and fits many motions."""
    textured_growth: float = setting(0.3, minimum=0)
    """The same where the surface has texture, and where standing still is impossible because the previous frame saw
    through the point."""
    evidence_px: int = setting(7, minimum=1)
    """Pixels, at the width of the likelihood: side of the squares over which costs are averaged."""
    max_growth_cost: float = setting(2.5, minimum=0)
    """Largest mean cost of a motion where its object grows; it must also be lower than that of standing still. Where
    standing still is impossible, any motion wins, however badly it fits."""
    min_loss_cost: float = setting(1.0, minimum=0)
    """Least mean cost of a motion where its object loses pixels. Thin parts have a short border, so cutting them off
    is cheap although the motion explains them."""
    min_loss_gain: float = setting(0.2, minimum=0)
    """Mean cost that standing still spares there, which suffices as well."""
    max_rest_cost: float = setting(2.2, minimum=0)
    """Largest mean cost of standing still there; that of a pixel that was hidden is 2."""
    full_texture: float = setting(15.0, above=0)
    """Grey levels: mean local contrast from which a surface counts as textured."""
    other_object: float = setting(1.0, minimum=0)
    """Cost of taking a pixel from another object, in addition."""
    graph: PixelGraphSettings = PixelGraphSettings()
    assignment: AssignmentSettings = AssignmentSettings()


@dataclass(frozen=True)
class MissedObjectSettings(Settings):
    """Where missed objects are searched, and what is added (`missed_objects`).

    Pixels refer to the width of the likelihood.
    """

    changed_cost: float = setting(1.5, minimum=0)
    """Cost of standing still from which a pixel counts as changed."""
    min_object_share: float = setting(0.002, above=0, below=1)
    """Share of the image: smaller changed regions are not searched, and smaller objects are not added."""
    rounds: int = setting(2, minimum=1)
    """Rounds of assignment and refinement of the search."""
    rim_px: int = setting(2, minimum=0)
    """Pixels around a known object that belong to it, since masks end slightly inside or outside of edges."""
    min_score: float = setting(0.3, minimum=0, maximum=1)
    """Minimum score of an added object; regions that no motion explains have less."""
    neighbour_px: int = setting(7, minimum=0)
    """Pixels within which a piece may belong to a known object."""
    max_loss: float = setting(0.2, minimum=0)
    """Largest mean log-likelihood per pixel that a piece may lose by taking a known object's motion."""
    same_motion_ratio: float = setting(0.6, minimum=0)
    """Largest relative end-point difference at which two pieces share a motion."""
    min_area_ratio: float = setting(0.25, minimum=0)
    """Smallest size of a separate piece relative to a neighbouring object."""
    min_area_ratio_same_motion: float = setting(0.5, minimum=0)
    """The same for a piece that shares the neighbour's motion."""
    min_inside: float = setting(0.5, minimum=0, maximum=1)
    """Share of an added object that lies in the mask of an object at rest, from which it may take that mask."""
    fragment_area_ratio: float = setting(0.1, minimum=0)
    """Size, relative to an added body, below which a known object beside it is a fragment of that body."""


@dataclass(frozen=True)
class PostprocessSettings(Settings):
    """The steps after a network, in their order, and their settings."""

    steps: tuple[str, ...] = (
        "refine", "split", "static_test", "retry_static", "motion_search", "merge",
        "reassign", "merge", "second_look", "missed_objects", "static_test",
        "rest_hidden", "drop_without_outline", "drop_uncertain", "confidence",
    )  # fmt: skip
    """Names of the steps in their order; see `postprocess.pipeline.STEPS`."""
    label_size: tuple[int, int] | None = None
    """Height and width at which labels were found; `snap_to_edges` aligns their borders with the full image.
    Estimators set it to the size of the network's input; none leaves borders as they are."""
    min_static_score: float = setting(0.3, minimum=0, maximum=1)
    """Minimum score of a static object; moving objects have further evidence."""
    min_unexplained_score: float = setting(0.2, minimum=0, maximum=1)
    """The same of a static object that standing still does not explain."""
    min_unexplained_share: float = setting(0.0013, minimum=0, maximum=1)
    """Minimum share of the image of a moving object of lower score that its motion does not explain."""
    min_tiny_score: float = setting(0.5, minimum=0, maximum=1)
    """Minimum score of a moving object below `tiny_share` that its motion does not explain."""
    tiny_share: float = setting(0.001, minimum=0, maximum=1)
    """Share of the image below which an object is tiny."""
    unexplained_cost: float = setting(1.5, minimum=0)
    """Mean cost from which a motion, or standing still, does not explain an object; that of a pixel that was hidden is
    1 or 2."""
    likelihood: LikelihoodSettings = LikelihoodSettings()
    refine: RefineSettings = RefineSettings()
    static_test: StaticTestSettings = StaticTestSettings()
    outline: OutlineSettings = OutlineSettings()
    retry_static: RetryStaticSettings = RetryStaticSettings()
    split: SplitSettings = SplitSettings()
    motion_search: MotionSearchSettings = MotionSearchSettings()
    merge: MergeSettings = MergeSettings()
    rivals: RivalSettings = RivalSettings()
    color_similarity: ColorSimilaritySettings = ColorSimilaritySettings()
    reassign: ReassignSettings = ReassignSettings()
    snap_to_edges: MaskEdgeSettings = MaskEdgeSettings()
    second_look: SecondLookSettings = SecondLookSettings()
    missed_objects: MissedObjectSettings = MissedObjectSettings()
