"""How faces and texels are joined over the surface, across seams of an atlas: what a brush and fills need.

Faces are neighbours where their edges lie at the same place, however the file split its vertices. Corner
3f + k is corner k of face f and stands for the edge opposite to it.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Int32, UInt8

from flx.geometry.arrays import distinct_rows
from flx.geometry.atlas import Atlas, fill_gutter
from flx.geometry.topology import edges_of, label_components
from flx.types import TexturedMesh

INSIDE = 0.75  # texels from a seam at which the texel on either side is looked up


class Joints(NamedTuple):
    """The neighbours of faces."""

    places: Int32[Any, "F 3"]  # corners of faces; those at the same place have the same number
    across: Int32[Any, "F 3"]  # the corner on the other side of each edge; −1 where there is none
    smooth: Bool[Any, "F 3"]  # whether the atlas goes on there, without a seam

    @property
    def parts(self) -> Int[Any, "F"]:
        """The connected component of each face."""
        return self._components(self.across >= 0)

    @property
    def charts(self) -> Int[Any, "F"]:
        """The chart (UV island) of each face."""
        return self._components(self.smooth)

    def _components(self, joined: Bool[Any, "F 3"]) -> Int[Any, "F"]:
        ends = np.stack([np.nonzero(joined)[0], self.across[joined] // 3], 1)
        return label_components(ends, len(joined))[1]


def joints_of(mesh: TexturedMesh) -> Joints:
    """The joints of a mesh. At an edge of more than two faces each is joined to the next, in a circle."""
    places = distinct_rows(mesh.vertices)[1][mesh.faces]
    topology = edges_of(places, len(mesh.vertices))
    edge = np.repeat(np.arange(len(topology.keys)), topology.uses)
    turn = np.arange(len(edge)) - topology.first[edge] + 1
    partner = topology.opposite[topology.first[edge] + turn % topology.uses[edge]]
    across = np.full(places.size, -1, np.int32)
    across[topology.opposite] = np.where(topology.uses[edge] > 1, partner, -1)
    across = across.reshape(-1, 3)

    here, there = (across >= 0).ravel().nonzero()[0], across[across >= 0]
    smooth = mesh.face_textures[here // 3] == mesh.face_textures[there // 3]
    uvs, ends = mesh.corner_uvs.reshape(-1, 2), places.ravel()
    for k in (1, 2):
        own, first, second = _turned(here, k), _turned(there, 1), _turned(there, 2)
        gap = uvs[own] - uvs[np.where(ends[first] == ends[own], first, second)]
        smooth &= (np.abs(gap - np.round(gap)) < 1e-6).all(1)  # whole repeats are no seam
    joined = np.zeros(places.size, bool)
    joined[here] = smooth
    return Joints(places.astype(np.int32), across, joined.reshape(-1, 3))


def _turned(corners: Int[Any, "N"], steps: int) -> Int[Any, "N"]:
    """Later corners of the same faces."""
    return corners - corners % 3 + (corners + steps) % 3


def followers(atlas: Atlas) -> Int32[Any, "H W"]:
    """Chains of texels that show one colour: the gutter at the rims of charts, as `fill_gutter` fills it.

    Of each texel the next in its chain, −1 at its end. A chain begins at a texel of the surface.
    """
    rows, columns = np.indices(atlas.faces.shape, np.uint16)
    sources = fill_gutter(np.stack([rows, columns, 0 * rows], -1), atlas.covered, reach=1.5).astype(np.int64)
    source = (sources[..., 0] * atlas.width + sources[..., 1]).ravel()
    gutter = np.flatnonzero(source != np.arange(len(source)))
    gutter = gutter[np.argsort(source[gutter], kind="stable")]
    follower = np.full(len(source), -1, np.int32)
    same = source[gutter[1:]] == source[gutter[:-1]]
    follower[gutter[:-1][same]] = gutter[1:][same]
    first = gutter[np.r_[True, ~same][: len(gutter)]]
    follower[source[first]] = first
    return follower.reshape(atlas.faces.shape)


def bridges(mesh: TexturedMesh, joints: Joints, atlas: Atlas) -> tuple[Int[Any, "N"], Int[Any, "N"]]:
    """Texels on both sides of each seam, in pairs: where the surface goes on though the atlas does not."""
    here = np.flatnonzero((~joints.smooth & (joints.across >= 0)).ravel())
    there, ends = joints.across.ravel()[here], joints.places.ravel()
    swapped = ends[_turned(there, 1)] != ends[_turned(here, 1)]
    sides = [[_turned(here, 1), _turned(here, 2), here]]
    one, two = _turned(there, 1), _turned(there, 2)
    sides.append([np.where(swapped, two, one), np.where(swapped, one, two), there])
    places = atlas.corners.reshape(-1, 2)
    longest = np.maximum(*(np.hypot(*(places[a] - places[b]).T) for a, b, _ in sides))
    counts = np.ceil(longest).astype(np.int64) + 1
    edge = np.repeat(np.arange(len(here)), counts)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[edge]
    found = []
    for a, b, inner in sides:
        start, end, third = (places[corners[edge]] for corners in (a, b, inner))
        at = start + share[:, None] * (end - start)
        inward = third - at
        at = at + inward * np.minimum(INSIDE / np.maximum(np.hypot(*inward.T), 1e-9), 1 / 3)[:, None]
        columns, rows = np.rint(at).astype(np.int64).T
        found.append(rows % atlas.height * atlas.width + columns % atlas.width)
    known = (atlas.faces.ravel()[found[0]] >= 0) & (atlas.faces.ravel()[found[1]] >= 0)
    return found[0][known], found[1][known]


def similar(
    image: UInt8[Any, "H W 3"],
    atlas: Atlas,
    charts: Int[Any, "F"],
    bridged: tuple[Int[Any, "N"], Int[Any, "N"]],
    start: int,
    tolerance: float,
) -> Bool[Any, "H W"]:
    """The texels around one that have a colour like its own and are connected with it over the surface.

    Args:
        start: The texel, counted row by row; it must show the surface.
        tolerance: Distance of colours in RGB, as a share of that from black to white.
    """
    away = np.square(image.astype(np.float32) - image.reshape(-1, 3)[start]).sum(2)
    alike = atlas.covered & (away <= 3 * (255 * tolerance) ** 2)
    chart = np.where(alike, charts[atlas.faces], -1)
    number = np.arange(chart.size).reshape(chart.shape)
    ends = [bridged]
    for axis in (0, 1):
        before, after = (np.delete(np.arange(chart.shape[axis]), end) for end in (-1, 0))
        joined = chart.take(before, axis) == chart.take(after, axis)
        ends.append((number.take(before, axis)[joined], number.take(after, axis)[joined]))
    pairs = np.concatenate([np.stack(pair, 1) for pair in ends])
    component = label_components(pairs[alike.ravel()[pairs].all(1)], chart.size)[1]
    return alike & (component == component[start]).reshape(chart.shape)
