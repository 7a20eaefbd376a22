"""What moved and what did not: each object's motion against standing still, by what the previous frame shows.

A network is never wholly still: where depth is noisy, or where something else was lifted away, it says that things
moved a little. The frames can refute that.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from objectflow.alignment.likelihood import COST_FLOATING
from objectflow.alignment.moved import moves
from objectflow.methods.postprocess.pair_likelihood import Witness
from objectflow.motion import ObjectMotion

GAIN = 0.2
"""Mean log-likelihood a pixel that a motion has to win over standing still."""
FITS = 1.0
"""Cost up to which a pixel is explained."""
STANDS = 0.2
"""Share of an object's pixels that standing still explains: with as many it does not speak against it."""
IMPOSSIBLE = 0.02
"""Share of the pixels that, standing still, would hang in front of what was seen: a few do at any depth edge."""
SURE = 0.6
"""Probability of an object from which the network is believed where the frames say nothing."""


class Evidence(NamedTuple):
    """What the previous frame says of one object.

    Attributes:
        gain: mean log-likelihood of a pixel under the object's motion, less that of standing still.
        stands: share of the pixels that standing still explains.
        impossible: share of the pixels that, had they stood still, would hang in front of what was seen.
    """

    gain: float
    stands: float
    impossible: float

    def moved(self, score: float) -> bool:
        """Whether the object moved.

        It did if its motion explains it better than standing still does. A wrong motion explains nothing; then it
        moved if it cannot have stood still, or, if it would merely have been hidden, by the network's word: what was
        lifted away leaves hidden things behind that never moved.

        Args:
            score: 0..1, how sure the network is.
        """
        if self.gain > GAIN:
            return True
        return self.stands < STANDS and (self.impossible > IMPOSSIBLE or score > SURE)


def bring_to_rest(witness: Witness, objects: tuple[ObjectMotion, ...]) -> tuple[ObjectMotion, ...]:
    """Give objects that stand still, as far as the frames can tell, the identity for a motion, and say so.

    Args:
        witness: the frames, with the objects' labels.
        objects: with their final motions.

    Returns:
        The same objects. `moving` is decided anew: by the motion's size, and by `Evidence`.
    """
    out = []
    for obj in objects:
        moving = bool(moves(obj.prev_T_curr[:3, :3], obj.translation))
        motion = obj.prev_T_curr
        if moving:
            found = find_evidence(witness, obj)
            moving = found is None or found.moved(obj.score)
            motion = motion if moving else np.eye(4)
        out.append(dataclasses.replace(obj, prev_T_curr=motion, moving=moving))
    return tuple(out)


def find_evidence(witness: Witness, obj: ObjectMotion) -> Evidence | None:
    """The evidence on one object; None where none of its pixels has depth."""
    mask = witness.mask(obj.id)
    if not mask.any():
        return None
    still: NDArray[np.float32] = witness.cost(np.eye(4), mask)
    return Evidence(
        gain=float((still - witness.cost(obj.prev_T_curr, mask)).mean()),
        stands=float((still < FITS).mean()),
        impossible=float((still >= COST_FLOATING).mean()),
    )
