"""Laws of straight walks: lines in the plane, great circles on a sphere, and the way back."""

import numpy as np
import pytest
import trimesh

from flx.geometry.geodesics import unfold, walk
from flx.geometry.sampling import positions
from flx.types import SurfacePoints


def grid(size):
    """A square of size² cells of side 1, as triangles in the plane z = 0."""
    x, y = np.meshgrid(*[np.arange(size + 1.0)] * 2)
    corner = np.arange((size + 1) ** 2).reshape(size + 1, -1)
    a, b, c, d = (corner[i : size + i, j : size + j].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


@pytest.fixture
def rays():
    return np.exp(2j * np.pi * (np.arange(40) + 0.3) / 40)


def start(face, count):
    return SurfacePoints(np.full(count, face), np.full((count, 3), [0.5, 0.2, 0.3]))


def test_a_walk_in_the_plane_is_a_straight_line(rays):
    vertices, faces = grid(20)
    face = 210  # its first side runs along x
    begin, stops = start(face, len(rays)), np.array([0.1, 1.0, 4.0, 7.5])
    ends = positions(vertices, faces, walk(unfold(vertices, faces), begin, rays, stops)).reshape(-1, 4, 3)
    expected = rays[:, None] * stops + complex(*positions(vertices, faces, begin)[0, :2])
    np.testing.assert_allclose(ends[..., 0] + 1j * ends[..., 1], expected, atol=1e-12)


def test_a_walk_on_a_sphere_follows_a_great_circle(rays):
    sphere = trimesh.creation.icosphere(4)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    stops = np.array([0.3, 1.0, 2.0, 3.0])
    begin = start(7, len(rays))
    ends = positions(vertices, faces, walk(unfold(vertices, faces), begin, rays, stops)).reshape(-1, 4, 3)
    ends /= np.linalg.norm(ends, axis=-1, keepdims=True)
    first = positions(vertices, faces, begin)[0]
    first /= np.linalg.norm(first)
    np.testing.assert_allclose(np.arccos(ends @ first), np.broadcast_to(stops, (40, 4)), rtol=3e-3)
    normals = np.cross(first, ends[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert abs(np.einsum("nsx,nx->ns", ends[:, 1:3], normals)).max() < 0.02  # the plane of the first stop


def test_a_walk_stays_where_it_meets_a_boundary(rays):
    vertices, faces = grid(4)
    stops = walk(unfold(vertices, faces), start(5, 40), rays, np.array([50.0, 60.0]))
    ends = positions(vertices, faces, stops)
    assert np.isclose(abs(ends[:, :2] - 2).max(1), 2).all()  # on the outline of [0, 4]²
    np.testing.assert_array_equal(ends[::2], ends[1::2])


def test_unfolding_keeps_lengths_and_neighbours_agree_on_their_edge():
    sphere = trimesh.creation.icosphere(2)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    laid = unfold(vertices, faces)
    for j in range(3):
        sides = vertices[faces[:, j - 2]] - vertices[faces[:, j - 1]]
        flat = laid.corners[:, j - 2] - laid.corners[:, j - 1]
        np.testing.assert_allclose(abs(flat), np.linalg.norm(sides, axis=1), atol=1e-12)
        there = laid.neighbors[:, j]
        assert (there >= 0).all()
        moved = laid.turns[:, j] * laid.corners[:, j - 2] + laid.shifts[:, j]
        onto = laid.corners[there]
        same = faces[there] == faces[:, j - 2][:, None]
        np.testing.assert_allclose(moved, onto[same], atol=1e-12)
