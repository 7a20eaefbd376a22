"""Solids of revolution and hollow vessels about the z axis, with any section in place of the circle."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from objectflow.synth.objects.shapes.outline import circle, offset_inwards
from objectflow.synth.objects.shapes.solid import Solid, loft
from objectflow.typing import Float64Array

Section = Float64Array | Callable[[float], Float64Array]
"""A (K, 2) outline of about unit radius, scaled by the profile's radius; or a function of the height z, metres."""

_THICK_FLOOR = 0.006
"""Minimum thickness of a vessel's floor, metres: objects at 2 m/s pass through thinner ones between two steps."""
_HULL_SIDES = 20
"""Number of sides of a convex part, where it divides that of the section."""
_HULL_ERROR = 0.0015
"""Maximum distance between a convex part and a concave section of the profile, metres."""
_PROFILE_ERROR = 0.0005
"""Maximum error of the simplified profile of a convex part, metres."""


def revolve(profile: ArrayLike, section: Section | None = None, hull_profile: ArrayLike | None = None) -> Solid:
    """A solid of revolution about z.

    Args:
        profile: (N, 2) of (r, z) metres, from the lower tip to the upper one; the first and the last r are 0.
        section: see `Section`; None for a circle with 40 sides.
        hull_profile: profile of the convex parts, without recesses; None for `profile`.
    """
    p = np.asarray(profile, dtype=np.float64)
    h = p if hull_profile is None else np.asarray(hull_profile, dtype=np.float64)
    parts = [_thinned(_rings(h[_simplified(h, run)], section)).reshape(-1, 3) for run in _convex_runs(h)]
    return loft(_rings(p[1:-1], section), parts, (0, 0, p[0, 1]), (0, 0, p[-1, 1]))


def vessel(
    outer: ArrayLike,
    thickness: float,
    section: Section | None = None,
    wedges: int = 12,
    levels: int = 1,
    *,
    floor: float = _THICK_FLOOR,
) -> Solid:
    """A hollow vessel, open at the top, with a wall of constant thickness and a flat floor.

    Args:
        outer: (N, 2) of (r, z) metres: the outer profile from (0, z) at the bottom over the foot's edge to the rim.
        thickness: of the wall, metres.
        section: see `Section`; its number of points must be a multiple of `wedges`. None for a circle with 4 * wedges
            sides.
        wedges: number of convex parts around the wall.
        levels: number of convex parts along the height of the wall, 1 or 2; the cut gives the smallest hulls.
        floor: thickness of the floor, metres; at least that of the wall.
    """
    p = np.asarray(outer, dtype=np.float64)
    if section is None:
        section = circle(4 * wedges)
    inner = offset_inwards(p, thickness)
    ground = p[0, 1] + max(floor, thickness)
    inner[:-1, 1] = np.maximum(inner[:-1, 1], ground)
    inner[0] = 0, ground
    inner[-1, 1] = p[-1, 1]
    rim = (p[-1] + inner[-1]) / 2 + [0, thickness * 0.3]
    whole = np.concatenate([p[1:], [rim], inner[:0:-1]])
    outer_rings, inner_rings = _rings(p, section), _rings(inner, section)
    parts = [np.concatenate([_thinned(outer_rings[1]), _thinned(inner_rings[1])])]
    step = outer_rings.shape[1] // wedges
    for start, stop in _wall_runs(p[1:], inner[1:], levels):
        rows = np.unique(np.linspace(start + 1, stop + 1, min(stop - start + 1, 6)).round().astype(int))
        for wedge in range(wedges):
            columns = np.arange(wedge * step, (wedge + 1) * step + 1) % outer_rings.shape[1]
            outside = outer_rings[np.ix_(rows, columns)].reshape(-1, 3)
            inside = inner_rings[np.ix_(rows, columns[[0, -1]])].reshape(-1, 3)
            parts.append(np.concatenate([outside, inside]))
    return loft(_rings(whole, section), parts, (0, 0, p[0, 1]), (0, 0, inner[0, 1]))


def _rings(profile: Float64Array, section: Section | None) -> Float64Array:
    """(N, 2) profile -> (N, K, 3) rings."""
    if section is None:
        section = circle()
    outlines = np.stack([section(float(z)) for z in profile[:, 1]]) if callable(section) else section[None]
    flat = profile[:, 0, None, None] * outlines
    z = np.broadcast_to(profile[:, 1, None, None], (*flat.shape[:2], 1))
    return np.concatenate([flat, z], axis=-1)


def _thinned(rings: Float64Array) -> Float64Array:
    """Reduce the points per ring for the physics: to `_HULL_SIDES` or 24 where they divide the number of points."""
    sides = rings.shape[-2]
    keep = sides // _HULL_SIDES if sides % _HULL_SIDES == 0 else max(sides // 24, 1) if sides % 24 == 0 else 1
    return rings[..., :: max(keep, 1), :]


def _convex_runs(profile: Float64Array) -> list[slice]:
    """Cut a profile r(z) into runs whose solids are convex up to `_HULL_ERROR`; neighbours share a ring."""
    runs, start = [], 0
    last = len(profile) - 1
    while start < last:
        hull = [start]
        stop = start
        while stop < last:
            trial = [*hull, stop + 1]
            while len(trial) > 2 and _convexity(profile[trial[-3:]]) >= 0:  # keep only the outermost points
                del trial[-2]
            span = profile[start : stop + 2]
            order = np.argsort(profile[trial, 1], kind="stable")
            outermost = np.interp(span[:, 1], profile[trial, 1][order], profile[trial, 0][order])
            if stop > start and (outermost - span[:, 0])[1:-1].max(initial=0) > _HULL_ERROR:
                break
            hull, stop = trial, stop + 1
        runs.append(slice(start, stop + 1))
        start = stop
    return [run for run in runs if np.ptp(profile[run, 1]) > 1e-9] or [slice(0, last + 1)]


def _simplified(profile: Float64Array, run: slice) -> list[int]:
    """Indices of a run that preserve its shape up to `_PROFILE_ERROR` (Douglas and Peucker 1973)."""
    todo, keep = [(run.start, run.stop - 1)], {run.start, run.stop - 1}
    while todo:
        first, last = todo.pop()
        chord = profile[last] - profile[first]
        inner = profile[first + 1 : last] - profile[first]
        away = np.abs(inner[:, 0] * chord[1] - inner[:, 1] * chord[0]) / max(float(np.hypot(*chord)), 1e-12)
        if len(away) and away.max() > _PROFILE_ERROR:
            middle = first + 1 + int(away.argmax())
            keep.add(middle)
            todo += [(first, middle), (middle, last)]
    return sorted(keep)


def _convexity(p: Float64Array) -> float:
    """At least 0 if the middle of three points (r, z) with increasing z is inside their solid's hull."""
    (r0, z0), (r1, z1), (r2, z2) = p
    return float((r2 - r0) * (z1 - z0) - (r1 - r0) * (z2 - z0))


def _wall_runs(outer: Float64Array, inner: Float64Array, levels: int) -> list[tuple[int, int]]:
    """Index ranges, ends included, of the wall's levels, cut so that the total area of their hulls is minimal."""
    last = len(outer) - 1
    if levels == 1 or last < 2:
        return [(0, last)]
    costs = [_hull_area(outer, inner, 0, cut) + _hull_area(outer, inner, cut, last) for cut in range(1, last)]
    cut = int(np.argmin(costs)) + 1
    return [(0, cut), (cut, last)]


def _hull_area(outer: Float64Array, inner: Float64Array, start: int, stop: int) -> float:
    span = slice(start, stop + 1)
    return float(ConvexHull(np.concatenate([outer[span], inner[span]])).volume)
