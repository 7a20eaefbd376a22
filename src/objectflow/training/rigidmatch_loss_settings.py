"""How much each term of `rigidmatch_losses` weighs."""

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
    position: float = 20.0
    """Metres between a cell's expected and true position in the previous frame, on both grids."""
    match_confidence: float = 0.5
    """Cross entropy of "within 2 cm"."""
    foreground: float = 1.0
    """Cross entropy of object or not, every cell."""
    votes: float = 10.0
    """Metres of error of X, and of X + T."""
    seed: float = 0.5
    """Cross entropy of exp(-error / 4 cm) of a vote; 0 off the objects."""
    objectness: float = 2.0
    """Cross entropy of an object or none, every query; the class of the Hungarian matching."""
    mask: float = 5.0
    dice: float = 5.0
    """Also in the matching, as the one above."""
    no_object: float = 0.5
    """Weight of queries without an object within `objectness`."""
    pixels: float = 2.0
    """Cross entropy and dice of the matched masks at every pixel; teaches the upsampling."""
    flow: float = 40.0
    """Metres between the flow that an object's motion makes and the true one, the same for all objects."""
    moves: float = 0.5
    """Cross entropy of moving or not, of matched queries."""
    background: float = 0.1
    """Weight of a cell off the objects in the means of match, window, position and match_confidence."""

    def __post_init__(self) -> None:
        for one in fields(self):
            if not 0 <= getattr(self, one.name) < float("inf"):  # written so that NaN fails too
                raise MethodError(f"loss setting {one.name} must be finite and >= 0, not {getattr(self, one.name)}")
