"""Laws of the gather tables: one-rings, pooling, the coarse level, padding and files."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.surfaces import bump, folded, grid_faces, moved, sheet, uneven_sphere, uneven_torus
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from flx.geometry.tables import mesh_tables, one_rings, stack
from flx.geometry.tangent import mean_vertex_radius, tangent_frames, transports
from flx.pipeline.copies import load_tables, save_tables
from flx.types import MeshTables, OneRings, Pooling, Triangulation

seeds = st.integers(0, 10**6)
surfaces = pytest.mark.parametrize("surface", [uneven_sphere, uneven_torus, bump])
SLOTS = 24


def assert_same_tables(actual: MeshTables, expected: MeshTables, atol: float = 0.0) -> None:
    for level, other in zip(actual, expected, strict=True):
        for name, array in level._asdict().items():
            wanted = getattr(other, name)
            assert array.dtype == wanted.dtype
            np.testing.assert_allclose(array, wanted, rtol=0, atol=atol, err_msg=name)


def path_lengths(mesh: Triangulation) -> np.ndarray:
    """Distances along mesh edges between all vertices."""
    a, b = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    lengths = np.zeros((len(mesh.vertices),) * 2)
    lengths[a, b] = lengths[b, a] = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=1)
    return dijkstra(csr_array(lengths), directed=False)


def flat_axes(mesh: Triangulation) -> tuple[np.ndarray, np.ndarray]:
    """Positions in a flat sheet and the x axes of its frames, as complex numbers."""
    flat = mesh.vertices[:, :2] @ [1, 1j]
    axes = flat[tangent_frames(mesh).neighbors[:, 0]] - flat
    return flat, axes / np.abs(axes)


def ring_mean(rings: OneRings, field: np.ndarray) -> np.ndarray:
    """What every convolution does: transport, weigh, sum."""
    return (rings.weights * rings.transports * field[rings.neighbors]).sum(axis=1)


def pool(pooling: Pooling, field: np.ndarray) -> np.ndarray:
    return (pooling.child_weights * pooling.child_transports * field[pooling.children]).sum(axis=1)


def unpool(pooling: Pooling, field: np.ndarray) -> np.ndarray:
    return pooling.transports.conj() * field[pooling.parents]


def in_use(rings: OneRings) -> np.ndarray:
    """Real neighbours: every slot of positive weight but the first."""
    used = rings.weights > 0
    used[:, 0] = False
    return used


# ---- both levels ---------------------------------------------------------------------------------------


@given(seeds)
@surfaces
def test_rings_obey_the_conventions(surface, seed):
    tables = mesh_tables(surface(seed), SLOTS, seed)
    for kind, level in zip((OneRings, Pooling, OneRings), tables, strict=True):
        for name, array in level._asdict().items():
            assert isinstance(array, kind.__annotations__[name]), name
    for rings in (tables.fine, tables.coarse):
        count, width = rings.neighbors.shape
        p, k = np.meshgrid(np.arange(count), np.arange(width), indexing="ij")
        used = in_use(rings)
        assert used.sum() > 4 * count
        assert used.any(axis=0)[1:].all()  # trimmed to the largest ring
        assert (np.diff(used[:, 1:].astype(int), axis=1) <= 0).all()  # neighbours first, then spare slots
        np.testing.assert_array_equal(rings.neighbors[~used], p[~used])
        np.testing.assert_array_equal(rings.reverse[~used], k[~used])
        assert (rings.logs[~used] == 0).all()
        assert (rings.transports[~used] == 1).all()
        assert (rings.weights[~used & (k > 0)] == 0).all()
        assert (rings.neighbors[used] != p[used]).all()
        np.testing.assert_array_equal(rings.neighbors[rings.neighbors, rings.reverse], p)
        np.testing.assert_array_equal(rings.reverse[rings.neighbors, rings.reverse], k)
        ring_masses = rings.masses[rings.neighbors] * (used | (k == 0))
        np.testing.assert_allclose(
            rings.weights, ring_masses / ring_masses.sum(axis=1, keepdims=True), rtol=1e-5
        )
        np.testing.assert_allclose(rings.masses.sum(), 1, rtol=1e-5)
        assert (rings.masses > 0).all()


@given(seeds)
@surfaces
def test_way_back_is_the_inverse_of_the_way_there(surface, seed):
    tables = mesh_tables(surface(seed), SLOTS, seed)
    for rings in (tables.fine, tables.coarse):
        there = rings.transports
        np.testing.assert_array_equal(there[rings.neighbors, rings.reverse], there.conj())
        np.testing.assert_allclose(np.abs(there), 1, atol=1e-6)
        back = rings.logs[rings.neighbors, rings.reverse]
        np.testing.assert_allclose(there * back, -rings.logs, atol=2e-6)
        assert np.abs(rings.logs[in_use(rings)]).min() > 0.2


@given(seeds)
@pytest.mark.parametrize("fold", [0, 1.9])
def test_flat_logs_are_differences_of_position_at_both_levels(fold, seed):
    flat = sheet(seed)
    tables = mesh_tables(folded(flat, fold), SLOTS, seed)
    a, b, c = flat.vertices[flat.faces.T]
    area = np.cross(b - a, c - a)[:, 2].sum() / 2
    position, axes = flat_axes(flat)
    centers = tables.pooling.centers
    for rings, at in ((tables.fine, np.arange(len(position))), (tables.coarse, centers)):
        radius = np.sqrt(area / (np.pi * len(at)))
        there = position[at[rings.neighbors]] - position[at][:, None]
        np.testing.assert_allclose(rings.logs, there * axes[at].conj()[:, None] / radius, atol=1e-5)


@given(seeds)
def test_parallel_fields_of_a_flat_mesh_survive_rings_pooling_and_unpooling(seed):
    mesh = sheet(seed)
    tables = mesh_tables(folded(mesh), SLOTS, seed)
    _, axes = flat_axes(mesh)
    parallel = np.exp(1j * seed) * axes.conj()
    coarse = pool(tables.pooling, parallel)
    assert np.abs(np.diff(parallel)).max() > 0.5  # the frames do turn
    np.testing.assert_allclose(ring_mean(tables.fine, parallel), parallel, atol=1e-6)
    np.testing.assert_allclose(coarse, parallel[tables.pooling.centers], atol=1e-6)
    np.testing.assert_allclose(ring_mean(tables.coarse, coarse), coarse, atol=1e-6)
    np.testing.assert_allclose(unpool(tables.pooling, coarse), parallel, atol=1e-6)


def test_hexagonal_grid_has_the_lattice_for_logs():
    rows, columns = 9, 11
    r, c = np.divmod(np.arange(rows * columns), columns)
    flat = c - 0.5 * r + r * np.sqrt(0.75) * 1j
    faces = grid_faces(rows, columns)[:, [0, 2, 1]]
    points = np.stack([flat.real, flat.imag, 0 * flat.real], axis=1)
    mesh = Triangulation(points, faces)
    rings = one_rings(tangent_frames(mesh))
    inside = (r > 0) & (r < rows - 1) & (c > 0) & (c < columns - 1)
    radius = np.sqrt((rows - 1) * (columns - 1) * np.sqrt(0.75) / (np.pi * rows * columns))
    lattice = np.exp(1j * np.pi / 3 * np.arange(6)) / radius  # counter-clockwise from the first edge
    np.testing.assert_allclose(rings.logs[inside, 1:], np.tile(lattice, (inside.sum(), 1)), atol=1e-6)
    deep = inside[rings.neighbors].all(axis=1)
    assert deep.sum() > 20
    np.testing.assert_allclose(rings.weights[deep], 1 / 7, rtol=1e-6)


# ---- what the tables may depend on ---------------------------------------------------------------------


@given(seeds, st.floats(0.01, 100))
@surfaces
def test_rigid_motion_and_scale_change_nothing(surface, seed, scale):
    mesh = surface(seed)
    assert_same_tables(mesh_tables(moved(mesh, seed, scale), SLOTS), mesh_tables(mesh, SLOTS), atol=2e-6)


@given(seeds)
@pytest.mark.parametrize("jitter", [0.2, 0.0])
def test_folding_along_edges_changes_nothing(jitter, seed):
    """Without jitter most paths tie, and must tie in both."""
    flat = sheet(seed, jitter=jitter)
    assert_same_tables(mesh_tables(folded(flat), SLOTS), mesh_tables(flat, SLOTS), atol=2e-6)


@given(seeds)
@surfaces
def test_other_frames_turn_logs_and_transports_and_nothing_else(surface, seed):
    """The order of faces decides where interior rings start: another order is another gauge."""
    mesh = surface(seed)
    rng = np.random.default_rng(seed)
    before = mesh_tables(mesh, SLOTS)
    shuffled = Triangulation(mesh.vertices, rng.permutation(mesh.faces))
    after = mesh_tables(shuffled, SLOTS)
    np.testing.assert_array_equal(after.pooling.centers, before.pooling.centers)
    np.testing.assert_array_equal(after.pooling.parents, before.pooling.parents)
    frames, again = tangent_frames(mesh), tangent_frames(shuffled)
    place = (frames.neighbors == again.neighbors[:, :1]).argmax(axis=1)
    gauge = frames.directions[np.arange(len(place)), place].conj()  # the old x axis in the new frame
    assert np.abs(gauge - 1).max() > 0.1
    centers, parents = before.pooling.centers, before.pooling.parents
    np.testing.assert_allclose(
        after.pooling.transports,
        gauge[centers[parents]] * before.pooling.transports * gauge.conj(),
        atol=1e-5,
    )
    for rings, turned, g in (
        (before.fine, after.fine, gauge),
        (before.coarse, after.coarse, gauge[centers]),
    ):
        old, new = (np.argsort(r.neighbors + 10**6 * ~in_use(r), axis=1) for r in (rings, turned))
        q = np.take_along_axis(rings.neighbors, old, 1)
        np.testing.assert_array_equal(np.take_along_axis(turned.neighbors, new, 1), q)
        for name, factor in (
            ("logs", g[:, None]),
            ("transports", g[:, None] * g[q].conj()),
            ("weights", np.ones(1)),
        ):
            expected = factor * np.take_along_axis(getattr(rings, name), old, 1)
            np.testing.assert_allclose(
                np.take_along_axis(getattr(turned, name), new, 1), expected, atol=1e-5, err_msg=name
            )


# ---- pooling -------------------------------------------------------------------------------------------


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


# ---- errors --------------------------------------------------------------------------------------------


def test_ring_too_large_is_refused_by_name():
    spokes = 19
    turn = np.exp(2j * np.pi * np.arange(spokes) / spokes)
    points = np.insert(np.stack([turn.real, turn.imag, 0 * turn.real], axis=1), 7, 0, axis=0)
    rim = np.delete(np.arange(spokes + 1), 7)
    wheel = Triangulation(points, np.stack([np.full(spokes, 7), rim, np.roll(rim, -1)], axis=1))
    with pytest.raises(
        ValueError, match=r"vertex 7 has 19 neighbours but the table has 16 slots.*surface\.slots"
    ):
        mesh_tables(wheel)
    with pytest.raises(ValueError, match="vertex 7 has 19"):
        mesh_tables(wheel, 19)
    assert mesh_tables(wheel, 20).fine.neighbors.shape[1] == 20


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


# ---- copies and files ----------------------------------------------------------------------------------


@given(seeds)
def test_padding_of_stacked_copies_is_inert(seed):
    copies = [mesh_tables(m, SLOTS, seed) for m in (uneven_sphere(seed, 120), bump(seed), uneven_torus(seed))]
    stacked = stack(copies)
    rng = np.random.default_rng(seed)
    vertices, clusters = stacked.fine.masses.shape[1], stacked.coarse.masses.shape[1]
    assert vertices > 120 == len(copies[0].fine.masses)
    for level in (stacked.fine, stacked.coarse):
        np.testing.assert_allclose(level.masses.sum(axis=1), 1, rtol=1e-5)
    for i, alone in enumerate(copies):
        fine, pooling, coarse = (type(level)(*(array[i] for array in level)) for level in stacked)
        for rings in (fine, coarse):
            count, width = rings.neighbors.shape
            p, k = np.meshgrid(np.arange(count), np.arange(width), indexing="ij")
            np.testing.assert_array_equal(rings.neighbors[rings.neighbors, rings.reverse], p)
            np.testing.assert_array_equal(rings.reverse[rings.neighbors, rings.reverse], k)
            spare = (rings.weights == 0) & (k > 0)
            assert (rings.neighbors == p)[spare].all()
            assert (rings.logs == 0)[spare].all()
            assert (rings.transports == 1)[spare].all()
        v, w = len(alone.fine.masses), len(alone.coarse.masses)
        assert (fine.masses[v:] == 0).all()
        assert (coarse.masses[w:] == 0).all()
        assert (pooling.child_weights[w:] == 0).all()
        np.testing.assert_array_equal(np.sort(pooling.children[pooling.child_weights > 0]), np.arange(v))
        values, values_coarse = rng.normal(size=(2, max(vertices, clusters))) * (1 + 2j)
        values, values_coarse = values[:vertices], values_coarse[:clusters]  # spare rows hold garbage
        close = {"rtol": 0, "atol": 1e-6}
        np.testing.assert_allclose(ring_mean(fine, values)[:v], ring_mean(alone.fine, values[:v]), **close)
        np.testing.assert_allclose(
            ring_mean(coarse, values_coarse)[:w], ring_mean(alone.coarse, values_coarse[:w]), **close
        )
        np.testing.assert_allclose(pool(pooling, values)[:w], pool(alone.pooling, values[:v]), **close)
        np.testing.assert_allclose(
            unpool(pooling, values_coarse)[:v], unpool(alone.pooling, values_coarse[:w]), **close
        )


def test_stacking_one_copy_adds_an_axis_and_nothing_else():
    alone = mesh_tables(uneven_torus(0), SLOTS)
    stacked = stack([alone])
    first = MeshTables(*(type(level)(*(array[0] for array in level)) for level in stacked))
    assert_same_tables(first, alone)


def test_tables_survive_the_disk_bit_for_bit(tmp_path):
    tables = mesh_tables(bump(0), SLOTS)
    save_tables(tmp_path / "copy", tables)
    assert_same_tables(load_tables(tmp_path / "copy"), tables)
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_interrupted_save_leaves_the_old_file(tmp_path, monkeypatch):
    old, new = mesh_tables(bump(0), SLOTS), mesh_tables(bump(1), SLOTS)
    save_tables(tmp_path / "copy.npz", old)

    def interrupted(file, **arrays):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_tables(tmp_path / "copy.npz", new)
    assert_same_tables(load_tables(tmp_path / "copy.npz"), old)
    assert [path.name for path in tmp_path.iterdir()] == ["copy.npz"]


def test_file_that_holds_no_tables_is_refused(tmp_path):
    path = tmp_path / "copy.npz"
    save_tables(path, mesh_tables(bump(0), SLOTS))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ValueError, match="holds no mesh tables"):
        load_tables(path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(ValueError, match=r"holds no mesh tables.*fine\.neighbors"):
        load_tables(path)
    np.savez(path, **{"fine.neighbors": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(ValueError, match=r"holds no mesh tables.*pickle"):
        load_tables(path)
