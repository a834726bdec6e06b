"""Edges of a manifold mesh, and what of its topology remeshing keeps.

Conventions: corner 3f + k is corner k of face f and stands for the edge opposite to it; faces are
counter-clockwise.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from flx.mesh.vectors import length_of


class Topology(NamedTuple):
    """Edges of a manifold mesh, sorted by `keys` = smaller vertex · V + larger vertex."""

    edges: Int[Any, "E 2"]
    keys: Int[Any, "E"]
    corners: Int[Any, "E 2"]  # opposite corners; the second is -1 at the boundary
    face_edges: Int[Any, "F 3"]

    @property
    def boundary(self) -> Bool[Any, "E"]:
        return self.corners[:, 1] < 0


def topology(faces: Int[Any, "F 3"], count: int) -> Topology:
    """Edges of a mesh of `count` vertices, by one sort of its corners.

    Raises ValueError where an edge has more than two faces.
    """
    start, end = faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()
    key, corner = _sorted(np.minimum(start, end) * count + np.maximum(start, end))
    fresh = np.concatenate([[True], key[1:] != key[:-1]])
    first = np.flatnonzero(fresh)
    uses = np.diff(first, append=len(key))
    if uses.max() > 2:
        raise ValueError(f"{(uses > 2).sum()} edges have more than two faces; split the mesh there first")
    second = np.where(uses == 2, corner[np.minimum(first + 1, len(corner) - 1)], -1)
    face_edges = np.empty(faces.size, np.int64)
    face_edges[corner] = np.cumsum(fresh) - 1
    keys = key[first]
    edges = np.stack([keys // count, keys % count], 1)
    return Topology(edges, keys, np.stack([corner[first], second], 1), face_edges.reshape(-1, 3))


def _sorted(key):
    """Sorted keys and where they were. A value sort of key and place in one integer is 10 times faster."""
    bits = len(key).bit_length()
    if int(key.max()) >> (63 - bits):
        order = np.argsort(key, kind="stable")
        return key[order], order
    packed = np.sort((key << bits) | np.arange(len(key)))
    return packed >> bits, packed & ((1 << bits) - 1)


def edge_lengths(vertices: Float64[Any, "V 3"], topo: Topology) -> Float64[Any, "E"]:
    a, b = topo.edges.T
    return length_of(np.take(vertices, a, 0) - np.take(vertices, b, 0))


def find_edges(topo: Topology, count: int, a: Int[Any, "N"], b: Int[Any, "N"]) -> Int[Any, "N"]:
    """The edges that join a and b, pair by pair; where none does, any."""
    key = np.minimum(a, b) * count + np.maximum(a, b)
    return np.minimum(np.searchsorted(topo.keys, key), len(topo.keys) - 1)


def has_edge(topo: Topology, count: int, a: Int[Any, "N"], b: Int[Any, "N"]) -> Bool[Any, "N"]:
    """Whether an edge joins a and b, pair by pair."""
    key = np.minimum(a, b) * count + np.maximum(a, b)
    return topo.keys[find_edges(topo, count, a, b)] == key


def mark(count: int, members: Int[Any, "..."]) -> Bool[Any, "V"]:
    """A mask of `count` that is true at `members`."""
    marked = np.zeros(count, bool)
    marked[members] = True
    return marked


def any_of(marked: Bool[Any, "V"], groups: Int[Any, "N K"]) -> Bool[Any, "N"]:
    """Whether a member of each group is marked: column by column, ten times faster than NumPy's any(1)."""
    return np.logical_or.reduce([np.take(marked, members) for members in groups.T])


def all_of(marked: Bool[Any, "V"], groups: Int[Any, "N K"]) -> Bool[Any, "N"]:
    """Whether all members of each group are marked."""
    return np.logical_and.reduce([np.take(marked, members) for members in groups.T])


def invariants(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> str:
    """What remeshing keeps: components, Euler characteristic and boundary loops, in words.

    Raises ValueError unless every vertex has one fan, faces agree in orientation.
    """
    count = len(vertices)
    if not len(faces) or faces.min() < 0 or faces.max() >= count:
        raise ValueError(f"{len(faces)} faces do not fit {count} vertices; check the face indices")
    topo = topology(faces, count)
    inner = topo.corners[~topo.boundary]
    start, end = (faces[inner // 3, (inner + k) % 3] for k in (1, 2))
    if (start[:, 0] != end[:, 1]).any():
        raise ValueError(
            f"{(start[:, 0] != end[:, 1]).sum()} edges join opposite orientations; orient the faces"
        )
    # Two corners of one vertex belong to one fan if their faces share an edge there.
    sides = [(inner // 3 * 3 + (inner + k) % 3) for k in (1, 2)]
    pairs = [(sides[0][:, 0], sides[1][:, 1]), (sides[1][:, 0], sides[0][:, 1])]
    fans = _components(np.concatenate([np.stack(pair, 1) for pair in pairs]), faces.size)
    if fans != count:
        raise ValueError(
            f"{count} vertices have {fans} fans of faces; split or drop vertices until each has one"
        )
    rim = topo.edges[topo.boundary]
    loops = _components(rim, count) - (count - len(np.unique(rim)))
    return (
        f"{_components(topo.edges, count)} components, Euler characteristic "
        f"{count - len(topo.edges) + len(faces)}, {loops} boundary loops"
    )


def _components(pairs, count):
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    return connected_components(graph, directed=False)[0]
