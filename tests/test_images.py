"""Laws of the one-rings that the FL-VAE is trained on."""

import numpy as np
import pytest
from PIL import Image

from flx.config import FLVAE, Images
from flx.mesh.triangulations import planar
from flx.pipeline import images
from flx.pipeline.images import ImageRings


@pytest.fixture
def folder(tmp_path):
    """Three smooth pictures, one of them small."""
    y, x = np.mgrid[0:600, 0:700] / 600
    for k, size in enumerate([(600, 700), (520, 520), (100, 300)]):
        picture = 127 + 120 * np.sin(np.stack([x * (k + 3), y * 4, x + y], -1) * 3)
        Image.fromarray(picture[: size[0], : size[1]].astype(np.uint8)).save(tmp_path / f"{k}.png")
    return tmp_path


def test_a_batch_is_the_same_in_every_run_and_another_at_another_step(folder):
    config, model = Images(folder=str(folder)), FLVAE(samples=16)
    a, b = ImageRings(config, model, 8), ImageRings(config, model, 8)
    np.testing.assert_array_equal(a(3).rings.colors, b(3).rings.colors)
    assert np.abs(a(3).queries - a(4).queries).max() > 0.1


def test_fans_cover_the_plane_three_times():
    """Each triangle belongs to three rings; in mean radii the area of all of them is 3πV."""
    fans = images.fans(planar(300, (2.0, 1.0), np.random.default_rng(0)))
    z = fans.corners
    total = 0.5 * np.imag(np.conj(z[..., 0]) * z[..., 1]).sum()
    np.testing.assert_allclose(total, 3 * np.pi * len(z), rtol=1e-9)
    np.testing.assert_allclose(fans.areas[:, -1], 1)


def test_points_are_uniform_in_their_ring():
    fans = images.fans(planar(60, (1.0, 1.0), np.random.default_rng(1)))
    points = images.points_in_fans(fans, 4000, np.random.default_rng(2))
    z = fans.corners
    weights = np.imag(np.conj(z[..., 0]) * z[..., 1])
    centroid = (weights * z.sum(-1) / 3).sum(1) / weights.sum(1)
    np.testing.assert_allclose(points.mean(1), centroid, atol=0.08)


def test_colours_are_those_under_the_point():
    """On a picture that is linear in x, bilinear reading gives x itself."""
    ramp = np.zeros((1, 32, 256, 3), np.uint8)
    ramp[..., 0] = np.arange(256)
    x = np.linspace(0.3, 250.7, 11)[None]
    colors = images.bilinear(ramp, np.array([0]), x, np.full_like(x, 7.25))
    np.testing.assert_allclose(colors[0, :, 0] * 255, x[0], atol=1e-3)


def test_squeezing_keeps_areas():
    rng = np.random.default_rng(3)
    z = rng.normal(size=(5, 3)) + 1j * rng.normal(size=(5, 3))
    area = lambda z: np.imag(np.conj(z[:, 1] - z[:, 0]) * (z[:, 2] - z[:, 0]))  # noqa: E731
    squeezed = images.squeeze(z, np.full((5, 1), 1.7), rng.random((5, 1)))
    np.testing.assert_allclose(area(squeezed), area(z), rtol=1e-9)
    assert np.abs(squeezed - z).max() > 0.1


def test_half_of_the_rings_keep_their_colours():
    colors = np.random.default_rng(4).random((4000, 6, 3)).astype(np.float32)
    painted = images.recolor(colors, np.random.default_rng(5))
    kept = (painted == colors).all((1, 2)).mean()
    assert 0.45 < kept < 0.55 and painted.min() == 0 and painted.max() == 1


def test_a_folder_without_images_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no images"):
        ImageRings(Images(folder=str(tmp_path)), FLVAE(), 4)
