"""A dense grid of voxels around one object: truncated signed distances, colours and weights, grown on demand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray

BLOCK = 8
"""Edge length of a block, in voxels. The grid grows by blocks, and blocks are selected before voxels are."""


@dataclass(eq=False)
class VolumeGrid:
    """Fused measurements on a regular grid. The arrays share their first three axes, which follow the object's axes.

    Attributes:
        voxel: edge length of a voxel, metres.
        first: (3,) index of the first voxel; voxel (i, j, k) of the arrays is centred at
            `(first + (i, j, k) + 0.5) voxel`.
        distance: (X, Y, Z) float32: mean signed distance to the surface, metres; positive in front of it.
        weight: (X, Y, Z) float32: weight of the measurements close to the surface.
        free: (X, Y, Z) float32: weight of the views through the voxel to something behind it.
        color: (X, Y, Z, 3) float32: mean colour, 0..255.
    """

    voxel: float
    first: IndexArray
    distance: Float32Array
    weight: Float32Array
    free: Float32Array
    color: Float32Array

    @classmethod
    def empty(cls, voxel: float, first: IndexArray, shape: tuple[int, int, int]) -> VolumeGrid:
        """A grid without measurements."""
        distance, weight, free = (np.zeros(shape, np.float32) for _ in range(3))
        return cls(voxel, first, distance, weight, free, np.zeros((*shape, 3), np.float32))

    @property
    def shape(self) -> IndexArray:
        """(3,) number of voxels along each axis."""
        return np.array(self.distance.shape, np.intp)

    def values(self, truncation: float) -> Float32Array:
        """(X, Y, Z) metres: distances with views through a voxel counted as the truncation distance."""
        total = np.maximum(self.weight + self.free, np.float32(1e-12))
        return np.asarray((self.weight * self.distance + self.free * np.float32(truncation)) / total)

    def covering(self, lower: Float64Array, upper: Float64Array) -> VolumeGrid:
        """The grid itself, or a copy that is larger by whole blocks, so that it covers a box.

        Args:
            lower, upper: (3,) corners of the box, metres in the object frame.
        """
        start, stop = block_range(lower, upper, self.voxel)
        start, stop = np.minimum(start, self.first), np.maximum(stop, self.first + self.shape)
        if (start == self.first).all() and (stop == self.first + self.shape).all():
            return self
        x, y, z = (stop - start).tolist()
        out = VolumeGrid.empty(self.voxel, start, (x, y, z))
        inside = tuple(slice(a, a + n) for a, n in zip(self.first - start, self.shape, strict=True))
        for name in ("distance", "weight", "free", "color"):
            getattr(out, name)[inside] = getattr(self, name)
        return out

    def coarser(self) -> VolumeGrid:
        """The same measurements on voxels of twice the edge length: weighted means of eight voxels."""
        start = self.first // (2 * BLOCK) * BLOCK
        stop = -(-(self.first + self.shape) // (2 * BLOCK)) * BLOCK
        # Pad to whole coarse blocks, so that each coarse voxel has eight fine ones.
        padding = [
            (int(a), int(b)) for a, b in zip(self.first - 2 * start, 2 * stop - self.first - self.shape, strict=True)
        ]

        def summed(values: Float32Array) -> Float32Array:
            padded = np.pad(values, padding + [(0, 0)] * (values.ndim - 3))
            x, y, z = (n // 2 for n in padded.shape[:3])
            return np.asarray(padded.reshape(x, 2, y, 2, z, 2, *values.shape[3:]).sum(axis=(1, 3, 5)), np.float32)

        weight = summed(self.weight)
        total = np.maximum(weight, np.float32(1e-12))
        return VolumeGrid(
            2 * self.voxel,
            start,
            np.asarray(summed(self.distance * self.weight) / total, np.float32),
            weight / np.float32(8),
            summed(self.free) / np.float32(8),
            np.asarray(summed(self.color * self.weight[..., None]) / total[..., None], np.float32),
        )

    def centers(self, index: IndexArray) -> Float32Array:
        """(3, N) metres: centres of voxels by their flat indices."""
        position = np.stack(np.unravel_index(index, self.distance.shape)).astype(np.float32)
        return (position + (self.first[:, None] + np.float32(0.5)).astype(np.float32)) * np.float32(self.voxel)

    def coordinates(self, points: Float64Array) -> Float64Array:
        """(N, 3) metres in the object frame -> (N, 3) fractional voxel indices; voxel centres are whole numbers."""
        return np.asarray(points / self.voxel - self.first - 0.5)

    def near_points(self, points: Float64Array) -> BoolMask:
        """(X, Y, Z) blocks that hold one of the points (N, 3), and all blocks around them."""
        blocks = np.floor(self.coordinates(points) + 0.5).astype(np.intp) // BLOCK
        count = self.shape // BLOCK
        blocks = blocks[((blocks >= 0) & (blocks < count)).all(axis=1)]
        padded = np.zeros(count + 2, np.bool_)
        i, j, k = blocks.T
        near = (-1, 0, 1)
        for a in near:
            for b in near:
                for c in near:
                    padded[i + 1 + a, j + 1 + b, k + 1 + c] = True
        return padded[1:-1, 1:-1, 1:-1]

    def observed_blocks(self) -> BoolMask:
        """(X, Y, Z) blocks with a measurement close to the surface."""
        x, y, z = self.shape // BLOCK
        return np.asarray((self.weight > 0).reshape(x, BLOCK, y, BLOCK, z, BLOCK).any(axis=(1, 3, 5)))


def block_range(lower: Float64Array, upper: Float64Array, voxel: float) -> tuple[IndexArray, IndexArray]:
    """First voxel, and the voxel before which to stop, of the whole blocks that cover a box in metres."""
    size = BLOCK * voxel
    return (
        np.floor(lower / size).astype(np.intp) * BLOCK,
        (np.floor(upper / size).astype(np.intp) + 1) * BLOCK,
    )


def voxels_of_blocks(blocks: BoolMask) -> IndexArray:
    """Flat voxel indices, ascending, of the selected blocks (X, Y, Z) of a grid."""
    selected = blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1).repeat(BLOCK, axis=2)
    return np.flatnonzero(selected)
