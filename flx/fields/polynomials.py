"""Real polynomials on a tangent plane, up to degree three: the smooth part of a one-ring's colours.

A polynomial is Σ r^{d−m} (A Re u^m + B Im u^m) over degrees d and orders m = d, d−2, … ≥ 0. Where the
frame turns, the pair A + iB of order m turns by e^{imα}: least squares in this basis is equivariant.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float

from flx.fields.algebra import squared_modulus

TERMS = ((0, 0), (1, 1), (2, 0), (2, 2), (3, 1), (3, 3))  # (degree, order) of each coefficient or pair
SIZE = sum(1 if order == 0 else 2 for _, order in TERMS)
RIM = 1.9  # the usual distance of a ring's rim in mean vertex radii: terms are about 1 there
ROWS = ((0, 3), (1, 6), (4,), (8,))  # of the coefficients, or the first of each pair, by order
# Adds to the Gram matrix what 64 samples leave undetermined; higher degrees are smaller in pictures.
RIDGE = np.array([1e-3 * (1 + 2 * d) for d, m in TERMS for _ in range(2 if m else 1)])


def basis(u: Complex[Array, "*B"]) -> Float[Array, "*B N"]:
    """Every term at the point u, lengths in mean vertex radii."""
    terms = []
    for degree, order in TERMS:
        radial = squared_modulus(u) ** ((degree - order) // 2) / RIM**degree
        power = u**order
        terms += [radial] if order == 0 else [radial * jnp.real(power), radial * jnp.imag(power)]
    return jnp.stack(terms, -1)


def least_squares(logs: Complex[Array, "*B S"], values: Float[Array, "*B S C"]) -> Float[Array, "*B N C"]:
    """The coefficients of the polynomial nearest to the values at the samples, slightly damped."""
    terms = basis(logs)
    samples = terms.shape[-2]
    gram = jnp.einsum("...si,...sj->...ij", terms, terms) / samples + jnp.diag(RIDGE)
    moments = jnp.einsum("...si,...sc->...ic", terms, values) / samples
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(gram), True), moments)


def by_order(
    coefficients: Float[Array, "*B N C"],
) -> tuple[
    Float[Array, "*B 2 C"], Complex[Array, "*B 2 C"], Complex[Array, "*B 1 C"], Complex[Array, "*B 1 C"]
]:
    """The coefficients of order 0, and the pairs A + iB of orders 1, 2 and 3 as complex numbers."""
    zeroth, first, second, third = (
        jnp.stack([coefficients[..., row, :] for row in rows], -2) for rows in ROWS
    )
    imaginary = (jnp.stack([coefficients[..., row + 1, :] for row in rows], -2) for rows in ROWS[1:])
    pairs = (jax.lax.complex(re, im) for re, im in zip((first, second, third), imaginary, strict=True))
    return zeroth, *pairs  # type: ignore[return-value]


def from_orders(
    zeroth: Float[Array, "*B 2 C"],
    first: Complex[Array, "*B 2 C"],
    second: Complex[Array, "*B 1 C"],
    third: Complex[Array, "*B 1 C"],
) -> Float[Array, "*B N C"]:
    """The inverse of `by_order`."""
    rows = {row: zeroth[..., k, :] for k, row in enumerate(ROWS[0])}
    for pairs, starts in zip((first, second, third), ROWS[1:], strict=True):
        for k, row in enumerate(starts):
            rows |= {row: jnp.real(pairs[..., k, :]), row + 1: jnp.imag(pairs[..., k, :])}
    return jnp.stack([rows[row] for row in range(SIZE)], -2)
