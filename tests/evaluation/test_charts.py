"""Charts: cells of equal meaning wherever they are, and images that are turned as they should be."""

import numpy as np

from flx.assets.arrays import from_arrays
from flx.evaluation.charts import ANGLES, RINGS, chart_colors, chart_images, place_charts
from flx.geometry.geodesics import unfold
from flx.geometry.sampling import positions


def sheet(image):
    """A square of side 1 in the plane that shows an image."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    uvs = corners[:, :2] * [1, -1] + [0, 1]
    return from_arrays(corners, np.array([[0, 1, 2], [0, 2, 3]]), uvs=uvs, image=image).mesh


def test_cells_are_means_of_the_colours_around_the_centre():
    ramp = np.zeros((256, 256, 3), np.uint8)
    ramp[..., 0] = np.arange(256)
    ramp[..., 1] = np.arange(256)[::-1, None]
    mesh = sheet(ramp)
    sites = place_charts(mesh, unfold(mesh.vertices, mesh.faces), 0.01, 200, np.random.default_rng(0))
    centers = positions(mesh.vertices, mesh.faces, sites.centers)[:, :2]
    inside = (abs(centers - 0.5) < 0.5 - 1.1 * sites.radius).all(1)
    assert inside.sum() > 100
    charts = chart_colors(mesh, sites)[inside]
    assert charts.shape[1:] == (RINGS, ANGLES, 3)
    np.testing.assert_allclose(charts[:, :, :, :2].mean((1, 2)), centers[inside], atol=3e-3)
    outer = charts[:, -1].max(1) - charts[:, -1].min(1)  # a diameter of the outermost ring
    np.testing.assert_allclose(outer[:, :2], 2 * sites.radius * (1 - 0.5 / RINGS), rtol=0.03)


def test_an_image_shows_the_chart_unturned_and_unflipped():
    angle = (np.arange(ANGLES) + 0.5) / ANGLES * 2 * np.pi
    chart = np.zeros((1, RINGS, ANGLES, 3), np.float32)
    chart[..., 0] = np.cos(angle) > 0
    chart[..., 1] = np.sin(angle) > 0
    image = chart_images(chart, 16)[0]
    assert image[:, 10:, 0].min() > 0.9 and image[:, :6, 0].max() < 0.1
    assert image[10:, :, 1].min() > 0.9 and image[:6, :, 1].max() < 0.1
