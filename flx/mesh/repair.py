"""From the triangles of a file to a manifold, oriented mesh; every change is counted.

In this order: vertices welded by position; faces with a repeated
corner dropped; doubled ears dropped; faces with the corners of an earlier one dropped; vertices split until
every edge joins at most two faces of agreeing orientation and every vertex has one fan. Slivers of no area
are kept and counted: dropping one would open the surface. No face is turned round: neighbours that disagree
are cut apart.
"""

from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from flx.mesh.rows import distinct_rows
from flx.mesh.topology import mark, topology

WELD_TOLERANCE = 1e-9  # of the diagonal: round-off of a float64 transform, far below a float32 step
MOST_NEAR = (16, 1 << 22)  # for each point, and in all: ordered pairs of points to be welded


class Repairs(NamedTuple):
    """What was done, in the order it was done."""

    welded_vertices: int  # merged into another one at the same place
    degenerate_faces: int  # dropped: a corner twice
    ear_faces: int  # dropped: two with the same corners, hanging from a surface that is whole without them
    duplicate_faces: int  # dropped: the corners of an earlier face, either way round
    unused_vertices: int  # dropped: no face
    nonmanifold_edges: int  # cut: three faces or more
    disagreeing_edges: int  # cut: two faces that run along it in the same direction
    nonmanifold_vertices: int  # cut: separate fans met there, or do since an edge was cut
    split_vertices: int  # added by all cuts


class Shape(NamedTuple):
    """The topology of a manifold mesh."""

    components: int
    boundary_edges: int
    boundary_loops: int
    euler: int
    sliver_faces: int  # no area


class Repaired(NamedTuple):
    """The mesh, and for each of its faces the row of the input it was."""

    vertices: Float64[Any, "V 3"]
    faces: Int[Any, "F 3"]
    sources: Int[Any, "F"]
    repairs: Repairs


def weld(points: Float64[Any, "V 3"]) -> Int[Any, "V"]:
    """For each point the first one at the same place, within `WELD_TOLERANCE` of the diagonal.

    Raises ValueError where that is nearly everywhere, since one point is so far off.
    """
    first, which = distinct_rows(points)
    unique = points[first]
    tolerance = WELD_TOLERANCE * np.linalg.norm(np.ptp(unique, axis=0))
    tree = KDTree(unique)
    if tree.count_neighbors(tree, tolerance) > MOST_NEAR[0] * len(unique) + MOST_NEAR[1]:
        stray = unique[np.abs(unique - np.median(unique, axis=0)).max(1).argmax()]
        raise ValueError(
            f"a vertex at {stray.tolist()} is so far off that the others are one point; remove it"
        )
    pairs = tree.query_pairs(tolerance, output_type="ndarray")
    _, group = connected_components(_graph(pairs, len(unique)), directed=False)
    lowest = np.full(len(unique), len(points))
    np.minimum.at(lowest, group, first)
    return lowest[group][which]


def repair(points: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Repaired:
    """A manifold, oriented mesh of the same triangles (see the module), in the order of the input.

    Points of faces are finite. Raises ValueError where no triangle is left.
    """
    sources = np.arange(len(faces))
    representative = np.arange(len(points))
    kept = np.flatnonzero(np.isfinite(points).all(1))
    representative[kept] = kept[weld(points[kept])]
    corners = representative[faces]

    proper = (corners != np.roll(corners, 1, axis=1)).all(1)
    degenerate = int((~proper).sum())
    corners, sources = corners[proper], sources[proper]
    first, same = distinct_rows(np.sort(corners, 1))
    ears = _doubled_ears(corners, same)
    fresh = mark(len(corners), first) & ~ears
    duplicate = int((~fresh & ~ears).sum())
    corners, sources = corners[fresh], sources[fresh]
    if len(corners) == 0:
        raise ValueError(f"no triangles: of {len(faces)}, {degenerate} have a corner twice; export it again")

    present = mark(len(points), corners)
    used, compact = np.flatnonzero(present), (np.cumsum(present) - 1)[corners]
    several, disagreeing = _bad_edges(compact)
    split, place = map(np.asarray, igl.split_nonmanifold(compact))
    order = np.argsort(place, kind="stable")  # the file's order, as far as there is one
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    repairs = Repairs(
        welded_vertices=int((representative[kept] != kept).sum()),
        degenerate_faces=degenerate,
        ear_faces=int(ears.sum()),
        duplicate_faces=duplicate,
        unused_vertices=int((representative == np.arange(len(points))).sum()) - len(used),
        nonmanifold_edges=several,
        disagreeing_edges=disagreeing,
        nonmanifold_vertices=int((np.bincount(place) > 1).sum()),
        split_vertices=len(place) - len(used),
    )
    return Repaired(points[used[place[order]]], rank[split], sources, repairs)


def shape(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Shape:
    """Components, boundary and Euler characteristic of a manifold mesh without unused vertices."""
    topo = topology(faces, len(vertices))
    rim = topo.edges[topo.boundary]
    # Of the boundary's vertices alone: every other one would be a loop of its own.
    inside = len(vertices) - int(mark(len(vertices), rim).sum())
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.maximum(((b - a) ** 2).sum(1), np.maximum(((c - a) ** 2).sum(1), ((c - b) ** 2).sum(1)))
    return Shape(
        components=_parts(topo.edges, len(vertices)),
        boundary_edges=len(rim),
        boundary_loops=_parts(rim, len(vertices)) - inside,
        euler=len(vertices) - len(topo.edges) + len(faces),
        sliver_faces=int((area <= 1e-12 * longest).sum()),
    )


def _doubled_ears(faces: Int[Any, "F 3"], same: Int[Any, "F"]) -> Bool[Any, "F"]:
    """Pairs of faces with the same corners (`same` numbers them) that hang from a surface which is whole
    without them.

    Decimation leaves such ears, closed on themselves, at a vertex of valence two. A sheet whose back is
    modelled is made of pairs too, but there a pair has pairs for neighbours: one of each stays.
    """
    pair = (np.bincount(same) == 2)[same]
    if not pair.any():
        return pair
    edge, count = _edges(faces)
    size = len(count)
    paired = np.bincount(edge[pair].reshape(-1), minlength=size)[edge]
    others = np.bincount(edge[~pair].reshape(-1), minlength=size)[edge]
    hanging = (others == 2).any(1) & ((others == 0) | (others == 2)).all(1)
    return pair & hanging & (paired == 2).all(1)


def _bad_edges(faces: Int[Any, "F 3"]) -> tuple[int, int]:
    """Edges of three faces or more; edges of two faces that both run from the same end."""
    edge, count = _edges(faces)
    forward = np.bincount(edge.ravel(), (faces < np.roll(faces, -1, 1)).ravel(), minlength=len(count))
    return int((count > 2).sum()), int(((count == 2) & (forward != 1)).sum())


def _edges(faces: Int[Any, "F 3"]) -> tuple[Int[Any, "F 3"], Int[Any, "E"]]:
    """The edge from each corner to the next, by number, and how often each edge comes."""
    start, end = faces, np.roll(faces, -1, 1)
    keys = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    _, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
    return edge.reshape(faces.shape), count


def _parts(edges: Int[Any, "E 2"], size: int) -> int:
    """How many pieces edges leave of so many vertices."""
    return int(connected_components(_graph(edges, size), directed=False)[0])


def _graph(edges: Int[Any, "E 2"], size: int) -> coo_array:
    return coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(size, size))
