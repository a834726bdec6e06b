"""Laws of smoothing: where points land, and that no face turns or shrinks to nothing."""

import igl
import numpy as np
import pytest
from helpers.oracles import mean_edge
from helpers.surfaces import box, bumpy, rough, square_grid
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flx.geometry.arrays import area_normals
from flx.geometry.remesh.planar import planar
from flx.geometry.remesh.smoothing import ReferenceSurface, smooth

UP = np.array([0.0, 0.0, 1.0])


def two_sheets(apart: float, length: float, face_each_other: bool, side: int = 7) -> ReferenceSurface:
    """Unit squares at heights 0 and `apart`: a wall seen from outside, or a gap seen from within."""
    points, faces = square_grid(side)
    turned = faces[:, ::-1]
    low, high = (faces, turned) if face_each_other else (turned, faces)
    vertices = np.concatenate([points, points + apart * UP])
    return ReferenceSurface(vertices, np.ascontiguousarray(np.concatenate([low, high + len(points)])), length)


@pytest.mark.slow
@settings(max_examples=150)
@given(
    apart=st.floats(0.02, 3),
    place=st.floats(0, 1),
    upwards=st.booleans(),
    face_each_other=st.booleans(),
    x=st.floats(0.2, 0.8),
    y=st.floats(0.2, 0.8),
)
def test_a_point_lands_on_the_sheet_that_faces_its_way_within_an_edge(
    apart, place, upwards, face_each_other, x, y
):
    """Even where the other one is nearer; farther off it is not trusted."""
    length = 0.1
    apart = apart * length
    surface = two_sheets(apart, length, face_each_other)
    points = np.array([[x, y, place * apart]])
    own = apart if upwards != face_each_other else 0.0
    off = abs(points[0, 2] - own)
    assume(abs(off - length) > 1e-6 and abs(place - 0.5) > 1e-6)
    normals = (1 if upwards else -1) * UP[None]
    landed, on_own_side = surface.project(points, normals, np.zeros(1, int), np.zeros(1, bool))
    nearer = off < apart / 2
    assert on_own_side[0] == (nearer or off < length)
    height = own if on_own_side[0] else apart - own
    np.testing.assert_allclose(landed, [[x, y, height]], atol=1e-12)


@settings(max_examples=60)
@given(
    apart=st.floats(0.02, 0.95),
    place=st.floats(0, 1),
    upwards=st.booleans(),
    face_each_other=st.booleans(),
    y=st.floats(0, 1),
    aside=st.floats(-0.5, 0.5),
)
def test_a_boundary_point_lands_on_the_boundary_of_its_own_sheet(
    apart, place, upwards, face_each_other, y, aside
):
    length = 0.1
    surface = two_sheets(apart * length, length, face_each_other)
    points = np.array([[aside * length, y, place * apart * length]])
    normals = (1 if upwards else -1) * UP[None]
    inside = 0.5 * length < y < 1 - 0.5 * length  # nearest to this side of the square
    assume(inside)
    landed, on_own_side = surface.project(points, normals, np.ones(1, int), np.ones(1, bool))
    own = apart * length if upwards != face_each_other else 0.0
    np.testing.assert_allclose(landed, [[0, y, own]], atol=1e-12)
    assert on_own_side[0]


def test_a_crease_vertex_lands_on_the_crease_and_others_on_faces():
    cube = box(1.0, 1.0, 1.0)
    surface = ReferenceSurface(*cube, 0.2)
    points = np.array([[0.45, 0.47, 0.1], [0.45, 0.47, 0.1], [0.3, 0.47, 0.1]])
    normals = np.array([[0.0, 1.0, 0.0]] * 3)
    landed, on_own_side = surface.project(points, normals, np.array([1, 0, 1]), np.zeros(3, bool))
    expected = [[0.5, 0.5, 0.1], [0.45, 0.5, 0.1], [0.3, 0.5, 0.1]]  # the last is too far from any crease
    np.testing.assert_allclose(landed, expected, atol=1e-12)
    assert on_own_side.all()


def test_smoothing_stays_on_the_surface_turns_no_face_and_leaves_what_is_pinned():
    surface, mesh = bumpy(4), rough(0)
    whole = ReferenceSurface(*surface, mean_edge(mesh))
    pinned = np.random.default_rng(0).random(162) < 0.3
    smoothed = smooth(mesh, whole, 2, pinned).vertices
    np.testing.assert_array_equal(smoothed[pinned], mesh.vertices[pinned])
    assert whole.distances(smoothed[~pinned]).max() < 1e-9
    corners = smoothed[mesh.faces]
    volumes = np.linalg.det(corners)
    assert volumes.min() > 0 and (smoothed[~pinned] != mesh.vertices[~pinned]).any(1).all()


def test_no_smoothing_shrinks_a_face_to_nothing():
    """Of strewn points: faces keep a tenth of the mean area, or nearly theirs."""
    for seed in range(3):
        mesh = planar(150, (1.0, 1.0), np.random.default_rng(seed), 1.0)
        area = igl.doublearea(*mesh)
        after = smooth(mesh, ReferenceSurface(*mesh, mean_edge(mesh)), 1)
        up = area_normals(*after)[:, 2]
        assert (up >= np.minimum(0.1 * area.mean(), 0.9 * area) - 1e-12).all()
        assert np.ptp(up) < np.ptp(area)
