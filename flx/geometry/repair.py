"""From the triangles of a file to a manifold, oriented mesh; every change is counted.

The steps, in order: weld vertices by position; drop faces with a repeated corner; drop doubled ears; drop
faces with the same corners as an earlier one; split vertices until every edge joins at most two faces of
agreeing orientation and every vertex has one fan. Slivers without area are kept and counted, because dropping
one would open the surface. No face is reversed: neighbours that disagree in orientation are cut apart.
"""

from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial import KDTree

from flx.geometry.arrays import distinct_rows, face_areas, mark, squared_sides
from flx.geometry.topology import (
    Topology,
    boundary_loops,
    count_disagreeing,
    count_fans,
    edges_of,
    label_components,
)
from flx.types import Faces, Vertices

# Distance below which vertices are welded, as a share of the diagonal: above the round-off of a float64
# transform, far below one step of float32.
WELD_TOLERANCE = 1e-9
MAX_WELD_PAIRS = (16, 1 << 22)  # ordered pairs of points to weld: at most this many per point, plus this many


class Repairs(NamedTuple):
    """The number of changes of each kind, in the order they are made."""

    welded_vertices: int  # merged into another vertex at the same place
    degenerate_faces: int  # dropped: the same corner twice
    ear_faces: int  # dropped: pairs with the same corners, attached to a surface that is whole without them
    duplicate_faces: int  # dropped: the same corners as an earlier face, in either orientation
    unused_vertices: int  # dropped: not in any face
    nonmanifold_edges: int  # cut: three faces or more
    disagreeing_edges: int  # cut: two faces that run along it in the same direction
    nonmanifold_vertices: int  # cut: separate fans met there, in the file or after an edge was cut
    split_vertices: int  # added by all cuts


class TopologyCounts(NamedTuple):
    """The topology of a manifold mesh, in numbers."""

    components: int
    boundary_edges: int
    boundary_loops: int
    euler: int
    sliver_faces: int  # faces without area


class Repaired(NamedTuple):
    """A repaired mesh, its topology, and the input face that each of its faces comes from."""

    vertices: Vertices
    faces: Faces
    sources: Int[Any, "F"]
    repairs: Repairs
    topology: TopologyCounts


def weld(points: Float64[Any, "V 3"]) -> Int[Any, "V"]:
    """For each point, the index of the first point at the same place, within `WELD_TOLERANCE`.

    Raises ValueError if nearly all points would be welded, because a stray one stretches the diagonal.
    """
    tolerance = WELD_TOLERANCE * float(np.linalg.norm(np.ptp(points, axis=0)))
    representative = np.arange(len(points))
    near = _crowded(points, 2 * tolerance)  # twice the tolerance: round-off must not lose a pair
    if not len(near):
        return representative
    first, which = distinct_rows(points[near])
    unique = points[near[first]]
    tree = KDTree(unique)
    alone = len(points) - len(near)
    most = MAX_WELD_PAIRS[0] * (alone + len(unique)) + MAX_WELD_PAIRS[1]
    if alone + tree.count_neighbors(tree, tolerance) > most:
        raise ValueError(_stray(points))
    pairs = tree.query_pairs(tolerance, output_type="ndarray")
    _, group = label_components(pairs, len(unique))
    lowest = np.full(len(unique), len(points))
    np.minimum.at(lowest, group, near[first])
    representative[near] = lowest[group][which]
    return representative


def _stray(points: Float64[Any, "V 3"]) -> str:
    unique = points[distinct_rows(points)[0]]
    stray = unique[np.abs(unique - np.median(unique, axis=0)).max(1).argmax()]
    return f"a vertex at {stray.tolist()} is so far off that all others coincide; remove it"


def _crowded(points: Float64[Any, "V 3"], radius: float) -> Int[Any, "N"]:
    """Points that may have another one within `radius`; the rest are isolated along some axis.

    Sorting along each axis in turn is several times faster than a tree of all points.
    """
    near, run = np.arange(len(points)), np.zeros(len(points), np.int64)
    for axis in range(points.shape[1]):
        x = points[near, axis]
        order = np.lexsort((x, run))
        x, run = x[order], run[order]
        starts = np.flatnonzero(np.concatenate([[True], (run[1:] != run[:-1]) | (np.diff(x) > radius)]))
        sizes = np.diff(starts, append=len(x))
        run = np.repeat(np.arange(len(sizes)), sizes)
        shared = sizes[run] > 1
        near, run = near[order[shared]], run[shared]
    return np.sort(near)


def repair(points: Float64[Any, "V 3"], faces: Faces) -> Repaired:
    """A manifold, oriented mesh of the same triangles, in the order of the input, by the steps listed above.

    The points of faces must be finite. Raises ValueError if no triangle is left.
    """
    sources = np.arange(len(faces))
    representative = np.arange(len(points))
    finite = np.flatnonzero(np.isfinite(points).all(1))
    representative[finite] = finite[weld(points[finite])]
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
        if (points[faces] != points[np.roll(faces, 1, axis=1)]).any(2).all(1).any():
            raise ValueError(_stray(points[finite]))
        raise ValueError(f"no triangles: of {len(faces)}, {degenerate} have a corner twice; export it again")

    present = mark(len(points), corners)
    used, compact = np.flatnonzero(present), (np.cumsum(present) - 1)[corners]
    topo = edges_of(compact, len(used))
    nonmanifold, opposed = int((topo.uses > 2).sum()), count_disagreeing(compact, topo.inner)
    origins = np.arange(len(used))  # the vertex that each vertex was before the cuts
    # An edge of three faces or more shows as more than one fan at each of its ends.
    if opposed or count_fans(compact, topo.inner) != len(used):
        compact, origins = _cut(compact)
        topo = edges_of(compact, len(origins))
    repairs = Repairs(
        welded_vertices=int((representative[finite] != finite).sum()),
        degenerate_faces=degenerate,
        ear_faces=int(ears.sum()),
        duplicate_faces=duplicate,
        unused_vertices=int((representative == np.arange(len(points))).sum()) - len(used),
        nonmanifold_edges=nonmanifold,
        disagreeing_edges=opposed,
        nonmanifold_vertices=int((np.bincount(origins) > 1).sum()),
        split_vertices=len(origins) - len(used),
    )
    vertices = points[used[origins]]
    return Repaired(vertices, compact, sources, repairs, topology_counts(vertices, compact, topo))


def topology_counts(vertices: Vertices, faces: Faces, topo: Topology | None = None) -> TopologyCounts:
    """Components, boundary and Euler characteristic of a manifold mesh without unused vertices."""
    topo = topo or edges_of(faces, len(vertices))
    rim = topo.edges[topo.boundary]
    longest = squared_sides(vertices, faces).max(0)
    return TopologyCounts(
        components=label_components(topo.edges, len(vertices))[0],
        boundary_edges=len(rim),
        boundary_loops=boundary_loops(rim, len(vertices)),
        euler=len(vertices) - len(topo.edges) + len(faces),
        sliver_faces=int((2 * face_areas(vertices, faces) <= 1e-12 * longest).sum()),
    )


def _cut(faces: Faces) -> tuple[Int[Any, "F 3"], Int[Any, "V"]]:
    """Split vertices until the mesh is manifold: the new faces, and the original of each new vertex.

    Vertices stay in the file's order, so later steps read memory in sequence.
    """
    split_faces, origins = (np.asarray(array, np.int64) for array in igl.split_nonmanifold(faces))
    order = np.argsort(origins, kind="stable")
    return np.argsort(order)[split_faces], origins[order]


def _doubled_ears(faces: Faces, same: Int[Any, "F"]) -> Bool[Any, "F"]:
    """Pairs of faces with the same corners, attached to a surface that is whole without them.

    `same` numbers the sets of corners. Decimation leaves such closed ears at a vertex of valence two. A sheet
    modelled from both sides consists of pairs as well, but there a pair borders on other pairs; of each of
    those, `repair` keeps one face.
    """
    pair = (np.bincount(same) == 2)[same]
    if not pair.any():
        return pair
    edge = edges_of(faces, int(faces.max()) + 1).face_edges
    size = int(edge.max()) + 1
    paired = np.bincount(edge[pair].reshape(-1), minlength=size)[edge]
    single = np.bincount(edge[~pair].reshape(-1), minlength=size)[edge]  # faces at the edge without a twin
    attached = (single == 2).any(1) & ((single == 0) | (single == 2)).all(1)
    return pair & attached & (paired == 2).all(1)
