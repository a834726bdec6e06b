"""How visible the seams of an atlas are: the jump of colour where charts meet, against that inside them."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from flx.geometry.arrays import face_areas
from flx.geometry.sampling import surface_colors
from flx.types import Layer, Slot, SurfacePoints, TexturedMesh

OFFSET = 1.0  # texels from the edge to either side; at half of it, what bilinear reading adds shows
PLACES = (1 / 6, 1 / 2, 5 / 6)  # along each edge
LEVEL = 1 / 255  # of an 8-bit texture: what rounding alone may add


class SeamJump(NamedTuple):
    """Mean differences of RGB, in [0, 1], between points on both sides of an edge, two texels apart."""

    seams: float
    inside: float

    @property
    def ratio(self) -> float:
        """1, or less: seams are not to be seen. A level is added to both: a flat texture has ratio 1."""
        return (self.seams + LEVEL) / (self.inside + LEVEL)


def seam_jump(mesh: TexturedMesh, slot: Slot = "base_color") -> SeamJump | None:
    """The jump across UV seams and across all other edges, weighted by length.

    Both are measured alike: at matching points a (mean) texel from the edge, each read from its own face
    as a viewer reads it. None without images, and where no seam, or no other edge, is.
    """
    layer = mesh.maps[slot]
    if not layer.images:
        return None
    edges = _inner_edges(mesh.faces)
    seam = _is_seam(layer, edges)
    if seam.all() or not seam.any():
        return None
    offset = OFFSET * _texel_size(mesh, layer)
    jumps = np.zeros(len(edges))
    for place in PLACES:
        one, other = (
            surface_colors(mesh, _beside(mesh, edges[:, side], where, offset), slot)
            for side, where in ((0, place), (1, 1 - place))
        )
        jumps += np.abs(one - other).mean(1) / len(PLACES)
    first = edges[:, 0]
    ends = mesh.vertices[[mesh.faces.ravel()[corner] for corner in (first, _after(first))]]
    lengths = np.linalg.norm(ends[1] - ends[0], axis=1)
    if not lengths[seam].any() or not lengths[~seam].any():
        return None
    seams, inside = (float(np.average(jumps[chosen], weights=lengths[chosen])) for chosen in (seam, ~seam))
    return SeamJump(seams, inside)


def _after(corners: Int[Any, "*N"]) -> Int[Any, "*N"]:
    """The next corner of the same face; corner 3 f + i is at faces[f, i] and stands for the edge onwards."""
    return corners - corners % 3 + (corners + 1) % 3


def _inner_edges(faces: Int[Any, "F 3"]) -> Int[Any, "E 2"]:
    """The two corners that stand for each edge between two faces of a manifold, oriented mesh."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    count = int(faces.max(initial=0)) + 1
    order = np.argsort(start * count + end)
    keys = (start * count + end)[order]
    forward = np.flatnonzero(start < end)
    place = np.minimum(np.searchsorted(keys, end[forward] * count + start[forward]), len(keys) - 1)
    paired = keys[place] == end[forward] * count + start[forward]
    return np.stack([forward[paired], order[place[paired]]], 1)


def _is_seam(layer: Layer, edges: Int[Any, "E 2"]) -> Bool[Any, "E"]:
    """Whether the two faces read the edge at different places; whole repeats are the same place."""
    uvs = layer.corner_uvs.reshape(-1, 2)
    here, there = edges.T
    gaps = np.stack([uvs[here] - uvs[_after(there)], uvs[_after(here)] - uvs[there]], 1)
    torn = (np.abs(gaps - np.round(gaps)) > 1e-6).any((1, 2))
    return torn | (layer.face_images[here // 3] != layer.face_images[there // 3])


def _texel_size(mesh: TexturedMesh, layer: Layer) -> float:
    """The side of a mean texel on the surface, in the vertices' units."""
    pixels = np.array([image.shape[1::-1] for image in layer.images])[layer.face_images]
    sides = (layer.corner_uvs[:, 1:] - layer.corner_uvs[:, :1]) * pixels[:, None]
    texels = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum()
    area = 2 * face_areas(mesh.vertices, mesh.faces).sum()
    return float(np.sqrt(area / max(texels, 1e-300)))


def _beside(mesh: TexturedMesh, corners: Int[Any, "E"], place: float, offset: float) -> SurfacePoints:
    """Points at a share of the way along each edge, `offset` inside its face (at most ⅓ of its height)."""
    a, b, c = (
        mesh.vertices[mesh.faces.ravel()[k]] for k in (corners, _after(corners), _after(_after(corners)))
    )
    edge, side = b - a, c - a
    squares = np.maximum(np.einsum("ex,ex->e", edge, edge), np.finfo(float).tiny)
    foot = np.einsum("ex,ex->e", edge, side) / squares
    heights = np.linalg.norm(side - foot[:, None] * edge, axis=1)
    share = np.minimum(offset / np.maximum(heights, np.finfo(float).tiny), 1 / 3)
    second = np.clip(place - share * foot, 0, 1 - share)
    barycentrics = np.zeros((len(corners), 3))
    rows = np.arange(len(corners))
    barycentrics[rows, corners % 3] = 1 - share - second
    barycentrics[rows, _after(corners) % 3] = second
    barycentrics[rows, _after(_after(corners)) % 3] = share
    return SurfacePoints(corners // 3, barycentrics)


def seam_ratio(mesh: TexturedMesh) -> float | None:
    """For reports: the jump across seams over that inside charts; None where the mesh has no seams."""
    jump = seam_jump(mesh)
    return None if jump is None else round(jump.ratio, 3)
