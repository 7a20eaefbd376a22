"""Motions that the network missed: a search by sampling, for each object that its own motion does not explain.

A motion that is right explains what the previous frame shows far better than one that is off by centimetres; what is
hard is to come upon it. From the network's motion and from places that have the object's colours, turned every way,
the best guesses are scattered and sifted, ever finer, and the last few aligned with the depth and the colour.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment import registration
from objectflow.alignment.moved import is_moving
from objectflow.frame import RgbdFrame
from objectflow.methods.postprocess.color_proposals import propose_positions
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.search_likelihood import COST_OUT_OF_VIEW, SearchLikelihood
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray

MAX_TRUSTED_COST = 0.5
"""Mean cost of a pixel up to which a motion is not doubted."""
MIN_COST_REDUCTION = 0.2
"""Mean cost that another motion has to save, against the network's and against standing still."""
INLIER_COST, MIN_INLIER_RATIO = 1.0, 0.3
"""Least share of the pixels that have to cost less than `INLIER_COST` under it."""
COST_PER_METRE = 10.0
"""Cost a metre between the object's middle under it and under the network's: far away there is always something."""
_MAX_DISTANCE_COST = 3.0
"""Most that distance costs in the search."""
_MIN_PIXELS = 20
"""Fewer say nothing."""
_TURNS = np.radians([35.0, 70.0])
_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]], np.float64)
_AXES /= np.linalg.norm(_AXES, axis=1, keepdims=True)
_FIRST_POINTS, _POINTS = 60, 120
_ALIGNED = 2
"""So many of the last guesses are aligned; `_ALIGNED_POINTS` of the object take part, in so many iterations a blur."""
_ALIGNED_POINTS, _ITERATIONS = 400, 4


@dataclasses.dataclass(frozen=True, eq=False)
class PoseHypotheses:
    """(K, 3, 3) rotations `prev_R_curr`, and (K, 3) metres: where the object's middle was in the previous frame."""

    rotations: Float64Array
    places: Float64Array

    def take(self, index: IndexArray) -> PoseHypotheses:
        """Some of them."""
        return PoseHypotheses(self.rotations[index], self.places[index])

    def __add__(self, other: PoseHypotheses) -> PoseHypotheses:
        return PoseHypotheses(
            np.concatenate([self.rotations, other.rotations]), np.concatenate([self.places, other.places])
        )


class Aligner(NamedTuple):
    """Both frames, ready for `rigid.refine`."""

    target: registration.RegistrationTarget
    sources: registration.RegistrationSources


class SearchLevel(NamedTuple):
    """Guesses are scattered by `turn` (radians) and `shift` (metres) into about `number`, judged, and `kept`."""

    turn: float
    shift: float
    number: int
    kept: int
    reach: float
    shade: float


_FIRST_LEVEL = SearchLevel(0.0, 0.0, 0, 24, 0.03, 14.0)
_LEVELS = (
    SearchLevel(np.radians(25), 0.020, 480, 16, 0.025, 12.0),
    SearchLevel(np.radians(15), 0.015, 360, 12, 0.020, 10.0),
    SearchLevel(np.radians(10), 0.010, 240, 8, 0.015, 9.0),
    SearchLevel(np.radians(5), 0.005, 160, 6, 0.012, 8.0),
)


def search_motions(
    prev: RgbdFrame, curr: RgbdFrame, likelihood: PairLikelihood, objects: tuple[ObjectMotion, ...]
) -> tuple[ObjectMotion, ...]:
    """Give moving objects whose motions do not explain them better ones, where the frames show such.

    Args:
        prev, curr: the frames, of a camera that stands still.
        likelihood: the same, with the objects' labels.
        objects: with the motions to begin with.

    Returns:
        The same objects, the same for the same frames; `moving` follows a new motion's size.
    """
    motions = {obj.id: obj.prev_T_curr for obj in objects if obj.moving}
    masks = {number: likelihood.mask(number) for number in motions}
    doubted = {
        number: mask
        for number, mask in masks.items()
        if mask.sum() >= _MIN_PIXELS
        and likelihood.cost(motions[number], mask, blind=COST_OUT_OF_VIEW).mean() > MAX_TRUSTED_COST
    }
    if not doubted:
        return objects
    aligner = Aligner(
        registration.RegistrationTarget(likelihood.prev), registration.RegistrationSources(likelihood.curr)
    )
    frames = SearchLikelihood(prev, curr)
    found = {number: _search(frames, aligner, likelihood, mask, motions[number]) for number, mask in doubted.items()}
    return tuple(_with_motion(obj, found.get(obj.id, obj.prev_T_curr)) for obj in objects)


def _with_motion(obj: ObjectMotion, motion: Float64Array) -> ObjectMotion:
    """The object itself, where its motion stays."""
    if motion is obj.prev_T_curr:
        return obj
    new = dataclasses.replace(obj, prev_T_curr=motion)
    return dataclasses.replace(new, moving=bool(is_moving(motion[:3, :3], new.translation)))


def _search(
    frames: SearchLikelihood, aligner: Aligner, likelihood: PairLikelihood, mask: BoolMask, first: Float64Array
) -> Float64Array:
    """The motion of one object: `first`, or one that explains it better."""
    random = np.random.default_rng(int(mask.sum()))
    rows, columns = np.nonzero(mask)
    order = random.permutation(len(rows))
    rows, columns = rows[order], columns[order]
    points = likelihood.points[rows, columns]
    height, width = frames.curr_appearance.shape[:2]
    appearance = frames.curr_appearance[rows * height // mask.shape[0], columns * width // mask.shape[1]]
    middle = points.mean(axis=0, dtype=np.float64)
    guesses = coarse_to_fine_search(frames, points, appearance, first, random)

    source = aligner.sources.take(mask, limit=_ALIGNED_POINTS)
    own, still = (likelihood.cost(motion, mask, blind=COST_OUT_OF_VIEW).mean() for motion in (first, np.eye(4)))
    best, out = min(own, still) - MIN_COST_REDUCTION, first
    for rotation, place in zip(guesses.rotations[:_ALIGNED], guesses.places[:_ALIGNED], strict=True):
        start = geometry.make_transform(rotation, place - rotation @ middle)
        motion = registration.refine(aligner.target, source, start, iterations=_ITERATIONS).prev_T_curr
        cost = likelihood.cost(motion, mask, blind=COST_OUT_OF_VIEW)
        far = np.linalg.norm(geometry.transform(motion, middle) - geometry.transform(first, middle))
        total = float(cost.mean()) + COST_PER_METRE * float(far)
        if total < best and (cost < INLIER_COST).mean() > MIN_INLIER_RATIO:
            best, out = total, motion
    return out


def coarse_to_fine_search(
    frames: SearchLikelihood,
    points: Float32Array,
    appearance: Float32Array,
    first: Float64Array,
    random: np.random.Generator,
) -> PoseHypotheses:
    """Good guesses at an object's motion, the best first.

    Args:
        frames: both frames.
        points: (N, 3) metres, in any order.
        appearance: (N, 3), theirs in `frames.curr_appearance`.
        first: (4, 4) the motion that is doubted.
        random: where the scattering comes from.
    """
    middle = points.mean(axis=0, dtype=np.float64)
    centered = (points - middle).astype(np.float32)
    home = geometry.transform(first, middle)

    def judge(guesses: PoseHypotheses, round: SearchLevel, count: int) -> Float64Array:
        cost = frames(
            guesses.rotations,
            guesses.places,
            centered[:count],
            appearance[:count],
            reach=round.reach,
            shade=round.shade,
        )
        far = np.linalg.norm(guesses.places - home, axis=1)
        return np.asarray(cost + np.minimum(COST_PER_METRE * far, _MAX_DISTANCE_COST), dtype=np.float64)

    turns = np.concatenate([np.eye(3)[None], *(geometry.so3_exp(s * t * _AXES) for t in _TURNS for s in (1, -1))])
    places = np.concatenate([[home, middle], propose_positions(frames, points, appearance)])
    guesses = PoseHypotheses(np.tile(turns, (len(places), 1, 1)), np.repeat(places, len(turns), axis=0))
    guesses += PoseHypotheses(np.stack([first[:3, :3]] * 2), np.stack([home, middle]))
    cost = judge(guesses, _FIRST_LEVEL, _FIRST_POINTS)
    guesses = guesses.take(suppress_duplicates(guesses, cost, _FIRST_LEVEL.kept, np.radians(20), 0.02))
    for round in _LEVELS:
        guesses += perturb(guesses, round, random)
        cost = judge(guesses, round, _POINTS)
        guesses = guesses.take(suppress_duplicates(guesses, cost, round.kept, round.turn / 2, round.shift / 2))
    return guesses


def perturb(guesses: PoseHypotheses, round: SearchLevel, random: np.random.Generator) -> PoseHypotheses:
    """Each guess several times, turned and shifted at random."""
    times = max(1, round.number // len(guesses.rotations))
    index = np.repeat(np.arange(len(guesses.rotations)), times)
    turns = geometry.so3_exp(random.normal(size=(len(index), 3)) * round.turn / np.sqrt(3))
    shifts = random.normal(size=(len(index), 3)) * round.shift
    return PoseHypotheses(turns @ guesses.rotations[index], guesses.places[index] + shifts)


def suppress_duplicates(
    guesses: PoseHypotheses, cost: Float64Array, count: int, turn: float, shift: float
) -> IndexArray:
    """Indices of the cheapest guesses of which no two lie within both `turn` (radians) and `shift` (metres)."""
    order = np.argsort(cost, kind="stable")[: 6 * count]
    kept: list[int] = []
    while len(order) and len(kept) < count:
        best, rest = order[0], order[1:]
        kept.append(int(best))
        cosine = ((guesses.rotations[rest] * guesses.rotations[best]).sum((1, 2)) - 1) / 2
        apart = np.linalg.norm(guesses.places[rest] - guesses.places[best], axis=1) > shift
        order = rest[apart | (cosine < np.cos(turn))]
    return np.array(kept, dtype=np.intp)
