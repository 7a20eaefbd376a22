"""Thresholds of the association of objects with tracks."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """Thresholds of the association."""

    min_overlap: float = setting(0.1, minimum=0, maximum=1)
    """Minimum intersection over union of two footprints."""
    max_gap: float = setting(0.1, minimum=0)
    """Metres: largest difference of two surfaces' median depths."""
    min_score: float = setting(0.3, minimum=0, maximum=1)
    """Objects with a lower score, such as regions that no motion explains, get no track, unless depth shows that they
    were not there before (`KnownSettings.arrival`)."""
    min_color_similarity: float = setting(0.35, minimum=0, maximum=1)
    """Minimum Bhattacharyya coefficient of two surfaces' colours: a neighbour does not take over the id of an object
    that left."""
    min_continued_overlap: float = setting(0.3, minimum=0, maximum=1)
    """Minimum intersection over union of the footprint of an object without an association with that of a track at its
    last place, or where its last motion leads: the track goes on, with a gap, since the pair's motion is wrong."""
    min_continued_similarity: float = setting(0.5, minimum=0, maximum=1)
    """Minimum coefficient of the colours in this case."""
    coast: int = setting(3, minimum=0)
    """Number of pairs for which a lost track is also searched at the position its last motion predicts."""
    max_age: int = setting(300, minimum=0)
    """Number of pairs without an association after which a track ends. Objects at rest have none."""
    history: int | None = setting(None, minimum=1)
    """Number of poses kept per track and for the camera; None keeps all poses and ended tracks."""
    footprint_cells: int = setting(64, minimum=1)
    """Number of grid cells across the image width for footprints: fine enough for a cup, coarse for sparse points."""
    max_points: int = setting(600, minimum=1)
    """Maximum number of surface points stored per track."""
