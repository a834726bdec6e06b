"""Laws of the seam metric: 1 where nobody sees the seam, large where everybody does."""

import numpy as np
import pytest
from helpers.surfaces import icosphere

from flx.geometry.atlas import atlas_texels, paint
from flx.geometry.sampling import positions
from flx.geometry.seams import seam_jump, seam_ratio
from flx.types import Layer, TexturedMesh

SIZE = 256


def two_charts() -> TexturedMesh:
    """A sphere whose halves are laid out beside each other, without change of area (Lambert)."""
    vertices, faces = icosphere(4)
    corners = vertices[faces]
    left = corners[..., 0].mean(1) < 0
    heights = corners[..., 0] * np.where(left, -1, 1)[:, None]
    uvs = corners[..., 1:] / np.sqrt(1 + heights)[..., None] * [0.2, 0.4] + [0.5, 0.5]
    uvs[..., 0] += np.where(left, -0.25, 0.25)[:, None]
    none = np.zeros(len(faces), np.int64)
    black = np.zeros((SIZE, SIZE, 3), np.uint8)
    return TexturedMesh(
        vertices, faces, {"base_color": Layer((black,), none, uvs)}, np.zeros((len(faces), 3, 3), np.float32)
    )


def painted(mesh: TexturedMesh, frequency: float, step: float = 0.0) -> TexturedMesh:
    """Waves in space, and where asked one half of the sphere brighter."""
    atlas = atlas_texels(mesh, 0, SIZE, SIZE)
    places = positions(mesh.vertices, mesh.faces, atlas.points)
    waves = 0.4 + 0.2 * np.sin(frequency * places @ np.random.default_rng(0).normal(size=(3, 3)))
    waves[mesh.corner_uvs[atlas.points.faces, 0, 0] > 0.5] += step
    return mesh.with_layer(images=(paint(atlas, waves.astype(np.float32)),))


@pytest.mark.parametrize("frequency", [2, 10, 40])
def test_a_texture_that_is_continuous_over_the_seam_has_ratio_one(frequency):
    mesh = painted(two_charts(), frequency)
    jump = seam_jump(mesh)
    assert jump is not None and jump.inside > 0.004
    assert seam_ratio(mesh) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("step", [0.05, 0.3])
def test_charts_of_other_colours_show_their_seam_and_its_height(step):
    mesh = painted(two_charts(), 2, step)
    jump = seam_jump(mesh)
    assert jump is not None and jump.seams == pytest.approx(step, rel=0.3) and jump.ratio > 2 + 20 * step


def test_a_flat_texture_has_ratio_one():
    mesh = two_charts()
    assert seam_ratio(mesh) == 1


def test_shifting_a_chart_by_whole_repeats_makes_no_seam():
    mesh = painted(two_charts(), 10)
    shifted = mesh.corner_uvs + np.arange(len(mesh.faces))[:, None, None] % 3
    there = seam_jump(mesh.with_layer(corner_uvs=shifted))
    np.testing.assert_allclose(there, seam_jump(mesh), rtol=1e-9)


def test_without_seams_or_without_textures_there_is_no_ratio():
    mesh = two_charts()
    whole = mesh.vertices[mesh.faces][..., 1:] * 0.4 + 0.5
    assert seam_ratio(mesh.with_layer(corner_uvs=whole)) is None
    assert seam_ratio(mesh.with_layer(images=())) is None
