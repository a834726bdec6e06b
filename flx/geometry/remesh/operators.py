"""The local operations of a remesher (Botsch & Kobbelt 2004): split, collapse and flip edges.

Each is applied to a random independent set of edges at once. Features (flx.geometry.remesh.features) are
preserved: their vertices move only along them.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import Rng, area_normals, cross, dot, length_of, mark, unit_vectors
from flx.geometry.remesh.features import features
from flx.geometry.topology import Topology, all_of, any_of, edge_lengths, find_edges, has_edge, topology
from flx.types import Faces, Triangulation

CAP = np.radians(160.0)  # a face with a larger angle has no reliable normal
UNPROTECTED = 0.3  # length, in shortest edge lengths, below which an edge may collapse across a crease

# The children of a face for each set of split edges (bit k: the edge opposite corner k). 0-2 are its corners,
# 3-5 the new points on those edges.
CHILDREN = (
    ((0, 1, 2),),
    ((0, 1, 3), (0, 3, 2)),
    ((1, 2, 4), (1, 4, 0)),
    ((2, 4, 3), (0, 1, 3), (0, 3, 4)),
    ((2, 0, 5), (2, 5, 1)),
    ((1, 3, 5), (0, 5, 3), (0, 3, 2)),
    ((0, 5, 4), (5, 1, 2), (5, 2, 4)),
    ((0, 5, 4), (1, 3, 5), (2, 4, 3), (3, 4, 5)),
)


def split_edges(mesh: Triangulation, topo: Topology, chosen: Bool[Any, "E"], rng: Rng) -> Triangulation:
    """Split the chosen edges at random points near their middles; at the middles, copies would be alike."""
    vertices, faces = mesh
    new = np.full(len(chosen), -1)
    new[chosen] = len(vertices) + np.arange(chosen.sum())
    a, b = vertices[topo.edges[chosen, 0]], vertices[topo.edges[chosen, 1]]
    points = a + rng.uniform(0.35, 0.65, len(a))[:, None] * (b - a)
    corners = np.concatenate([faces, new[topo.face_edges]], 1)
    pattern = (corners[:, 3:] >= 0) @ np.array([1, 2, 4])
    parts = [corners[pattern == k][:, child] for k, children in enumerate(CHILDREN) for child in children]
    return Triangulation(np.concatenate([vertices, points]), np.concatenate(parts))


def ranks(priority: Float64[Any, "N"]) -> Int[Any, "N"]:
    """The rank of each value in ascending order, from 0."""
    rank = np.empty(len(priority), np.int64)
    rank[np.argsort(priority)] = np.arange(len(priority))
    return rank


NO_PAIRS = np.zeros((0, 2), np.int64)


def disjoint(
    groups: Int[Any, "N K"], count: int, priority: Float64[Any, "N"], edges: Int[Any, "E 2"] = NO_PAIRS
) -> Int[Any, "n"]:
    """A nearly maximal set of groups of which no two share a vertex, or have one of `edges` between them.

    Lowest priority first: a group wins that ranks before all its neighbours (Luby's algorithm, three rounds).
    """
    (u, v), rank = edges.T, ranks(priority)
    won, left = [], np.arange(len(groups))
    for _ in range(3):
        best = np.full(count, len(groups))
        for member in groups[left].T:
            np.minimum.at(best, member, rank[left])
        near = best.copy()
        np.minimum.at(near, u, best[v])
        np.minimum.at(near, v, best[u])
        first = [np.take(near, members) == rank[left] for members in groups[left].T]
        won.append(left[np.logical_and.reduce(first)])
        taken = mark(count, groups[won[-1]].ravel())
        near = taken.copy()
        near[u[taken[v]]] = near[v[taken[u]]] = True
        left = left[~any_of(near, groups[left])]
    return np.concatenate(won)


class Collapsed(NamedTuple):
    """A mesh after one round of collapses."""

    mesh: Triangulation
    done: int  # number of edges that were collapsed
    refused: Int[Any, "N 2"]  # edges that failed a check and whose surroundings have not changed since


def collapse_edges(
    mesh: Triangulation,
    shortest: float,
    longest: float,
    rng: Rng,
    most: int | None = None,
    bend: float = 0.3,
    refused: Int[Any, "N 2"] = NO_PAIRS,
) -> Collapsed:
    """Collapse a random independent set of at most `most` edges shorter than `shortest`, shorter ones first.

    An edge stays if its collapse would change the topology, cut a feature, turn a face by more than
    arccos(`bend`) or make an edge longer than `longest`. Edges `refused` in an earlier round are skipped.
    """
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    feature, kind = features(vertices, faces, topo)
    allowed = ~mark(len(topo.edges), find_edges(topo, *refused.T))
    ids = _collapsible(vertices, faces, topo, feature, kind, shortest, allowed, rng)
    a, b = topo.edges[ids].T
    middle = (vertices[a] + vertices[b]) / 2
    # A feature vertex keeps its place, except when an edge of its own curve collapses to the middle.
    apart = (kind[a] == kind[b]) & (kind[a] > 0) & (~feature[ids] | (kind[a] == 2))
    middle = np.where((apart | (kind[a] > kind[b]))[:, None], vertices[a], middle)
    middle = np.where((kind[b] > kind[a])[:, None], vertices[b], middle)
    moved = vertices.copy()
    moved[a] = moved[b] = middle
    good = _collapses_well(vertices, moved, faces, a, b, longest, bend)
    refused = np.concatenate([refused, topo.edges[ids[~good]]])
    done = np.flatnonzero(good)[:most]
    a, b = a[done], b[done]
    around = any_of(mark(count, np.concatenate([a, b])), faces)
    changed = mark(count, faces[around])
    refused = refused[~any_of(changed, refused)]
    target = np.arange(count)
    target[b] = a
    vertices = vertices.copy()
    vertices[a] = middle[done]
    x, y, z = target[faces].T
    proper = (x != y) & (y != z) & (z != x)
    remains = ~mark(count, b)
    new_index = np.cumsum(remains) - 1
    mesh = Triangulation(vertices[remains], new_index[target[faces[proper]]])
    return Collapsed(mesh, len(done), new_index[refused])


def _collapsible(vertices, faces, topo, feature, kind, shortest, allowed, rng):
    """A random independent set of short edges whose collapse keeps topology and features."""
    lengths = edge_lengths(vertices, topo)
    ids = np.flatnonzero(allowed & (lengths < shortest))
    a, b = topo.edges[ids].T
    rim, boundary = topo.rim, topo.boundary[ids]
    free = (feature[ids] | (kind[a] == 0) | (kind[b] == 0)) & ((kind[a] < 2) | (kind[b] < 2) | boundary)
    free |= (lengths[ids] < UNPROTECTED * shortest) & (boundary | ~(rim[a] & rim[b]))
    # Each opposite vertex loses an edge; it must keep three, or two at the boundary.
    spare = topo.valence - np.where(rim, 2, 3)
    corners = topo.corners[ids]
    opposite = faces.ravel()[np.where(corners < 0, corners[:, :1], corners)]
    free &= all_of(spare > 0, opposite)
    ids, opposite, boundary = ids[free], opposite[free], boundary[free]
    priority = lengths[ids] / shortest + rng.random(len(ids))
    among = all_of(mark(topo.count, topo.edges[ids]), topo.edges)
    won = disjoint(topo.edges[ids], topo.count, priority, topo.edges[among])
    ids, opposite, boundary = ids[won], opposite[won], boundary[won]
    # Where the collapses around an opposite vertex would take too many edges together, only one is made.
    lost = np.bincount(opposite.ravel(), minlength=topo.count)
    crowded = any_of(lost > spare, opposite)
    chosen = np.concatenate([np.flatnonzero(~crowded), np.flatnonzero(crowded)[:1]])
    ids, boundary = ids[chosen], boundary[chosen]
    # Link condition (Dey et al. 1999): the ends share no neighbours other than the opposite vertices.
    common = _common_neighbors(topo, *topo.edges[ids].T)
    return ids[common == np.where(boundary, 1, 2)]


def _common_neighbors(topo, a, b):
    """The number of common neighbours of a and b, for edges a-b of which no two are adjacent."""
    owner = np.full(topo.count, -1)
    owner[a] = np.arange(len(a))
    common = np.zeros(len(a), np.int64)
    for near, far in (topo.edges.T, topo.edges.T[::-1]):
        rim = owner[near] >= 0
        pair, far = owner[near[rim]], far[rim]
        joined = has_edge(topo, b[pair], far)
        common += np.bincount(pair[joined], minlength=len(a))
    return common


def _collapses_well(vertices, moved, faces, a, b, longest, bend):
    """Whether, for each edge to collapse, no face around it turns over and no edge gets too long."""
    owner = np.full(len(vertices), -1)
    owner[a] = owner[b] = np.arange(len(a))
    owners = [np.take(owner, faces[:, k]) for k in range(3)]
    pair = np.maximum.reduce(owners)
    around = np.flatnonzero(np.add.reduce([each >= 0 for each in owners], dtype=np.int8) == 1)
    rim, pair = faces[around], pair[around]
    before, after = area_normals(vertices, rim), area_normals(moved, rim)
    corners = [np.take(moved, rim[:, k], 0) for k in range(3)]
    side = np.maximum.reduce([length_of(corners[k] - corners[k - 1]) for k in range(3)])
    bad = (dot(before, after) <= bend * length_of(before) * length_of(after)) | (side > longest)
    return ~mark(len(a), pair[bad])


def flip_edges(mesh: Triangulation, rng: Rng, delaunay: bool, passes: int) -> Triangulation:
    """Flip edges towards valence 6 (4 at a boundary) or, if `delaunay`, the intrinsic Delaunay triangulation.

    Features stay, except in caps; each pass flips a random independent set, those with most gain first.
    """
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    held = topo.edges[features(vertices, faces, topo)[0]]  # once is enough: flips create no features
    for _ in range(passes):
        held = held[has_edge(topo, *held.T)]
        inner = np.flatnonzero(~topo.boundary)
        free = ~mark(len(topo.edges), find_edges(topo, *held.T))[inner]
        quads, face = edge_quads(topo, faces, inner)
        (a, b, p, q), valence = quads.T, topo.valence
        cap = np.zeros(len(inner), bool)
        if delaunay:
            angles = _angle(vertices, p, a, b), _angle(vertices, q, a, b)
            cap = np.maximum(*angles) > CAP
            gain = angles[0] + angles[1] - np.pi - 1e-3
        else:
            excess = valence - np.where(topo.rim, 4, 6)
            gain = excess[a] + excess[b] - excess[p] - excess[q] - 2.0
        free = (free | cap) & (gain > 0) & (valence[a] > 3) & (valence[b] > 3) & (p != q)
        quads, gain, face, cap = quads[free], gain[free], face[free], cap[free]
        good = ~has_edge(topo, *quads[:, 2:].T) & _flips_well(vertices[quads], cap)
        quads, gain, face = quads[good], gain[good], face[good]
        chosen = disjoint(quads, count, rng.random(len(quads)) - gain)
        faces = faces.copy()
        faces[face[chosen].T.ravel()] = flipped(quads[chosen])
        if len(chosen) < 0.002 * len(faces):
            break
        topo = topology(faces, count)
    return Triangulation(vertices, faces)


def edge_quads(topo: Topology, faces: Faces, edges: Int[Any, "N"]) -> tuple[Int[Any, "N 4"], Int[Any, "N 2"]]:
    """For inner edges a-b, the vertices a, b, p, q of their faces (p, a, b) and (q, b, a), and the faces."""
    rows, corner = topo.corners[edges] // 3, topo.corners[edges, 0] % 3
    p, q = faces.ravel()[topo.corners[edges].T]
    a, b = faces[rows[:, 0], (corner + 1) % 3], faces[rows[:, 0], (corner + 2) % 3]
    return np.stack([a, b, p, q], 1), rows


def flipped(quads: Int[Any, "N 4"]) -> Int[Any, "M 3"]:
    """The faces (p, a, q), then the faces (q, b, p), that replace those of `edge_quads`."""
    return np.concatenate([quads[:, [2, 0, 3]], quads[:, [3, 1, 2]]])


def _angle(vertices, at, a, b):
    u, v = vertices[a] - vertices[at], vertices[b] - vertices[at]
    return np.arctan2(length_of(cross(u, v)), dot(u, v))


def _flips_well(quads, cap):
    """Whether the two faces are nearly coplanar before and after the flip; a cap need not be before it."""
    a, b, p, q = quads.transpose(1, 0, 2)
    left, right = cross(a - p, b - p), cross(b - q, a - q)
    mean = unit_vectors(left + right)
    good = cap | (dot(unit_vectors(left), unit_vectors(right)) > 0.5)
    for after in (cross(a - p, q - p), cross(b - q, p - q)):
        good &= dot(unit_vectors(after), mean) > 0.5
    return good
