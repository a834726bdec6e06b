"""The steps of a remesher: split, collapse and flip edges, each on a random independent set at once.

Features (flx.geometry.remesh.features) stay: their vertices move along them only.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from flx.geometry.arrays import area_normals, cross, dot, length_of, unit_vectors
from flx.geometry.remesh.features import features
from flx.geometry.topology import Topology, all_of, any_of, edge_lengths, find_edges, has_edge, mark, topology
from flx.types import Triangulation

CAP = np.radians(160.0)  # a face with such an angle has no normal to speak of
NEEDLE = 0.3  # of the shortest edge wanted: below it, creases do not protect an edge

# The children of a face by the edges that are split (bit k: the edge opposite corner k); 0-2 are its
# corners, 3-5 the points on those edges.
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


def split(
    mesh: Triangulation, topo: Topology, chosen: Bool[Any, "E"], rng: np.random.Generator
) -> Triangulation:
    """Split the chosen edges near their middles, at random: even splits would make every copy alike."""
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
    """The place of each in the order of ascending priority."""
    rank = np.empty(len(priority), np.int64)
    rank[np.argsort(priority)] = np.arange(len(priority))
    return rank


def _unconnected(topo, count, pairs, priority):
    """A maximal set (nearly) of `pairs` of which no two are joined by an edge, lowest priority first."""
    (a, b), rank = pairs.T, ranks(priority)
    live = mark(count, pairs)
    u, v = topo.edges[all_of(live, topo.edges)].T
    won, left = [], np.arange(len(pairs))
    for _ in range(3):
        best = np.full(count, len(pairs))
        np.minimum.at(best, a[left], rank[left])
        np.minimum.at(best, b[left], rank[left])
        near = best.copy()
        np.minimum.at(near, u, best[v])
        np.minimum.at(near, v, best[u])
        won.append(left[rank[left] <= np.minimum(near[a[left]], near[b[left]])])
        taken = mark(count, pairs[won[-1]].ravel())
        near = taken.copy()
        near[u[taken[v]]] = near[v[taken[u]]] = True
        left = left[~near[a[left]] & ~near[b[left]]]
    return np.concatenate(won)


def disjoint(groups: Int[Any, "N K"], count: int, priority: Float64[Any, "N"]) -> Int[Any, "n"]:
    """A maximal set (nearly) of groups of which no two share a vertex, lowest priority first."""
    rank = ranks(priority)
    won, left = [], np.arange(len(groups))
    for _ in range(3):
        best = np.full(count, len(groups))
        for member in groups[left].T:
            np.minimum.at(best, member, rank[left])
        first = [np.take(best, members) == rank[left] for members in groups[left].T]
        won.append(left[np.logical_and.reduce(first)])
        taken = mark(count, groups[won[-1]].ravel())
        left = left[~any_of(taken, groups[left])]
    return np.concatenate(won)


class Collapsed(NamedTuple):
    """A mesh, how many of its edges were collapsed, and which may not be: no need to ask again."""

    mesh: Triangulation
    done: int
    refused: Int[Any, "N 2"]


ASK_ALL = np.zeros((0, 2), np.int64)


def collapse(
    mesh: Triangulation,
    shortest: float,
    longest: float,
    rng: np.random.Generator,
    most: int | None = None,
    bend: float = 0.3,
    refused: Int[Any, "N 2"] = ASK_ALL,
) -> Collapsed:
    """Collapse a random independent set of edges shorter than `shortest`, `most` at most, the shorter rather.

    An edge stays where the topology would change, a feature would be cut, a face would turn by more than
    arccos(`bend`) or an edge would grow beyond `longest`; the edges `refused` before are not asked.
    """
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    feature, kind = features(vertices, faces, topo)
    asked = ~mark(len(topo.edges), find_edges(topo, count, *refused.T))
    ids = _collapsible(vertices, faces, topo, feature, kind, shortest, asked, rng)
    a, b = topo.edges[ids].T
    middle = (vertices[a] + vertices[b]) / 2
    # A feature vertex stays in place, unless two slide together along their curve.
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
    kept = (x != y) & (y != z) & (z != x)
    remains = ~mark(count, b)
    new_index = np.cumsum(remains) - 1
    mesh = Triangulation(vertices[remains], new_index[target[faces[kept]]])
    return Collapsed(mesh, len(done), new_index[refused])


def _collapsible(vertices, faces, topo, feature, kind, shortest, asked, rng):
    """A random independent set of short edges that neither topology nor features protect."""
    count = len(vertices)
    lengths = edge_lengths(vertices, topo)
    ids = np.flatnonzero(asked & (lengths < shortest))
    a, b = topo.edges[ids].T
    boundary = topo.boundary
    rim = mark(count, topo.edges[boundary].ravel())
    boundary = boundary[ids]
    free = (feature[ids] | (kind[a] == 0) | (kind[b] == 0)) & ((kind[a] < 2) | (kind[b] < 2) | boundary)
    free |= (lengths[ids] < NEEDLE * shortest) & (boundary | ~(rim[a] & rim[b]))
    # A fan must remain around the opposite vertices: three faces, two at the boundary.
    spare = np.bincount(topo.edges.ravel(), minlength=count) - np.where(rim, 2, 3)
    corners = topo.corners[ids]
    opposite = faces.ravel()[np.where(corners < 0, corners[:, :1], corners)]
    free &= all_of(spare > 0, opposite)
    ids, opposite, boundary = ids[free], opposite[free], boundary[free]
    priority = lengths[ids] / shortest + rng.random(len(ids))
    won = _unconnected(topo, count, topo.edges[ids], priority)
    ids, opposite, boundary = ids[won], opposite[won], boundary[won]
    # An opposite vertex loses an edge to each collapse around it: where that is too many, one goes ahead.
    lost = np.bincount(opposite.ravel(), minlength=count)
    crowded = any_of(lost > spare, opposite)
    first = np.flatnonzero(crowded)[:1]
    kept = np.concatenate([np.flatnonzero(~crowded), first])
    ids, boundary = ids[kept], boundary[kept]
    # Link condition: the ends have no neighbour in common but the opposite vertices.
    common = _common_neighbors(topo, count, *topo.edges[ids].T)
    return ids[common == np.where(boundary, 1, 2)]


def _common_neighbors(topo, count, a, b):
    """How many vertices are joined to both ends of the edges a-b, no two of which are adjacent."""
    owner = np.full(count, -1)
    owner[a] = np.arange(len(a))
    common = np.zeros(len(a), np.int64)
    for near, far in (topo.edges.T, topo.edges.T[::-1]):
        rim = owner[near] >= 0
        pair, far = owner[near[rim]], far[rim]
        joined = has_edge(topo, count, b[pair], far)
        common += np.bincount(pair[joined], minlength=len(a))
    return common


def _collapses_well(vertices, moved, faces, a, b, longest, bend):
    """For each collapsing edge: no face around it turns over and no edge gets too long."""
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


def flip(mesh: Triangulation, rng: np.random.Generator, delaunay: bool, passes: int) -> Triangulation:
    """Flip edges towards valence 6 (4 at a boundary), or towards intrinsic Delaunay; features stay."""
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    held = topo.edges[features(vertices, faces, topo)[0]]  # no flip makes others
    for _ in range(passes):
        held = held[has_edge(topo, count, *held.T)]
        inner = np.flatnonzero(~topo.boundary)
        free = ~mark(len(topo.edges), find_edges(topo, count, *held.T))[inner]
        face, corner = topo.corners[inner] // 3, topo.corners[inner, 0] % 3
        # The faces are (p, a, b) and (q, b, a); they become (p, a, q) and (q, b, p).
        p, q = faces.ravel()[topo.corners[inner].T]
        a, b = faces[face[:, 0], (corner + 1) % 3], faces[face[:, 0], (corner + 2) % 3]
        valence = np.bincount(topo.edges.ravel(), minlength=count)
        cap = np.zeros(len(inner), bool)
        if delaunay:
            angles = _angle(vertices, p, a, b), _angle(vertices, q, a, b)
            cap = np.maximum(*angles) > CAP
            gain = angles[0] + angles[1] - np.pi - 1e-3
        else:
            excess = valence - np.where(mark(count, topo.edges[topo.boundary].ravel()), 4, 6)
            gain = excess[a] + excess[b] - excess[p] - excess[q] - 2.0
        free = (free | cap) & (gain > 0) & (valence[a] > 3) & (valence[b] > 3) & (p != q)
        quads, gain, face, cap = np.stack([a, b, p, q], 1)[free], gain[free], face[free], cap[free]
        good = ~has_edge(topo, count, *quads[:, 2:].T) & _flips_well(vertices[quads], cap)
        quads, gain, face = quads[good], gain[good], face[good]
        chosen = disjoint(quads, count, rng.random(len(quads)) - gain)
        faces = faces.copy()
        faces[face[chosen, 0]] = quads[chosen][:, [2, 0, 3]]
        faces[face[chosen, 1]] = quads[chosen][:, [3, 1, 2]]
        if len(chosen) < 0.002 * len(faces):
            break
        topo = topology(faces, count)
    return Triangulation(vertices, faces)


def _angle(vertices, at, a, b):
    u, v = vertices[a] - vertices[at], vertices[b] - vertices[at]
    return np.arctan2(length_of(cross(u, v)), dot(u, v))


def _flips_well(quads, cap):
    """The two faces lie nearly in one plane, before and after; a cap has no plane of its own."""
    a, b, p, q = quads.transpose(1, 0, 2)
    left, right = cross(a - p, b - p), cross(b - q, a - q)
    mean = unit_vectors(left + right)
    good = cap | (dot(unit_vectors(left), unit_vectors(right)) > 0.5)
    for after in (cross(a - p, q - p), cross(b - q, p - q)):
        good &= dot(unit_vectors(after), mean) > 0.5
    return good
