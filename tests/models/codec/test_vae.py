"""Laws of the field-latent VAE: codes turn with the frame, colours do not, rings do not see each other."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.config import FLVAE, FRAME_VECTORS
from flx.fields import polynomials
from flx.fields.algebra import complex_linear, real_pairs, tangent_noise
from flx.models.codec import frame
from flx.models.codec.transformer import Attention
from flx.models.codec.vae import FieldLatentVAE, blend_weights, flvae_loss, kl_divergence
from flx.models.layers import Posterior
from flx.pipeline.codec import Codec, initial_params, load_codec, save_codec
from flx.types import Queries, RingSamples

SMALL = FLVAE(channels=16, layers=2, heads=4, samples=24, decoder_width=32, precision="float32")
FRAME = replace(SMALL, encoder="frame", invariants=3, width=32, depth=2, edges=6, sharpness=2.0)
INTERPOLATED = replace(FRAME, decoder="interpolated", sharpness=1.0)
CONFIGS = [SMALL, FRAME, INTERPOLATED]
each_config = pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.encoder} {c.decoder}")


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


@cache
def trained_a_little(config: FLVAE) -> tuple[FieldLatentVAE, dict]:
    params = initial_params(config, 0)
    if config.encoder == "frame":
        params = frame.start_from_principal_components(params, rings(500, config.samples, 9))
    return FieldLatentVAE(config), params


def encode(model: FieldLatentVAE, params: dict, r: RingSamples) -> Posterior:
    return model.apply(params, r, method=FieldLatentVAE.encode)  # type: ignore[return-value]


def alone(logs: jax.Array) -> Queries:
    """Points in faces that have the same vertex at all three corners: [V, P] of each vertex."""
    vertices = jnp.broadcast_to(jnp.arange(logs.shape[0], dtype=jnp.int32)[:, None], logs.shape)
    weights = jnp.full((*logs.shape, 3), 1 / 3, jnp.float32)
    thrice = (jnp.stack([a] * 3, -1) for a in (vertices, logs))
    return Queries(*(a.reshape(-1, 3) for a in (*thrice, weights)))


def decode(model: FieldLatentVAE, params: dict, logs: jax.Array, z: jax.Array) -> jax.Array:
    """The colours [V, P] that each vertex's code shows at its own points."""
    expanded = model.apply(params, z, method=FieldLatentVAE.expand)
    colors = model.apply(params, expanded, alone(logs), method=FieldLatentVAE.blend)
    return colors.reshape(*logs.shape, 3)  # type: ignore[union-attr]


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


@each_config
def test_a_ring_is_encoded_the_same_in_any_batch_or_chunk(config, monkeypatch):
    model, params = trained_a_little(config)
    r = rings(23)
    whole = encode(model, params, r).mean
    single = encode(model, params, jax.tree.map(lambda a: a[7:8], r)).mean
    np.testing.assert_allclose(single[0], whole[7], atol=1e-4)
    codec = Codec(config, params)
    points = alone(r.logs[:, :4])
    colors = codec.decode(points, whole)
    for name, size in {"RINGS": 5, "VERTICES": 5, "POINTS": 50}.items():
        monkeypatch.setattr(f"flx.pipeline.codec.{name}", size)
    np.testing.assert_allclose(codec.encode(r), whole, atol=1e-4)
    np.testing.assert_allclose(codec.decode(points, whole), colors, atol=1e-5)
    assert np.ptp(colors) > 0.1


@each_config
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


def polynomial_at(u: jax.Array, coefficients: jax.Array, degree: int = 5) -> jax.Array:
    return jnp.einsum("rsi,ric->rsc", polynomials.basis(u, degree), coefficients)


def test_polynomials_are_recovered_by_least_squares():
    r = rings(10, samples=64)
    wanted = jax.random.normal(jax.random.key(1), (10, polynomials.size(5), 3))
    values = polynomial_at(r.logs, wanted)
    errors = polynomial_at(r.logs, polynomials.least_squares(r.logs, values, 5)) - values
    near = np.abs(r.logs) < polynomials.NEAR
    assert np.mean(errors[near] ** 2) < 0.01 * np.mean(values[near] ** 2)  # the ridge damps a little


def test_a_polynomial_of_low_degree_is_the_start_of_one_of_high_degree():
    u = tangent_noise(jax.random.key(0), (4, 9))
    low = polynomials.basis(u, 3)
    constant, pairs, _ = polynomials.coefficient_rows(3)
    assert low.shape[-1] == polynomials.size(3) == len(constant) + 2 * len(pairs)
    np.testing.assert_allclose(polynomials.basis(u, 5)[..., : polynomials.size(3)], low, rtol=1e-6)


@given(angle=st.floats(-np.pi, np.pi))
def test_each_order_of_a_polynomial_turns_at_its_own_speed(angle):
    coefficients = jax.random.normal(jax.random.key(2), (4, polynomials.size(5), 3))
    zeroth, pairs = polynomials.by_order(coefficients, 5)
    np.testing.assert_array_equal(polynomials.from_orders(zeroth, pairs, 5), coefficients)

    turn = np.exp(1j * angle) ** np.array(polynomials.coefficient_rows(5)[2])[:, None]
    faster = polynomials.from_orders(zeroth, pairs * turn.astype(np.complex64), 5)
    u = tangent_noise(jax.random.key(0), (4, 9))
    here = polynomial_at(u, coefficients)
    there = polynomial_at(u * jnp.exp(1j * jnp.float32(angle)), faster)
    np.testing.assert_allclose(there, here, atol=2e-4 * np.abs(here).max())


def test_an_upright_ring_looks_the_same_in_every_frame():
    r = rings(12, samples=64)
    turn = np.exp(1j * np.random.default_rng(1).uniform(-np.pi, np.pi, 12)).astype(np.complex64)
    here, there = frame.upright(r), frame.upright(r._replace(logs=r.logs * turn[:, None]))
    np.testing.assert_allclose(there.scalars, here.scalars, atol=1e-5)
    np.testing.assert_allclose(there.vectors, here.vectors, atol=1e-4)
    np.testing.assert_allclose(there.direction, here.direction * turn, atol=1e-3)
    assert np.std(here.vectors) > 1e-2


def test_a_code_is_split_as_it_was_joined():
    r = frame.upright(rings(12))
    scalars, vectors = frame.split_code(frame.join_code(r.scalars[:, :6], r.vectors), 3)
    np.testing.assert_array_equal(scalars, r.scalars[:, :6])
    np.testing.assert_array_equal(vectors, r.vectors)


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


@each_config
def test_at_a_corner_a_face_has_the_colour_of_its_vertex(config):
    model, params, z, points = three_corners(config, 3)
    expanded = model.apply(params, z, method=FieldLatentVAE.expand)
    points = points._replace(barycentrics=jnp.eye(3))
    found = model.apply(params, expanded, points, method=FieldLatentVAE.blend)
    expected = decode(model, params, jnp.diag(points.logs)[:, None], z)[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.ptp(expected, axis=0).max() > 0.01


@pytest.mark.parametrize("config", [SMALL, FRAME], ids=lambda c: c.encoder)
def test_inside_a_face_the_colours_of_its_corners_are_blended(config):
    model, params, _, points = three_corners(config)
    blended, corners, _ = model.apply(params, rings(3), points, jax.random.key(0))
    powers = points.barycentrics[..., None] ** config.sharpness
    np.testing.assert_allclose(blended, (powers * corners).sum(1) / powers.sum(1), atol=1e-5)
    assert np.abs(blended - corners.mean(1)).max() > 0.01


def weights_of(logs: jax.Array) -> np.ndarray:
    """How samples count: a Gaussian about the vertex, a mean vertex radius wide."""
    weights = np.exp(-(np.abs(np.asarray(logs, np.complex128)) ** 2) / 2)
    return weights / weights.sum(-1, keepdims=True)


def test_a_fit_is_closest_where_the_vertex_is_asked_most():
    """Of no other polynomial are the weighted squares and the damping together less: their slope is zero."""
    r = rings(10, samples=64, noise=0.3)
    fit = np.asarray(polynomials.least_squares(r.logs, r.colors, 5), np.float64)
    basis = np.asarray(polynomials.basis(r.logs, 5), np.float64)
    errors = basis @ fit - np.asarray(r.colors)
    slopes = np.einsum("rs,rsn,rsc->rnc", weights_of(r.logs), basis, errors)
    damping = np.array([1e-3 * (1 + 2 * d) for d, m in polynomials.terms(5) for _ in range(2 if m else 1)])
    np.testing.assert_allclose(slopes, -damping[:, None] * fit, atol=2e-5)
    assert np.abs(damping[:, None] * fit).max() > 1e-3


def test_components_are_measured_by_colours_where_samples_count():
    """The norm of coefficients in the metric is the weighted mean square of their polynomial."""
    logs = rings(200, samples=64).logs
    metric, _ = frame._metrics(logs)
    constant = polynomials.coefficient_rows(frame.FITTED_DEGREE)[0]
    terms = np.asarray(polynomials.basis(logs.ravel(), frame.FITTED_DEGREE), np.float64)[:, constant]
    coefficients = np.random.default_rng(0).normal(size=(len(constant), 3))
    expected = weights_of(logs.ravel()) @ ((terms @ coefficients) ** 2).sum(1)
    np.testing.assert_allclose(((coefficients.ravel() @ metric) ** 2).sum(), expected, rtol=1e-4)


def test_principal_components_keep_more_than_any_mean():
    """Before any training the linear maps give most of a smooth ring back."""
    model, params = trained_a_little(replace(FRAME, samples=64, edges=1))
    r = rings(200, samples=64, seed=5, noise=0)
    back = decode(model, params, r.logs, encode(model, params, r).mean)
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
    ("config", "changed"),
    [(SMALL, {"invariants": 2}), (SMALL, {"encoder": "frame"}), (FRAME, {"latents": 3})],
)
def test_codes_that_an_encoder_cannot_make_are_refused(config, changed):
    with pytest.raises(ValueError, match="invariants"):
        replace(config, **changed)


def test_a_frame_code_has_at_most_the_vectors_of_its_polynomials():
    assert frame.VECTORS == FRAME_VECTORS
    with pytest.raises(ValueError, match="1 to 48 vectors"):
        replace(FRAME, latents=FRAME.invariants + FRAME_VECTORS + 1)


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


# --- the codec on disk and in use


def test_weights_come_back_as_they_were_saved(tmp_path):
    params = trained_a_little(FRAME)[1]
    save_codec(tmp_path / "w.safetensors", Codec(FRAME, params), {"steps": "0"})
    back = load_codec(tmp_path / "w.safetensors")
    assert back.config == FRAME and back.digest() == Codec(FRAME, params).digest()
    r = rings(5)
    np.testing.assert_array_equal(back.encode(r), Codec(FRAME, params).encode(r))


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
    """At points near the vertices of rings that are smooth, and at any frames of these."""
    codec = load_codec()
    r = rings(300, codec.config.samples)
    queries = alone(r.logs[:, :3])
    colors = codec.decode(queries, codec.encode(r))
    asked = np.asarray(r.colors[:, :3]).reshape(-1, 3)
    assert np.sqrt(np.mean((colors - asked) ** 2)) < 0.05 < 0.15 < np.std(asked)

    turn = np.exp(1j * np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 1))).astype(np.complex64)
    z = codec.encode(r._replace(logs=r.logs * turn))
    np.testing.assert_allclose(codec.decode(alone(r.logs[:, :3] * turn), z), colors, atol=1e-4)
