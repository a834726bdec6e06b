"""Laws of the methods that the FL-VAE is measured against: what each of them cannot lose."""

import numpy as np
import pytest
from helpers.subjects import rms, subject
from helpers.surfaces import icosphere, square_grid
from PIL import Image
from scipy.ndimage import gaussian_filter

from flx.evaluation import baselines
from flx.pipeline.patches import ImagePatches
from flx.types import RingSamples


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> ImagePatches:
    """Smooth coloured noise of several scales."""
    folder, rng = tmp_path_factory.mktemp("images"), np.random.default_rng(0)
    for k, scale in enumerate((2, 4, 8, 16)):
        picture = gaussian_filter(rng.normal(size=(512, 512, 3)), (scale, scale, 0))
        picture = (255 * (picture - picture.min()) / np.ptp(picture)).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{k}.png")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baselines, "FITTED_RINGS", 1024)
        patch.setattr(baselines, "GRID", 11)
        yield baselines.open_images(folder)


def test_vertex_colours_keep_linear_and_constant_colours():
    seen, points, truth = subject(square_grid(5), square_grid(9))
    assert rms(baselines.vertex_colours(seen)(points), truth) < 1e-6 < np.ptp(truth)
    seen, points, truth = subject(icosphere(1), icosphere(2), lambda x: np.full(x.shape, 0.3))
    np.testing.assert_allclose(baselines.vertex_colours(seen)(points), truth, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", [baselines.components, baselines.frame_components])
def test_sixteen_components_keep_nearly_linear_colours(method, images):
    """Better than vertices can that know their rings' mean colours alone, by far."""
    seen, points, truth = subject(square_grid(5), square_grid(9))
    means = seen.rings.colors.mean(1)
    flat = np.einsum("pkc,pk->pc", means[points.vertices], points.barycentrics)
    error = rms(method(images)(seen)(points), truth)
    assert error < 0.012 and error < rms(flat, truth) / 1.3


@pytest.mark.slow
def test_encoding_gives_back_the_coefficients_of_a_component(images):
    fitted = baselines.fit_components(images)
    seen, *_ = subject(square_grid(5), square_grid(9))
    wanted = np.random.default_rng(1).normal(size=16).astype(np.float32)
    logs = seen.rings.logs[:20]
    mean, patches = baselines._at(fitted, logs.ravel())
    rings = RingSamples(logs, np.asarray(mean + patches @ wanted, np.float32).reshape(*logs.shape, 3))
    found = np.asarray(baselines.encode_components(fitted._replace(noise=1e-6), rings))
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=2e-2)
