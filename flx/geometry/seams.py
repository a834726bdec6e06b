"""How visible the seams of an atlas are: the colour jump across them, compared with that inside charts.

And the same for the border of what is kept of a texture.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from flx.geometry.arrays import dot, face_areas
from flx.geometry.atlas import atlas_texels
from flx.geometry.sampling import surface_colors
from flx.geometry.topology import edges_of
from flx.types import Layer, Slot, SurfacePoints, TexturedMesh

OFFSET = 1.0  # distance from the edge in texels; at half a texel, bilinear reading would add to the jump
PLACES = (1 / 6, 1 / 2, 5 / 6)  # shares of the way along each edge
LEVEL = 1 / 255  # one level of an 8-bit texture, which rounding alone may add


class SeamJump(NamedTuple):
    """Mean differences of RGB, in [0, 1], between points on both sides of an edge, two texels apart."""

    seams: float
    inside: float

    @property
    def ratio(self) -> float:
        """At 1 or below, seams are invisible. One level is added to both: a flat texture has ratio 1."""
        return (self.seams + LEVEL) / (self.inside + LEVEL)


def seam_jump(mesh: TexturedMesh, slot: Slot = "base_color") -> SeamJump | None:
    """The jump across UV seams and across all other edges, weighted by length.

    Both are measured alike: between matching points one (mean) texel from the edge, each read from its own
    face, as a viewer reads it. None if there are no images, no seams or no other edges.
    """
    layer = mesh.maps[slot]
    if not layer.images:
        return None
    # The two corners from which each edge starts, in the face on either side.
    edges = _after(edges_of(mesh.faces, len(mesh.vertices)).inner)
    seam = _is_seam(layer, edges)
    if seam.all() or not seam.any():
        return None
    offset = OFFSET * _texel_size(mesh, layer)
    jumps = np.zeros(len(edges))
    for place in PLACES:
        one, other = (
            surface_colors(mesh, _near_edges(mesh, corners, where, offset), slot)
            for corners, where in zip(edges.T, (place, 1 - place), strict=True)
        )
        jumps += np.abs(one - other).mean(1) / len(PLACES)
    first = edges[:, 0]
    start, end = mesh.vertices[mesh.faces.ravel()[np.stack([first, _after(first)])]]
    lengths = np.linalg.norm(end - start, axis=1)
    if not lengths[seam].any() or not lengths[~seam].any():
        return None
    return SeamJump(*(float(np.average(jumps[at], weights=lengths[at])) for at in (seam, ~seam)))


def seam_corners(mesh: TexturedMesh, slot: Slot = "base_color") -> Int[Any, "S 2"]:
    """The two corners from which each seam starts, one in the face on either side; none without images.

    Corner 3f + i is faces[f, i]; the seam goes to the next corner of the face. Open borders are no seams.
    """
    layer = mesh.maps[slot]
    if not layer.images:
        return np.zeros((0, 2), np.int64)
    edges = _after(edges_of(mesh.faces, len(mesh.vertices)).inner)
    return edges[_is_seam(layer, edges)]


def _after(corners: Int[Any, "*N"]) -> Int[Any, "*N"]:
    """The next corner of the same face; corner 3f + i is faces[f, i] and stands for the edge to the next."""
    return corners - corners % 3 + (corners + 1) % 3


def _is_seam(layer: Layer, edges: Int[Any, "E 2"]) -> Bool[Any, "E"]:
    """Whether the two faces read the edge at different places; whole repeats of the texture do not count."""
    uvs = layer.corner_uvs.reshape(-1, 2)
    here, there = edges.T
    gaps = np.stack([uvs[here] - uvs[_after(there)], uvs[_after(here)] - uvs[there]], 1)
    torn = (np.abs(gaps - np.round(gaps)) > 1e-6).any((1, 2))
    return torn | (layer.face_images[here // 3] != layer.face_images[there // 3])


def _texel_size(mesh: TexturedMesh, layer: Layer) -> float:
    """The side length of a mean texel on the surface, in the vertices' units."""
    pixels = np.array([image.shape[1::-1] for image in layer.images])[layer.face_images]
    sides = (layer.corner_uvs[:, 1:] - layer.corner_uvs[:, :1]) * pixels[:, None]
    texels = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum()
    area = 2 * face_areas(mesh.vertices, mesh.faces).sum()
    return float(np.sqrt(area / max(texels, 1e-300)))


def _near_edges(mesh: TexturedMesh, corners: Int[Any, "E"], place: float, offset: float) -> SurfacePoints:
    """Points at a share of the way along each edge, `offset` inside its face (at most ⅓ of its height)."""
    own = np.stack([corners, _after(corners), _after(_after(corners))], 1)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces.ravel()[own]], 1, 0)
    edge, side = b - a, c - a
    foot = dot(edge, side) / np.maximum(dot(edge, edge), np.finfo(float).tiny)
    heights = np.linalg.norm(side - foot[:, None] * edge, axis=1)
    share = np.minimum(offset / np.maximum(heights, np.finfo(float).tiny), 1 / 3)
    second = np.clip(place - share * foot, 0, 1 - share)
    barycentrics = np.empty((len(corners), 3))
    np.put_along_axis(barycentrics, own % 3, np.stack([1 - share - second, second, share], 1), 1)
    return SurfacePoints(corners // 3, barycentrics)


def seam_ratio(mesh: TexturedMesh) -> float | None:
    """For reports: the jump across seams divided by that inside charts; None if the mesh has no seams."""
    jump = seam_jump(mesh)
    return None if jump is None else round(jump.ratio, 3)


def border_ratio(mesh: TexturedMesh, index: int, kept: Bool[Any, "H W"]) -> float | None:
    """The mean jump between neighbouring texels of which one is kept, divided by that between kept ones.

    Of one image, on the surface alone: neighbours lie in faces that have a vertex in common. None where there
    are no such texels.
    """
    image, faces = mesh.textures[index].astype(np.float32), atlas_texels(mesh, index, *kept.shape).faces
    jumps, kinds = [], []
    for axis in (0, 1):
        pairs = [np.delete(np.arange(kept.shape[axis]), end) for end in (-1, 0)]
        one, other = (faces.take(p, axis) for p in pairs)
        both = (one >= 0) & (other >= 0)
        corners = mesh.faces[np.stack([one[both], other[both]])]
        joined = (corners[0][:, :, None] == corners[1][:, None]).any((1, 2))
        here, there = (image.take(p, axis)[both][joined] for p in pairs)
        jumps.append(np.abs(here - there).mean(1) / 255)
        kinds.append(sum(kept.take(p, axis)[both][joined].astype(int) for p in pairs))
    jump, kind = np.concatenate(jumps), np.concatenate(kinds)
    if not (kind == 1).any() or not (kind == 2).any():
        return None
    return round(float((jump[kind == 1].mean() + LEVEL) / (jump[kind == 2].mean() + LEVEL)), 3)
