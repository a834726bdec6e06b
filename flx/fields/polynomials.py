"""Real polynomials on a tangent plane, for the smooth part of the colours in a one-ring.

A polynomial is Σ r^{d−m} (A Re u^m + B Im u^m) over degrees d and orders m = d, d−2, … ≥ 0. If the frame
turns by α, the pair A + iB of order m turns by e^{imα}, so least squares in this basis is equivariant.
Coefficients are listed by degree, then order, so a polynomial of lower degree is a prefix of a higher one.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float

from flx.fields.algebra import squared_modulus

RIM = 1.9  # typical radius of a one-ring, in mean vertex radii; terms are scaled to about 1 there
NEAR = 1.0  # width of the Gaussian weights in a fit, in mean vertex radii; most queries are closer than that


def terms(degree: int) -> list[tuple[int, int]]:
    """(degree, order) of each coefficient (order 0) or pair of coefficients."""
    return [(d, m) for d in range(degree + 1) for m in range(d % 2, d + 1, 2)]


def size(degree: int) -> int:
    """The number of coefficients, (degree + 1) (degree + 2) / 2."""
    return (degree + 1) * (degree + 2) // 2


def coefficient_rows(degree: int) -> tuple[list[int], list[int], list[int]]:
    """The indices of the coefficients of order 0, those of the first of each pair, and the pairs' orders."""
    listed = [(d, m) for d, m in terms(degree) for _ in range(2 if m else 1)]
    pairs = [i for i, term in enumerate(listed) if term[1] and listed[i - 1] != term]
    return [i for i, (_, m) in enumerate(listed) if m == 0], pairs, [listed[i][1] for i in pairs]


def basis(u: Complex[Array, "*B"], degree: int) -> Float[Array, "*B N"]:
    """All terms at the point u, which is in mean vertex radii."""
    squared, powers = squared_modulus(u / RIM), [jnp.ones_like(u)]
    for _ in range(degree):
        powers.append(powers[-1] * u / RIM)
    values = []
    for d, m in terms(degree):
        radial = squared ** ((d - m) // 2)
        values += [radial * jnp.real(powers[m]), radial * jnp.imag(powers[m])] if m else [radial]
    return jnp.stack(values, -1)


def least_squares(
    logs: Complex[Array, "*B S"], values: Float[Array, "*B S C"], degree: int
) -> Float[Array, "*B N C"]:
    """The coefficients of the polynomial closest to the samples: weighted least squares with a ridge.

    The ridge grows with the degree, because in images coefficients of high degree are small.
    """
    near = jnp.exp(-squared_modulus(logs) / (2 * NEAR**2))
    weights = (near / jnp.sum(near, -1, keepdims=True))[..., None]
    design = basis(logs, degree)
    ridge = np.array([1e-3 * (1 + 2 * d) for d, m in terms(degree) for _ in range(2 if m else 1)])
    exact = jax.lax.Precision.HIGHEST  # GPUs by default round to 10 bits, an error as large as the ridge
    gram = jnp.einsum("...si,...sj->...ij", weights * design, design, precision=exact) + jnp.diag(ridge)
    moments = jnp.einsum("...si,...sc->...ic", weights * design, values, precision=exact)
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(gram), True), moments)


def by_order(
    coefficients: Float[Array, "*B N C"], degree: int
) -> tuple[Float[Array, "*B N0 C"], Complex[Array, "*B N1 C"]]:
    """The coefficients of order 0, and those of other orders as complex numbers A + iB."""
    zeroth, pairs, _ = coefficient_rows(degree)
    first = np.array(pairs)
    both = jax.lax.complex(coefficients[..., first, :], coefficients[..., first + 1, :])
    return coefficients[..., np.array(zeroth), :], both


def from_orders(
    zeroth: Float[Array, "*B N0 C"], pairs: Complex[Array, "*B N1 C"], degree: int
) -> Float[Array, "*B N C"]:
    """The inverse of `by_order`."""
    constant, first, _ = coefficient_rows(degree)
    listed = jnp.concatenate([zeroth, jnp.real(pairs), jnp.imag(pairs)], -2)
    return listed[..., np.argsort([*constant, *first, *(i + 1 for i in first)]), :]
