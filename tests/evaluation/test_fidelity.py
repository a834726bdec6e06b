"""Laws of the metrics: over covered texels only, and 0 for the same picture."""

import numpy as np
import pytest

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
