"""Laws of the gather tables: one-rings, frames, padding."""

import numpy as np
import pytest
from helpers.surfaces import bump, folded, grid_faces, moved, sheet, uneven_sphere, uneven_torus
from helpers.tables import SLOTS, assert_same_tables, in_use, pool, ring_mean, surfaces, unpool
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.tables import mesh_tables, one_rings, stack
from flx.geometry.tangent import tangent_frames
from flx.types import MeshTables, OneRings, Pooling, Triangulation

seeds = st.integers(0, 10**6)


def flat_axes(mesh: Triangulation) -> tuple[np.ndarray, np.ndarray]:
    """Positions in a flat sheet and the x axes of its frames, as complex numbers."""
    flat = mesh.vertices[:, :2] @ [1, 1j]
    axes = flat[tangent_frames(mesh).neighbors[:, 0]] - flat
    return flat, axes / np.abs(axes)


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
