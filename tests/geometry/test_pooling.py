"""Laws of the coarse level: clusters, centres, and the way between the levels."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.surfaces import bump, grid_faces, uneven_sphere
from helpers.tables import SLOTS, assert_same_tables, in_use, pool, ring_mean, surfaces, unpool
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from flx.geometry.tables import mesh_tables
from flx.geometry.tangent import mean_vertex_radius, tangent_frames, transports
from flx.types import Triangulation

seeds = st.integers(0, 10**6)


def path_lengths(mesh: Triangulation) -> np.ndarray:
    """Distances along mesh edges between all vertices."""
    a, b = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    lengths = np.zeros((len(mesh.vertices),) * 2)
    lengths[a, b] = lengths[b, a] = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=1)
    return dijkstra(csr_array(lengths), directed=False)


@given(seeds)
@surfaces
def test_clusters_partition_the_vertices_around_their_nearest_centre(surface, seed):
    mesh = surface(seed)
    tables = mesh_tables(mesh, SLOTS, seed)
    pooling, masses = tables.pooling, tables.fine.masses
    count, width = len(mesh.vertices), pooling.children.shape[1]
    used = pooling.child_weights > 0
    assert len(pooling.centers) == len(set(pooling.centers.tolist())) == count // 4
    np.testing.assert_array_equal(np.sort(pooling.children[used]), np.arange(count))
    assert used.any(axis=0).all()
    cluster = np.arange(count // 4)[:, None].repeat(width, axis=1)
    np.testing.assert_array_equal(pooling.parents[pooling.children[used]], cluster[used])
    np.testing.assert_array_equal(pooling.parents[pooling.centers], cluster[:, 0])
    np.testing.assert_array_equal(pooling.children[~used], pooling.centers[cluster[~used]])
    np.testing.assert_array_equal(
        pooling.child_transports, np.where(used, pooling.transports[pooling.children], 1)
    )
    shares = np.where(used, masses[pooling.children], 0)
    np.testing.assert_allclose(shares.sum(axis=1), tables.coarse.masses, rtol=1e-5)
    np.testing.assert_allclose(pooling.child_weights, shares / shares.sum(axis=1, keepdims=True), rtol=1e-5)
    distances = path_lengths(mesh)[pooling.centers]
    np.testing.assert_allclose(distances[pooling.parents, np.arange(count)], distances.min(axis=0), atol=1e-7)


@given(seeds)
@surfaces
def test_centres_are_spread_evenly(surface, seed):
    mesh = surface(seed)
    centers = mesh_tables(mesh, SLOTS, seed).pooling.centers
    distances = path_lengths(mesh)[centers]
    spacing = distances[:, centers] + np.diag(np.full(len(centers), np.inf))
    assert distances.min(axis=0).max() <= 1.5 * spacing.min() * (1 + 1e-6)


@settings(max_examples=5)
@given(seeds)
@surfaces
def test_coarse_level_follows_shortest_paths_step_by_step(surface, seed):
    """Against a walk along each path, one edge at a time."""
    mesh = surface(seed)
    tables = mesh_tables(mesh, SLOTS, seed)
    frames = tangent_frames(mesh)
    p, k = np.nonzero(frames.neighbors >= 0)
    places = {(int(i), int(frames.neighbors[i, j])): (i, j) for i, j in zip(p, k, strict=True)}
    carry, edge = transports(frames), frames.lengths * frames.directions
    pooling, coarse = tables.pooling, tables.coarse
    lengths = np.full((len(frames.neighbors),) * 2, np.inf)
    lengths[p, frames.neighbors[p, k]] = frames.lengths[p, k]
    distances, before = dijkstra(
        csr_array(np.where(np.isfinite(lengths), lengths, 0)),
        indices=pooling.centers,
        return_predecessors=True,
    )

    def path(center: int, end: int) -> list[int]:
        steps = [end]
        while steps[-1] != pooling.centers[center]:
            steps.append(int(before[center, steps[-1]]))
        return steps[::-1]

    def walk(steps: list[int]) -> tuple[complex, complex]:
        log, transport = 0j, 1 + 0j
        for x, y in pairwise(steps):
            log += transport * edge[places[x, y]]
            transport *= carry[places[x, y]]
        return log, transport

    for v, parent in enumerate(pooling.parents):
        np.testing.assert_allclose(pooling.transports[v], walk(path(parent, v))[1], atol=1e-6)

    crossings: dict[tuple[int, int], list] = {}
    for a, b in places:
        pair = int(pooling.parents[a]), int(pooling.parents[b])
        if pair[0] != pair[1]:
            length = distances[pair[0], a] + lengths[a, b] + distances[pair[1], b]
            crossings.setdefault(pair, []).append((length, a, b))
    rows, slots = np.nonzero(in_use(coarse))
    pairs = [(int(r), int(coarse.neighbors[r, s])) for r, s in zip(rows, slots, strict=True)]
    assert set(pairs) == set(crossings)
    radius = mean_vertex_radius(mesh) * np.sqrt(len(mesh.vertices) / len(pooling.centers))
    for (r, s), pair in zip(zip(rows, slots, strict=True), pairs, strict=True):
        _, a, b = min(crossings[pair])
        log, transport = walk(path(pair[0], a) + path(pair[1], b)[::-1])
        np.testing.assert_allclose(coarse.transports[r, s], transport, atol=1e-5)
        np.testing.assert_allclose(coarse.logs[r, s], log / radius, atol=1e-5)


@given(seeds)
def test_with_every_vertex_coarse_the_coarse_level_is_the_fine_one(seed):
    mesh = bump(seed)
    fine, pooling, coarse = mesh_tables(mesh, SLOTS, seed, coarse_count=len(mesh.vertices))
    assert (pooling.transports == 1).all()
    np.testing.assert_array_equal(pooling.children[:, 0], pooling.centers)
    values = np.exp(1j * np.arange(len(mesh.vertices)))
    np.testing.assert_allclose(
        unpool(pooling, ring_mean(coarse, pool(pooling, values))), ring_mean(fine, values), atol=1e-5
    )
    np.testing.assert_allclose(
        (coarse.weights * coarse.logs**2).sum(axis=1),
        (fine.weights * fine.logs**2).sum(axis=1)[pooling.centers],
        atol=1e-5,
    )


@given(seeds)
def test_no_vertex_of_a_thin_cup_is_pooled_to_the_other_wall(seed):
    """Two walls, 0.02 apart where edges are 0.2 long, joined at the rim."""
    depth, around = 12, 32
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange((2 * depth + 1) * around), around)
    turn = (column + rng.uniform(-0.2, 0.2, column.shape)) * 2 * np.pi / around
    radius = 1 - 0.01 * np.sign(row - depth)
    height = -0.2 * np.abs(row - depth)
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    cup = Triangulation(points, grid_faces(2 * depth + 1, around, seed, close_columns=True))
    pooling = mesh_tables(cup, SLOTS, seed).pooling
    wall = np.sign(row - depth)
    deep = np.abs(row - depth) > 2  # nearer the rim a cluster may reach over it
    assert (wall[pooling.centers[pooling.parents]] == wall)[deep].all()
    gaps = np.linalg.norm(points[pooling.centers][:, None] - points, axis=2)
    across = wall[pooling.centers[gaps.argmin(axis=0)]] != wall
    assert across[deep].mean() > 0.2  # where Euclidean distance decides, many are


@given(seeds)
def test_every_component_is_pooled_within_itself(seed):
    ball, hill = uneven_sphere(seed, 60), bump(seed)
    mesh = Triangulation(  # one inside the other: only the graph tells them apart
        np.concatenate([ball.vertices, hill.vertices]),
        np.concatenate([ball.faces, hill.faces + len(ball.vertices)]),
    )
    first = np.arange(len(mesh.vertices)) < 60
    for coarse_count, expected in ((None, len(mesh.vertices) // 4), (1, 2)):
        tables = mesh_tables(mesh, SLOTS, seed, coarse_count)
        centers, parents = tables.pooling.centers, tables.pooling.parents
        assert len(centers) == expected
        np.testing.assert_array_equal(first[centers[parents]], first)
        assert (first[centers[tables.coarse.neighbors]] == first[centers][:, None]).all()


def test_seed_chooses_the_coarse_vertices_and_repeats_them():
    mesh = uneven_sphere(0)
    assert_same_tables(mesh_tables(mesh, SLOTS, 3), mesh_tables(mesh, SLOTS, 3))
    assert set(mesh_tables(mesh, SLOTS, 3).pooling.centers) != set(
        mesh_tables(mesh, SLOTS, 4).pooling.centers
    )


def test_coarse_ring_too_large_is_refused_by_name():
    mesh = uneven_sphere(1)
    tables = mesh_tables(mesh)
    degrees = in_use(tables.coarse).sum(axis=1)
    largest = int(degrees.max())
    assert in_use(tables.fine).sum(axis=1).max() < largest
    with pytest.raises(ValueError, match=f"coarse vertex {degrees.argmax()} has {largest} neighbours"):
        mesh_tables(mesh, largest)


@pytest.mark.parametrize("count", [0, 301])
def test_impossible_coarse_count_is_refused(count):
    with pytest.raises(ValueError, match=f"coarse_count is {count} on a mesh of 300 vertices; take 1 to 300"):
        mesh_tables(uneven_sphere(0), coarse_count=count)
