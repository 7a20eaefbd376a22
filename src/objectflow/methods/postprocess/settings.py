"""Settings of the steps that follow a network, one dataclass per step. Costs and gains are in nats per pixel."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.alignment.refine_objects import RefineSettings
from objectflow.geometry.moved import STATIC_DISPLACEMENT
from objectflow.methods.mask_edges import MaskEdgeSettings
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
    network_confidence: float = setting(0.6, minimum=0, maximum=1)
    """Probability of an object from which the network decides where the frames give no evidence."""
    static_displacement: float = setting(STATIC_DISPLACEMENT, minimum=0)
    """Metres: an object that moves by less counts as static."""


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
    """Cost per metre between an object's centre under a hypothesis and under the present motion."""
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
    iterations: int = setting(4, minimum=1)
    """Iterations of that registration for each blur."""
    max_points: int = setting(400, minimum=6)
    """Maximum number of points that are registered."""


@dataclass(frozen=True)
class MergeSettings(Settings):
    """When fragments are one body (`merge_fragments`)."""

    min_contact: float = setting(0.8, minimum=0, maximum=1)
    """Minimum share of the common border across which the surface is continuous."""
    max_loss: float = setting(0.2, minimum=0)
    """Largest mean log-likelihood per pixel that two fragments may lose by sharing one motion."""
    max_cost: float = setting(1.0, minimum=0)
    """Largest mean cost per pixel under that motion; two motions that explain nothing are no evidence of one body."""
    max_depth_step: float = setting(0.01, above=0)
    """Metres between neighbouring pixels at which a surface ends."""


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
    fragment_area_ratio: float = setting(0.1, minimum=0)
    """Size, relative to an added body, below which a known object beside it is a fragment of that body."""


@dataclass(frozen=True)
class PostprocessSettings(Settings):
    """The steps after a network, in their order, and their settings."""

    steps: tuple[str, ...] = (
        "refine", "static_test", "motion_search", "merge",
        "snap_to_edges", "drop_uncertain", "missed_objects", "confidence",
    )  # fmt: skip
    """Names of the steps in their order; see `postprocess.pipeline.STEPS`."""
    label_size: tuple[int, int] | None = None
    """Height and width at which labels were found; `snap_to_edges` aligns their borders with the full image.
    Estimators set it to the size of the network's input; none leaves borders as they are."""
    min_static_score: float = setting(0.3, minimum=0, maximum=1)
    """Minimum score of a static object; moving objects have further evidence."""
    likelihood: LikelihoodSettings = LikelihoodSettings()
    refine: RefineSettings = RefineSettings()
    static_test: StaticTestSettings = StaticTestSettings()
    motion_search: MotionSearchSettings = MotionSearchSettings()
    merge: MergeSettings = MergeSettings()
    snap_to_edges: MaskEdgeSettings = MaskEdgeSettings()
    missed_objects: MissedObjectSettings = MissedObjectSettings()
