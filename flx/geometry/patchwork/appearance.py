"""What a texture looks like around the vertices of a surface: colours and their spread in polar charts.

The colours of a source are known at its vertices, as means and spreads over their one-rings, with gradients.
A chart of a vertex is a disc in geodesic polar coordinates that begins at the vertex's x axis; a turn of the
chart is a shift of its angles. Charts of two surfaces are compared by the sum of their weighted differences.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex64, Float32, Int

from flx.geometry.arrays import chunks
from flx.geometry.copies import sample_rings
from flx.geometry.geodesics import walk
from flx.geometry.patchwork.anchors import Anchors, Surface, settled
from flx.geometry.tangent import corner_logs
from flx.types import SurfacePoints, TexturedMesh

ANGLES, RINGS = 24, 4  # samples of a chart
VALUES = 4  # of a sample: three colours and their spread
REACH = 3.5  # radius of a chart in edges of the target
EDGE = 1.9046  # mean vertex radii in an edge, were all triangles equilateral: √(2π / √3)
START = 0.25  # mean vertex radii between a vertex and the place where walks from it begin
LEAST = 10  # vertices of a source that can be used
BEYOND = 2.0  # mean vertex radii from the nearest vertex from which a point is beyond a border
GUARD = 3  # rings around damage that are not used either: texels are looked up that far from anchors
SAMPLES = 24  # colours averaged in a one-ring
AROUND = 24  # means over one-rings, by which a gradient is one of about a chart
CHUNK = 1 << 14  # vertices whose charts are made at a time

Values = Float32[Any, "*N 4"]
Charts = Float32[Any, "N 24 4 4"]  # angle, ring, value


def _weights() -> Float32[Any, "4"]:
    """Of the rings: their areas, less towards the rim; all samples of a chart add up to 1."""
    radii = (np.arange(RINGS) + 0.6) / RINGS
    weights = radii * np.exp(-((radii / 0.8) ** 2) / 2)
    return (weights / weights.sum() / ANGLES).astype(np.float32)


ROOTS = np.sqrt(_weights())[:, None]  # of the weights of a chart's samples


class Source:
    """A triangulated copy of a textured mesh, coarser or finer, and what its texture looks like there."""

    def __init__(
        self,
        mesh: TexturedMesh,
        surface: Surface,
        reach: float,
        seed: int,
        damaged: TexturedMesh | None = None,
        finest: bool = True,
    ) -> None:
        """`reach`: radius of the charts in the surface's mean vertex radii.

        `damaged` is the mesh with white texels where nothing may be taken from, black ones elsewhere. At the
        finest level not one is; coarser ones only decide what the finest begins with.

        Raises ValueError where nothing is left.
        """
        self.surface = surface
        self.usable: Bool[Any, V] = np.ones(len(surface), bool)
        if damaged is not None:
            white = (sample_rings(damaged, surface.triangulation, SAMPLES, seed).colors[..., 0] > 0.5).mean(1)
            self.usable &= white <= (0 if finest else 0.5)
            for _ in range(GUARD if finest else 0):
                self.usable &= self.usable[surface.rings.neighbors].all(1)
            if self.usable.sum() < LEAST:
                raise ValueError("nothing of the texture is left to take pieces from; mark less as damaged")
        colors = sample_rings(mesh, surface.triangulation, SAMPLES, seed).colors.astype(np.float32)
        mean = colors.mean(1)
        spread = np.sqrt(((colors - mean[:, None]) ** 2).mean((1, 2)))
        self.values: Values = np.concatenate([mean, spread[:, None]], 1)
        self.gradients = gradients(surface, self.values)
        parts = chunks(len(surface), CHUNK)
        self.charts: Charts = np.concatenate([self._seen(rows, reach) for rows in parts]) * ROOTS

    def _seen(self, rows: slice, reach: float) -> Charts:
        points = chart_points(self.surface, np.arange(len(self.surface))[rows], reach)
        corners = self.values[self.surface.triangulation.faces[points.faces]]
        seen = np.einsum("pkc,pk->pc", corners, points.barycentrics.astype(np.float32))
        return seen.reshape(-1, ANGLES, RINGS, VALUES)

    @cached_property
    def busy(self) -> Float32[Any, "V"]:
        """How much is going on around the vertices: the size of the gradients there, 1 on average."""
        surface, counts = self.surface, self.surface.used.sum(1)
        sizes = np.sqrt(np.square(np.abs(self.gradients)).sum(-1)) + np.float32(1e-6)
        for _ in range(AROUND):
            sizes = (sizes[surface.rings.neighbors] * surface.used).sum(1) / counts
        return (sizes / sizes.mean()).astype(np.float32)

    def can_give(self, anchors: Anchors) -> Bool[Any, "*N"]:
        """Whether there is something at (settled) anchors: they are not beyond a border, nor damaged."""
        return self.usable[anchors.vertices] & (np.abs(anchors.offsets) < BEYOND)

    def look(self, anchors: Anchors) -> Values:
        """Colours and spreads at anchors: those of the nearest vertex, and its gradients."""
        near = settled(self.surface, anchors)
        slopes = (np.conj(self.gradients[near.vertices]) * near.offsets[..., None]).real
        return np.clip(self.values[near.vertices] + slopes, 0, 1)


def gradients(surface: Surface, values: Float32[Any, "V C"]) -> Complex64[Any, "V C"]:
    """The least-squares gradient of each value over the one-rings, per mean vertex radius."""
    rings, used = surface.rings, surface.used.astype(np.float32)
    x, y = rings.logs.real * used, rings.logs.imag * used
    differences = values[rings.neighbors] - values[:, None]
    xx, yy, xy = (x * x).sum(1) + 1e-6, (y * y).sum(1) + 1e-6, (x * y).sum(1)
    along_x, along_y = (np.einsum("vk,vkc->vc", side, differences) for side in (x, y))
    determinant = (xx * yy - xy * xy)[:, None]
    right = yy[:, None] * along_x - xy[:, None] * along_y
    up = xx[:, None] * along_y - xy[:, None] * along_x
    return ((right + 1j * up) / determinant).astype(np.complex64)


def chart_points(surface: Surface, vertices: Int[Any, "n"], reach: float) -> SurfacePoints:
    """The samples of the charts of some vertices: chart by chart, angle by angle, outwards."""
    at = np.repeat(vertices, ANGLES)
    directions = np.exp(2j * np.pi * (np.arange(ANGLES) + 1e-4) / ANGLES)  # off the edges themselves
    starts = surface.points_at(at, np.tile(START * directions, len(vertices)).astype(np.complex64))
    faces, corners = surface.triangulation.faces[starts.faces], surface.unfolding.corners[starts.faces]
    place = np.einsum("pk,pk->p", corners, starts.barycentrics)
    ahead = place - corners[np.arange(len(at)), (faces == at[:, None]).argmax(1)]
    stops = ((np.arange(RINGS) + 0.6) / RINGS * reach - START) * surface.radius
    return walk(surface.unfolding, starts, ahead / np.maximum(np.abs(ahead), 1e-300), stops)


class Views(NamedTuple):
    """The charts of a target's vertices: which vertex decides what each sample shows, and its log there."""

    owners: Int[Any, "V 24 4"]
    logs: Complex64[Any, "V 24 4"]


def views(target: Surface, reach: float) -> Views:
    """`reach`: radius of the charts in the target's mean vertex radii."""
    faces, shape = target.triangulation.faces, (len(target), ANGLES, RINGS)
    owners, logs = np.empty(np.prod(shape), np.int64), np.empty(np.prod(shape), np.complex64)
    for rows in chunks(len(target), CHUNK):
        points = chart_points(target, np.arange(len(target))[rows], reach)
        nearest = points.barycentrics.argmax(1)
        each = np.arange(len(nearest))
        part = slice(rows.start * ANGLES * RINGS, rows.start * ANGLES * RINGS + len(each))
        owners[part] = faces[points.faces][each, nearest]
        logs[part] = corner_logs(target.frames, target.triangulation, *points)[each, nearest]
    return Views(owners.reshape(shape), logs.reshape(shape))


def seen(source: Source, view: Views, anchors: Anchors, step: float, rows: Int[Any, "n"]) -> Charts:
    """The charts that some vertices of a target have, if its texture comes from these anchors."""
    there = anchors.at(view.owners[rows]).moved(view.logs[rows], step)
    return source.look(there) * ROOTS
