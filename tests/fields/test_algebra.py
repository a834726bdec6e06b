"""Laws of tangent vectors: everything turns with the frame, and complex means complex."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flx.fields import algebra

ANGLES = st.floats(-np.pi, np.pi)


def noise(seed: int, *shape: int) -> jax.Array:
    return algebra.tangent_noise(jax.random.key(seed), shape)


def turned(x: jax.Array, angles: jax.Array) -> jax.Array:
    """Each row seen from a frame of its own."""
    return x * jnp.exp(1j * angles)[:, None]


FRAMES = jnp.asarray(np.random.default_rng(0).uniform(-np.pi, np.pi, 40))


def test_tangent_noise_has_unit_variance_in_each_coordinate():
    x = noise(0, 200_000)
    np.testing.assert_allclose(np.mean(np.abs(x) ** 2), 2, rtol=0.01)
    np.testing.assert_allclose(np.mean(np.abs(x)), np.sqrt(np.pi / 2), rtol=0.01)
    np.testing.assert_allclose(np.mean(x**2), 0, atol=0.02)  # no preferred direction


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("bfloat16", 2e-2)])
def test_complex_linear_is_the_complex_matrix_product(precision, tolerance):
    x, w = noise(1, 30, 7), jax.random.normal(jax.random.key(2), (2, 7, 5))
    expected = np.asarray(x) @ (np.asarray(w[0]) + 1j * np.asarray(w[1]))
    error = np.abs(algebra.complex_linear(x, w, precision) - expected).max()
    assert error < tolerance * np.abs(expected).max()


@pytest.mark.slow
def test_gradient_of_a_pair_of_real_weights_descends():
    """A complex parameter would need a conjugate; a pair must not."""
    x, w = noise(3, 50, 4), jnp.zeros((2, 4, 1))
    target = algebra.complex_linear(x, jax.random.normal(jax.random.key(4), w.shape))

    def loss(w: jax.Array) -> jax.Array:
        return jnp.mean(algebra.squared_modulus(algebra.complex_linear(x, w) - target))

    before = loss(w)
    for _ in range(200):
        w = w - 0.1 * jax.grad(loss)(w)
    assert loss(w) < 1e-3 * before


@given(seed=st.integers(0, 1000))
def test_layers_turn_with_the_frame(seed):
    q, k = noise(seed, 40, 6), noise(seed + 1, 40, 6)
    masses = jax.random.uniform(jax.random.key(seed), (40,))
    masses = masses / masses.sum()
    scale, delta = jnp.array([[0.5] * 6, [0.8] * 6]), jnp.full(6, 1e-3)
    for layer in (
        lambda q, k: algebra.vn_nonlinearity(q, k),
        lambda q, k: algebra.response_norm(q, masses, scale, delta),
        lambda q, k: algebra.token_norm(q, scale),
        lambda q, k: algebra.unit(q),
    ):
        there = layer(turned(q, FRAMES), turned(k, FRAMES))
        np.testing.assert_allclose(there, turned(layer(q, k), FRAMES), atol=1e-5)


@given(angle=ANGLES, seed=st.integers(0, 1000))
def test_inner_products_do_not_turn(angle, seed):
    x, y = noise(seed, 20), noise(seed + 1, 20)
    turn = np.exp(1j * angle)
    np.testing.assert_allclose(algebra.inner(x * turn, y * turn), algebra.inner(x, y), atol=1e-5)
    np.testing.assert_allclose(algebra.inner(x, x), algebra.squared_modulus(x), rtol=1e-6)


def test_vn_nonlinearity_keeps_what_agrees_and_cuts_what_opposes():
    k = noise(5, 100, 3)
    np.testing.assert_array_equal(algebra.vn_nonlinearity(k, k), k)  # along K: as it was
    np.testing.assert_allclose(algebra.vn_nonlinearity(-k, k), 0, atol=2e-3)  # against K: gone
    x = algebra.vn_nonlinearity(noise(6, 100, 3), k)
    assert np.min(algebra.inner(x, k)) > -1e-3


def test_response_norm_gives_unit_power_and_ignores_spare_vertices():
    x, delta = 7.0 * noise(7, 500, 4), jnp.zeros(4)
    scale = jnp.array([[1.0] * 4, [0.0] * 4])
    masses = jnp.ones(500) / 500
    y = algebra.response_norm(x, masses, scale, delta)
    np.testing.assert_allclose(np.mean(np.abs(y) ** 2, 0), 1, rtol=1e-4)
    padded = jnp.concatenate([x, 1e3 * noise(8, 9, 4)])
    again = algebra.response_norm(padded, jnp.pad(masses, (0, 9)), scale, delta)
    np.testing.assert_allclose(again[:500], y, rtol=1e-5)


@pytest.mark.parametrize("size", [1e-1, 1.0, 1e3])
def test_token_norm_gives_each_token_unit_power_whatever_its_size(size):
    x = size * noise(9, 30, 5) * jnp.arange(1, 31)[:, None]
    y = algebra.token_norm(x, jnp.array([[0.6] * 5, [0.8] * 5]))
    np.testing.assert_allclose(np.mean(np.abs(y) ** 2, 1), 1, rtol=1e-3)


@pytest.mark.slow
def test_gradients_at_zero_are_numbers():
    zero = jnp.zeros((3, 2), jnp.complex64)

    def total(x: jax.Array) -> jax.Array:
        y = algebra.vn_nonlinearity(x, x) + algebra.unit(x) + algebra.token_norm(x, jnp.ones((2, 2)))
        return jnp.sum(algebra.squared_modulus(y))

    assert np.all(np.isfinite(jax.grad(total)(zero)))
