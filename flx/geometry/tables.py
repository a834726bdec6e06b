"""Gather tables of a triangulation: padded one-rings at two levels and the pooling between them.

Geometry is computed in float64 (`exact_tables`) and rounded at the end to the float32 and complex64 that
networks read (flx.types has the conventions). Both levels are intrinsic: coarse vertices are farthest-point
samples in the distance along mesh edges, and each fine vertex is assigned to the nearest of them in that
distance, so the two sides of a thin wall are never pooled together.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex128, Float64, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from flx.arguments import whole
from flx.geometry.arrays import mark
from flx.geometry.tangent import TangentFrames, tangent_frames, transports
from flx.types import MeshTables, OneRings, Pooling, Triangulation


class _Forest(NamedTuple):
    """Shortest paths along fine edges, from every vertex to its nearest coarse one."""

    centers: Int[Any, "W"]
    parents: Int[Any, "V"]
    distances: Float64[Any, "V"]  # in units of `_whole_lengths`
    transports: Complex128[Any, "V"]  # P_{center←v}, composed along the path
    logs: Complex128[Any, "V"]  # log_center v: the sum of the path's steps, each transported to the centre


def mesh_tables(
    triangulation: Triangulation, slots: int = 16, seed: int = 0, coarse_count: int | None = None
) -> MeshTables:
    """The gather tables of a triangulation as it is: padded one-rings of two levels, and the pooling between.

    Args:
        triangulation: Vertices [V, 3] and faces [F, 3], manifold and oriented, open or closed.
        slots: The most neighbours of a vertex, itself included; the table is as wide as the largest ring.
        seed: Chooses where the sampling of each component starts.
        coarse_count: Vertices of the coarse level; V // 4 unless given.

    Components are never pooled together: each has at least one coarse vertex, so there are
    max(coarse_count, components) of them.

    Raises ValueError where a vertex of either level has more neighbours than slots − 1, for a coarse count
    outside 1..V, and for arrays that are not a surface.

    Example:
        tables = flx.mesh_tables(flx.Triangulation(vertices, faces))
        tables.fine.logs, tables.fine.transports  # [V, K] complex
    """
    slots, seed = whole("slots", slots, 4), whole("seed", seed)
    exact = exact_tables(triangulation, slots, seed, coarse_count)
    return MeshTables._make(part._make(map(_rounded, part)) for part in exact)


def exact_tables(
    triangulation: Triangulation, slots: int = 16, seed: int = 0, coarse_count: int | None = None
) -> MeshTables:
    """`mesh_tables` before rounding, in float64 and complex128, to test symmetries exactly."""
    frames, count = tangent_frames(triangulation), len(triangulation.vertices)
    coarse_count = max(1, count // 4) if coarse_count is None else coarse_count
    if not 1 <= coarse_count <= count:
        raise ValueError(f"coarse_count is {coarse_count} on a mesh of {count} vertices; take 1 to {count}")
    graph = _edge_graph(frames)
    forest = _shortest_paths(graph, frames, _farthest_points(graph, coarse_count, seed))
    pooling = _pooling(forest, frames.masses)
    return MeshTables(one_rings(frames, slots), pooling, _coarse_rings(frames, forest, slots))


def one_rings(frames: TangentFrames, slots: int = 16) -> OneRings:
    """The padded one-rings in float64; K is the size of the largest ring, including the vertex itself.

    Raises ValueError where a vertex has more neighbours than slots − 1.
    """
    p, place = np.nonzero(frames.neighbors >= 0)
    logs = (frames.lengths * frames.directions)[p, place] / frames.radius
    return _padded_rings(
        frames.masses,
        (p, place + 1, frames.neighbors[p, place], frames.reverse[p, place] + 1),
        logs,
        transports(frames)[p, place],
        slots,
    )


def stack(tables: Sequence[MeshTables]) -> MeshTables:
    """Mesh copies on a leading axis, padded to the largest ring, cluster and vertex counts.

    A spare vertex has mass 0 and only itself as neighbour. A spare fine vertex has coarse vertex 0 as parent
    but is not among its children; a spare coarse vertex has fine vertex 0 as centre and children of weight 0.
    """
    return MeshTables._make(_stacked(parts) for parts in zip(*tables, strict=True))


def _stacked(parts: tuple[Any, ...]) -> Any:
    """The rings or the poolings of all copies, each array padded to the largest shape."""
    fields: dict[str, np.ndarray] = {}
    for name, arrays in zip(parts[0]._fields, zip(*parts, strict=True), strict=True):
        shape = (len(arrays), *np.max([array.shape for array in arrays], axis=0))
        filled = np.full(shape, name in ("transports", "child_transports"), arrays[0].dtype)
        if name == "neighbors":
            filled[:] = np.arange(shape[1])[:, None]
        elif name == "reverse":
            filled[:] = np.arange(shape[2])
        elif name == "children":
            filled[:] = fields["centers"][..., None]
        for copy, array in zip(filled, arrays, strict=True):
            copy[tuple(map(slice, array.shape))] = array
        fields[name] = filled
    return type(parts[0])(**fields)


# ---- padded rings --------------------------------------------------------------------------------------


def _padded_rings(
    masses: Float64[Any, "V"],
    entries: tuple[Int[Any, "E"], Int[Any, "E"], Int[Any, "E"], Int[Any, "E"]],
    logs: Complex128[Any, "E"],
    transports: Complex128[Any, "E"],
    slots: int,
    level: str = "vertex",
) -> OneRings:
    """Rings from directed edges (p, slot of q at p, q, slot of p at q); logs are in mean vertex radii.

    `level` names the vertices in errors.
    """
    p, slot, q, reverse_slot = entries
    width = 1 + int(slot.max(initial=0))
    if width > slots:
        vertex = int(p[slot.argmax()])
        raise ValueError(
            f"{level} {vertex} has {width - 1} neighbours but the table has {slots} slots, one of them its "
            "own; remesh, or raise slots (--surface.slots of flx train)"
        )
    shape = (len(masses), width)
    neighbors, reverse = np.indices(shape, np.int32)
    neighbors[p, slot], reverse[p, slot] = q, reverse_slot
    padded_logs, padded_transports = np.zeros(shape, np.complex128), np.ones(shape, np.complex128)
    padded_logs[p, slot], padded_transports[p, slot] = logs, transports
    weights = np.zeros(shape)
    weights[:, 0] = masses
    weights[p, slot] = masses[q]
    return OneRings(
        neighbors, reverse, padded_logs, padded_transports, _normalized(weights), _normalized(masses)
    )


def _rounded(array: np.ndarray) -> np.ndarray:
    return array.astype({"f": np.float32, "c": np.complex64, "i": np.int32}[array.dtype.kind])


def _normalized(weights: np.ndarray) -> np.ndarray:
    """Scale to sum 1 along the last axis; all-zero rows (a vertex without faces) stay zero."""
    return weights / np.maximum(weights.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)


# ---- pooling -------------------------------------------------------------------------------------------


def _whole_lengths(frames: TangentFrames) -> Float64[Any, "V N"]:
    """Edge lengths rounded to whole multiples of 2⁻³⁰ times the mean length.

    Sums of whole numbers are exact, so equally long paths tie under any motion or scaling of the mesh.
    """
    used = frames.neighbors >= 0
    mean = frames.lengths.sum() / max(used.sum(), 1)
    return np.maximum(np.round(frames.lengths * (2.0**30 / (mean or 1.0))), used)


def _edge_graph(frames: TangentFrames) -> csr_array:
    used = frames.neighbors >= 0
    row_starts = np.concatenate([[0], np.cumsum(used.sum(axis=1))]).astype(np.int32)
    columns = frames.neighbors[used].astype(np.int32)
    return csr_array((_whole_lengths(frames)[used], columns, row_starts), shape=(len(used), len(used)))


def _farthest_points(graph: csr_array, count: int, seed: int) -> Int[Any, "W"]:
    """Farthest-point sampling in graph distance, many samples per round; it starts with one per component.

    Each round takes vertices that are at least two thirds of the largest distance away from all samples so
    far and from each other, so no vertex ends farther from its centre than 1.5 times the least spacing of the
    centres. (One sample per round, as in textbooks, would give 1 time the spacing, but takes 2.7 s in Python
    at 30,000 vertices; this takes 0.3 s.)
    """
    _, component = connected_components(graph, directed=False)
    order = np.random.default_rng(seed).permutation(len(component))
    centers = order[np.unique(component[order], return_index=True)[1]]
    distances = dijkstra(graph, indices=centers, min_only=True)
    while len(centers) < count:
        farthest = distances.max()
        taken = _spaced(graph, distances, np.flatnonzero(3 * distances >= 2 * farthest), 2 / 3 * farthest)
        taken = taken[np.argsort(-distances[taken], kind="stable")][: count - len(centers)]
        nearer = dijkstra(graph, indices=taken, min_only=True, limit=farthest)
        distances = np.minimum(distances, nearer)
        centers = np.concatenate([centers, taken])
    return centers


def _spaced(
    graph: csr_array, priority: Float64[Any, "V"], chosen: Int[Any, "N"], spacing: float
) -> Int[Any, "n"]:
    """Drop chosen vertices that have another of higher priority nearer than `spacing`, until none has.

    It suffices to compare neighbouring Voronoi cells: if two chosen vertices are too close, the first cell
    that the path between them enters belongs to a chosen vertex that is at least as close.
    """
    edges = graph.tocoo()
    a, b = edges.coords
    while True:
        distance, _, nearest = dijkstra(
            graph, indices=chosen, min_only=True, return_predecessors=True, limit=spacing
        )
        i, j = nearest[a], nearest[b]
        close = (i != j) & (distance[a] + edges.data + distance[b] < spacing)
        i, j = i[close], j[close]
        if not len(i):
            return chosen
        worse = (priority[i] < priority[j]) | ((priority[i] == priority[j]) & (i > j))
        chosen = np.setdiff1d(chosen, i[worse])


def _shortest_paths(graph: csr_array, frames: TangentFrames, centers: Int[Any, "W"]) -> _Forest:
    """Shortest-path trees from the centres, with transports and logs accumulated along them."""
    distances, before, nearest = dijkstra(graph, indices=centers, min_only=True, return_predecessors=True)
    parents = np.empty(len(distances), np.int64)
    parents[centers] = np.arange(len(centers))
    parents = parents[nearest]

    done = mark(len(distances), centers)
    before[centers] = centers
    back = np.arange(len(before)), (frames.neighbors == before[:, None]).argmax(axis=1)
    step = np.conj(transports(frames)[back])  # P_{before←v}
    reverse = frames.reverse[back]
    edge = (frames.lengths * frames.directions)[before, reverse]  # log_before v
    carried, logs = np.ones(len(distances), np.complex128), np.zeros(len(distances), np.complex128)
    while not done.all():
        v = np.flatnonzero(~done & done[before])
        u = before[v]
        logs[v] = logs[u] + carried[u] * edge[v]
        carried[v] = carried[u] * step[v]
        done[v] = True
    return _Forest(centers, parents, distances, carried, logs)


def _pooling(forest: _Forest, masses: Float64[Any, "V"]) -> Pooling:
    order = np.argsort(forest.parents, kind="stable")
    parent = forest.parents[order]
    slot = _rank_in_group(parent)
    shape = (len(forest.centers), int(slot.max()) + 1)
    children = np.repeat(forest.centers[:, None], shape[1], axis=1)
    child_transports, weights = np.ones(shape, np.complex128), np.zeros(shape)
    children[parent, slot] = order
    child_transports[parent, slot], weights[parent, slot] = forest.transports[order], masses[order]
    return Pooling(
        centers=forest.centers.astype(np.int32),
        parents=forest.parents.astype(np.int32),
        transports=forest.transports,
        children=children.astype(np.int32),
        child_transports=child_transports,
        child_weights=_normalized(weights),
    )


def _coarse_rings(frames: TangentFrames, forest: _Forest, slots: int) -> OneRings:
    """Rings of the clusters: two are neighbours if a fine edge joins them; one path serves both directions.

    The path of (p, q), p < q, crosses the edge ab that makes it shortest: p … a b … q. With T and L, the
    transports and logs of the trees, P_{p←q} = T_a P_{a←b} conj(T_b) and
    log_p q = L_a + T_a log_a b − P_{p←q} L_b.
    """
    a, place = np.nonzero(frames.neighbors >= 0)
    b = frames.neighbors[a, place]
    across = forest.parents[a] < forest.parents[b]
    a, b, place = a[across], b[across], place[across]
    p, q = forest.parents[a], forest.parents[b]

    length = forest.distances[a] + _whole_lengths(frames)[a, place] + forest.distances[b]
    order = np.lexsort((b, a, length, q, p))
    fresh = (np.diff(p[order], prepend=-1) != 0) | (np.diff(q[order], prepend=-1) != 0)
    best = order[fresh]
    a, b, place, p, q = a[best], b[best], place[best], p[best], q[best]

    edge = (frames.lengths * frames.directions)[a, place]
    carried = forest.transports
    transport = carried[a] * transports(frames)[a, place] * carried[b].conj()
    log = forest.logs[a] + carried[a] * edge - transport * forest.logs[b]

    rows, columns = np.concatenate([p, q]), np.concatenate([q, p])
    order = np.lexsort((columns, rows))
    slot = np.empty(len(rows), np.int64)
    slot[order] = 1 + _rank_in_group(rows[order])
    scale = np.sqrt(len(forest.parents) / len(forest.centers))  # r̄ of the coarse level over r̄ of the fine
    return _padded_rings(
        np.bincount(forest.parents, frames.masses, minlength=len(forest.centers)),
        (rows, slot, columns, np.roll(slot, len(p))),
        np.concatenate([log, -transport.conj() * log]) / (frames.radius * scale),
        np.concatenate([transport, transport.conj()]),
        slots,
        "coarse vertex",
    )


def _rank_in_group(groups: Int[Any, "N"]) -> Int[Any, "N"]:
    """0, 1, 2, … within each run of equal values of a sorted array."""
    return np.arange(len(groups)) - np.searchsorted(groups, groups)
