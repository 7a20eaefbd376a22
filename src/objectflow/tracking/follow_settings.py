"""Thresholds by which models find motions that the estimates of pairs lack, and refuse wrong ones."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.alignment.fitting import FitSettings
from objectflow.settings import Settings, setting
from objectflow.tracking.looks import LooksSettings


@dataclass(frozen=True)
class FollowSettings(Settings):
    """When a known object that no estimate moved is followed by its model, and when an estimate is refused."""

    max_rest: float = setting(0.85, minimum=0, maximum=1)
    """Share of the model's visible points that a frame confirms at the last pose, from which the object rests."""
    min_drop: float = setting(0.08, minimum=0, maximum=1)
    """Minimum loss of that share since the last frame, at which an object that rested may have moved."""
    min_points: int = setting(60, minimum=1)
    """Minimum number of confirmed points."""
    min_present: float = setting(0.7, minimum=0, maximum=1)
    """Minimum share of the model's visible points that the frame must confirm at the new pose."""
    min_visible: float = setting(0.3, minimum=0, maximum=1)
    """Minimum share of the facing points that nothing may hide at the new pose."""
    min_gain: float = setting(0.1, minimum=0, maximum=1)
    """Minimum increase of the confirmed share of the visible points, relative to rest; and its minimum excess over
    the share that the previous frame confirms at the new pose, where the object cannot have been."""
    max_claimed: float = setting(0.5, minimum=0, maximum=1)
    """Largest share of the mask at the new pose that other known objects may cover."""
    max_starts: int = setting(3, minimum=1)
    """Maximum number of initial poses per object that are registered; the others fit the frame less."""
    min_matches: int = setting(6, minimum=3)
    """Minimum number of matches between the frames on an object from which its motion is fitted."""
    fit: FitSettings = FitSettings()
    """The fit of a motion to the matches."""
    looks: LooksSettings = LooksSettings()
    """Features by which a lost object is searched in the whole frame, one object per frame."""
    twin_distance: float = setting(0.03, minimum=0)
    """Metres: an object is not found again this close to where something else was seen that looks the same."""
    max_regions: int = setting(3, minimum=0)
    """Maximum number of changed regions, the largest ones, in which a lost object is searched."""
    max_candidates: int = setting(3, minimum=0)
    """Maximum number of lost objects, those of the most similar colours, that a new object is compared with."""
    min_overlap: float = setting(0.5, minimum=0, maximum=1)
    """Minimum intersection over union of the masks of a new object and of the lost object that it is."""
    min_part: float = setting(0.25, minimum=0, maximum=0.5)
    """Minimum share of a model's visible points in each part, where one part moves and the other rests."""
    part_margin: int = setting(3, minimum=0)
    """Pixels around the mask of the moving part that do not count as evidence for a part at rest."""
    refused_rest: float = setting(0.9, minimum=0, maximum=1)
    """Share of the model's visible points that the frame confirms at the last pose, from which an estimated motion
    that explains the frame less well is refused."""
    min_piece: float = setting(0.7, minimum=0, maximum=1)
    """Minimum share of an object of a pair that the model of a moving one covers, of which it is a piece."""
    piece_shift: float = setting(0.003, minimum=0)
    """Metres: largest difference between the motions of a piece and of the whole at the centre of the piece."""
    piece_share: float = setting(0.2, minimum=0)
    """The same relative to the displacement of the piece; the larger of both applies."""
