"""Laws of atlas texels: which face owns one, what a gutter holds, what is painted."""

import numpy as np
import pytest
from helpers.surfaces import ellipsoid
from helpers.textured import noise, quad, separate_charts, textured
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.atlas import atlas_texels, fill_gutter, paint, with_filled_gutters
from flx.geometry.sampling import ring_points, surface_colors
from flx.types import SurfacePoints

# --- colours


# --- pixels inside triangles


# --- atlas


def test_an_atlas_texel_leads_back_to_its_own_centre():
    ball = ellipsoid(2)
    mesh = textured(ball, separate_charts(ball, 12))
    atlas = atlas_texels(mesh, 0, 300, 400)
    uvs = np.einsum("pkx,pk->px", mesh.corner_uvs[atlas.points.faces], atlas.points.barycentrics)
    rows, columns = np.divmod(atlas.texels, atlas.width)
    centres = np.stack([(columns + 0.5) / 400, (rows + 0.5) / 300], 1)
    np.testing.assert_allclose(uvs, centres, atol=1e-6)
    assert (atlas.points.barycentrics >= 0).all()
    assert len(np.unique(rows * 400 + columns)) == len(rows)
    area = 0.5 * 0.8**2 / 12**2 * len(ball.faces)
    assert len(rows) / (300 * 400) == pytest.approx(area, rel=0.03)


@given(st.integers(-5, 5), st.integers(-5, 5))
def test_whole_shifts_of_uvs_change_nothing(right, down):
    ball = ellipsoid(1)
    uvs = separate_charts(ball, 6)
    here = atlas_texels(textured(ball, uvs), 0, 64, 64)
    there = atlas_texels(textured(ball, uvs + np.array([right, down])), 0, 64, 64)
    np.testing.assert_array_equal(here.points.faces, there.points.faces)
    np.testing.assert_array_equal(here.texels, there.texels)


@pytest.mark.parametrize("shift", [0.0, 0.37, -2.5])
def test_a_square_as_large_as_the_texture_covers_each_texel_once(shift):
    mesh = quad([(shift, shift), (1 + shift, shift), (1 + shift, 1 + shift), (shift, 1 + shift)])
    atlas = atlas_texels(mesh, 0, 32, 48)
    rows, columns = np.divmod(atlas.texels, atlas.width)
    assert len(np.unique(rows * 48 + columns)) == len(rows) == 32 * 48


def test_the_first_face_owns_a_shared_texel_whatever_the_chunks(monkeypatch):
    mesh = quad([(0, 0), (3, 0), (3, 3), (0, 3)])  # nine tiles, and the diagonal through texel centres
    whole = atlas_texels(mesh, 0, 16, 16)
    assert (whole.points.faces == 0).all() and len(whole.texels) == 256  # face 0 alone reaches every texel
    monkeypatch.setattr("flx.geometry.raster.CHUNK", 5)
    monkeypatch.setattr("flx.geometry.atlas.CHUNK", 5)
    parts = atlas_texels(mesh, 0, 16, 16)
    np.testing.assert_array_equal(parts.texels, whole.texels)
    np.testing.assert_array_equal(parts.points.barycentrics, whole.points.barycentrics)


def test_faces_without_uv_area_or_of_other_textures_have_no_texels():
    mesh = quad([(0, 0), (1, 0), (1, 1), (0.5, 0.5)])  # the second face is a line
    assert set(atlas_texels(mesh, 0, 16, 16).points.faces) == {0}
    mesh = mesh.with_layer(face_images=np.array([1, 1]))
    assert len(atlas_texels(mesh, 0, 16, 16).texels) == 0


def test_a_texel_inside_a_large_face_shows_a_point_of_one_of_its_repeats():
    mesh = quad([(0, 0), (3, 0), (3, 3), (0, 3)])
    atlas = atlas_texels(mesh, 0, 16, 24)
    points = atlas.points
    uvs = np.einsum("pkx,pk->px", mesh.corner_uvs[points.faces], points.barycentrics)
    rows, columns = np.divmod(atlas.texels, atlas.width)
    centres = np.stack([(columns + 0.5) / 24, (rows + 0.5) / 16], 1)
    np.testing.assert_allclose(uvs % 1, centres, atol=1e-9)
    assert (points.barycentrics.min(1) > 0).all() and (uvs >= 1).any()


def test_a_face_that_repeats_its_texture_without_end_is_refused():
    with pytest.raises(ValueError, match=r"face 1 spans 1,000 repeats of texture 0.*unwrap"):
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
    rows, columns = np.divmod(atlas.texels, atlas.width)
    np.testing.assert_array_equal(columns, np.arange(64))
    assert (rows == 4).all()
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
    rows, columns = np.divmod(atlas.texels, atlas.width)
    bare[rows, columns] = 200
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
    rows, columns = np.divmod(atlas.texels, atlas.width)
    assert len(rows) > 1000
    at = rows, columns
    np.testing.assert_array_equal(painted[at], mesh.textures[0][at])


def test_paint_clips_and_a_texture_that_no_face_uses_is_black():
    mesh = quad([(0, 0), (1, 0), (1, 1), (0, 1)])
    atlas = atlas_texels(mesh, 0, 4, 4)
    colors = np.where(np.arange(16)[:, None] % 2, 1.7, -0.2) * np.ones((16, 3))
    assert set(paint(atlas, colors.astype(np.float32)).ravel()) == {0, 255}
    assert not paint(atlas_texels(mesh, 1, 4, 4), np.zeros((0, 3), np.float32)).any()


# --- closest points


# --- points of one-rings
