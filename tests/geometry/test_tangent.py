"""Laws of the intrinsic tangent geometry, on spheres, tori and sheets."""

import numpy as np
import potpourri3d
import pytest
from helpers.surfaces import both, bump, folded, moved, sheet, uneven_sphere, uneven_torus
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.geometry.tables import one_rings
from flx.geometry.tangent import (
    TangentFrames,
    corner_logs,
    mean_vertex_radius,
    tangent_frames,
    transports,
    vertex_masses,
)
from flx.types import Triangulation

seeds = st.integers(0, 10**6)


def dense(frames: TangentFrames, values: np.ndarray) -> np.ndarray:
    """Values of ring slots as a V × V matrix, zero off the rings."""
    p, k = np.nonzero(frames.neighbors >= 0)
    matrix = np.zeros((len(frames.neighbors),) * 2, values.dtype)
    matrix[p, frames.neighbors[p, k]] = values[p, k]
    return matrix


def holonomies(mesh: Triangulation) -> np.ndarray:
    """The turn of a vector carried counter-clockwise around each face."""
    frames = tangent_frames(mesh)
    transport = dense(frames, transports(frames))
    i, j, k = mesh.faces.T
    return np.angle(transport[i, k] * transport[k, j] * transport[j, i])


@given(seeds)
@pytest.mark.parametrize("surface", [uneven_sphere, uneven_torus, bump])
def test_holonomies_are_those_of_the_vector_heat_connection(surface, seed):
    mesh = surface(seed)
    solver = potpourri3d.MeshVectorHeatSolver(mesh.vertices, mesh.faces, use_intrinsic_delaunay=False)
    laplacian = solver.get_connection_laplacian().toarray()
    i, j, k = mesh.faces.T
    edges = np.stack([laplacian[i, k], laplacian[k, j], laplacian[j, i]])
    inside = ~tangent_frames(mesh).boundary[mesh.faces].any(axis=1)  # it scales boundaries to π, we do not
    used = inside & (np.abs(edges) > 1e-6).all(axis=0)
    assert used.sum() > 100
    loop = np.prod(edges / np.abs(edges), axis=0)[used] * np.exp(-1j * holonomies(mesh)[used])
    assert np.abs(np.angle(loop**2)).max() < 2e-12  # squared: a negative cotangent weight turns the sign


@given(seeds)
def test_holonomies_of_a_closed_surface_add_up_to_two_pi_chi(seed):
    for mesh, chi in (
        (uneven_sphere(seed), 2),
        (uneven_torus(seed), 0),
        (both(uneven_sphere(seed), uneven_sphere(seed + 1)), 4),
    ):
        turns = holonomies(mesh)
        assert np.abs(turns).max() > 1e-3
        np.testing.assert_allclose(turns.sum(), 2 * np.pi * chi, atol=1e-10)


@given(seeds)
def test_flat_sheet_is_flat_up_to_its_boundary(seed):
    mesh = sheet(seed)
    frames = tangent_frames(mesh)
    assert np.abs(holonomies(mesh)).max() < 1e-12
    np.testing.assert_allclose(frames.scales, 1, atol=1e-12)
    rows, columns = 15, 13
    r, c = np.divmod(np.arange(rows * columns), columns)
    ends = (r == 0) | (r == rows - 1) | (c == 0) | (c == columns - 1)
    assert (frames.boundary == ends).all()


@given(seeds)
def test_folding_along_edges_changes_nothing(seed):
    flat = sheet(seed)
    bent = folded(flat)
    assert np.ptp(bent.vertices[:, 2]) > 3
    for before, after in zip(tangent_frames(flat), tangent_frames(bent), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(vertex_masses(bent), vertex_masses(flat), atol=1e-12)


@given(seeds, st.floats(0.01, 100))
def test_rigid_motion_changes_nothing_and_scale_only_lengths(seed, scale):
    mesh = both(uneven_sphere(seed, 100), bump(seed))
    before, after = tangent_frames(mesh), tangent_frames(moved(mesh, seed, scale))
    for name in TangentFrames._fields:
        factor = {"lengths": scale, "radius": scale, "masses": scale**2}.get(name, 1)
        np.testing.assert_allclose(
            getattr(after, name), factor * getattr(before, name), rtol=1e-11, atol=1e-11 * factor
        )
    np.testing.assert_allclose(
        mean_vertex_radius(moved(mesh, seed, scale)), scale * mean_vertex_radius(mesh), rtol=1e-12
    )


@given(seeds)
def test_renumbering_turns_frames_and_nothing_else(seed):
    mesh = both(uneven_sphere(seed, 80), bump(seed))
    rng = np.random.default_rng(seed)
    new = rng.permutation(len(mesh.vertices))  # new number of each vertex
    old = np.argsort(new)
    renumbered = Triangulation(mesh.vertices[old], rng.permutation(new[mesh.faces]))
    a, b = tangent_frames(mesh), tangent_frames(renumbered)
    before, after = dense(a, a.directions), dense(b, b.directions)[np.ix_(new, new)]
    assert ((before == 0) == (after == 0)).all()
    gauge = (after * before.conj()).sum(axis=1) / (before != 0).sum(axis=1)
    np.testing.assert_allclose(after, gauge[:, None] * before, atol=1e-12)
    assert np.abs(gauge - 1).max() > 0.1
    turned = gauge[:, None] * dense(a, transports(a)) * gauge.conj()
    np.testing.assert_allclose(dense(b, transports(b))[np.ix_(new, new)], turned, atol=1e-12)


@given(seeds)
def test_reverse_finds_the_way_back_and_transport_carries_the_edge_along(seed):
    mesh = both(uneven_torus(seed), bump(seed))
    frames = tangent_frames(mesh)
    p, k = np.nonzero(frames.neighbors >= 0)
    q, back = frames.neighbors[p, k], frames.reverse[p, k]
    assert (frames.neighbors[q, back] == p).all()
    assert (frames.reverse[q, back] == k).all()
    transport, directions = transports(frames), frames.directions
    np.testing.assert_allclose(transport[p, k], transport[q, back].conj(), atol=1e-15)
    np.testing.assert_allclose(transport[p, k] * directions[q, back], -directions[p, k], atol=1e-14)


@given(seeds)
def test_rings_run_counter_clockwise_with_each_neighbour_once(seed):
    mesh = both(uneven_sphere(seed, 80), bump(seed))
    frames = tangent_frames(mesh)
    edges = {(int(f[i]), int(f[j])) for f in mesh.faces for i, j in ((0, 1), (1, 2), (2, 0))}
    for p, ring in enumerate(frames.neighbors):
        ring = ring[ring >= 0].tolist()
        theta = np.angle(frames.directions[p, : len(ring)]) % (2 * np.pi)
        assert theta[0] == 0
        assert (np.diff(theta) > 0).all()
        assert len(set(ring)) == len(ring)
        assert set(ring) == {b for a, b in edges if a == p} | {a for a, b in edges if b == p}
        if frames.boundary[p]:
            assert (ring[0], p) not in edges
            assert (p, ring[-1]) not in edges
        following = zip(ring, ring[1:] if frames.boundary[p] else ring[1:] + ring[:1], strict=False)
        assert all((a, b) in edges for a, b in following)


@given(seeds)
def test_masses_share_out_the_area(seed):
    mesh = sheet(seed, jitter=0)
    assert vertex_masses(mesh).sum() == pytest.approx(14 * 12)
    assert mean_vertex_radius(mesh) == pytest.approx(np.sqrt(14 * 12 / np.pi / (15 * 13)))
    inside = ~tangent_frames(mesh).boundary
    np.testing.assert_allclose(vertex_masses(mesh)[inside].mean(), 1, atol=0.1)
    assert (vertex_masses(mesh) > 0).all()


@given(seeds)
def test_corner_logs_are_differences_of_position_on_a_flat_mesh(seed):
    mesh = folded(sheet(seed))
    flat = sheet(seed).vertices[:, :2] @ [1, 1j]
    frames = tangent_frames(mesh)
    axis = flat[frames.neighbors[:, 0]] - flat
    axis /= np.abs(axis)
    faces = np.arange(len(mesh.faces))
    barycentrics = np.random.default_rng(seed).dirichlet(np.ones(3), len(faces))
    corners = mesh.faces[faces]
    point = (flat[corners] * barycentrics).sum(axis=1, keepdims=True)
    expected = (point - flat[corners]) * axis[corners].conj() / mean_vertex_radius(mesh)
    np.testing.assert_allclose(corner_logs(frames, mesh, faces, barycentrics), expected, atol=1e-12)


@given(seeds)
def test_corner_logs_meet_the_ring_at_vertices_and_agree_across_edges(seed):
    mesh = both(uneven_sphere(seed, 100), bump(seed))
    frames = tangent_frames(mesh)
    faces = np.arange(len(mesh.faces))
    ring = dense(frames, frames.lengths * frames.directions) / mean_vertex_radius(mesh)
    for corner in range(3):
        logs = corner_logs(frames, mesh, faces, np.tile(np.eye(3)[corner], (len(faces), 1)))
        np.testing.assert_allclose(logs, ring[mesh.faces, mesh.faces[:, [corner]]], atol=1e-12)
    # A point of edge ab in one face, and the same point in the face on the edge's other side.
    share = np.random.default_rng(seed).uniform(0.1, 0.9)
    on_edge = corner_logs(frames, mesh, faces, np.tile([1 - share, share, 0], (len(faces), 1)))
    a, b, _ = mesh.faces.T
    np.testing.assert_allclose(on_edge[:, 0], share * ring[a, b], atol=1e-12)
    np.testing.assert_allclose(on_edge[:, 1], (1 - share) * ring[b, a], atol=1e-12)


def test_vertex_without_faces_has_an_empty_ring():
    mesh = sheet(0)
    lonely = Triangulation(np.concatenate([mesh.vertices, [[9.0, 9.0, 9.0]]]), mesh.faces)
    frames = tangent_frames(lonely)
    assert (frames.neighbors[-1] == -1).all()
    assert frames.boundary[-1]
    assert vertex_masses(lonely)[-1] == 0


def test_edge_with_two_faces_on_one_side_is_refused_by_name():
    points = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(ValueError, match="edge 0 → 1 has two faces on one side"):
        tangent_frames(Triangulation(points, np.array([[0, 1, 2], [0, 1, 3]])))


def test_vertex_of_two_fans_is_refused_by_name():
    points = np.random.default_rng(0).normal(size=(7, 3))
    with pytest.raises(ValueError, match="vertex 2 joins several fans"):
        tangent_frames(Triangulation(points, np.array([[0, 1, 2], [3, 2, 4]])))


@settings(max_examples=20)
@given(st.integers(3, 160), st.booleans(), st.floats(0, 3), st.integers(0, 10**6))
def test_rings_of_any_valence_close_or_stay_open(valence, closed, height, seed):
    """A cone of `valence` spokes: interior angles fill the circle; at a boundary they are left alone."""
    rng = np.random.default_rng(seed)
    turn = np.sort(rng.permutation(4 * valence)[:valence]) if not closed else 4 * np.arange(valence)
    turn = turn * (np.pi / 2 / valence) * (1.0 if closed else 0.7)
    rim = np.stack([np.cos(turn), np.sin(turn), np.full(valence, -height)], 1)
    points = np.concatenate([np.zeros((1, 3)), rim])
    spokes = 1 + np.arange(valence)
    faces = np.stack([np.zeros(valence, np.int64), spokes, np.roll(spokes, -1)], 1)
    cone = Triangulation(points, faces if closed else faces[:-1])
    frames = tangent_frames(cone)
    rings = one_rings(frames, slots=valence + 1)
    assert (rings.neighbors[0, 1:] == spokes).all()
    logs = rings.logs[0, 1:].astype(complex)
    radius = np.sqrt(1 + height**2) / mean_vertex_radius(cone)
    np.testing.assert_allclose(np.abs(logs), radius, rtol=1e-5)
    chords = np.linalg.norm(rim - np.roll(rim, -1, 0), axis=1)
    angles = 2 * np.arcsin(np.minimum(chords / 2 / np.sqrt(1 + height**2), 1))[: valence if closed else -1]
    steps = angles * (2 * np.pi / angles.sum()) if closed else angles
    theta = np.concatenate([[0], np.cumsum(steps)])[:valence]
    np.testing.assert_allclose(logs, radius * np.exp(1j * theta), atol=1e-4 * radius)
    with pytest.raises(
        ValueError, match=f"vertex 0 has {valence} neighbours but the table has {valence} slots"
    ):
        one_rings(frames, slots=valence)
