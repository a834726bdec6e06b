"""Laws of polynomials in the tangent plane: found by least squares, turned order by order."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers.codecs import rings, weights_of
from hypothesis import given
from hypothesis import strategies as st

from flx.fields import polynomials
from flx.fields.algebra import tangent_noise


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
