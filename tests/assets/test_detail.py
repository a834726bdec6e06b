"""Laws of what vertices keep, estimated: known for a chessboard, and the same read in both directions."""

import numpy as np
import pytest
from PIL import Image

from flx.assets.arrays import from_arrays
from flx.assets.asset import Asset
from flx.assets.detail import CELLS, detail, psnr_at, vertices_for
from flx.assets.inspect import texel_counts


def sheet(image: np.ndarray) -> Asset:
    """A square that shows the whole image."""
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    points = np.concatenate([uvs, np.zeros((4, 1))], 1)
    return from_arrays(points, [[0, 1, 2], [0, 2, 3]], uvs, image)


def chessboard(cell: int, size: int = 128) -> np.ndarray:
    rows, columns = np.indices((size, size)) // cell
    return np.repeat(255 * ((rows + columns) % 2)[..., None], 3, 2).astype(np.uint8)


def test_blocks_within_the_cells_of_a_chessboard_miss_nothing_and_larger_ones_all():
    asset = sheet(chessboard(8))
    found = detail(asset, texel_counts(asset))
    assert [round(cells) for cells, _ in found] == [128**2 // 16**2, 128**2 // 32**2]
    np.testing.assert_allclose([error for _, error in found], 0.25, rtol=1e-3)


def test_what_the_surface_does_not_show_does_not_count():
    image = chessboard(1)
    image[:, 64:] = 128
    half = np.array([[0.5, 0], [1, 0], [1, 1], [0.5, 1.0]])
    asset = from_arrays(np.pad(half, ((0, 0), (0, 1))), [[0, 1, 2], [0, 2, 3]], half, image)
    assert detail(asset, texel_counts(asset)) == []
    whole = sheet(image)
    assert detail(whole, texel_counts(whole))


@pytest.fixture(scope="module")
def noise() -> Asset:
    """Noise at all scales, as textures have it."""
    rng = np.random.default_rng(0)
    scales = [rng.integers(0, 255, (size, size, 3), np.uint8) for size in (4, 16, 64, 256)]
    images = [Image.fromarray(image).resize((256, 256), Image.Resampling.BILINEAR) for image in scales]
    return sheet(np.mean([np.asarray(image) for image in images], axis=0).astype(np.uint8))


def test_more_vertices_keep_more_and_both_questions_have_one_answer(noise):
    found = detail(noise, texel_counts(noise))
    psnrs = [psnr_at(found, count) for count in (10, 100, 1000, 5000, 10**5)]
    assert psnrs == sorted(psnrs) and psnrs[-1] > psnrs[0] + 3
    for count, psnr in zip((10, 100, 1000, 5000, 10**5), psnrs, strict=True):
        assert vertices_for(found, psnr) == pytest.approx(count, rel=1e-6)
    cells, error = found[1]
    assert psnr_at(found, cells / CELLS) == pytest.approx(-10 * np.log10(error), abs=1e-3)
