"""Laws of colours at points and of points in one-rings."""

import igl
import numpy as np
from helpers.surfaces import ellipsoid
from helpers.textured import noise, quad, separate_charts, textured
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.sampling import (
    closest_points,
    face_normals,
    locate,
    positions,
    ring_points,
    surface_colors,
    texture_colors,
)
from flx.types import SurfacePoints, Triangulation


@given(st.integers(1, 9), st.integers(1, 9), st.integers(-3, 3), st.integers(-3, 3))
def test_texel_centres_give_their_own_colour_in_every_tile(height, width, right, down):
    image = noise(height, width)
    rows, columns = (axis.ravel() for axis in np.indices((height, width)))
    uvs = np.stack([(columns + 0.5) / width + right, (rows + 0.5) / height + down], 1)
    expected = image.reshape(-1, 3).astype(np.float32) / 255
    np.testing.assert_allclose(texture_colors(image, uvs), expected, atol=1e-6)


@given(st.floats(0, 1), st.integers(0, 3), st.integers(0, 4))
def test_between_two_centres_the_colour_is_linear_also_across_the_border(share, row, column):
    image = noise(4, 5)
    uvs = np.array(
        [[(column + 0.5 + share) / 5, (row + 0.5) / 4], [(column + 0.5) / 5, (row + 0.5 + share) / 4]]
    )
    here = image[row, column].astype(float)
    expected = [
        here + share * (image[row, (column + 1) % 5] - here),
        here + share * (image[(row + 1) % 4, column] - here),
    ]
    np.testing.assert_allclose(texture_colors(image, uvs) * 255, expected, atol=1e-3)


def test_v_runs_down():
    image = np.zeros((2, 1, 3), np.uint8)
    image[0] = 255
    assert texture_colors(image, np.array([[0.5, 0.25]]))[0, 0] == 1


def test_chunks_do_not_show(monkeypatch):
    uvs = np.random.default_rng(0).normal(size=(1000, 2))
    whole = texture_colors(noise(7, 5), uvs)
    monkeypatch.setattr("flx.geometry.sampling.CHUNK", 7)
    np.testing.assert_array_equal(texture_colors(noise(7, 5), uvs), whole)


def test_each_face_reads_its_own_texture_and_its_own_corners():
    ball = ellipsoid(0)
    mesh = textured(ball, separate_charts(ball, 3), *(np.full((8, 8, 3), c, np.uint8) for c in (51, 204)))
    mesh = mesh.with_layer(face_images=np.arange(8) % 2)
    points = SurfacePoints(np.arange(8), np.full((8, 3), 1 / 3))
    np.testing.assert_allclose(
        surface_colors(mesh, points)[:, 0], np.where(np.arange(8) % 2, 0.8, 0.2), atol=1e-6
    )


def test_without_textures_corner_colours_blend():
    corners = np.random.default_rng(0).random((8, 3, 3), np.float32)
    mesh = textured(ellipsoid(0), np.zeros((8, 3, 2)))._replace(corner_colors=corners)
    points = SurfacePoints(np.arange(8), np.tile([0.2, 0.3, 0.5], (8, 1)))
    expected = corners[:, 0] * 0.2 + corners[:, 1] * 0.3 + corners[:, 2] * 0.5
    np.testing.assert_allclose(surface_colors(mesh, points), expected, atol=1e-6)


def test_points_of_the_surface_are_located_where_they_are():
    ball = ellipsoid(3)
    points, _ = ring_points(ball, 3, np.random.default_rng(1))
    places, normals = positions(*ball, points), face_normals(*ball)[points.faces]
    for found in (closest_points(places, *ball), locate(places, normals, *ball)):
        np.testing.assert_allclose(positions(*ball, found), places, atol=1e-12)
        assert (found.barycentrics >= 0).all()
    assert (found.faces == points.faces).mean() > 0.99


def slab(thickness: float) -> Triangulation:
    """A closed wavy sheet: its upper and its lower side, and the rim between."""
    side = np.linspace(-1, 1, 21)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    middle = 0.3 * np.sin(2 * x) * np.cos(2 * y)
    number = np.arange(441).reshape(21, 21)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    after = np.roll(rim, -1)
    walls = [np.stack([after, rim, rim + 441], 1), np.stack([after, rim + 441, after + 441], 1)]
    vertices = np.concatenate([np.stack([x, y, middle + s * thickness / 2], 1) for s in (1, -1)])
    return Triangulation(vertices, np.concatenate([top, top[:, ::-1] + 441, *walls]))


def test_a_thin_wall_keeps_its_sides():
    wall = slab(0.002)
    assert (igl.boundary_loop(wall.faces) == np.zeros(0)).all()
    normals = face_normals(*wall)
    points, _ = ring_points(wall, 2, np.random.default_rng(2))
    flat = np.abs(normals[points.faces, 2]) > 0.5
    points = SurfacePoints(points.faces[flat], points.barycentrics[flat])
    asked = normals[points.faces]
    # Queries sink through the wall, as the chords of a coarse copy do.
    places = positions(*wall, points) - 0.004 * asked
    blind, found = closest_points(places, *wall), locate(places, asked, *wall)
    opposed = np.einsum("px,px->p", normals[blind.faces], asked) < 0
    assert opposed.mean() > 0.9  # the fault is there
    assert (np.einsum("px,px->p", normals[found.faces], asked) > 0.5).all()
    assert np.linalg.norm(positions(*wall, found) - places, axis=1).max() < 0.005


def test_a_query_that_no_face_agrees_with_keeps_the_closest_point():
    square = quad([(0, 0)] * 4)
    down = np.array([[0.0, 0.0, -1.0]])
    found = locate(np.array([[0.7, 0.2, 0.1]]), down, square.vertices, square.faces)
    np.testing.assert_allclose(positions(square.vertices, square.faces, found), [[0.7, 0.2, 0]], atol=1e-12)


def test_ring_points_lie_in_the_ring_of_the_corner_they_name():
    ball = ellipsoid(2)
    points, corner = ring_points(ball, 16, np.random.default_rng(0))
    assert corner.shape == (len(ball.vertices), 16) and points.barycentrics.shape == (corner.size, 3)
    named = ball.faces[points.faces, corner.ravel()].reshape(corner.shape)
    np.testing.assert_array_equal(named, np.arange(len(ball.vertices))[:, None] * np.ones((1, 16), int))
    assert (points.barycentrics >= 0).all()
    np.testing.assert_allclose(points.barycentrics.sum(1), 1)


def test_ring_points_are_uniform_by_area():
    ball = ellipsoid(1)
    count = 4000
    points, _ = ring_points(ball, count, np.random.default_rng(0))
    places = positions(*ball, points).reshape(-1, count, 3)
    areas = igl.doublearea(*ball) / 2
    centroids, vertices = ball.vertices[ball.faces].mean(1), ball.vertices
    hit = points.faces.reshape(-1, count)
    for v in range(len(vertices)):
        ring = np.flatnonzero((ball.faces == v).any(1))
        share = areas[ring] / areas[ring].sum()
        # Strata: at most one sample more or less at either end of a face.
        assert np.abs((hit[v][:, None] == ring).sum(0) - share * count).max() <= 2
        np.testing.assert_allclose(places[v].mean(0), share @ centroids[ring], atol=0.02)
    # Inside a face: a uniform barycentric has mean 1/3, variance 1/18 and covariance −1/36.
    covariance = np.cov(points.barycentrics.T)
    np.testing.assert_allclose(points.barycentrics.mean(0), 1 / 3, atol=0.01)
    np.testing.assert_allclose(covariance, np.eye(3) / 12 - 1 / 36, atol=2e-3)


def test_ring_points_at_a_boundary_stay_on_the_mesh_and_repeat_with_the_seed():
    square = quad([(0, 0)] * 4)
    plane = Triangulation(square.vertices, square.faces)
    one, corners = ring_points(plane, 32, np.random.default_rng(5))
    two, _ = ring_points(plane, 32, np.random.default_rng(5))
    np.testing.assert_array_equal(one.barycentrics, two.barycentrics)
    faces = one.faces.reshape(4, 32)
    assert set(faces[1]) == {0} and set(faces[3]) == {1} and set(faces[0]) == {0, 1}
    assert set(corners[1]) == {1} and set(corners[3]) == {2}


def test_normals_are_outward_and_of_length_one_or_zero():
    ball = ellipsoid(1)
    normals = face_normals(*ball)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert (np.einsum("fx,fx->f", normals, ball.vertices[ball.faces].mean(1)) > 0).all()
    np.testing.assert_array_equal(face_normals(ball.vertices, np.array([[0, 0, 1]])), 0)
