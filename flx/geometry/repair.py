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
from scipy.spatial import KDTree

from flx.geometry.arrays import distinct_rows
from flx.geometry.topology import Edges, boundary_loops, disagreeing, edges_of, fans, mark, pieces

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
    """The mesh, its topology, and for each of its faces the row of the input it was."""

    vertices: Float64[Any, "V 3"]
    faces: Int[Any, "F 3"]
    sources: Int[Any, "F"]
    repairs: Repairs
    shape: Shape


def weld(points: Float64[Any, "V 3"]) -> Int[Any, "V"]:
    """For each point the first one at the same place, within `WELD_TOLERANCE` of the diagonal.

    Raises ValueError where that is nearly everywhere, since one point is so far off.
    """
    tolerance = WELD_TOLERANCE * float(np.linalg.norm(np.ptp(points, axis=0)))
    representative = np.arange(len(points))
    near = _neighbored(points, 2 * tolerance)  # twice: for certain
    if not len(near):
        return representative
    first, which = distinct_rows(points[near])
    unique = points[near[first]]
    tree = KDTree(unique)
    alone = len(points) - len(near)
    most = MOST_NEAR[0] * (alone + len(unique)) + MOST_NEAR[1]
    if alone + tree.count_neighbors(tree, tolerance) > most:
        unique = points[distinct_rows(points)[0]]
        stray = unique[np.abs(unique - np.median(unique, axis=0)).max(1).argmax()]
        raise ValueError(
            f"a vertex at {stray.tolist()} is so far off that the others are one point; remove it"
        )
    pairs = tree.query_pairs(tolerance, output_type="ndarray")
    _, group = pieces(pairs, len(unique))
    lowest = np.full(len(unique), len(points))
    np.minimum.at(lowest, group, near[first])
    representative[near] = lowest[group][which]
    return representative


def _neighbored(points: Float64[Any, "V 3"], reach: float) -> Int[Any, "N"]:
    """Points that may have another one within `reach`: along each axis in turn, others leave a wider gap.

    Sorting is several times faster than a tree of all points.
    """
    near, run = np.arange(len(points)), np.zeros(len(points), np.int64)
    for axis in range(points.shape[1]):
        x = points[near, axis]
        order = np.lexsort((x, run))
        x, run = x[order], run[order]
        starts = np.flatnonzero(np.concatenate([[True], (run[1:] != run[:-1]) | (np.diff(x) > reach)]))
        sizes = np.diff(starts, append=len(x))
        run = np.repeat(np.arange(len(sizes)), sizes)
        shared = sizes[run] > 1
        near, run = near[order[shared]], run[shared]
    return np.sort(near)


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
    edges = edges_of(compact, len(used))
    several, opposed = int((edges.uses > 2).sum()), disagreeing(compact, edges.inner)
    place = np.arange(len(used))  # the vertex that each vertex was before the cuts
    # Three faces at an edge are three fans, or two, at its ends.
    if opposed or fans(compact, edges.inner) != len(used):
        compact, place = _cut(compact)
        edges = edges_of(compact, len(place))
    repairs = Repairs(
        welded_vertices=int((representative[kept] != kept).sum()),
        degenerate_faces=degenerate,
        ear_faces=int(ears.sum()),
        duplicate_faces=duplicate,
        unused_vertices=int((representative == np.arange(len(points))).sum()) - len(used),
        nonmanifold_edges=several,
        disagreeing_edges=opposed,
        nonmanifold_vertices=int((np.bincount(place) > 1).sum()),
        split_vertices=len(place) - len(used),
    )
    vertices = points[used[place]]
    return Repaired(vertices, compact, sources, repairs, _shape(vertices, compact, edges))


def shape(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Shape:
    """Components, boundary and Euler characteristic of a manifold mesh without unused vertices."""
    return _shape(vertices, faces, edges_of(faces, len(vertices)))


def _shape(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], edges: Edges) -> Shape:
    ends = edges.ends
    rim = ends[edges.uses == 1]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.maximum(((b - a) ** 2).sum(1), np.maximum(((c - a) ** 2).sum(1), ((c - b) ** 2).sum(1)))
    return Shape(
        components=pieces(ends, len(vertices))[0],
        boundary_edges=len(rim),
        boundary_loops=boundary_loops(rim, len(vertices)),
        euler=len(vertices) - len(ends) + len(faces),
        sliver_faces=int((area <= 1e-12 * longest).sum()),
    )


def _cut(faces: Int[Any, "F 3"]) -> tuple[Int[Any, "F 3"], Int[Any, "V"]]:
    """Faces of split vertices, in the file's order as far as there is one, and the vertex that each was.

    The union-find of `split_nonmanifold` misses the cache at each face of an unordered file.
    """
    split, place = (np.asarray(found, np.int64) for found in igl.split_nonmanifold(faces))
    order = np.argsort(place, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[split], place[order]


def _doubled_ears(faces: Int[Any, "F 3"], same: Int[Any, "F"]) -> Bool[Any, "F"]:
    """Pairs of faces with the same corners (`same` numbers them) that hang from a surface which is whole
    without them.

    Decimation leaves such ears, closed on themselves, at a vertex of valence two. A sheet whose back is
    modelled is made of pairs too, but there a pair has pairs for neighbours: one of each stays.
    """
    pair = (np.bincount(same) == 2)[same]
    if not pair.any():
        return pair
    edge = edges_of(faces, int(faces.max()) + 1).of_faces
    size = int(edge.max()) + 1
    paired = np.bincount(edge[pair].reshape(-1), minlength=size)[edge]
    others = np.bincount(edge[~pair].reshape(-1), minlength=size)[edge]
    hanging = (others == 2).any(1) & ((others == 0) | (others == 2)).all(1)
    return pair & hanging & (paired == 2).all(1)
