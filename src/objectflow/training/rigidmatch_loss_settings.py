"""Weights of the terms of `rigidmatch_losses`."""

from __future__ import annotations

from dataclasses import dataclass, fields

from objectflow.errors import MethodError


@dataclass(frozen=True)
class RigidMatchLossSettings:
    """Weights of the terms, by their names in `rigidmatch_losses`.

    Raises:
        MethodError: a weight that is negative or not finite.
    """

    match: float = 2.0
    """Negative log-likelihood of the true cell, over rows and columns of the scores, or of the dustbin."""
    window: float = 1.0
    """Negative log-likelihood of the true cell within the last small window."""
    position: float = 12.0
    """Metres between a cell's expected and true position in the previous frame, on both grids."""
    match_confidence: float = 0.5
    """Cross entropy of "the match is within 2 cm of the truth"."""
    foreground: float = 3.0
    """Cross entropy of object or background, over all cells."""
    votes: float = 6.0
    """Metres of error of X, and of X + T."""
    seed: float = 0.5
    """Cross entropy with exp(-error / 6 cm) of a vote; the target is 0 off the objects."""
    objectness: float = 2.0
    """Cross entropy of object or no object, over all queries; also the class cost of the Hungarian matching."""
    mask: float = 5.0
    """Cross entropy of the matched masks; also a cost of the matching."""
    dice: float = 5.0
    """Dice loss of the matched masks; also a cost of the matching."""
    no_object: float = 0.5
    """Weight of queries without an object within `objectness`."""
    pixels: float = 2.0
    """Cross entropy and dice of the matched masks on the finest grid; trains the upsampling."""
    flow: float = 25.0
    """Metres between the flow of an object's predicted motion and the true flow, with equal weight per object."""
    moving: float = 0.5
    """Cross entropy of moving or static, over matched queries."""
    background: float = 0.1
    """Weight of a cell off the objects in the means of match, window, position and match_confidence."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 <= value < float("inf"):  # NaN fails this comparison too
                raise MethodError(f"loss setting {field.name} must be finite and >= 0, not {value}")
