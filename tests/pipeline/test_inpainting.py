"""Laws of inpainting: what is kept comes back to the bit, and what is new is made to fit it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.generators import textured_ball
from helpers.surfaces import icosphere
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from flx.assets.asset import Painting
from flx.controls import Controls
from flx.geometry.seams import border_ratio
from flx.pipeline.canvas import open_canvas, shown
from flx.pipeline.generator import Generator
from flx.pipeline.inpainting import (
    HELD,
    Inpainting,
    held,
    inpainting,
    kept_shares,
    restored,
)
from flx.pipeline.masks import Kept, kept_texels
from flx.pipeline.variations import generate

BALL = icosphere(2)


ASSET = textured_ball()
TEXTURE = ASSET.mesh.textures[0]
SHAPE = TEXTURE.shape[:2]
HALF = np.arange(SHAPE[0])[:, None] + np.zeros(SHAPE, int) < 32  # the upper half of the image, white


def written(folder, white: np.ndarray, **more):
    image = Image.fromarray(np.uint8(255) * white)
    image.save(folder / "mask.png", **more)
    return folder / "mask.png"


def kept_of(white: np.ndarray) -> Inpainting:
    kept = Kept(TEXTURE, 0, white)
    return Inpainting(kept, kept_shares(ASSET.mesh, kept, BALL, 64), None)  # pyright: ignore


@given(st.integers(0, 2**32 - 1), st.sampled_from([48, 96, 192]), st.floats(0.01, 0.99))
def test_what_is_kept_comes_back_to_the_bit_at_any_size(seed, size, share):
    """Of blots of any shape; at another size, of the input at that size."""
    rng = np.random.default_rng(seed)
    white = rng.random((8, 12)).repeat(8, 0).repeat(8, 1) < share
    part, canvas = kept_of(white), open_canvas(ASSET, BALL, size)
    drawn = rng.integers(0, 256, (size * 64 // 96, size, 3), np.uint8)
    new = restored(part, canvas, Painting({"base_color": (drawn,)})).images[0]
    there = part.kept.at_size(*new.shape[:2])
    np.testing.assert_array_equal(new[there.texels], there.image[there.texels])
    if size == 96:
        np.testing.assert_array_equal(there.image, TEXTURE)
        np.testing.assert_array_equal(there.texels, white)


def test_a_texel_is_kept_at_another_size_where_all_that_it_covers_is():
    white = np.ones(SHAPE, bool)
    white[11, 20] = False
    for height, kept in ((64, 1), (32, 1), (128, 4)):
        texels = Kept(TEXTURE, 0, white).at_size(height, height * 96 // 64).texels
        assert (~texels).sum() == kept and not texels[11 * height // 64, 20 * height // 64]


def test_new_texels_change_only_within_a_ring_of_the_border():
    part, canvas = kept_of(HALF), open_canvas(ASSET, BALL, 96)
    drawn = np.full_like(TEXTURE, 90)
    new = restored(part, canvas, Painting({"base_color": (drawn,)})).images[0]
    atlas = canvas.atlases[0]
    assert atlas is not None
    places = np.einsum("pkx,pk->px", BALL.vertices[BALL.faces[canvas.faces]], canvas.barycentrics)
    white = HALF[atlas.covered]
    away = np.linalg.norm(places[~white][:, None] - places[white], axis=2).min(1)
    changed = (new != drawn).any(2)[atlas.covered][~white]
    edge = np.linalg.norm(BALL.vertices[BALL.faces[:, 0]] - BALL.vertices[BALL.faces[:, 1]], axis=1).max()
    assert changed[away < edge / 4].mean() > 0.9 and not changed[away > edge].any() and (away > edge).any()


def test_an_offset_of_the_codec_vanishes_at_the_border():
    """New colours that are off by the same everywhere meet the kept ones as the input's own would."""
    part, canvas = kept_of(HALF), open_canvas(ASSET, BALL, 96)
    off = Painting({"base_color": (TEXTURE + np.uint8(30),)})
    naive = np.where(HALF[..., None], TEXTURE, off.images[0])
    blended = restored(part, canvas, off)
    one, other, own = (
        border_ratio(shown(ASSET, painting), 0, HALF) or 0.0
        for painting in (Painting({"base_color": (naive,)}), blended, Painting({"base_color": (TEXTURE,)}))
    )
    assert other < 1.1 * own < one / 2


def test_vertices_are_held_by_the_kept_share_of_their_rings():
    """The equator separates the charts: above it all is kept, below it nothing."""
    shares = kept_of(np.arange(SHAPE[1]) + np.zeros(SHAPE, int) < 48).shares
    height = BALL.vertices[:, 2]
    assert (shares[height > 0.3] == 1).all() and (shares[height < -0.3] == 0).all()
    rim = np.abs(height) < 0.05
    assert rim.any() and abs(shares[rim].mean() - 0.5) < 0.2


def test_held_vertices_have_their_codes_and_the_noise_of_the_level():
    """At the end the codes alone; before it, the same noise at every level; others are not touched."""
    alphas, where = jnp.array([1.0, 0.6, 0.2]), jnp.array([True, False])
    codes, noise, z = (jnp.full((2, 1), c, jnp.complex64) for c in (2 + 1j, 1 - 1j, 5j))
    for level, alpha in enumerate(alphas):
        at_level = held(where, codes, noise, alphas, z, jnp.float32(level), jax.random.key(0))
        expected = np.sqrt(alpha) * (2 + 1j) + np.sqrt(1 - alpha) * (1 - 1j)
        np.testing.assert_allclose(at_level[:, 0], [expected, 5j], rtol=1e-6)


def test_fill_is_keep_the_other_way_round_and_grey_goes_to_the_nearer(tmp_path):
    grey = np.where(HALF, 140, 100).astype(np.uint8)
    Image.fromarray(grey).save(tmp_path / "mask.png")
    keep, fill = (kept_texels(ASSET, Controls(**{name: tmp_path / "mask.png"})) for name in ("keep", "fill"))
    assert keep and fill
    np.testing.assert_array_equal(keep.texels, HALF)
    np.testing.assert_array_equal(fill.texels, ~HALF)
    clear = np.dstack([np.full((*SHAPE, 3), 255, np.uint8), np.uint8(255) * HALF])
    Image.fromarray(clear).save(tmp_path / "clear.png")
    keep = kept_texels(ASSET, Controls(keep=tmp_path / "clear.png"))
    assert keep and (keep.texels == HALF).all()
    assert kept_texels(ASSET, Controls()) is None
    assert kept_texels(ASSET, Controls(keep=written(tmp_path, np.zeros(SHAPE, bool)))) is None


def test_masks_that_do_not_fit_are_refused(tmp_path, generator):
    path = tmp_path / "mask.png"
    with pytest.raises(ValueError, match=r"mask .*mask\.png does not exist"):
        kept_texels(ASSET, Controls(keep=path))
    Image.fromarray(np.zeros((7, 9), np.uint8)).save(path)
    with pytest.raises(ValueError, match=r"mask .* has 9 × 7 pixels but the texture 96 × 64"):
        kept_texels(ASSET, Controls(keep=path))
    path.write_text("no image")
    with pytest.raises(ValueError, match="of no known kind"):
        kept_texels(ASSET, Controls(fill=path))
    with pytest.raises(ValueError, match="has 0 textures"):
        kept_texels(generator.asset, Controls(keep=path))
    with pytest.raises(ValueError, match="give one"):
        Controls(keep=path, fill=path)


@pytest.fixture(scope="module")
def textured(generator) -> Generator:
    """The generator of the coloured ball, of the same ball with a texture."""
    other = dataclasses.replace(generator)
    other.__dict__["asset"] = ASSET
    return other


@pytest.mark.slow
def test_all_kept_is_the_input_and_nothing_kept_is_a_plain_sample(textured, tmp_path):
    def first(**controls) -> np.ndarray:
        return next(generate(textured, 1, seed=3, steps=4, controls=Controls(**controls))).images[0]

    everything = written(tmp_path, np.ones(SHAPE, bool))
    np.testing.assert_array_equal(first(keep=everything), TEXTURE)
    np.testing.assert_array_equal(first(fill=everything), first())
    assert np.abs(first().astype(int) - TEXTURE).mean() > 5


@pytest.mark.slow
def test_sampling_ends_with_the_codes_of_what_is_kept_and_changes_with_the_seed_elsewhere(textured):
    part = inpainting(textured, Kept(TEXTURE, 0, HALF), BALL)
    where, codes, *_ = part.hook.args
    assert 20 < where.sum() < 142 and (where == (part.shares >= HELD)).all()
    one, other = (
        textured.scaling.to_diffusion(
            textured.sample(jax.random.key(n), steps=6, hook=part.hook, repeats=(2, 1))
        )
        for n in (0, 1)
    )
    np.testing.assert_allclose(one[where], codes[where], atol=1e-5)
    assert np.abs(one[~where] - other[~where]).min(0).max() > 1e-3


@pytest.mark.slow
def test_codes_of_the_border_do_not_tell_what_was_there(textured):
    """Another picture where nothing is kept leaves every held code as it is."""
    other = np.where(HALF[..., None], TEXTURE, 255 - TEXTURE)
    changed = dataclasses.replace(textured)
    changed.__dict__["asset"] = ASSET._replace(mesh=ASSET.mesh.with_layer(images=(other,)))
    one = inpainting(textured, Kept(TEXTURE, 0, HALF), BALL)
    two = inpainting(changed, Kept(other, 0, HALF), BALL)
    np.testing.assert_array_equal(one.hook.args[1], two.hook.args[1])
