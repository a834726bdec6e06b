"""Laws of the field-latent VAE: codes turn with the frame, colours do not, rings do not see each other."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.config import FLVAE
from flx.fields import polynomials
from flx.fields.algebra import complex_linear, real_pairs, tangent_noise
from flx.models import frame
from flx.models.layers import Posterior
from flx.models.transformer import Attention
from flx.models.vae import FieldLatentVAE, flvae_loss, kl_divergence
from flx.pipeline.codec import Codec, initial_params, load_codec, save_codec
from flx.types import Queries, RingSamples

SMALL = FLVAE(channels=16, layers=2, heads=4, samples=24, decoder_width=32, precision="float32")
CONFIGS = [SMALL, replace(SMALL, encoder="frame", invariants=3)]


def rings(count: int, samples: int = 24, seed: int = 0, noise: float = 0.02) -> RingSamples:
    """Random rings with smooth random colours."""
    rng = np.random.default_rng(seed)
    radius, angle = (
        1.9 * np.sqrt(rng.random((2, count, samples)))[0],
        2 * np.pi * rng.random((count, samples)),
    )
    logs = (radius * np.exp(1j * angle)).astype(np.complex64)
    slopes = rng.normal(0, 0.04, (2, count, 1, 3))
    colors = rng.uniform(0.15, 0.85, (count, 1, 3)) + logs.real[..., None] * slopes[0]
    colors = colors + logs.imag[..., None] * slopes[1] + rng.normal(0, noise, (count, samples, 3))
    return RingSamples(jnp.asarray(logs), jnp.asarray(colors, jnp.float32))


def code_turn(config: FLVAE, turn: np.ndarray) -> np.ndarray:
    """How each channel of a code turns with its vertex's frame: vectors do, invariants do not."""
    vectors = config.latents - config.invariants
    return np.where(np.arange(config.latents) < vectors, turn[:, None], 1)


def trained_a_little(config: FLVAE) -> tuple[FieldLatentVAE, dict]:
    params = initial_params(config, 0)
    if config.encoder == "frame":
        params = frame.start_from_principal_components(params, rings(500, config.samples, 9))
    return FieldLatentVAE(config), params


def encode(model: FieldLatentVAE, params: dict, r: RingSamples) -> Posterior:
    return model.apply(params, r, method=FieldLatentVAE.encode)  # type: ignore[return-value]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: c.encoder)
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
    colors = model.apply(params, query, here.mean, method=FieldLatentVAE.decode)
    turned = model.apply(params, query * turn, here.mean * turns, method=FieldLatentVAE.decode)
    np.testing.assert_allclose(turned, colors, atol=1e-5)
    assert np.std(colors) > 1e-4


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: c.encoder)
def test_a_ring_is_encoded_the_same_in_any_batch_or_chunk(config, monkeypatch):
    model, params = trained_a_little(config)
    r = rings(23)
    whole = encode(model, params, r).mean
    alone = encode(model, params, jax.tree.map(lambda a: a[7:8], r)).mean
    np.testing.assert_allclose(alone[0], whole[7], atol=1e-4)
    codec = Codec(config, params)
    monkeypatch.setattr("flx.pipeline.codec.RINGS", 5)
    np.testing.assert_allclose(codec.encode(r), whole, atol=1e-4)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: c.encoder)
def test_the_order_of_the_samples_does_not_matter(config):
    model, params = trained_a_little(config)
    r = rings(8)
    order = np.random.default_rng(0).permutation(24)
    shuffled = RingSamples(r.logs[:, order], r.colors[:, order])
    np.testing.assert_allclose(encode(model, params, shuffled).mean, encode(model, params, r).mean, atol=2e-4)


def test_black_and_white_flat_rings_have_different_codes():
    """A linear lift would send black to nothing; without a mean both would be the same."""
    for config in CONFIGS:
        model, params = trained_a_little(config)
        r = rings(6)
        black, white = (
            encode(model, params, r._replace(colors=jnp.full_like(r.colors, c))).mean for c in (0, 1)
        )
        assert np.abs(black).max() > 1e-2 and np.abs(black - white).max() > 1e-2


def test_polynomials_are_recovered_by_least_squares():
    r = rings(10, samples=64)
    wanted = jax.random.normal(jax.random.key(1), (10, polynomials.SIZE, 3))
    values = jnp.einsum("rsi,ric->rsc", polynomials.basis(r.logs), wanted)
    found = polynomials.least_squares(r.logs, values)
    back = jnp.einsum("rsi,ric->rsc", polynomials.basis(r.logs), found)
    assert np.mean((back - values) ** 2) < 0.01 * np.mean(values**2)  # the ridge damps a little


@given(angle=st.floats(-np.pi, np.pi))
def test_each_order_of_a_polynomial_turns_at_its_own_speed(angle):
    coefficients = jax.random.normal(jax.random.key(2), (4, polynomials.SIZE, 3))
    orders = polynomials.by_order(coefficients)
    np.testing.assert_array_equal(polynomials.from_orders(*orders), coefficients)

    turn = jnp.exp(1j * jnp.float32(angle))
    faster = [orders[0], *(pairs * turn**m for m, pairs in enumerate(orders[1:], 1))]
    u = tangent_noise(jax.random.key(0), (4, 9))
    here = jnp.einsum("rsi,ric->rsc", polynomials.basis(u), coefficients)
    there = jnp.einsum("rsi,ric->rsc", polynomials.basis(u * turn), polynomials.from_orders(*faster))
    np.testing.assert_allclose(there, here, atol=2e-4 * np.abs(here).max())


def test_colours_taken_apart_are_put_together_again():
    r = rings(12, samples=64)
    fitted = polynomials.least_squares(r.logs, r.colors - 0.5)
    parts = frame.take_apart(r)
    np.testing.assert_allclose(frame.put_together(*parts), fitted, atol=1e-5)
    code = frame.join(parts.scalars, parts.vectors)
    scalars, vectors = frame.split(code, 3)
    np.testing.assert_array_equal(scalars, parts.scalars)
    np.testing.assert_array_equal(vectors, parts.vectors)


def test_principal_components_keep_more_than_any_mean():
    """Before any training the linear maps give most of a smooth ring back."""
    config = replace(SMALL, encoder="frame", invariants=3, samples=64)
    model, params = trained_a_little(config)
    r = rings(200, samples=64, seed=5, noise=0)
    z = encode(model, params, r).mean
    back = model.apply(
        params, r.logs, jnp.broadcast_to(z[:, None], (200, 64, 8)), method=FieldLatentVAE.decode
    )
    assert np.mean((back - r.colors) ** 2) < 0.1 * np.mean((r.colors.mean(1, keepdims=True) - r.colors) ** 2)


def test_sampled_codes_have_the_mean_and_the_deviation_of_their_posterior():
    posterior = Posterior(jnp.full(100_000, 0.7 - 0.3j), jnp.full(100_000, -0.5))
    z = posterior.sample(jax.random.key(0))
    np.testing.assert_allclose(np.mean(z), 0.7 - 0.3j, atol=0.01)
    for coordinate in (np.real(z), np.imag(z)):
        np.testing.assert_allclose(np.std(coordinate), np.exp(-0.5), rtol=0.01)


def test_attention_is_that_of_real_pairs():
    """Against the library's attention over (re, im) pairs."""
    layer, x = Attention(4), tangent_noise(jax.random.key(0), (3, 7, 8))
    params = layer.init(jax.random.key(1), x)
    first, last = (params["params"][f"ComplexDense_{k}"]["kernel"] for k in (0, 1))

    def heads(part):
        return real_pairs(part.reshape(3, 7, 4, 2))

    q, k, v = (heads(part) for part in jnp.split(complex_linear(x, first), 3, -1))
    re, im = jnp.split(jax.nn.dot_product_attention(q, k, v, scale=2**-0.5), 2, -1)
    expected = complex_linear(jax.lax.complex(re, im).reshape(x.shape), last)
    np.testing.assert_allclose(layer.apply(params, x), expected, atol=1e-5)


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
    "config", [replace(SMALL, invariants=2), replace(SMALL, encoder="frame"), replace(CONFIGS[1], latents=3)]
)
def test_codes_that_an_encoder_cannot_make_are_refused(config):
    with pytest.raises(ValueError, match="invariants"):
        initial_params(config, 0)


# --- the codec on disk and in use


def test_weights_come_back_as_they_were_saved(tmp_path):
    params = trained_a_little(CONFIGS[1])[1]
    save_codec(tmp_path / "w.safetensors", Codec(CONFIGS[1], params), {"steps": "0"})
    back = load_codec(tmp_path / "w.safetensors")
    assert back.config == CONFIGS[1] and back.digest() == Codec(CONFIGS[1], params).digest()
    r = rings(5)
    np.testing.assert_array_equal(back.encode(r), Codec(CONFIGS[1], params).encode(r))


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "foreign"])
def test_damaged_weights_are_refused_in_one_line(tmp_path, damage):
    path = tmp_path / "w.safetensors"
    save_codec(path, Codec(SMALL, initial_params(SMALL, 0)), {})
    content = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes({"empty": b"", "cut": content[:-100], "foreign": b"x" * 1000}[damage])
    with pytest.raises(ValueError, match="holds no FL-VAE weights") as caught:
        load_codec(path)
    assert "\n" not in str(caught.value)


def test_the_released_codec_reconstructs_and_does_not_mind_the_frame():
    codec = load_codec()
    r = rings(300, codec.config.samples)
    z = codec.encode(r)
    vertices = np.repeat(np.arange(300, dtype=np.int32), 3).reshape(-1, 3)
    queries = Queries(vertices, np.asarray(r.logs[:, :3]), np.eye(3, dtype=np.float32)[np.arange(300) % 3])
    colors = codec.decode(queries, z)
    asked = np.asarray(r.colors)[np.arange(300), np.arange(300) % 3]
    error = np.sqrt(np.mean((colors - asked) ** 2))
    assert error < 0.05 and np.std(asked) > 0.15

    turn = np.exp(1j * np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 1))).astype(np.complex64)
    turned = codec.decode(
        queries._replace(logs=queries.logs * turn), codec.encode(r._replace(logs=r.logs * turn))
    )
    np.testing.assert_allclose(turned, colors, atol=1e-4)
