"""Polygons cut into triangles: convex ones as fans, others by clipping ears."""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from flx.geometry.arrays import area_normals, cross, dot, sum_at, unit_vectors

MOST_CORNERS = 256  # polygons of more corners are cut into fans, whatever their shape
MOST_WORK = 3e8  # so are those beyond this sum of cubes of their corners, about two seconds
CHUNK = 1 << 20  # tests of a corner in an ear at a time


def cut_polygons(sizes: Int[Any, "N"], points: Float64[Any, "C 3"]) -> tuple[Int[Any, "F 3"], Int[Any, "F"]]:
    """Triangles of polygons whose corners lie end to end, as indices of corners; and the polygon of each.

    `sizes` counts the corners of each polygon, `points` are where they lie. A polygon is cut into a fan
    around its first corner, unless a triangle of the fan would face the other way.
    """
    triangles, owners = fans(sizes)
    if len(triangles) == len(sizes):
        return triangles, owners
    with np.errstate(all="ignore"):  # numbers that are not finite are refused by name, later
        normals = area_normals(points, triangles)
        whole = sum_at(owners[:, None], normals, len(sizes))
        turned = dot(normals, whole[owners]) < -1e-9 * dot(whole, whole)[owners]
    concave = np.unique(owners[turned])
    starts = np.cumsum(sizes) - sizes
    firsts = starts - 2 * np.arange(len(sizes))  # a polygon has two triangles fewer than corners
    work = 0.0
    for size in np.unique(sizes[concave]).tolist():
        members = concave[sizes[concave] == size]
        work += len(members) * float(size) ** 3
        if size > MOST_CORNERS or work > MOST_WORK:
            break
        step = max(CHUNK // size**2, 1)
        for part in (members[i : i + step] for i in range(0, len(members), step)):
            flat = _flattened(points[starts[part][:, None] + np.arange(size)], unit_vectors(whole[part]))
            rows = firsts[part][:, None] + np.arange(size - 2)
            triangles[rows] = starts[part][:, None, None] + _ears(flat)
    return triangles, owners


def fans(sizes: Int[Any, "N"]) -> tuple[Int[Any, "F 3"], Int[Any, "F"]]:
    """Fans around the first corners of polygons with these numbers of corners; and the polygon of each."""
    counts = sizes - 2
    owners = np.repeat(np.arange(len(sizes)), counts)
    steps = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = (np.cumsum(sizes) - sizes)[owners]
    return np.stack([first, first + steps + 1, first + steps + 2], 1), owners


def _flattened(points: Float64[Any, "P n 3"], normals: Float64[Any, "P 3"]) -> Float64[Any, "P n 2"]:
    """Polygons in the planes across their normals, counter-clockwise."""
    axes = np.eye(3)[np.abs(normals).argmin(1)]
    right = unit_vectors(cross(normals, axes))
    both = np.stack([right, cross(normals, right)], 2)
    return (points - points[:, :1]) @ both


def _ears(flat: Float64[Any, "P n 2"]) -> Int[Any, "P m 3"]:
    """Ears clipped one by one, the roundest first, of many polygons of as many corners at once."""
    count, size, _ = flat.shape
    left = np.tile(np.arange(size), (count, 1))
    every, clipped = np.arange(count), []
    for _ in range(size - 3):
        b = flat[every[:, None], left]
        a, c = np.roll(b, 1, 1), np.roll(b, -1, 1)
        area = _turn(a, b, c)
        # Only a reflex corner can be in the way; one at the same place as a corner of the ear is not.
        p, ear = b[:, None], (a[:, :, None], b[:, :, None], c[:, :, None])
        inside = np.broadcast_to((area < 0)[:, None], (count, b.shape[1], b.shape[1]))
        for k, corner in enumerate(ear):
            inside = inside & (_turn(ear[k - 1], corner, p) >= 0) & (p != corner).any(-1)
        sides = ((b - a) ** 2 + (c - b) ** 2 + (a - c) ** 2).sum(-1)
        roundness = np.where(inside.any(2), -2.0, area / np.maximum(sides, 1e-300))
        at = roundness.argmax(1)
        around = (at[:, None] + [-1, 0, 1]) % left.shape[1]
        clipped.append(np.take_along_axis(left, around, 1))
        keep = np.ones(left.shape, bool)
        keep[every, at] = False
        left = left[keep].reshape(count, -1)
    return np.stack([*clipped, left], 1)


def _turn(a: Any, b: Any, c: Any) -> Any:
    """Twice the area of triangles, positive where they are counter-clockwise."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
