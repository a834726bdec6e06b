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
ORDER_ONE = 1  # where the pair of degree 1 begins: the gradient
# Adds to the Gram matrix what 64 samples leave undetermined; higher degrees are smaller in pictures.
RIDGE = np.array([1e-3 * (1 + 2 * d) for d, m in TERMS for _ in range(2 if m else 1)])


def basis(u: Complex[Array, "*B"]) -> Float[Array, "*B {SIZE}"]:
    """Every term at the point u, lengths in mean vertex radii."""
    terms = []
    for degree, order in TERMS:
        radial = squared_modulus(u) ** ((degree - order) // 2) / RIM**degree
        power = u**order
        terms += [radial] if order == 0 else [radial * jnp.real(power), radial * jnp.imag(power)]
    return jnp.stack(terms, -1)


def least_squares(
    logs: Complex[Array, "*B S"], values: Float[Array, "*B S C"]
) -> Float[Array, "*B {SIZE} C"]:
    """The coefficients of the polynomial nearest to the values at the samples, slightly damped."""
    terms = basis(logs)
    samples = terms.shape[-2]
    gram = jnp.einsum("...si,...sj->...ij", terms, terms) / samples + jnp.diag(RIDGE)
    moments = jnp.einsum("...si,...sc->...ic", terms, values) / samples
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(gram), True), moments)


def upright(
    coefficients: Float[Array, "*B {SIZE} C"], direction: Complex[Array, "*B"]
) -> Float[Array, "*B {SIZE} C"]:
    """The same polynomial with `direction` (a unit complex number) as the x axis."""
    parts, start = [], 0
    for _, order in TERMS:
        if order == 0:
            parts.append(coefficients[..., start : start + 1, :])
            start += 1
            continue
        pair = jax.lax.complex(coefficients[..., start, :], coefficients[..., start + 1, :])
        pair = pair * jnp.conj(direction[..., None]) ** order
        parts.append(jnp.stack([jnp.real(pair), jnp.imag(pair)], -2))
        start += 2
    return jnp.concatenate(parts, -2)
