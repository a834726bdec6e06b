"""Laws of colours at points, atlas texels and points of one-rings."""

import igl
import numpy as np
import pytest
from helpers.surfaces import ellipsoid
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.atlas import atlas_texels, fill_gutter, paint, with_filled_gutters
from flx.geometry.raster import pixels_inside
from flx.geometry.sampling import face_normals, locate, positions, ring_points, surface_colors, texture_colors
from flx.types import Layer, SurfacePoints, TexturedMesh, Triangulation


def textured(triangulation: Triangulation, uvs: np.ndarray, *textures: np.ndarray) -> TexturedMesh:
    count = len(triangulation.faces)
    none = np.zeros(count, np.int64)
    return TexturedMesh(
        *triangulation, {"base_color": Layer(textures, none, uvs)}, np.zeros((count, 3, 3), np.float32)
    )


def separate_charts(triangulation: Triangulation, cells: int, fill: float = 0.8) -> np.ndarray:
    """Every face its own little chart in a grid: nothing but seams."""
    number = np.arange(len(triangulation.faces))
    assert len(number) <= cells * cells
    low = np.stack([number % cells, number // cells], -1)[:, None] + 0.1
    return (low + fill * np.array([(0, 0), (1, 0), (0, 1.0)])) / cells


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


# --- colours


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
    monkeypatch.setattr("flx.geometry.atlas.CHUNK", 7)
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


# --- pixels inside triangles


def inside(triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The oracle: on one side of all three edges."""
    sides = [
        (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
        for a, b in zip(triangle, np.roll(triangle, -1, 0), strict=True)
    ]
    return (np.min(sides, 0) >= 0) | (np.max(sides, 0) <= 0)


@given(st.integers(0, 10_000), st.booleans())
def test_scan_conversion_finds_the_pixels_on_one_side_of_all_edges(seed, whole_numbers):
    rng = np.random.default_rng(seed)
    triangle = rng.uniform(-12, 12, (3, 2))
    if whole_numbers:  # centres on edges and corners
        triangle = np.round(triangle)
    edges = triangle[1:] - triangle[0]
    y, x = np.mgrid[-13:14, -13:14]
    flat = abs(np.linalg.det(edges)) < 1e-12
    expected = set() if flat else set(zip(x[inside(triangle, x, y)], y[inside(triangle, x, y)], strict=True))
    found = [
        (column, row)
        for chunk in pixels_inside(triangle[None])
        for column, row in zip(chunk.columns, chunk.rows, strict=True)
    ]
    assert len(found) == len(set(found))
    assert set(found) == expected


# --- atlas


def test_an_atlas_texel_leads_back_to_its_own_centre():
    ball = ellipsoid(2)
    mesh = textured(ball, separate_charts(ball, 12))
    atlas = atlas_texels(mesh, 0, 300, 400)
    uvs = np.einsum("pkx,pk->px", mesh.corner_uvs[atlas.points.faces], atlas.points.barycentrics)
    centres = np.stack([(atlas.columns + 0.5) / 400, (atlas.rows + 0.5) / 300], 1)
    np.testing.assert_allclose(uvs, centres, atol=1e-6)
    assert (atlas.points.barycentrics >= 0).all()
    assert len(np.unique(atlas.rows * 400 + atlas.columns)) == len(atlas.rows)
    area = 0.5 * 0.8**2 / 12**2 * len(ball.faces)
    assert len(atlas.rows) / (300 * 400) == pytest.approx(area, rel=0.03)


@given(st.integers(-5, 5), st.integers(-5, 5))
def test_whole_shifts_of_uvs_change_nothing(right, down):
    ball = ellipsoid(1)
    uvs = separate_charts(ball, 6)
    here = atlas_texels(textured(ball, uvs), 0, 64, 64)
    there = atlas_texels(textured(ball, uvs + np.array([right, down])), 0, 64, 64)
    np.testing.assert_array_equal(here.points.faces, there.points.faces)
    np.testing.assert_array_equal(here.rows, there.rows)
    np.testing.assert_array_equal(here.columns, there.columns)


def quad(uvs: list[tuple[float, float]]) -> TexturedMesh:
    """The unit square; uvs of (0, 0), (1, 0), (1, 1), (0, 1)."""
    vertices = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    return textured(Triangulation(vertices, faces), np.array(uvs, float)[faces])


@pytest.mark.parametrize("shift", [0.0, 0.37, -2.5])
def test_a_square_as_large_as_the_texture_covers_each_texel_once(shift):
    mesh = quad([(shift, shift), (1 + shift, shift), (1 + shift, 1 + shift), (shift, 1 + shift)])
    atlas = atlas_texels(mesh, 0, 32, 48)
    assert len(np.unique(atlas.rows * 48 + atlas.columns)) == len(atlas.rows) == 32 * 48


def test_the_first_face_owns_a_shared_texel_whatever_the_chunks(monkeypatch):
    mesh = quad([(0, 0), (3, 0), (3, 3), (0, 3)])  # nine tiles, and the diagonal through texel centres
    whole = atlas_texels(mesh, 0, 16, 16)
    columns, rows = whole.columns, whole.rows
    assert (whole.points.faces == 0).all() and len(rows) == 256  # face 0 alone reaches every texel
    monkeypatch.setattr("flx.geometry.raster.CHUNK", 5)
    monkeypatch.setattr("flx.geometry.atlas.CHUNK", 5)
    parts = atlas_texels(mesh, 0, 16, 16)
    np.testing.assert_array_equal(parts.columns, columns)
    np.testing.assert_array_equal(parts.points.barycentrics, whole.points.barycentrics)


def test_faces_without_uv_area_or_of_other_textures_have_no_texels():
    mesh = quad([(0, 0), (1, 0), (1, 1), (0.5, 0.5)])  # the second face is a line
    assert set(atlas_texels(mesh, 0, 16, 16).points.faces) == {0}
    mesh = mesh.with_layer(face_images=np.array([1, 1]))
    assert len(atlas_texels(mesh, 0, 16, 16).rows) == 0


def test_a_texel_inside_a_large_face_shows_a_point_of_one_of_its_repeats():
    mesh = quad([(0, 0), (3, 0), (3, 3), (0, 3)])
    atlas = atlas_texels(mesh, 0, 16, 24)
    points = atlas.points
    uvs = np.einsum("pkx,pk->px", mesh.corner_uvs[points.faces], points.barycentrics)
    centres = np.stack([(atlas.columns + 0.5) / 24, (atlas.rows + 0.5) / 16], 1)
    np.testing.assert_allclose(uvs % 1, centres, atol=1e-9)
    assert (points.barycentrics.min(1) > 0).all() and (uvs >= 1).any()


def test_a_face_that_repeats_its_texture_without_end_is_refused():
    with pytest.raises(ValueError, match=r"face 1 runs over 1000 repeats of texture 0.*unwrap"):
        atlas_texels(quad([(0, 0), (1, 0), (1, 1), (0, 1000)]), 0, 16, 16)


@pytest.mark.parametrize("fill", [0.2, 0.0])
def test_a_face_smaller_than_a_texel_takes_the_texel_it_lies_in(fill):
    """... and so does one that has no area on the texture at all."""
    ball = ellipsoid(2)
    mesh = textured(ball, separate_charts(ball, 12, fill))
    atlas = atlas_texels(mesh, 0, 12, 12)  # a texel for each chart, its centre beside the chart
    np.testing.assert_array_equal(atlas.faces.ravel()[:128], np.arange(128))
    assert (atlas.faces.ravel()[128:] == -1).all()
    uvs = np.einsum("pkx,pk->px", mesh.corner_uvs[atlas.points.faces], atlas.points.barycentrics)
    rim = np.array([0.1, 0.1]) + fill / 2  # the middle of the long side is nearest to the centre
    np.testing.assert_allclose((uvs * 12) % 1, np.tile(rim, (128, 1)), atol=1e-6)


def test_a_needle_between_the_centres_takes_every_texel_it_passes():
    mesh = quad([(0.01, 0.26), (0.99, 0.26), (0.99, 0.27), (0.01, 0.27)])
    atlas = atlas_texels(mesh, 0, 16, 64)
    np.testing.assert_array_equal(atlas.columns, np.arange(64))
    assert (atlas.rows == 4).all()
    u = np.einsum("pkx,pk->px", mesh.corner_uvs[atlas.points.faces], atlas.points.barycentrics)[:, 0]
    np.testing.assert_allclose(u, np.clip((np.arange(64) + 0.5) / 64, 0.01, 0.99), atol=1e-3)


# --- gutters and paint


def test_inside_a_chart_only_its_own_colour_is_seen_at_every_mip_level():
    """Charts of one colour each, at least 24 texels apart, on black: bilinear, down to 1/4 of the size."""
    ball, cells, size = ellipsoid(1), 6, 384
    mesh = textured(ball, separate_charts(ball, cells, 0.6), np.zeros((size, size, 3), np.uint8))
    atlas = atlas_texels(mesh, 0, size, size)
    colors = np.random.default_rng(0).integers(60, 256, (32, 3), np.uint8).astype(np.float32) / 255
    rng = np.random.default_rng(1)
    points = SurfacePoints(np.repeat(np.arange(32), 90), rng.dirichlet((0.3, 0.3, 0.3), 32 * 90))
    points.barycentrics[::9] = np.eye(3)[rng.integers(0, 3, 320)]  # the very corners

    def worst(image: np.ndarray, level: int) -> float:
        side = 2**level
        small = image.reshape(size // side, side, size // side, side, 3).mean((1, 3))
        seen = surface_colors(mesh.with_layer(images=(np.rint(small).astype(np.uint8),)), points)
        return float(np.abs(seen - colors[points.faces]).max())

    filled = paint(atlas, colors[atlas.points.faces])
    bare = np.where(atlas.covered[..., None], filled, 0).astype(np.uint8)
    assert [worst(filled, level) < 1e-6 for level in (0, 1, 2)] == [True] * 3
    assert min(worst(bare, level) for level in (0, 1, 2)) > 0.1 and worst(filled, 5) > 0.1


def test_a_gutter_takes_the_nearest_colour_and_leaves_covered_texels():
    image = noise(20, 30)
    covered = np.zeros((20, 30), bool)
    covered[5:9, 4:10] = covered[12:15, 18:25] = True
    filled = fill_gutter(image, covered)
    np.testing.assert_array_equal(filled[covered], image[covered])
    rows, columns = np.nonzero(covered)
    for row, column in [(0, 0), (10, 7), (6, 12), (19, 22), (11, 20)]:
        down, right = np.abs(rows - row), np.abs(columns - column)
        squares = np.minimum(down, 20 - down) ** 2 + np.minimum(right, 30 - right) ** 2
        nearest = image[rows, columns][squares == squares.min()]
        assert (filled[row, column] == nearest).all(1).any()


@pytest.mark.parametrize("reach", [1.0, 2.5, 4.0])
def test_beyond_its_reach_a_gutter_is_as_it_was(reach):
    image, covered = noise(20, 30), np.zeros((20, 30), bool)
    covered[0:3, 4:10] = covered[12:15, 22:30] = True
    rows, columns = np.nonzero(covered)
    down = np.abs(np.arange(20)[:, None, None] - rows)
    right = np.abs(np.arange(30)[:, None] - columns)
    squares = np.minimum(down, 20 - down) ** 2 + np.minimum(right, 30 - right) ** 2
    near = squares.min(-1) <= reach**2
    filled, whole = fill_gutter(image, covered, reach), fill_gutter(image, covered)
    assert 60 < near.sum() < 500
    np.testing.assert_array_equal(filled[~near], image[~near])
    np.testing.assert_array_equal(filled[near], whole[near])


def test_a_gutter_sees_across_the_border():
    image, covered = np.zeros((8, 40, 3), np.uint8), np.zeros((8, 40), bool)
    covered[:, 10], covered[:, 39] = True, True
    image[:, 10], image[:, 39] = 10, 39
    filled = fill_gutter(image, covered)
    assert (filled[:, 0] == 39).all() and (filled[:, 9] == 10).all()


def test_filled_gutters_end_black_bleeding_at_seams():
    ball = ellipsoid(2)
    uvs = separate_charts(ball, 12)
    mesh = textured(ball, uvs, np.zeros((180, 180, 3), np.uint8))
    atlas = atlas_texels(mesh, 0, 180, 180)
    bare = np.zeros((180, 180, 3), np.uint8)
    bare[atlas.rows, atlas.columns] = 200
    mesh = mesh.with_layer(images=(bare,))
    points, _ = ring_points(ball, 4, np.random.default_rng(0))
    assert surface_colors(mesh, points).min() < 0.5  # the fault is there
    filled = surface_colors(with_filled_gutters(mesh), points)
    np.testing.assert_allclose(filled, 200 / 255, atol=1e-6)


def test_painting_the_surfaces_own_colours_gives_the_texture_back():
    ball = ellipsoid(2)
    mesh = textured(ball, separate_charts(ball, 12), noise(128, 96))
    atlas = atlas_texels(mesh, 0, 128, 96)
    painted = paint(atlas, surface_colors(mesh, atlas.points))
    assert len(atlas.rows) > 1000
    at = atlas.rows, atlas.columns
    np.testing.assert_array_equal(painted[at], mesh.textures[0][at])


def test_paint_clips_and_an_unused_texture_keeps_its_background():
    mesh = quad([(0, 0), (1, 0), (1, 1), (0, 1)])
    atlas = atlas_texels(mesh, 0, 4, 4)
    colors = np.where(np.arange(16)[:, None] % 2, 1.7, -0.2) * np.ones((16, 3))
    assert set(paint(atlas, colors.astype(np.float32)).ravel()) == {0, 255}
    unused = atlas_texels(mesh, 1, 4, 4)
    np.testing.assert_array_equal(paint(unused, np.zeros((0, 3), np.float32), noise(4, 4)), noise(4, 4))
    with pytest.raises(ValueError, match="background has 5x4 texels but the atlas has 4x4"):
        paint(unused, np.zeros((0, 3), np.float32), noise(4, 5))


# --- closest points


def test_points_of_the_surface_are_located_where_they_are():
    ball = ellipsoid(3)
    points, _ = ring_points(ball, 3, np.random.default_rng(1))
    places, normals = positions(*ball, points), face_normals(*ball)[points.faces]
    for asked in (None, normals):
        found = locate(places, asked, *ball)
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
    blind, found = locate(places, None, *wall), locate(places, asked, *wall)
    opposed = np.einsum("px,px->p", normals[blind.faces], asked) < 0
    assert opposed.mean() > 0.9  # the fault is there
    assert (np.einsum("px,px->p", normals[found.faces], asked) > 0.5).all()
    assert np.linalg.norm(positions(*wall, found) - places, axis=1).max() < 0.005


def test_a_query_that_no_face_agrees_with_keeps_the_closest_point():
    square = quad([(0, 0)] * 4)
    down = np.array([[0.0, 0.0, -1.0]])
    found = locate(np.array([[0.7, 0.2, 0.1]]), down, square.vertices, square.faces)
    np.testing.assert_allclose(positions(square.vertices, square.faces, found), [[0.7, 0.2, 0]], atol=1e-12)


# --- points of one-rings


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
