"""Pieces of one object: two known objects that touch and have always moved as one become one, with the older id."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.tracking.fine_step import displacement
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.merge_settings import MergeSettings
from objectflow.typing import Float64Array

_APART = -1
"""Number of common steps of two objects that have moved relative to each other."""


class MovedTogether:
    """Counts the steps that pairs of known objects have made as one. It can be pickled."""

    def __init__(self, settings: MergeSettings) -> None:
        self._settings = settings
        self._steps: dict[tuple[int, int], int] = {}
        self._poses: dict[int, Float64Array] = {}
        self._since: dict[int, int] = {}
        self._frames = 0

    def update(self, objects: Mapping[int, KnownObject], moved: Collection[int]) -> dict[int, int]:
        """Add the latest frame.

        Args:
            objects: by the id of the track.
            moved: ids of the objects that moved in the latest pair.

        Returns:
            The id of each object that is a piece of an older one, and the id of that one.
        """
        pieces: dict[int, int] = {}
        ids = sorted(objects)
        self._frames += 1
        self._since = {number: self._since.get(number, self._frames) for number in ids}
        self._steps = {pair: steps for pair, steps in self._steps.items() if set(pair) <= set(ids)}
        for place, younger in enumerate(ids):
            for older in ids[:place]:
                pair = older, younger
                steps = self._count(pair, objects, moved)
                self._steps[pair] = steps
                enough = steps >= self._settings.min_steps
                if enough and not {older, younger} & set(pieces) and self._touch(objects[older], objects[younger]):
                    pieces[younger] = older
        self._poses = {number: known.world_T_object for number, known in objects.items() if number not in pieces}
        return pieces

    def _count(self, pair: tuple[int, int], objects: Mapping[int, KnownObject], moved: Collection[int]) -> int:
        """The number of steps of two objects as one, after the latest frame."""
        older, younger = pair
        if pair not in self._steps:
            # An object that had moved for several frames when the other one was found moved without it.
            return 0 if self._since[younger] - self._since[older] <= self._settings.max_delay else _APART
        steps = self._steps[pair]
        if steps == _APART or not {older, younger} & set(moved):
            return steps
        known, before, after = objects[younger], self._poses[younger], objects[younger].world_T_object
        carried = objects[older].world_T_object @ geometry.inverse(self._poses[older]) @ before
        if displacement(known.model, carried, after) > self._settings.max_shift:
            return _APART
        return steps + int(displacement(known.model, before, after) >= self._settings.min_step)

    def _touch(self, a: KnownObject, b: KnownObject) -> bool:
        points = geometry.transform(a.world_T_object, a.model.points)
        others = geometry.transform(b.world_T_object, b.model.points)
        distance, _ = cKDTree(points).query(others)
        limit = self._settings.max_distance + max(a.model.voxel, b.model.voxel)
        return bool(np.min(distance) <= limit)


def merge_into(older: KnownObject, piece: KnownObject, max_features: int) -> None:
    """Add the surface and the looks of a piece to the object that it belongs to.

    Args:
        older: the object.
        piece: another one with a constant pose relative to it.
        max_features: maximum number of features of its looks.
    """
    older_T_piece = geometry.inverse(older.world_T_object) @ piece.world_T_object
    older.model.add(piece.model, older_T_piece)
    older.looks.add_all(piece.looks, older_T_piece, max_features)
