"""Laws of the metrics: over covered texels only, and 0 for the same picture; of what is written, and when."""

import numpy as np
import pytest
from helpers.cube import changed, saved
from PIL import Image

from flx.commands.reconstruct import Reconstruct, reconstruct
from flx.evaluation.fidelity import compare, psnr


def pictures() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    covered = np.zeros((64, 64), bool)
    covered[10:50, 12:40] = True
    return rng.integers(0, 256, (64, 64, 3), np.uint8), covered


def test_the_same_picture_is_without_error():
    picture, covered = pictures()
    distances = compare(picture, picture, covered)
    assert distances["squared_error"] == 0 and abs(distances["dssim"]) < 1e-6


@pytest.mark.parametrize("size", [(1, 256), (4, 4), (10, 11)])
def test_pictures_smaller_than_a_window_are_measured(size):
    """Palettes of a pixel's height are common: all of them is compared, and nothing else."""
    rng = np.random.default_rng(0)
    picture, other = rng.integers(0, 256, (2, *size, 3), np.uint8)
    covered = np.ones(size, bool)
    assert abs(compare(picture, picture, covered)["dssim"]) < 1e-6
    distances = compare(picture, other, covered)
    assert distances["squared_error"] == pytest.approx(
        np.mean((picture / 255.0 - other / 255.0) ** 2), rel=1e-5
    )
    assert 0.1 < distances["dssim"] < 1


def test_what_is_not_covered_does_not_count():
    picture, covered = pictures()
    other = np.where(covered[..., None], np.clip(picture.astype(int) + 20, 0, 255), picture).astype(np.uint8)
    distances = compare(picture, other, covered)
    assert all(distance > 0 for distance in distances.values())
    noisy = np.where(covered[..., None], other, 255 - other).astype(np.uint8)
    assert compare(picture, noisy, covered) == distances


def test_error_is_the_mean_square_over_the_texels():
    picture = np.full((32, 32, 3), 100, np.uint8)
    covered = np.ones((32, 32), bool)
    error = compare(picture, picture + 51, covered)["squared_error"]
    np.testing.assert_allclose(error, 0.04, rtol=1e-4)
    np.testing.assert_allclose(psnr(0.04), 13.979, atol=1e-3)


def test_an_obj_is_reconstructed_as_the_same_obj_and_its_image_keeps_its_alpha(tmp_path):
    path, out = saved(tmp_path / "in"), tmp_path / "out"
    reconstruct(Reconstruct(path, vertices=60, texture_size=32, out=out, format="obj"))
    assert changed(path, out / "reconstruction.obj") == [
        (b"mtllib my cube.mtl\n", b"mtllib reconstruction.mtl\n")
    ]
    assert not (out / "reconstruction.png").exists()
    alpha = Image.open(out / "reconstruction_0.png").getchannel("A")
    assert alpha.size == (32, 16) and alpha.getextrema() == (77, 77)


def test_what_cannot_be_written_is_refused_before_anything_is_paid_for(tmp_path, monkeypatch):
    monkeypatch.setattr("flx.geometry.copies.make_copy", lambda *_: pytest.fail("a copy was made"))
    path = saved(tmp_path / "in")
    with pytest.raises(ValueError, match="has textures, a PLY has colours of vertices; take --format"):
        reconstruct(Reconstruct(path, out=tmp_path / "out", format="ply"))
    path = path.rename(path.with_name("reconstruction.obj"))
    with pytest.raises(ValueError, match=r"would overwrite a file of .*; name another --out"):
        reconstruct(Reconstruct(path, out=path.parent, format="obj"))
    assert not (tmp_path / "out").exists()
