"""Thresholds by which frames are compared with older ones than the previous one."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class LongerGapSettings(Settings):
    """When a frame is also compared with an older one, and what is found in this way."""

    gap: int = setting(4, minimum=2)
    """Number of frames between the two; fewer at the start of a world."""
    closer: bool = True
    """Look for smaller objects in these estimates than in those of pairs, if the method can: `rigidmatch` does so with
    `detail="crops"`."""
    rim: int = setting(3, minimum=0)
    """Pixels around what is found, within which a known object is the same if it moved alike."""
    pairs_per_estimate: int = setting(5, minimum=1)
    """Number of pairs per estimate between frames farther apart, in the long run; it bounds the time."""
    max_saved: int = setting(2, minimum=1)
    """Maximum number of such estimates in consecutive pairs, where there were none before."""
    min_score: float = setting(0.4, minimum=0, maximum=1)
    """Minimum score of an object that is found in this way; a motion that other motions rival counts, since the poses
    in between confirm it."""
    max_known: float = setting(0.3, minimum=0, maximum=1)
    """Largest share of its mask that known objects may cover."""
    max_deviation: float = setting(0.5, minimum=0)
    """Largest distance between its pose in the older frame, by this estimate, and the pose to which its model is
    followed back from frame to frame, relative to its displacement."""
