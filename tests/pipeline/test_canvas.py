"""Laws of the canvas: each texel is asked where it lies, and takes the colour of its point."""

import numpy as np
import pytest
from helpers.surfaces import icosphere

from flx.assets.asset import Asset
from flx.assets.vase import vase_asset
from flx.evaluation.fidelity import fidelity
from flx.geometry.sampling import surface_colors
from flx.pipeline.canvas import CHUNK, bake, chunks, open_canvas
from flx.types import Triangulation

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def asset() -> Asset:
    return vase_asset()


def test_colours_reach_the_texels_of_their_points(asset):
    """The whole way of a row with an exact method: the texels' own colours leave no error."""

    size = max(asset.mesh.textures[0].shape[:2])
    canvas = open_canvas(asset, icosphere(2), size)
    colors = surface_colors(asset.mesh, canvas.atlases[0].points)
    parts = np.split(colors, range(CHUNK, len(colors), CHUNK))
    assert len(parts) > 1
    right, wrong = iter(parts), iter(1 - part for part in parts)
    assert fidelity(asset, bake(canvas, lambda _: next(right)))["psnr"] > 100
    assert fidelity(asset, bake(canvas, lambda _: next(wrong)))["psnr"] < 20


def test_chunks_are_asked_where_the_texels_are(asset):
    """On its own triangles, a texel's corners and weights lead back to its place on the surface, in order."""
    vertices, faces = asset.mesh.vertices, asset.mesh.faces
    canvas = open_canvas(asset, Triangulation(vertices, faces), 128)
    assert canvas.atlases[0] is not None
    points = canvas.atlases[0].points
    places = [np.einsum("pkx,pk->px", vertices[part.vertices], part.barycentrics) for part in chunks(canvas)]
    expected = np.einsum("pkx,pk->px", vertices[faces[points.faces]], points.barycentrics)
    np.testing.assert_allclose(np.concatenate(places), expected, atol=1e-5 * np.ptp(vertices))
