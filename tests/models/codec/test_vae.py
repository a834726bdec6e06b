"""Laws of the field-latent VAE: codes turn with the frame, colours do not, rings do not see each other."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.codecs import (
    CONFIGS,
    FRAME,
    INTERPOLATED,
    SMALL,
    VECTORS,
    decode,
    each_config,
    encode,
    rings,
    trained_a_little,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.config import FLVAE, FRAME_VECTORS
from flx.fields.algebra import tangent_noise
from flx.models.codec import frame
from flx.models.codec.vae import FieldLatentVAE, blend_weights, flvae_loss, kl_divergence
from flx.models.layers import Posterior
from flx.types import Queries, RingSamples


def code_turn(config: FLVAE, turn: np.ndarray) -> np.ndarray:
    """How each channel of a code turns with its vertex's frame: vectors do, invariants do not."""
    vectors = config.latents - config.invariants
    return np.where(np.arange(config.latents) < vectors, turn[:, None], 1)


@pytest.mark.slow
@each_config
@settings(max_examples=5)
@given(seed=st.integers(0, 100))
def test_codes_turn_with_the_frame_and_colours_stay(config, seed):
    model, params = trained_a_little(config)
    r = rings(12, seed=seed)
    turn = np.exp(1j * np.random.default_rng(seed).uniform(-np.pi, np.pi, 12)).astype(np.complex64)
    here, there = encode(model, params, r), encode(model, params, r._replace(logs=r.logs * turn[:, None]))
    size = np.abs(here.mean).max()
    assert size > 0.05
    turns = code_turn(config, turn)
    np.testing.assert_allclose(there.mean, here.mean * turns, atol=2e-4 * size)
    np.testing.assert_allclose(there.log_sigma, here.log_sigma, atol=2e-4)

    query = tangent_noise(jax.random.key(seed), (12,))
    colors = decode(model, params, query[:, None], here.mean)
    turned = decode(model, params, (query * turn)[:, None], here.mean * turns)
    np.testing.assert_allclose(turned, colors, atol=1e-5)
    assert np.std(colors) > 1e-4


@pytest.mark.slow
@each_config
def test_the_order_of_the_samples_does_not_matter(config):
    model, params = trained_a_little(config)
    r = rings(8)
    order = np.random.default_rng(0).permutation(24)
    shuffled = RingSamples(r.logs[:, order], r.colors[:, order])
    np.testing.assert_allclose(encode(model, params, shuffled).mean, encode(model, params, r).mean, atol=2e-4)


@pytest.mark.slow
def test_black_and_white_flat_rings_have_different_codes():
    """A linear lift would send black to nothing; without a mean both would be the same."""
    for config in CONFIGS:
        model, params = trained_a_little(config)
        r = rings(6)
        black, white = (
            encode(model, params, r._replace(colors=jnp.full_like(r.colors, c))).mean for c in (0, 1)
        )
        assert np.abs(black).max() > 1e-2 and np.abs(black - white).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("sharpness", [1.0, 2.0, 3.5])
def test_a_blend_is_a_mean_that_is_one_corner_at_a_corner_and_two_on_an_edge(sharpness):
    inside = jnp.asarray(np.random.default_rng(0).dirichlet(np.ones(3), 50), jnp.float32)
    weights = blend_weights(inside, sharpness)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-5)
    np.testing.assert_array_equal(np.argsort(weights, 1), np.argsort(inside, 1))
    np.testing.assert_allclose(blend_weights(jnp.eye(3), sharpness), np.eye(3))
    half = blend_weights(jnp.array([[0.5, 0.5, 0], [0.7, 0.3, 0]]), sharpness)
    np.testing.assert_allclose(half[0], [0.5, 0.5, 0], atol=1e-6)
    assert half[1, 2] == 0 and half[1, 0] >= 0.7 - 1e-6


def three_corners(config: FLVAE, count: int = 20) -> tuple[FieldLatentVAE, dict, jax.Array, Queries]:
    """Points of one face whose corners have codes of their own."""
    model, params = trained_a_little(config)
    z = encode(model, params, rings(3)).mean
    weights = jnp.asarray(np.random.default_rng(1).dirichlet(np.ones(3), count), jnp.float32)
    vertices = jnp.broadcast_to(jnp.arange(3, dtype=jnp.int32), weights.shape)
    return model, params, z, Queries(vertices, tangent_noise(jax.random.key(5), weights.shape), weights)


@pytest.mark.slow
@each_config
def test_at_a_corner_a_face_has_the_colour_of_its_vertex(config):
    model, params, z, points = three_corners(config, 3)
    expanded = model.apply(params, z, method=FieldLatentVAE.expand)
    points = points._replace(barycentrics=jnp.eye(3))
    found = model.apply(params, expanded, points, method=FieldLatentVAE.blend)
    expected = decode(model, params, jnp.diag(points.logs)[:, None], z)[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.ptp(expected, axis=0).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("config", [SMALL, FRAME], ids=lambda c: c.encoder)
def test_inside_a_face_the_colours_of_its_corners_are_blended(config):
    model, params, _, points = three_corners(config)
    blended, corners, _ = model.apply(params, rings(3), points, jax.random.key(0))
    powers = points.barycentrics[..., None] ** config.sharpness
    np.testing.assert_allclose(blended, (powers * corners).sum(1) / powers.sum(1), atol=1e-5)
    assert np.abs(blended - corners.mean(1)).max() > 0.01


def test_kl_is_the_closed_form_of_two_real_gaussians_a_channel():
    """Against a Monte-Carlo estimate of E_q[ln q − ln p]."""
    mean, log_sigma = jnp.array([0.7 - 0.3j, 1.2j]), jnp.array([-0.5, 0.2])
    posterior = Posterior(mean, log_sigma)
    noise = tangent_noise(jax.random.key(0), (400_000, 2))
    z = mean + jnp.exp(log_sigma) * noise
    ln_q = jnp.sum(-0.5 * jnp.abs(noise) ** 2 - 2 * log_sigma, -1)
    ln_p = jnp.sum(-0.5 * jnp.abs(z) ** 2, -1)
    np.testing.assert_allclose(kl_divergence(posterior), np.mean(ln_q - ln_p), rtol=0.01)
    zero = Posterior(jnp.zeros(2, jnp.complex64), jnp.zeros(2))
    np.testing.assert_allclose(kl_divergence(zero), 0, atol=1e-6)


def test_the_loss_is_zero_only_for_the_right_colours():
    posterior = Posterior(jnp.zeros((1, 2), jnp.complex64), jnp.zeros((1, 2)))
    colors = jnp.full((1, 4, 3), 0.25)
    assert flvae_loss(colors, colors, posterior, 1.0)[0] == 0
    np.testing.assert_allclose(flvae_loss(colors, colors + 0.1, posterior, 1.0)[0], 0.3, rtol=1e-5)


@pytest.mark.parametrize(
    ("config", "changed"),
    [
        (SMALL, {"invariants": 2}),
        (FRAME, {"invariants": 4}),
        (FRAME, {"latents": 3}),
        (VECTORS, {"latents": 3}),
    ],
)
def test_codes_that_an_encoder_cannot_make_are_refused(config, changed):
    with pytest.raises(ValueError, match="invariants"):
        replace(config, **changed)


@pytest.mark.parametrize(
    ("config", "changed"),
    [
        (SMALL, {"encoder": "convolution"}),
        (SMALL, {"precision": "float16"}),
        (SMALL, {"heads": 3}),
        (SMALL, {"decoder_layers": 0}),
        (FRAME, {"decoder": "linear"}),
        (FRAME, {"edges": 0}),
        (FRAME, {"depth": -1}),
        (FRAME, {"sharpness": 0.5}),
        (FRAME, {"sharpness": float("nan")}),
        (INTERPOLATED, {"sharpness": 2.0}),
    ],
    ids=lambda x: str(x) if isinstance(x, dict) else "",
)
def test_fields_that_make_no_model_are_refused_by_name_in_one_line(config, changed):
    ((field, value),) = changed.items()
    broken = replace(config)
    object.__setattr__(broken, field, value)  # past the types, which are checked in tests only
    with pytest.raises(ValueError, match=f"^model.{field} is '?{value}") as caught:
        broken.__post_init__()
    assert "\n" not in str(caught.value)


def test_a_frame_code_has_at_most_the_vectors_of_its_polynomials():
    assert frame.VECTORS == FRAME_VECTORS
    with pytest.raises(ValueError, match="1 to 48 vectors"):
        replace(FRAME, latents=FRAME.invariants + FRAME_VECTORS + 1)


# --- the codec on disk and in use
