"""Laws of remeshing: exact counts, kept topology, vertices on the surface, independent copies."""

import os
from itertools import combinations
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from helpers.oracles import (
    assert_sound,
    boundary_loops,
    coincidence,
    components,
    distances,
    edge_length,
    min_angles,
    points_on,
)
from helpers.surfaces import both, box, globe, icosphere, square_with_hole, torus
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.geometry.remesh.remesh import remesh
from flx.types import Triangulation

TWO_SPHERES = both(icosphere(3), icosphere(2), apart=3)
SURFACES = {
    "sphere": lambda: icosphere(4),
    "torus": lambda: torus(48, 24),
    "two spheres": lambda: TWO_SPHERES,
    "box": lambda: box(1.0, 1.0, 1.0),
    "thin box": lambda: box(1.0, 1.0, 0.03),
    "square with hole": square_with_hole,
    "globe": globe,
}


@pytest.mark.slow
@pytest.mark.parametrize("count", [500, 1300])
@pytest.mark.parametrize("name", SURFACES)
def test_remeshing_hits_the_count_and_keeps_topology_and_place(name, count):
    surface = SURFACES[name]()
    mesh = remesh(*surface, count, seed=1)
    assert len(mesh.vertices) == count
    assert_sound(mesh)
    assert components(mesh.faces) == components(surface.faces)
    assert boundary_loops(mesh.faces) == boundary_loops(surface.faces)
    assert igl.euler_characteristic(mesh.faces) == igl.euler_characteristic(surface.faces)
    assert distances(mesh.vertices, surface).max() < 0.02 * edge_length(mesh)
    assert distances(points_on(mesh), surface).max() < 0.35 * edge_length(mesh)
    assert distances(points_on(surface), mesh).max() < 0.35 * edge_length(mesh)


def test_remeshing_keeps_the_outside_outside():
    surface = box(1.0, 0.8, 0.5)
    volume = trimesh.Trimesh(*remesh(*surface, 600, seed=0), process=False).volume
    assert volume == pytest.approx(0.4, rel=0.01)


@pytest.mark.slow
@settings(max_examples=8)
@given(st.integers(60, 1500), st.integers(0, 2**32 - 1))
def test_any_count_of_any_seed_is_exact(count, seed):
    mesh = remesh(*torus(48, 24), count, seed)
    assert len(mesh.vertices) == count
    assert igl.euler_characteristic(mesh.faces) == 0
    assert_sound(mesh)


@pytest.mark.slow
@pytest.mark.parametrize(("subdivisions", "count"), [(0, 2000), (5, 500), (3, 642)])
def test_much_coarser_denser_and_equal_inputs_give_even_and_independent_copies(subdivisions, count):
    surface = icosphere(subdivisions)
    a, b = remesh(*surface, count, seed=0), remesh(*surface, count, seed=1)
    assert len(a.vertices) == len(b.vertices) == count
    assert np.percentile(min_angles(a), 1) > 35
    assert coincidence(a, b) <= 0.06 + 2 * np.sqrt(0.036 / count)  # two standard errors of a share
    assert len(surface.vertices) > count or coincidence(surface, b) <= 0.06 + 2 * np.sqrt(0.036 / count)


def test_same_seed_same_bits():
    a, b, c = (remesh(*torus(48, 24), 700, seed) for seed in (3, 3, 4))
    assert a.vertices.tobytes() == b.vertices.tobytes() and a.faces.tobytes() == b.faces.tobytes()
    assert a.vertices.tobytes() != c.vertices.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("thickness", [1.0, 0.2])
def test_creases_of_a_box_are_edges_of_every_copy(thickness):
    mesh = remesh(*box(1.0, 1.0, thickness), 800, seed=2)
    half = np.array([0.5, 0.5, thickness / 2])
    corners = half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    ridges = [(a, b) for a, b in combinations(corners, 2) if (np.abs(a - b) > 1e-9).sum() == 1]
    assert len(ridges) == 12
    t = np.linspace(0, 1, 50)[:, None]
    ridge_points = np.concatenate([a + t * (b - a) for a, b in ridges])
    assert distances(ridge_points, mesh).max() < 0.01 * edge_length(mesh)


def test_boundaries_stay_on_the_boundary():
    mesh = remesh(*square_with_hole(), 700, seed=0)
    rim = mesh.vertices[np.unique(igl.boundary_facets(mesh.faces)[0])][:, :2]
    hole = np.abs(rim - 0.5).max(1)
    assert np.minimum(np.abs(hole - 0.5), np.abs(hole - 0.15)).max() < 1e-9
    # Both boundaries are covered, corners included: the area is the square's without the hole's.
    assert igl.doublearea(*mesh).sum() / 2 == pytest.approx(1 - 0.3**2, rel=1e-9)


def test_poles_of_high_valence_become_ordinary_vertices():
    surface, mesh = globe(), remesh(*globe(), 1500, seed=0)
    assert np.bincount(surface.faces.ravel()).max() == 160
    assert np.bincount(mesh.faces.ravel()).max() <= 9
    assert np.percentile(min_angles(mesh), 1) > 35


def test_unfit_meshes_and_counts_are_refused_in_one_line():
    vertices, faces = icosphere(2)
    fin = np.concatenate([faces, [[faces[0, 0], faces[0, 1], 100]]])
    turned = np.concatenate([faces[:1, ::-1], faces[1:]])
    touching = TWO_SPHERES.faces
    touching[touching == touching.max()] = 0
    spare = np.concatenate([vertices, [[0.0, 0.0, 0.0]]])
    for bad, count, word in (
        ((vertices, fin), 100, "more than two faces"),
        ((vertices, turned), 100, "orient"),
        ((TWO_SPHERES.vertices[:-1], touching), 100, "fans"),
        ((spare, faces), 100, "fans"),
        ((vertices, faces), 3, "more vertices"),
        (torus(48, 24), 5, "more vertices"),
    ):
        with pytest.raises(ValueError, match=word) as error:
            remesh(*bad, count, seed=0)
        assert "\n" not in str(error.value)


def test_coincidence_counts_vertices_within_a_tenth_of_an_edge():
    a = icosphere(3)
    length = igl.edge_lengths(*a).mean()
    half = np.arange(len(a.vertices)) % 2 == 0
    near = Triangulation(a.vertices + np.array([0.09 * length, 0, 0]), a.faces)
    far = Triangulation(np.where(half[:, None], a.vertices * (1 + 0.15 * length), a.vertices), a.faces)
    assert coincidence(a, a) == coincidence(a, near) == 1
    assert coincidence(a, far) == pytest.approx(1 - half.mean())


@pytest.mark.slow
def test_the_bowl_is_even_exact_and_independent():
    folder = os.environ.get("FLX_DATA")
    if not folder:
        pytest.skip("FLX_DATA is not set")
    path = sorted((Path(folder) / "meshes" / "gso_Now_Designs_Bowl_Akita_Black").rglob("*.obj"))[0]
    loaded = trimesh.load(path, process=False, force="mesh")
    vertices, index = np.unique(loaded.vertices, axis=0, return_inverse=True)
    surface = Triangulation(vertices.astype(float), index.ravel()[loaded.faces].astype(np.int64))
    a, b = remesh(*surface, 5000, seed=0), remesh(*surface, 5000, seed=1)
    assert len(a.vertices) == len(b.vertices) == 5000
    assert_sound(a)
    angles = min_angles(a)
    assert angles.mean() > 50 and np.percentile(angles, 1) >= 35 and angles.min() > 1
    assert coincidence(a, b) <= 0.06
    assert distances(points_on(surface), a).max() < 0.01 * np.linalg.norm(np.ptp(vertices, axis=0))
