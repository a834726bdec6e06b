"""Laws of repair: what comes out is a manifold of the same triangles, and every change is counted."""

from unittest.mock import patch

import igl
import numpy as np
import pytest
from helpers.surfaces import icosphere, random_sphere, soup
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from flx.geometry.repair import WELD_TOLERANCE, repair, topology_counts, weld


def assert_manifold(vertices: np.ndarray, faces: np.ndarray) -> None:
    """No directed edge twice, and the faces round each vertex form one fan."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert set(faces.ravel()) == set(range(len(vertices)))
    for vertex in range(len(vertices)):
        links = [np.roll(f, -list(f).index(vertex))[1:] for f in faces[(faces == vertex).any(1)]]
        follow = {int(a): int(b) for a, b in links}
        starts = [a for a in follow if a not in follow.values()] or [next(iter(follow))]
        assert len(starts) == 1
        length, at = 0, starts[0]
        while at in follow and length < len(follow):
            at, length = follow[at], length + 1
        assert length == len(links)


def corners_agree(points: np.ndarray, faces: np.ndarray, fixed) -> bool:
    return np.allclose(fixed.vertices[fixed.faces], points[faces[fixed.sources]], rtol=0, atol=1e-8)


@given(st.integers(8, 60), st.integers(0, 1000))
def test_weld_joins_what_a_soup_of_triangles_took_apart(count, seed):
    points, faces = random_sphere(count, seed)
    split_points, split_faces = soup(points, faces)
    jitter = np.random.default_rng(seed).uniform(-1, 1, split_points.shape) * 1e-11
    fixed = repair(split_points + jitter, split_faces)
    assert len(fixed.vertices) == count and fixed.repairs.welded_vertices == 3 * len(faces) - count
    found = topology_counts(fixed.vertices, fixed.faces)
    assert (found.components, found.boundary_edges, found.boundary_loops, found.euler) == (1, 0, 0, 2)
    assert corners_agree(split_points, split_faces, fixed)
    assert_manifold(fixed.vertices, fixed.faces)


@settings(max_examples=100)
@given(st.integers(1, 60), st.integers(1, 3), st.integers(0, 10**6))
def test_weld_joins_chains_of_points_within_the_tolerance_to_their_first(count, side, seed):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, side, (count, 3)) + 0.0
    spread = WELD_TOLERANCE * np.linalg.norm(np.ptp(points, axis=0))
    points += rng.choice([0, 0.45, 0.9, 1.5, 4], (count, 3)) * spread
    tolerance = WELD_TOLERANCE * np.linalg.norm(np.ptp(points, axis=0))
    near = np.linalg.norm(points[:, None] - points, axis=2) <= tolerance
    groups = connected_components(near, directed=False)[1]
    first = np.array([np.flatnonzero(groups == group)[0] for group in groups])
    np.testing.assert_array_equal(weld(points), first)


def test_points_further_apart_than_the_tolerance_stay_apart():
    points, faces = random_sphere(30, 0)
    split_points, split_faces = soup(points, faces)
    fixed = repair(
        split_points + np.random.default_rng(0).normal(size=split_points.shape) * 1e-5, split_faces
    )
    assert fixed.repairs.welded_vertices == 0


def test_a_vertex_so_far_off_that_all_others_are_one_is_named_before_they_are_paired():
    """The pairs of 10,242 vertices are 5 s and 2.5 GB; those of a million would never end."""
    points, faces = icosphere(5)
    with pytest.raises(ValueError, match=r"a vertex at \[0.0, -1000000000000.0, 0.0\] is so far off"):
        repair(np.concatenate([points, [[0, -1e12, 0]]]), faces)


@given(st.integers(10, 40), st.integers(0, 1000))
def test_a_clean_mesh_is_left_alone(count, seed):
    points, faces = random_sphere(count, seed)
    fixed = repair(points, faces)
    assert np.array_equal(fixed.vertices, points) and np.array_equal(fixed.faces, faces)
    assert sum(fixed.repairs) == 0


@given(st.integers(0, 1000), st.integers(0, 5), st.integers(0, 5), st.integers(0, 4))
def test_each_fault_put_in_is_counted_and_taken_out(seed, degenerate, duplicate, unused):
    points, faces = random_sphere(25, seed)
    rng = np.random.default_rng(seed)
    bad = faces[rng.choice(len(faces), degenerate + duplicate)].copy()
    bad[:degenerate, 2] = bad[:degenerate, 0]
    copies = bad[degenerate : degenerate + duplicate]
    copies[:] = faces[rng.choice(len(faces), duplicate, replace=False)][:, [1, 2, 0]]
    copies[::2] = copies[::2, ::-1]  # the back of a face is a duplicate too
    broken = np.concatenate([points, [[np.nan, 0, 0]], rng.normal(size=(unused, 3)) + 9])
    all_faces = np.concatenate([faces, bad])
    fixed = repair(broken, all_faces)
    assert fixed.repairs._asdict() == {
        "welded_vertices": 0,
        "degenerate_faces": degenerate,
        "ear_faces": 0,
        "duplicate_faces": duplicate,
        "unused_vertices": unused + 1,
        "nonmanifold_edges": 0,
        "disagreeing_edges": 0,
        "nonmanifold_vertices": 0,
        "split_vertices": 0,
    }
    assert np.array_equal(fixed.faces, faces) and np.array_equal(fixed.vertices, points)


def test_a_fin_is_cut_from_its_edge():
    points, faces = random_sphere(20, 1)
    fin = np.array([[faces[0, 0], faces[0, 1], len(points)]])
    fixed = repair(np.vstack([points, 2 * points[:1]]), np.vstack([faces, fin]))
    assert fixed.repairs.nonmanifold_edges == 1 and fixed.repairs.split_vertices > 0
    assert len(fixed.faces) == len(faces) + 1
    assert_manifold(fixed.vertices, fixed.faces)


def test_a_bow_tie_vertex_becomes_two():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0.0]])
    fixed = repair(points, np.array([[0, 1, 2], [0, 3, 4]]))
    assert (fixed.repairs.split_vertices, fixed.repairs.nonmanifold_edges) == (1, 0)
    assert topology_counts(fixed.vertices, fixed.faces)[:4] == (2, 6, 2, 2)
    assert_manifold(fixed.vertices, fixed.faces)


def test_a_turned_face_is_counted_and_cut_not_turned():
    points, faces = random_sphere(20, 2)
    faces[3] = faces[3, ::-1]
    fixed = repair(points, faces)
    assert fixed.repairs.disagreeing_edges == 3
    assert corners_agree(points, faces, fixed)
    assert_manifold(fixed.vertices, fixed.faces)


@st.composite
def many_or_few_faces(draw) -> np.ndarray:
    """Faces of three different corners, no two alike: any over few points, or some of a sphere's, where two
    vertices may have become one. Now and then a manifold.
    """
    if draw(st.booleans()):
        corners = st.lists(st.integers(0, draw(st.integers(2, 7))), min_size=3, max_size=3, unique=True)
        faces = np.array(draw(st.lists(corners, min_size=1, max_size=12)))
    else:
        sphere = random_sphere(draw(st.integers(6, 20)), draw(st.integers(0, 1000))).faces
        faces = sphere[draw(st.lists(st.integers(0, len(sphere) - 1), min_size=1, max_size=len(sphere)))]
        one, other = draw(st.sampled_from(faces.ravel())), draw(st.sampled_from(faces.ravel()))
        merged = np.where(faces == one, other, faces)
        merged = merged[(merged != np.roll(merged, 1, 1)).all(1)]
        faces = merged if len(merged) else faces
    faces = faces[np.unique(np.sort(faces, 1), axis=0, return_index=True)[1]]
    return np.unique(faces, return_inverse=True)[1].reshape(-1, 3)


@pytest.mark.slow
@settings(max_examples=300)
@given(many_or_few_faces())
def test_vertices_are_split_exactly_where_libigl_splits_any(faces):
    count = int(faces.max()) + 1
    place = igl.split_nonmanifold(faces)[1]
    with patch.object(igl, "split_nonmanifold", wraps=igl.split_nonmanifold) as asked:
        fixed = repair(np.random.default_rng(0).normal(size=(count, 3)), faces)
    assert asked.called == (len(place) > count)
    assert len(fixed.vertices) == len(place) == count + fixed.repairs.split_vertices
    assert fixed.topology == topology_counts(fixed.vertices, fixed.faces)
    assert_manifold(fixed.vertices, fixed.faces)


@pytest.mark.parametrize("turn", [[0, 1, 2], [2, 1, 0]])
def test_a_doubled_ear_is_dropped_and_the_surface_is_whole(turn):
    points, faces = random_sphere(20, 3)
    ear = np.array([faces[0, 0], faces[0, 1], len(points)])
    broken = np.vstack([points, 2 * points[:1]])
    fixed = repair(broken, np.vstack([faces, ear, ear[turn]]))
    assert fixed.repairs.ear_faces == 2 and fixed.repairs.nonmanifold_edges == 0
    assert np.array_equal(fixed.faces, faces)


def test_a_sheet_with_a_back_keeps_one_side():
    grid = np.array([[x, y, 0.0] for y in range(4) for x in range(4)])
    quads = [4 * y + x for y in range(3) for x in range(3)]
    front = np.array([t for q in quads for t in ([q, q + 1, q + 5], [q, q + 5, q + 4])])
    fixed = repair(grid, np.concatenate([front, front[:, ::-1]]))
    assert fixed.repairs.duplicate_faces == len(front) and fixed.repairs.ear_faces == 0
    assert np.array_equal(fixed.faces, front)
    assert topology_counts(fixed.vertices, fixed.faces)[:4] == (1, 12, 1, 1)


def test_nothing_left_is_an_error():
    with pytest.raises(ValueError, match="no triangles"):
        repair(np.zeros((3, 3)), np.array([[0, 1, 2]]))
