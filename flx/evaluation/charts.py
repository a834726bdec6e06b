"""Geodesic charts: discs of a surface of equal area, each seen from its centre, in polar coordinates.

A chart is cut into cells of `RINGS` radii and `ANGLES` directions; its values are the cells' mean colours. To
turn a chart is to shift its angles, so all turns of two charts are compared by one Fourier transform.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from flx.geometry.arrays import face_areas
from flx.geometry.geodesics import Unfolding, walk
from flx.geometry.sampling import surface_colors
from flx.types import SurfacePoints, TexturedMesh

SHARES = (0.01, 0.05, 0.20)  # of the surface's area, in a chart
ANGLES, RINGS, FINER = 32, 12, 3  # cells of a chart, and how much finer colours are sampled in each direction

Charts = Float32[Any, "N 12 32 3"]  # colours of the cells: ring, angle


class Sites(NamedTuple):
    """Where charts of one size are: their centres, and the points that their cells average."""

    share: float  # of the surface, in a chart
    radius: float  # in the vertices' units
    centers: SurfacePoints
    points: SurfacePoints  # chart by chart, angle by angle, outwards


def place_charts(
    mesh: TexturedMesh, unfolding: Unfolding, share: float, count: int, rng: np.random.Generator
) -> Sites:
    """Charts around `count` points uniform by area, turned at random."""
    areas = face_areas(mesh.vertices, mesh.faces)
    picked = rng.choice(len(areas), count, p=areas / areas.sum())
    centers = SurfacePoints(picked, rng.dirichlet((1, 1, 1), count))
    radius = float(np.sqrt(share * areas.sum() / np.pi))
    rays, stops = ANGLES * FINER, RINGS * FINER
    first = np.exp(2j * np.pi * rng.random(count))
    directions = first[:, None] * np.exp(2j * np.pi * np.arange(rays) / rays)
    starts = SurfacePoints(*(np.repeat(part, rays, 0) for part in centers))
    distances = (np.arange(stops) + 0.5) / stops * radius
    return Sites(share, radius, centers, walk(unfolding, starts, directions.ravel(), distances))


def chart_colors(mesh: TexturedMesh, sites: Sites) -> Charts:
    """The colours that a mesh has there, in [0, 1]."""
    fine = surface_colors(mesh, sites.points).reshape(-1, ANGLES, FINER, RINGS, FINER, 3)
    weights = np.arange(RINGS * FINER, dtype=np.float32).reshape(RINGS, FINER) + 0.5
    weights /= weights.sum(1, keepdims=True) * FINER
    return np.einsum("nafrgc,rg->nrac", fine, weights)


def chart_images(charts: Charts, size: int = 32) -> Float32[Any, "N size size 3"]:
    """The squares inside the charts as images, bilinear."""
    side = (np.arange(size) + 0.5) / size * 2 - 1
    place = np.add.outer(1j * side, side).ravel() / np.sqrt(2)
    row = np.clip(np.abs(place) * RINGS - 0.5, 0, RINGS - 1)
    column = np.angle(place) / (2 * np.pi) * ANGLES % ANGLES
    blend = np.zeros((size * size, RINGS, ANGLES), np.float32)
    for down in (0, 1):
        for right in (0, 1):
            ring, angle = np.floor(row).astype(int) + down, np.floor(column).astype(int) + right
            weight = (1 - np.abs(row - ring)) * (1 - np.abs(column - angle))
            blend[np.arange(size * size), np.minimum(ring, RINGS - 1), angle % ANGLES] += weight
    images = np.einsum("pra,nrac->npc", blend, charts, optimize=True)
    return images.reshape(-1, size, size, 3)
