"""Scan conversion of triangles, for atlases and for rendered views.

Corners are in pixels, x to the right and y down; whole numbers are pixel centres.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int

CHUNK = 1 << 16  # pixels or points processed at a time, so that they fit the cache
INSIDE = -1e-9  # least barycentric of a pixel that counts as inside; below 0, so shared edges leave no holes


class Pixels(NamedTuple):
    """Pixel centres inside triangles. A pixel may occur more than once, with different triangles."""

    triangles: Int[Any, "N"]
    columns: Int[Any, "N"]
    rows: Int[Any, "N"]


class Planes(NamedTuple):
    """K functions that are affine on each triangle: value = at_origin + x · along + y · across."""

    at_origin: Float64[Any, "K F"]
    along: Float64[Any, "K F"]
    across: Float64[Any, "K F"]

    def __call__(self, triangles: Int[Any, "N"], x: Int[Any, "N"], y: Int[Any, "N"]) -> Float64[Any, "K N"]:
        value = self.along.take(triangles, axis=1) * x  # `take` is several times faster than an index
        value += self.across.take(triangles, axis=1) * y
        value += self.at_origin.take(triangles, axis=1)
        return value


def barycentric_planes(corners: Float64[Any, "F 3 2"]) -> Planes:
    """The three barycentrics of each triangle as functions of the pixel; constant −1 if it has no area."""
    (ax, ay), (bx, by), (cx, cy) = np.moveaxis(corners, 0, 2)
    areas = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    solid = np.abs(areas) > 1e-12
    scale = np.divide(1.0, areas, out=np.zeros_like(areas), where=solid)
    along = np.stack([by - cy, cy - ay, ay - by]) * scale
    across = np.stack([cx - bx, ax - cx, bx - ax]) * scale
    at_origin = -along * ax - across * ay
    at_origin[0] += 1.0
    at_origin[:, ~solid] = -1.0
    return Planes(at_origin, along, across)


def pixels_inside(corners: Float64[Any, "F 3 2"]) -> Iterator[Pixels]:
    """Scan-convert triangles, a chunk at a time, in ascending order; those without area have no pixels.

    Each row of a triangle is clipped to the columns where all three barycentrics are ≥ 0, so the cost of a
    long thin triangle is its area, not that of its bounding box.
    """
    planes = barycentric_planes(corners)
    first = np.ceil(corners[:, :, 1].min(1)).astype(np.int64)
    last = np.floor(corners[:, :, 1].max(1)).astype(np.int64)
    flat = (planes.along == 0).all(0) & (planes.across == 0).all(0)
    heights = np.where(flat, 0, np.maximum(last - first + 1, 0))
    for triangles, steps in expand(heights):
        rows = first[triangles] + steps
        along = planes.along.take(triangles, axis=1)
        at_zero = planes(triangles, np.zeros_like(rows), rows)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings = (INSIDE - at_zero) / along
        left = np.ceil(np.where(along > 0, crossings, -np.inf).max(0))
        right = np.floor(np.where(along < 0, crossings, np.inf).min(0))
        outside = ((along == 0) & (at_zero < INSIDE)).any(0)
        widths = np.where(outside, 0, np.maximum(right - left + 1, 0)).astype(np.int64)
        left = left.astype(np.int64)
        for spans, steps in expand(widths):
            yield Pixels(triangles[spans], left[spans] + steps, rows[spans])


def expand(counts: Int[Any, "N"]) -> Iterator[tuple[Int[Any, "M"], Int[Any, "M"]]]:
    """Item i repeated counts[i] times, paired with 0, 1, 2, …; in chunks of about `CHUNK` repetitions."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        done = ends[start] - counts[start]
        stop = max(int(np.searchsorted(ends, done + CHUNK, side="right")), start + 1)
        items = np.repeat(np.arange(start, stop), counts[start:stop])
        if len(items):
            yield items, np.arange(len(items)) - (ends[items] - counts[items] - done)
        start = stop
