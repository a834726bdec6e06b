"""Random triangulations: of a given surface, to an exact vertex count, and of a planar rectangle.

A field network must not learn the mesh it lives on, so it sees one surface in many *independent*
triangulations. Edge-length remeshers keep the input's vertices when the densities are alike (95 % of them);
here random collapses to 1.4 times the wanted edge length come first, and the copies share about as many
points as chance would have it. After that: split, collapse, flip, smooth, project (Botsch & Kobbelt 2004,
"A remeshing approach to multiresolution modeling"), each step on a random independent set at once.

Conventions: corner 3f + k is corner k of face f and stands for the edge opposite to it; faces are
counter-clockwise. A feature is a boundary edge or a crease; feature vertices move along features only.
"""

from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, KDTree

from flx.types import Triangulation

CREASE = np.cos(np.radians(60.0))  # faces that bend more than 60° meet in a crease
COARSENING = 1.4  # edge length of the random coarse mesh, in wanted edge lengths; at 1.0 copies share 74 %
ROUNDS = 3
CURVE = 4  # edges in the shortest crease
CAP = np.radians(160.0)  # a face with such an angle has no normal to speak of
NEEDLE = 0.3  # of the shortest edge wanted: below it, creases do not protect an edge
LONGEST, SHORTEST = 4 / 3, 0.8  # of the wanted edge length (Botsch & Kobbelt)


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


def _normals(vertices, faces):
    """Face normals, twice the area long."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return _cross(b - a, c - a)


def _cross(u, v):
    x, y, z = u.T
    p, q, r = v.T
    return np.stack([y * r - z * q, z * p - x * r, x * q - y * p], 1)


def _dot(u, v):
    return np.einsum("ij,ij->i", u, v)


def _length(u):
    return np.sqrt(_dot(u, u))


def _unit(u):
    return u / (_length(u)[:, None] + 1e-300)


def _edge_lengths(vertices, topo):
    return _length(vertices[topo.edges[:, 0]] - vertices[topo.edges[:, 1]])


def _features(vertices, faces, topo, least=CURVE):
    """Which edges are features, and how free each vertex is: 0 on a face, 1 on a curve, 2 at a corner."""
    feature = topo.boundary.copy()
    normals = _unit(_normals(vertices, faces))
    left, right = topo.corners[~feature].T // 3
    sharp = np.flatnonzero(~feature)[_dot(normals[left], normals[right]) < CREASE]
    feature[_long_curves(topo.edges[sharp], np.ones(len(sharp)), len(vertices), least, sharp)] = True
    degree = np.bincount(topo.edges[feature].ravel(), minlength=len(vertices))
    kind = np.where(degree == 0, 0, np.where(degree == 2, 1, 2))
    kind[_turns(vertices, topo.edges[topo.boundary])] = 2
    return feature, kind


def _turns(vertices, rim):
    """Boundary vertices where the boundary turns by more than 60°."""
    a, b = rim.T
    along = _unit(vertices[b] - vertices[a])
    turn = _sum_at(a[:, None], along, len(vertices)) - _sum_at(b[:, None], along, len(vertices))
    return np.flatnonzero(_length(turn) > 1) if len(rim) else []


def _long_curves(edges, lengths, count, least, ids):
    """The `ids` of edges in connected curves at least `least` long: sharp specks of a scan are no creases."""
    graph = coo_array((np.ones(len(edges), bool), tuple(edges.T)), (count, count))
    curve = connected_components(graph, directed=False)[1][edges[:, 0]]
    return ids[np.bincount(curve, lengths)[curve] >= least] if len(ids) else ids


def _mark(count, members):
    marked = np.zeros(count, bool)
    marked[members] = True
    return marked


def _has_edge(topo, count, a, b):
    key = np.minimum(a, b) * count + np.maximum(a, b)
    slot = np.minimum(np.searchsorted(topo.keys, key), len(topo.keys) - 1)
    return topo.keys[slot] == key


class Surface:
    """The surface to stay on: closest points on its faces, its boundary and its creases."""

    def __init__(self, vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], length: float):
        topo = topology(faces, len(vertices))
        feature = _features(vertices, faces, topo, 1)[0]
        creases = np.flatnonzero(feature & ~topo.boundary)
        lengths = _edge_lengths(vertices, topo)[creases]
        creases = _long_curves(topo.edges[creases], lengths, len(vertices), CURVE * length, creases)
        self.vertices, self.faces = vertices, faces
        self.normals = _unit(_normals(vertices, faces))
        self.tree = igl.AABB()
        self.tree.init(vertices, faces)
        self.boundary = np.ascontiguousarray(topo.edges[topo.boundary])
        self.creases = np.ascontiguousarray(topo.edges[creases])

    def project(self, points, normals):
        """Closest points, and whether the surface there faces the way of `normals` (thin walls)."""
        _, face, closest = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points))
        return np.asarray(closest), _dot(self.normals[np.asarray(face)], normals) > 0.3

    def project_to(self, curve, points):
        """Closest points on the segments `curve`, and their distances."""
        square, _, closest = igl.point_mesh_squared_distance(
            np.ascontiguousarray(points), self.vertices, curve
        )
        return np.asarray(closest), np.sqrt(np.asarray(square))


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


def split(mesh: Triangulation, topo: Topology, chosen: Bool[Any, "E"], rng) -> Triangulation:
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


def _split_long(mesh, longest, rng):
    """Split until no edge is longer than `longest`."""
    while True:
        topo = topology(mesh.faces, len(mesh.vertices))
        long = _edge_lengths(mesh.vertices, topo) > longest
        if not long.any():
            return mesh
        mesh = split(mesh, topo, long, rng)


def _ranks(priority):
    rank = np.empty(len(priority), np.int64)
    rank[np.argsort(priority, kind="stable")] = np.arange(len(priority))
    return rank


def _unconnected(topo, count, pairs, priority):
    """A maximal set (nearly) of `pairs` of which no two are joined by an edge, lowest priority first."""
    (a, b), (u, v), rank = pairs.T, topo.edges.T, _ranks(priority)
    won, left = [], np.arange(len(pairs))
    for _ in range(3):
        best = np.full(count, len(pairs))
        np.minimum.at(best, a[left], rank[left])
        np.minimum.at(best, b[left], rank[left])
        near = best.copy()
        np.minimum.at(near, u, best[v])
        np.minimum.at(near, v, best[u])
        won.append(left[rank[left] <= np.minimum(near[a[left]], near[b[left]])])
        taken = _mark(count, pairs[won[-1]].ravel())
        near = taken.copy()
        near[u[taken[v]]] = near[v[taken[u]]] = True
        left = left[~near[a[left]] & ~near[b[left]]]
    return np.concatenate(won)


def _disjoint(groups, count, priority):
    """A maximal set (nearly) of groups of which no two share a vertex, lowest priority first."""
    rank = _ranks(priority)
    won, left = [], np.arange(len(groups))
    for _ in range(3):
        best = np.full(count, len(groups))
        for member in groups[left].T:
            np.minimum.at(best, member, rank[left])
        won.append(left[(best[groups[left]] == rank[left, None]).all(1)])
        taken = _mark(count, groups[won[-1]].ravel())
        left = left[~taken[groups[left]].any(1)]
    return np.concatenate(won)


def collapse(
    mesh: Triangulation,
    shortest: float,
    longest: float,
    rng: np.random.Generator,
    most: int | None = None,
    bend: float = 0.3,
) -> tuple[Triangulation, int]:
    """Collapse a random independent set of edges shorter than `shortest`, the shorter ones rather.

    An edge stays where the topology would change, a feature would be cut, a face would turn by more than
    arccos(`bend`) or an edge would grow beyond `longest`. Returns the mesh and how many of `most` were done.
    """
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    feature, kind = _features(vertices, faces, topo)
    ids = _collapsible(vertices, faces, topo, feature, kind, shortest, rng)
    a, b = topo.edges[ids].T
    middle = (vertices[a] + vertices[b]) / 2
    # A feature vertex stays in place, unless two slide together along their curve.
    apart = (kind[a] == kind[b]) & (kind[a] > 0) & (~feature[ids] | (kind[a] == 2))
    middle = np.where((apart | (kind[a] > kind[b]))[:, None], vertices[a], middle)
    middle = np.where((kind[b] > kind[a])[:, None], vertices[b], middle)
    moved = vertices.copy()
    moved[a] = moved[b] = middle
    done = np.flatnonzero(_collapses_well(vertices, moved, faces, a, b, longest, bend))[:most]
    a, b = a[done], b[done]
    target = np.arange(count)
    target[b] = a
    vertices = vertices.copy()
    vertices[a] = middle[done]
    x, y, z = target[faces].T
    kept = (x != y) & (y != z) & (z != x)
    remains = ~_mark(count, b)
    new_index = np.cumsum(remains) - 1
    return Triangulation(vertices[remains], new_index[target[faces[kept]]]), len(done)


def _collapsible(vertices, faces, topo, feature, kind, shortest, rng):
    """A random independent set of short edges that neither topology nor features protect."""
    count = len(vertices)
    a, b = topo.edges.T
    lengths = _edge_lengths(vertices, topo)
    rim = _mark(count, topo.edges[topo.boundary].ravel())
    free = (feature | (kind[a] == 0) | (kind[b] == 0)) & ((kind[a] < 2) | (kind[b] < 2) | topo.boundary)
    free |= (lengths < NEEDLE * shortest) & (topo.boundary | ~(rim[a] & rim[b]))
    # A fan must remain around the opposite vertices: three faces, two at the boundary.
    spare = np.bincount(topo.edges.ravel(), minlength=count) - np.where(rim, 2, 3)
    opposite = faces.ravel()[np.where(topo.corners < 0, topo.corners[:, :1], topo.corners)]
    free &= (spare[opposite] > 0).all(1)
    ids = np.flatnonzero(free & (lengths < shortest))
    priority = lengths[ids] / shortest + rng.random(len(ids))
    ids = ids[_unconnected(topo, count, topo.edges[ids], priority)]
    # An opposite vertex loses an edge to each collapse around it: where that is too many, one goes ahead.
    lost = np.bincount(opposite[ids].ravel(), minlength=count)
    crowded = (lost > spare)[opposite[ids]].any(1)
    ids = np.concatenate([ids[~crowded], ids[crowded][:1]])
    # Link condition: the ends have no neighbour in common but the opposite vertices.
    common = _common_neighbors(topo, count, *topo.edges[ids].T)
    return ids[common == np.where(topo.boundary[ids], 1, 2)]


def _common_neighbors(topo, count, a, b):
    """How many vertices are joined to both ends of the edges a-b, no two of which are adjacent."""
    owner = np.full(count, -1)
    owner[a] = np.arange(len(a))
    common = np.zeros(len(a), np.int64)
    for near, far in (topo.edges.T, topo.edges.T[::-1]):
        rim = owner[near] >= 0
        pair, far = owner[near[rim]], far[rim]
        joined = _has_edge(topo, count, b[pair], far)
        common += np.bincount(pair[joined], minlength=len(a))
    return common


def _collapses_well(vertices, moved, faces, a, b, longest, bend):
    """For each collapsing edge: no face around it turns over and no edge gets too long."""
    owner = np.full(len(vertices), -1)
    owner[a] = owner[b] = np.arange(len(a))
    owners = owner[faces]
    around = np.flatnonzero((owners >= 0).sum(1) == 1)
    rim, pair = faces[around], owners[around].max(1)
    before, after = _normals(vertices, rim), _normals(moved, rim)
    corners = moved[rim]
    side = np.stack([_length(corners[:, k] - corners[:, k - 1]) for k in range(3)]).max(0)
    bad = (_dot(before, after) <= bend * _length(before) * _length(after)) | (side > longest)
    return ~_mark(len(a), pair[bad])


def flip(mesh: Triangulation, rng: np.random.Generator, delaunay: bool, passes: int) -> Triangulation:
    """Flip edges towards valence 6 (4 at a boundary), or towards intrinsic Delaunay; features stay."""
    vertices, faces = mesh
    count = len(vertices)
    for _ in range(passes):
        topo = topology(faces, count)
        inner = np.flatnonzero(~topo.boundary)
        free = ~_features(vertices, faces, topo)[0][inner]
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
            excess = valence - np.where(_mark(count, topo.edges[topo.boundary].ravel()), 4, 6)
            gain = excess[a] + excess[b] - excess[p] - excess[q] - 2.0
        free = (free | cap) & (gain > 0) & (valence[a] > 3) & (valence[b] > 3) & (p != q)
        quads, gain, face, cap = np.stack([a, b, p, q], 1)[free], gain[free], face[free], cap[free]
        good = ~_has_edge(topo, count, *quads[:, 2:].T) & _flips_well(vertices[quads], cap)
        quads, gain, face = quads[good], gain[good], face[good]
        chosen = _disjoint(quads, count, rng.random(len(quads)) - gain)
        faces = faces.copy()
        faces[face[chosen, 0]] = quads[chosen][:, [2, 0, 3]]
        faces[face[chosen, 1]] = quads[chosen][:, [3, 1, 2]]
        if len(chosen) < 0.002 * len(faces):
            break
    return Triangulation(vertices, faces)


def _angle(vertices, at, a, b):
    u, v = vertices[a] - vertices[at], vertices[b] - vertices[at]
    return np.arctan2(_length(_cross(u, v)), _dot(u, v))


def _flips_well(quads, cap):
    """The two faces lie nearly in one plane, before and after; a cap has no plane of its own."""
    a, b, p, q = quads.transpose(1, 0, 2)
    left, right = _cross(a - p, b - p), _cross(b - q, a - q)
    mean = _unit(left + right)
    good = cap | (_dot(_unit(left), _unit(right)) > 0.5)
    for after in (_cross(a - p, q - p), _cross(b - q, p - q)):
        good &= _dot(_unit(after), mean) > 0.5
    return good


def smooth(mesh: Triangulation, surface: Surface, length: float, passes: int) -> Triangulation:
    """Move each vertex towards the area-weighted centroid of its faces, or along its curve; project back."""
    vertices, faces = mesh
    count = len(vertices)
    topo = topology(faces, count)
    edge_of_surface = _mark(count, topo.edges[topo.boundary].ravel())
    for _ in range(passes):
        feature, kind = _features(vertices, faces, topo)
        normals = _normals(vertices, faces)
        area = _length(normals)
        centroids = vertices[faces].mean(1) * area[:, None]
        vertex_normals = _unit(_sum_at(faces, normals, count))
        weight = np.bincount(faces.ravel(), np.repeat(area, 3), count)
        step = _sum_at(faces, centroids, count) / np.maximum(weight, 1e-300)[:, None] - vertices
        step -= _dot(step, vertex_normals)[:, None] * vertex_normals
        a, b = topo.edges[feature].T
        along = _sum_at(a[:, None], vertices[b], count) + _sum_at(b[:, None], vertices[a], count)
        step[kind == 1] = along[kind == 1] / 2 - vertices[kind == 1]
        step[kind == 2] = 0
        wanted = vertices + 0.6 * step
        moved, facing = surface.project(wanted, vertex_normals)
        # The normal of a feature vertex says little.
        facing |= edge_of_surface | ((kind > 0) & (_length(moved - wanted) < 0.5 * length))
        for curve, members, reach in (
            (surface.creases, np.flatnonzero((kind > 0) & ~edge_of_surface), 0.5 * length),
            (surface.boundary, np.flatnonzero(edge_of_surface), length),
        ):
            if len(curve) and len(members):
                closest, distance = surface.project_to(curve, wanted[members])
                near = distance < reach
                moved[members[near]] = closest[near]
                facing[members[near]] = True
        moved[~facing] = vertices[~facing]
        vertices = _without_folds(vertices, moved, faces, normals)
    return Triangulation(vertices, faces)


def _without_folds(vertices, moved, faces, normals):
    """Take back the moves that turn a face over or leave it a tenth of the mean area."""
    area = _length(normals)
    least = np.minimum(0.1 * area.mean(), 0.9 * area)
    while True:
        folded = _dot(_unit(normals), _normals(moved, faces)) < least
        back = faces[folded].ravel()
        if (moved[back] == vertices[back]).all():
            return moved
        moved[back] = vertices[back]


def _sum_at(faces, values, count):
    """At each vertex, the sum of the values of its faces."""
    at, width = faces.ravel(), faces.shape[1]
    return np.stack([np.bincount(at, np.repeat(x, width), count) for x in values.T], 1)


def _collapse_short(mesh, length, rng):
    """Collapse until few edges are shorter than 0.8 `length`."""
    while True:
        mesh, done = collapse(mesh, SHORTEST * length, LONGEST * length, rng)
        if done < 0.005 * len(mesh.vertices):
            return mesh


def _settle(mesh, count, length, rng):
    """Bring the mesh to `count` vertices: collapse its shortest edges, less and less choosy, or split."""
    for shortest, longest, bend in ((1.3, 2.0, 0.3), (2.0, 3.0, 0.1), (np.inf, np.inf, -1.0)):
        done = 1
        while done and len(mesh.vertices) > count:
            surplus = len(mesh.vertices) - count
            mesh, done = collapse(mesh, shortest * length, longest * length, rng, surplus, bend)
    while len(mesh.vertices) < count:
        mesh = _split_longest(mesh, count - len(mesh.vertices), rng)
    return mesh


def _split_longest(mesh, most, rng):
    """Split up to `most` of the edges that are the longest of both their faces, the longest first."""
    topo = topology(mesh.faces, len(mesh.vertices))
    lengths = _edge_lengths(mesh.vertices, topo)
    longest = np.zeros(len(lengths))
    np.maximum.at(longest, topo.face_edges, lengths[topo.face_edges].max(1)[:, None])
    ids = np.flatnonzero(lengths >= longest)
    ids = ids[np.argsort(-lengths[ids], kind="stable")[:most]]
    return split(mesh, topo, _mark(len(lengths), ids), rng)


def remesh(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], count: int, seed: int) -> Triangulation:
    """An isotropic triangulation of a surface with exactly `count` vertices, another one for every seed.

    The input is a manifold, consistently oriented mesh, open or closed, of any density. Components, Euler
    characteristic and boundary loops are kept; so are boundaries and creases (faces that bend more than 60°
    along at least four edges). Same seed, same machine: same bits. About 2.5 CPU seconds for 30,000 vertices.

    Raises ValueError where the input is not such a mesh, or has no triangulation that small.
    """
    shape = _shape(vertices, faces)
    if count < 4:
        raise ValueError(f"no surface has a triangulation of {count} vertices; ask for more vertices")
    area = _length(_normals(vertices, faces)).sum() / 2
    length = float(np.sqrt(2 * area / (np.sqrt(3) * count)))  # of the edges, were all faces equilateral
    rng = np.random.default_rng(seed)
    mesh = Triangulation(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64))
    surface = Surface(*mesh, length)
    mesh = _coarsen(mesh, surface, length, rng)
    for _ in range(ROUNDS):
        mesh = _split_long(mesh, LONGEST * length, rng)
        mesh = _collapse_short(mesh, length, rng)
        mesh = smooth(flip(mesh, rng, delaunay=False, passes=4), surface, length, passes=2)
        mesh = _settle(mesh, count, length, rng)
        mesh = smooth(flip(mesh, rng, delaunay=False, passes=4), surface, length, passes=1)
    mesh = smooth(flip(mesh, rng, delaunay=True, passes=8), surface, length, passes=1)
    mesh = flip(mesh, rng, delaunay=True, passes=4)
    if len(mesh.vertices) != count or _shape(*mesh) != shape:
        raise ValueError(
            f"remeshing {len(vertices)} vertices ({shape}) to {count} ended at {len(mesh.vertices)} "
            f"({_shape(*mesh)}); ask for more vertices"
        )
    return mesh


def _coarsen(mesh, surface, length, rng):
    """Random collapses to a coarse mesh: what makes the copies independent of the input and each other."""
    mesh = _split_long(mesh, LONGEST * COARSENING * length, rng)
    mesh = smooth(mesh, surface, length, passes=1)
    mesh = _collapse_short(mesh, COARSENING * length, rng)
    return smooth(flip(mesh, rng, delaunay=False, passes=4), surface, length, passes=2)


def _shape(vertices, faces):
    """What remeshing keeps. Raises ValueError unless every vertex has one fan, faces agree in orientation."""
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
        f"{count - len(topo.edges) + len(faces)}, {loops}"
        " boundary loops"
    )


def _components(pairs, count):
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    return connected_components(graph, directed=False)[0]


def planar(
    count: int, size: tuple[float, float], rng: np.random.Generator, irregularity: float = 0.3
) -> Triangulation:
    """A random Delaunay triangulation of the rectangle [0, w] x [0, h] at z = 0, with `count` vertices.

    `irregularity` is the share of points strewn at random among relaxed ones: 0 gives nearly equilateral
    faces, 1 whatever chance gives. The paper trains on farthest-point samples, which lie between.
    About 15 ms for 1,000 vertices. Raises ValueError where `count` < 4 or `size` is not positive.
    """
    if count < 4 or min(size) <= 0 or not 0 <= irregularity <= 1:
        raise ValueError(
            f"no triangulation of {count} vertices, size {size}, irregularity {irregularity}; "
            "give at least 4 vertices, positive sides and an irregularity from 0 to 1"
        )
    border = _border(count, size, rng, irregularity)
    points = np.concatenate([border, rng.uniform((0, 0), size, (count - len(border), 2))])
    strewn = points.copy()
    for _ in range(4):
        faces, area = _delaunay(points)
        pull = _sum_at(faces, area[:, None] * points[faces].mean(1), count)
        points[len(border) :] = (pull / _sum_at(faces, area[:, None], count))[len(border) :]
    random = (np.arange(count) >= len(border)) & (rng.random(count) < irregularity)
    points[random] = strewn[random]
    return Triangulation(np.concatenate([points, np.zeros((count, 1))], 1), _delaunay(points)[0])


def _delaunay(points):
    """Faces, counter-clockwise as SciPy gives them, and areas, without flat faces along the sides."""
    faces = np.asarray(Delaunay(points).simplices, np.int64)
    u, v = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    solid = area > 1e-12 * area.sum()
    return faces[solid], area[solid]


def _border(count, size, rng, irregularity):
    """The corners of a rectangle and points on its sides, spaced like `count` points inside."""
    (width, height) = size
    spacing = np.sqrt(2 * width * height / (np.sqrt(3) * count))
    room = 0.5 * (count - 4) * spacing / (2 * (width + height))  # at most half of the points
    points = [np.array([[0, 0], [width, 0], [width, height], [0, height]], float)]
    for axis, side in ((0, 0.0), (1, width), (0, height), (1, 0.0)):
        number = int(min(1.0, room) * size[axis] / spacing)
        even = np.arange(1, number + 1) / (number + 1)
        along = (even + irregularity * (rng.random(number) - 0.5) * 0.8 / (number + 1)) * size[axis]
        other = np.full(number, side)
        points.append(np.stack([along, other] if axis == 0 else [other, along], 1))
    return np.concatenate(points)


def coincidence(a: Triangulation, b: Triangulation) -> float:
    """Share of the vertices of b within 0.1 mean edge lengths of b of a vertex of a; 0.036 by chance."""
    reach = 0.1 * _edge_lengths(b.vertices, topology(b.faces, len(b.vertices))).mean()
    return float((KDTree(a.vertices).query(b.vertices)[0] < reach).mean())
