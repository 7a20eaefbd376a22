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
    """Negative log-likelihood of the true cell, from both frames' sides, or of the dustbin."""
    window: float = 1.0
    """The same within the last small window."""
    position: float = 12.0
    """Distance in metres between a cell's expected and true position in the previous frame, on both grids."""
    match_confidence: float = 0.5
    """Cross entropy of "the match is within 2 cm of the truth"."""
    foreground: float = 3.0
    """Cross entropy of object or not, every cell."""
    votes: float = 6.0
    """Errors of X and of X + T, in metres."""
    seed: float = 0.5
    """Cross entropy of a vote's quality exp(-error / 6 cm), which is 0 off the objects."""
    objectness: float = 2.0
    """Cross entropy of "an object", all queries; the class term of the Hungarian matching."""
    mask: float = 5.0
    dice: float = 5.0
    """Mask and dice weigh in the Hungarian matching too."""
    no_object: float = 0.5
    """Weight of queries without an object within `objectness`."""
    pixels: float = 2.0
    """Cross entropy and dice of the matched masks on the finest grid; trains the upsampling."""
    flow: float = 25.0
    """Distance in metres between the flow of an object's motion and the true flow; all objects weigh the same."""
    moves: float = 0.5
    """Cross entropy of moving or not, of matched queries."""
    background: float = 0.1
    """Weight of a cell off the objects in the means of match, window, position and match_confidence."""

    def __post_init__(self) -> None:
        for one in fields(self):
            if not 0 <= getattr(self, one.name) < float("inf"):  # written so that NaN fails too
                raise MethodError(f"loss setting {one.name} must be finite and >= 0, not {getattr(self, one.name)}")
