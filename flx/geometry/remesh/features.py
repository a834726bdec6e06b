"""Boundaries and creases: the feature curves that remeshing preserves."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import area_normals, chunks, dot, length_of, sum_at, unit_vectors
from flx.geometry.topology import Topology, label_components
from flx.types import Faces, Vertices

CREASE_COSINE = np.cos(np.radians(60.0))  # faces that bend more than 60° meet in a crease
CURVE = 4  # least number of edges in a crease


def features(
    vertices: Vertices, faces: Faces, topo: Topology, least: int = CURVE
) -> tuple[Bool[Any, "E"], Int[Any, "V"]]:
    """Which edges are features, and the kind of each vertex: 0 on a face, 1 on a curve, 2 at a corner.

    Features are boundary edges, and creases that form connected curves of at least `least` edges.
    """
    feature = topo.boundary.copy()
    normals = unit_vectors(area_normals(vertices, faces))
    sharp = np.flatnonzero(~feature & (bends(normals, topo) < CREASE_COSINE))
    feature[long_curves(topo.edges[sharp], np.ones(len(sharp)), len(vertices), least, sharp)] = True
    degree = np.bincount(topo.edges[feature].ravel(), minlength=len(vertices))
    kind = np.where(degree < 2, 0, np.where(degree == 2, 1, 2))
    kind[_turns(vertices, topo.edges[topo.boundary])] = 2
    return feature, kind


def bends(normals: Float64[Any, "F 3"], topo: Topology) -> Float64[Any, "E"]:
    """The cosine of the angle between the unit `normals` of the two faces at each edge.

    At boundary edges the value is arbitrary.
    """
    cosines = np.empty(len(topo.edges))
    for rows in chunks(len(cosines)):
        left, right = topo.corners[rows].T // 3
        cosines[rows] = dot(np.take(normals, left, 0), np.take(normals, right, 0))
    return cosines


def _turns(vertices, rim):
    """Boundary vertices where the boundary turns by more than 60°."""
    if not len(rim):
        return []
    a, b = rim.T
    along = unit_vectors(vertices[b] - vertices[a])
    turn = sum_at(a[:, None], along, len(vertices)) - sum_at(b[:, None], along, len(vertices))
    return np.flatnonzero(length_of(turn) > 1)


def long_curves(
    edges: Int[Any, "N 2"], lengths: Float64[Any, "N"], count: int, least: float | int, ids: Int[Any, "N"]
) -> Int[Any, "n"]:
    """The `ids` of edges in connected curves of length ≥ `least`: isolated sharp edges are scan noise."""
    curve = label_components(edges, count)[1][edges[:, 0]]
    return ids[np.bincount(curve, lengths)[curve] >= least] if len(ids) else ids
