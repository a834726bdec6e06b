"""Laws of the measure of how far mesh and surface lie apart."""

import numpy as np
import pytest
import trimesh
from helpers.oracles import mean_edge
from helpers.surfaces import bumpy, icosphere
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from flx.geometry.arrays import length_of
from flx.geometry.remesh.deviation import FaceQuality, MeasuredMesh, distances_to_mesh, measure_mesh
from flx.geometry.remesh.smoothing import ReferenceSurface
from flx.geometry.topology import edge_lengths, topology
from flx.types import Triangulation

seeds = st.integers(0, 10**6)


def lattice(n: int) -> np.ndarray:
    return np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n


def points_in(vertices: np.ndarray, faces: np.ndarray, n: int) -> np.ndarray:
    return np.einsum("pk,fkc->fpc", lattice(n), vertices[faces])


def measured(
    mesh: Triangulation, surface: Triangulation, share: float
) -> tuple[ReferenceSurface, float, MeasuredMesh]:
    whole = ReferenceSurface(*surface, mean_edge(mesh))
    gap = share * whole.length
    return whole, gap, measure_mesh(mesh, whole, gap)


@pytest.mark.parametrize(("share", "height"), [(0.2, 0.25), (0.3, 0.3), (0.42, 0.4)])
def test_faces_are_as_far_from_the_surface_as_their_points(share, height):
    """Against many points of each: what is measured is one of them, and none is much farther; what is not
    measured is within the gap."""
    mesh, surface = bumpy(2, height), bumpy(4, height)
    whole, gap, fit = measured(mesh, surface, share)
    dense = points_in(*mesh, 24)
    apart = whole.distances(dense.reshape(-1, 3)).reshape(dense.shape[:2]).max(1) / gap
    found = fit.quality.sags
    asked = found > 0
    assert asked.sum() > 20 and (~asked).sum() > 20
    assert (found <= apart + 1e-12).all() and apart[~asked].max() <= 1
    near = found > 0.7  # where a face is nearly too far off, it is measured closer
    fine = points_in(mesh.vertices, mesh.faces[near], 6)
    finer = whole.distances(fine.reshape(-1, 3)).reshape(fine.shape[:2]).max(1) / gap
    np.testing.assert_allclose(found[near], finer)
    # No point of a face is farther than this from a point of the lattice, 3 or 6 to a side.
    sides = np.array(
        [
            length_of(mesh.vertices[a] - mesh.vertices[b])
            for a, b in [mesh.faces[:, [k - 1, k]].T for k in range(3)]
        ]
    ).max(0)
    room = sides / np.where(near, 6, 3) / np.sqrt(3) / gap
    assert (apart <= found + room)[asked].all()
    np.testing.assert_array_equal(fit.wide, (found > 1) | np.isin(np.arange(320), fit.hits[fit.gaps > 1]))


def test_points_of_the_surface_are_as_far_from_the_mesh_as_from_the_face_they_hit():
    """Against the closest points of single triangles, by another library."""
    mesh, surface = bumpy(1, 0.3), bumpy(2, 0.3)
    _, gap, fit = measured(mesh, surface, 0.1)
    closest = trimesh.triangles.closest_point(mesh.vertices[mesh.faces[fit.hits]], fit.probes)
    np.testing.assert_allclose(fit.gaps * gap, length_of(closest - fit.probes), atol=1e-9)
    some = np.arange(0, len(fit.probes), 11)
    every = np.repeat(some, 80)  # against all faces
    closest = trimesh.triangles.closest_point(
        np.tile(mesh.vertices[mesh.faces], (len(some), 1, 1)), fit.probes[every]
    )
    nearest = length_of(closest - fit.probes[every]).reshape(-1, 80).min(1)
    np.testing.assert_allclose(nearest, fit.gaps[some] * gap, atol=1e-9)


@pytest.mark.parametrize(
    ("mesh", "surface", "share"),
    [
        (bumpy(1, 0.3), bumpy(2, 0.3), 0.1),
        # The corners of the coarse sphere are off by 0.6 of the gap, the middles of its faces by more than 1.
        (Triangulation(1.06 * icosphere(3).vertices, icosphere(3).faces), icosphere(1), 0.65),
    ],
)
def test_no_wide_gap_goes_unasked(mesh, surface, share):
    _, gap, fit = measured(mesh, surface, share)
    dense = points_in(*surface, 9).reshape(-1, 3)
    missed = dense[distances_to_mesh(dense, *mesh)[0] > 1.15 * gap]
    assert len(missed) > 100
    # No point of a face is farther than this from a lattice of 3 points to a side.
    room = (
        edge_lengths(surface.vertices, topology(surface.faces, len(surface.vertices))).max() / 3 / np.sqrt(3)
    )
    assert KDTree(fit.probes[fit.gaps > 1]).query(missed)[0].max() < room


@settings(max_examples=10)
@given(seeds)
def test_a_part_that_is_cut_out_and_put_back_changes_nothing(seed):
    _, gap, fit = measured(bumpy(1, 0.3), bumpy(3, 0.3), 0.1)
    rng = np.random.default_rng(seed)
    fit = fit._replace(kind=rng.integers(0, 3, 42))
    rows = np.flatnonzero(rng.random(80) < 0.4)
    whole = [a.copy() for a in (*fit.quality, *(x for x in fit if not isinstance(x, FaceQuality)))]
    part, inside, asked = fit.submesh(rows)
    np.testing.assert_array_equal(part.vertices[part.faces], fit.vertices[fit.faces[rows]])
    np.testing.assert_array_equal(part.kind, fit.kind[inside])
    np.testing.assert_array_equal(asked, np.flatnonzero(np.isin(fit.hits, rows)))
    np.testing.assert_array_equal(part.wide, fit.wide[rows])
    gaps, _ = distances_to_mesh(
        part.probes, part.vertices, part.faces
    )  # its probes are closest to its own faces
    np.testing.assert_allclose(gaps / gap, part.gaps, atol=1e-12)
    fit.vertices[inside], fit.faces[rows] = part.vertices, inside[part.faces]
    fit.quality.put(rows, part.quality)
    fit.gaps[asked], fit.hits[asked] = part.gaps, rows[part.hits]
    for new, old in zip(
        (*fit.quality, *(x for x in fit if not isinstance(x, FaceQuality))), whole, strict=True
    ):
        np.testing.assert_array_equal(new, old)
